"""Checks of the vehicle: firmware, state, estimator, GPS, pre-arm checks, battery, parameters."""

from __future__ import annotations

from collections.abc import Iterable

from offboard.doctor.findings import Finding, blocks, ok, wait, warn
from offboard.doctor.observation import FIX_3D, Observation
from offboard.flight.phases import Limits

LOW_BATTERY = 0.3
SUSPICIOUS_RATIO = 0.5
STARTED_S = 90.0  # of vehicle time: ArduCopter uses a GPS 30 s after its first 3D fix
RELEASE = 255  # FIRMWARE_VERSION_TYPE
KINDS = {0: "development", 64: "alpha", 128: "beta", 192: "release candidate", RELEASE: "release"}
TAIL = 2  # texts of a vehicle that are shown with a finding


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
    vehicle, limits = seen.vehicle, _limits(seen)
    if vehicle.heartbeat is None:
        return
    engaged = seen.dialect is not None and vehicle.mode == seen.dialect.engage_mode
    shown = f"{'armed' if vehicle.armed else 'disarmed'}, in {vehicle.mode}"
    if vehicle.armed and engaged and not limits.begin_engaged:
        yield blocks(f"{shown}: another controller flies it", "stop that controller")
    elif vehicle.armed and vehicle.in_failsafe and not limits.begin_in_failsafe:
        yield blocks(f"{shown}: a failsafe flies it", "let the pilot take over first")
    elif vehicle.in_failsafe:
        yield wait(f"{shown}, in a failsafe")
    elif vehicle.armed and not limits.begin_armed:
        yield blocks(f"{shown} (limits.begin_armed is false)", "disarm the vehicle")
    elif vehicle.armed and vehicle.landed == "unknown":
        yield blocks(f"{shown}, and does not report whether it flies (EXTENDED_SYS_STATE)")
    elif vehicle.armed:
        yield ok(f"{shown}: pre-arm checks were not run, rates not requested")
    else:
        yield ok(shown)


def estimator(seen: Observation) -> Iterable[Finding]:
    """The vehicle's position estimate: validity and innovation ratios."""
    report = seen.vehicle.estimator
    if report is None:
        if seen.dialect is not None:
            yield wait("the vehicle does not report its estimator")
        return
    name, ratio = report.worst
    hint = "wait for a GPS fix, keep the vehicle still, keep it away from metal; then calibrate"
    if ratio > 1.0:
        yield blocks(report.problem, hint)
    elif report.problem:
        starting = seen.fix_type != FIX_3D or seen.vehicle.time_s < STARTED_S
        level = wait if starting else blocks
        yield level(report.problem, hint)
    elif ratio > SUSPICIOUS_RATIO:
        yield warn(f"innovation ratio of {name} is {ratio:.2f}; above 1 it is rejected", hint)
    else:
        yield ok(f"valid; largest innovation ratio {ratio:.2f} ({name})")


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
    if report and report.position_ok and not report.problem:
        yield warn(
            f"{found}; the estimator still has a position", "check that it has another source"
        )
    elif seen.fix_type == 0:
        yield wait(found, "wait if the vehicle has just started, else connect a GPS")
    else:
        yield wait(found, "give the antenna a free sky and wait")


def prearm(seen: Observation) -> Iterable[Finding]:
    """The vehicle's own pre-arm checks, in its words (MAV_CMD_RUN_PREARM_CHECKS)."""
    vehicle = seen.vehicle
    if seen.dialect is None or vehicle.armed:
        return
    texts = seen.prearm_texts
    if vehicle.prearm_ok:
        for text in texts[:TAIL]:
            yield warn(f"reported while it was observed: {text}")
        yield ok(f"pre-arm checks pass in {vehicle.mode}")
    elif texts:
        for text in texts:
            yield wait(text)
    elif vehicle.health is None:
        yield wait("SYS_STATUS does not arrive: it is unknown whether the vehicle can arm")
    else:
        hold = seen.dialect.hold_mode
        hint = seen.dialect.unsaid
        found = f"pre-arm checks do not pass in {vehicle.mode}"
        if vehicle.health.unhealthy:
            found += f"; unhealthy by SYS_STATUS: {', '.join(vehicle.health.unhealthy)}"
        if vehicle.mode == seen.dialect.engage_mode:
            hint = f"it may only miss setpoints in {vehicle.mode}: select {hold} and check again"
        yield wait(found, hint)


def battery(seen: Observation) -> Iterable[Finding]:
    """Remaining charge."""
    health, limits = seen.vehicle.health, _limits(seen)
    if health is None:
        return
    charge = health.battery_remaining
    if charge is None:
        yield ok("remaining charge is not reported")
    elif charge < limits.battery:
        limit = f"limits.battery is {limits.battery:.0%}"
        yield blocks(f"{charge:.0%} left, {limit}", "charge the battery")
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
    good = []
    for parameter in dialect.watched_parameters:
        if parameter.name not in known:
            continue
        value = known[parameter.name]
        fault = parameter.fault(value)
        advised = parameter.advised(value, known, radio)
        if fault:
            yield blocks(*fault, about=parameter.name)
        elif advised:
            yield warn(*advised, about=parameter.name)
        else:
            good.append(f"{parameter.name} {parameter.shown(value)}")
    needed = {p.name for p in dialect.watched_parameters if p.must_answer}
    for name in seen.unanswered:
        if name in needed:
            yield blocks(f"no reply for {name}", "check the link to the vehicle", name)
    unanswered = [name for name in seen.unanswered if name not in needed]
    note = f"; no reply for {', '.join(unanswered)}" if unanswered else ""
    yield ok(", ".join(good) + note)


def _limits(seen: Observation) -> Limits:
    return seen.config.limits if seen.config else Limits()
