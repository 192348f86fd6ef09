"""What is said of the vehicle and of the planned flight beside the preflight list. All but the last
check need a vehicle that was found."""

from __future__ import annotations

import math
from collections.abc import Iterable

from offboard.control.bandwidth import supported_bandwidth
from offboard.doctor.link_checks import blocks, ok, wait, warn
from offboard.doctor.listening import Observation
from offboard.documents.errors import DocumentError
from offboard.flight.preflight import Finding
from offboard.identification.vehicle_estimate import SDS
from offboard.mavlink.decode import FIX_3D
from offboard.model.vehicle import DelayUncertainty
from offboard.reference.feasibility import check
from offboard.run.configuration import UNKNOWN_VEHICLE, build_track

LOW_BATTERY = 0.3
SUSPICIOUS_RATIO = 0.5
RELEASE = 255  # FIRMWARE_VERSION_TYPE
KINDS = {0: "development", 64: "alpha", 128: "beta", 192: "release candidate", RELEASE: "release"}
TEXTS = 2  # of the vehicle that are shown
HOVER_FACTOR = 1.3


def firmware(seen: Observation) -> Iterable[Finding]:
    """Version of the autopilot, and known defects of that version."""
    version, dialect = seen.vehicle.version, seen.dialect
    if version is None:
        yield warn("no reply for AUTOPILOT_VERSION")
        return
    kind = KINDS.get(version.kind, f"kind {version.kind}")
    name = f"{dialect.name} {version.major}.{version.minor}.{version.patch} ({kind})"
    number = version.major, version.minor
    if number < dialect.oldest:
        oldest = ".".join(map(str, dialect.oldest))
        yield warn(f"{name} is older than {oldest}, which nobody has tested", "update the firmware")
    elif version.kind != RELEASE:
        yield warn(f"{name} is no release", "install a release")
    defects = [each.what for each in dialect.defects if number < each.fixed_in]
    yield ok("; ".join((name, *(f"known defect: {each}" for each in defects))))


def state(seen: Observation) -> Iterable[Finding]:
    """Whether the vehicle is free: disarmed, in no failsafe, flown by nobody else."""
    vehicle = seen.vehicle
    if vehicle.heartbeat is None:
        return
    if vehicle.in_failsafe and not vehicle.armed:
        yield wait(f"disarmed, in {vehicle.mode}, in a failsafe")
    elif vehicle.armed:
        yield ok(f"armed, in {vehicle.mode}: pre-arm checks were not run, rates not requested")
    else:
        yield ok(f"disarmed, in {vehicle.mode}")


def estimator(seen: Observation) -> Iterable[Finding]:
    """The vehicle's position estimate: validity and innovation ratios."""
    report = seen.vehicle.estimator
    if report is None:
        yield wait("the vehicle does not report its estimator")
        return
    name, ratio = report.worst
    if SUSPICIOUS_RATIO < ratio <= 1.0:
        yield warn(f"innovation ratio of {name} is {ratio:.2f}; above 1 it is rejected")
    yield ok(f"largest innovation ratio {ratio:.2f} ({name})")


def gps(seen: Observation) -> Iterable[Finding]:
    """GPS fix."""
    fix_type = seen.heard.fix_type
    if fix_type == FIX_3D:
        yield ok("3D fix")
        return
    names = {None: "GPS_RAW_INT is not sent", 0: "no GPS is connected", 1: "no fix", 2: "2D fix"}
    found = names.get(fix_type, f"fix type {fix_type}")
    report = seen.vehicle.estimator
    if report and not report.problem:
        hint = "check that it has another source"
        yield warn(f"{found}; the estimator still has a position", hint)
    elif fix_type == 0:
        yield wait(found, "wait if the vehicle has just started, else connect a GPS")
    else:
        yield wait(found, "give the antenna a free sky and wait")


def prearm(seen: Observation) -> Iterable[Finding]:
    """The vehicle's own pre-arm checks, in its words (MAV_CMD_RUN_PREARM_CHECKS)."""
    vehicle = seen.vehicle
    if vehicle.armed or not vehicle.prearm_ok:
        return
    for text in list(dict.fromkeys(vehicle.texts))[-TEXTS:]:
        yield warn(f"the vehicle said while it was observed: {text}")
    yield ok(f"pre-arm checks pass in {vehicle.mode}")


