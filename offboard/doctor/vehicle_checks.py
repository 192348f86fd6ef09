"""Checks of the vehicle, the planned flight and this computer, beyond the preflight list."""

from __future__ import annotations

import math
from collections.abc import Iterable

from offboard.control.bandwidth import SDS, supported_bandwidth
from offboard.doctor.link_checks import blocks, ok, wait, warn
from offboard.doctor.observation import Observation
from offboard.flight.preflight import FIX_3D, Finding
from offboard.identification.uncertainty import Estimate
from offboard.model.vehicle import DelayUncertainty
from offboard.run.configuration import UNKNOWN_VEHICLE, FlightConfig

LOW_BATTERY = 0.3
SUSPICIOUS_RATIO = 0.5
RELEASE = 255  # FIRMWARE_VERSION_TYPE
KINDS = {0: "development", 64: "alpha", 128: "beta", 192: "release candidate", RELEASE: "release"}
TEXTS = 2  # of the vehicle that are shown
HOVER_FACTOR = 1.3
LEAST_FREE_BYTES = 500_000_000  # four hours of log
OVERSHOOT_S, CLOCK_STEP_S = 0.02, 0.05
MARGIN = 0.5  # of the deadline


def firmware(seen: Observation) -> Iterable[Finding]:
    """Version of the autopilot, and known defects of that version."""
    version, dialect = seen.vehicle.version, seen.dialect
    if dialect is None:
        return
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
        if seen.dialect is not None:
            yield wait("the vehicle does not report its estimator")
        return
    name, ratio = report.worst
    if SUSPICIOUS_RATIO < ratio <= 1.0:
        yield warn(f"innovation ratio of {name} is {ratio:.2f}; above 1 it is rejected")
    yield ok(f"largest innovation ratio {ratio:.2f} ({name})")


def gps(seen: Observation) -> Iterable[Finding]:
    """GPS fix."""
    if seen.dialect is None:
        return
    if seen.fix_type == FIX_3D:
        yield ok("3D fix")
        return
    names = {None: "GPS_RAW_INT is not sent", 0: "no GPS is connected", 1: "no fix", 2: "2D fix"}
    found = names.get(seen.fix_type, f"fix type {seen.fix_type}")
    report = seen.vehicle.estimator
    if report and not report.problem:
        hint = "check that it has another source"
        yield warn(f"{found}; the estimator still has a position", hint)
    elif seen.fix_type == 0:
        yield wait(found, "wait if the vehicle has just started, else connect a GPS")
    else:
        yield wait(found, "give the antenna a free sky and wait")


def prearm(seen: Observation) -> Iterable[Finding]:
    """The vehicle's own pre-arm checks, in its words (MAV_CMD_RUN_PREARM_CHECKS)."""
    vehicle = seen.vehicle
    if seen.dialect is None or vehicle.armed or not vehicle.prearm_ok:
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
    vehicle, dialect = seen.vehicle, seen.dialect
    if dialect is None or vehicle.found is None:
        return
    known, radio = vehicle.parameters, vehicle.health is not None and vehicle.health.radio_ok
    good, unanswered = [], []
    for parameter in dialect.watched_parameters:
        name, value = parameter.name, known.get(parameter.name)
        if value is None:
            unanswered.append(name)
            continue
        advised = parameter.advised(value, known, radio)
        if parameter.fault(value) is None and advised:
            yield warn(*advised, about=name)
        elif advised is None:
            good.append(f"{name} {parameter.shown(value)}")
    note = f"; no reply for {', '.join(unanswered)}" if unanswered else ""
    yield ok(", ".join(good) + note)


def configuration(seen: Observation) -> Iterable[Finding]:
    """The planned flight against this vehicle: hover thrust, tilt, reference, bandwidth."""
    config = seen.config
    if config is None:
        return
    if seen.config_problem:
        yield blocks(seen.config_problem, "change the reference or the vehicle file")
    yield from _hover(seen, config)
    yield from _tilt(seen)
    if seen.link.delay:
        yield from _bandwidth(seen.link.delay, config)
    yield ok(f"{config.reference.title} by {config.controller.law}, vehicle {config.vehicle.name}")


def _hover(seen: Observation, config: FlightConfig) -> Iterable[Finding]:
    dialect, assumed = seen.dialect, config.vehicle.hover_thrust
    if dialect is None or config.vehicle.name == UNKNOWN_VEHICLE:
        return
    told = seen.vehicle.parameters.get(dialect.hover_parameter)
    if told and not 1.0 / HOVER_FACTOR < assumed / told < HOVER_FACTOR:
        yield warn(
            f"vehicle {config.vehicle.name} has hover_thrust {assumed:.3g}, the autopilot has "
            f"{dialect.hover_parameter} {told:.3g}",
            f"use the file of this vehicle, --vehicle {UNKNOWN_VEHICLE} to have it identified, or "
            f"param set {dialect.hover_parameter} {assumed:.3g}",
        )


def _tilt(seen: Observation) -> Iterable[Finding]:
    dialect, needed = seen.dialect, seen.tilt_rad
    if dialect is None or needed is None:
        return
    name, unit = dialect.tilt_parameter
    value = seen.vehicle.parameters.get(name)
    if value is not None and needed > value * unit:
        enough = math.ceil(math.degrees(needed) + 1.0) * math.radians(1.0) / unit
        yield warn(
            f"the reference tilts by {math.degrees(needed):.0f} deg, the autopilot's own modes by "
            f"at most {math.degrees(value * unit):.0f} deg ({name})",
            f"fly slower, or param set {name} {enough:g}",
        )


def _bandwidth(delay: Estimate, config: FlightConfig) -> Iterable[Finding]:
    wanted = getattr(config.controller, "bandwidth_radps", None)
    if wanted is None:
        return
    uncertainty = DelayUncertainty(SDS * delay.sd, SDS * delay.sd, link_s=delay.value)
    possible = supported_bandwidth(config.vehicle, uncertainty, config.period_s, wanted)
    if possible < wanted:
        yield warn(
            f"with a delay of {1e3 * delay.value:.0f} +- {1e3 * delay.sd:.0f} ms the link bears a "
            f"bandwidth of {possible:g} rad/s, {wanted:g} is configured",
            f"the flight lowers it by itself; or --set controller.bandwidth_radps={possible:g}",
        )


def disk(seen: Observation) -> Iterable[Finding]:
    """Free space for the log of a flight."""
    free, place = seen.computer.free_bytes, seen.computer.directory
    if free is None:
        return
    figures = f"{free / 1e9:.1f} GB free in {place}"
    if free < LEAST_FREE_BYTES:
        yield warn(f"{figures}; a flight lands when its log cannot be written", "free some space")
    else:
        yield ok(figures)


def compiled(seen: Observation) -> Iterable[Finding]:
    """Whether the compiled functions are ready."""
    missing = seen.computer.not_compiled
    if missing is None:
        return
    if missing:
        found = f"{missing} functions are not compiled yet: the first flight begins late"
        yield warn(found, "run `offboard fly --sitl` once")
    else:
        yield ok("all functions are compiled")


def computer(seen: Observation) -> Iterable[Finding]:
    """Whether this computer decides and wakes up in time."""
    measured = seen.computer
    if measured.not_measured_s is not None:
        yield wait(
            f"reference and controller were not examined within {measured.not_measured_s:.0f} s",
            "close other programs and check again, or `offboard check` the configuration",
        )
    if measured.rehearsal:
        yield blocks(measured.rehearsal, "choose another controller, or a longer deadline_s")
    if measured.clock_step_s > CLOCK_STEP_S:
        yield warn(
            f"this computer's clock was set by {measured.clock_step_s:.2f} s while it listened",
            "let the clock settle (chrony, ntp); logs have wrong times",
        )
    if measured.decision_s is not None and measured.deadline_s:
        took_ms, most_ms = 1e3 * measured.decision_s, 1e3 * measured.deadline_s
        figures = f"a decision takes {took_ms:.1f} ms of {most_ms:.0f} ms"
        late = took_ms > MARGIN * most_ms and not measured.rehearsal
        yield (
            warn(figures, "close other programs, or allow more time (deadline_s)")
            if late
            else ok(figures)
        )
    if measured.overshoot_s is not None:
        figures = f"this computer wakes up at most {1e3 * measured.overshoot_s:.1f} ms late"
        hint = "close other programs; use the performance governor of the processor"
        yield warn(figures, hint) if measured.overshoot_s > OVERSHOOT_S else ok(figures)