def battery(seen: Observation) -> Iterable[Finding]:
    """Remaining charge."""
    health = seen.vehicle.health
    if health is None:
        return
    charge = health.battery_remaining
    if charge is None:
        yield ok("remaining charge is not reported")
    elif charge < LOW_BATTERY:
        yield warn(f"{charge:.0%} left", "charge the battery")
    else:
        yield ok(f"{charge:.0%} left")


def parameters(seen: Observation) -> Iterable[Finding]:
    """Parameters of the autopilot, with the line that sets each."""
    known, health = seen.vehicle.parameters, seen.vehicle.health
    radio, good = health is not None and health.radio_ok, []
    unanswered = [parameter.name for parameter in seen.dialect.unanswered(known)]
    for parameter in seen.dialect.watched_parameters:
        name, value = parameter.name, known.get(parameter.name)
        if value is None:
            continue
        advised = parameter.advised(value, known, radio)
        if parameter.fault(value) is None and advised:
            yield warn(*advised, about=name)
        elif advised is None:
            good.append(f"{name} {parameter.shown(value)}")
    parts = [", ".join(good), f"no reply for {', '.join(unanswered)}" if unanswered else ""]
    yield (ok if known else warn)("; ".join(filter(None, parts)))


def configuration(seen: Observation) -> Iterable[Finding]:
    """The planned flight against this vehicle: hover thrust, tilt, reference, bandwidth."""
    config, tilt_rad = seen.config, 0.0
    try:
        tilt_rad = check(build_track(config), config.vehicle).tilt_rad
    except DocumentError as error:
        yield blocks(str(error), "change the reference or the vehicle file")
    if seen.found:
        yield from _hover(seen)
        yield from _tilt(seen, tilt_rad)
        yield from _bandwidth(seen)
    yield ok(f"{config.reference.title} by {config.controller.law}, vehicle {config.vehicle.name}")


def _hover(seen: Observation) -> Iterable[Finding]:
    vehicle, name = seen.config.vehicle, seen.dialect.hover_parameter
    assumed, told = vehicle.hover_thrust, seen.vehicle.parameters.get(name)
    if vehicle.name == UNKNOWN_VEHICLE or not told:
        return
    if not 1.0 / HOVER_FACTOR < assumed / told < HOVER_FACTOR:
        yield warn(
            f"vehicle {vehicle.name} has hover_thrust {assumed:.3g}, the autopilot has "
            f"{name} {told:.3g}",
            f"use the file of this vehicle, --vehicle {UNKNOWN_VEHICLE} to have it identified, or "
            f"param set {name} {assumed:.3g}",
        )


def _tilt(seen: Observation, needed_rad: float) -> Iterable[Finding]:
    for name, unit in seen.dialect.tilt_parameters.items():
        value = seen.vehicle.parameters.get(name)
        if value is not None and needed_rad > value * unit:
            enough = math.ceil(math.degrees(needed_rad) + 1.0) * math.radians(1.0) / unit
            yield warn(
                f"the reference tilts by {math.degrees(needed_rad):.0f} deg, the autopilot's own "
                f"modes by at most {math.degrees(value * unit):.0f} deg ({name})",
                f"fly slower, or param set {name} {enough:g}",
            )


def _bandwidth(seen: Observation) -> Iterable[Finding]:
    config, delay = seen.config, seen.heard.clock.delay
    wanted = getattr(config.controller, "bandwidth_radps", None)
    if wanted is None or delay is None:
        return
    uncertainty = DelayUncertainty(SDS * delay.sd, SDS * delay.sd, link_s=delay.value)
    possible = min(supported_bandwidth(config.vehicle, uncertainty, config.period_s, wanted))
    if possible < wanted:
        yield warn(
            f"with a delay of {1e3 * delay.value:.0f} +- {1e3 * delay.sd:.0f} ms the link bears a "
            f"bandwidth of {possible:g} rad/s, {wanted:g} is configured",
            f"the flight lowers it by itself; or --set controller.bandwidth_radps={possible:g}",
        )
