"""Checks of the link, the vehicle and the planned flight, in addition to the preflight list.

A check is a function of an `Observation`; it returns nothing if there is nothing to report. Those
in OF_VEHICLE run only if a vehicle of a fit type was found. The docstring of a check is its line in
`--list`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from functools import partial

from offboard.control.bandwidth import supported_bandwidth
from offboard.doctor.listening import Observation
from offboard.documents.errors import DocumentError
from offboard.flight.preflight import TELEMETRY, Finding, Level
from offboard.flight.timing import REAL_TIME
from offboard.identification.vehicle_estimate import SDS
from offboard.link.connection import BITS_OF_A_BYTE
from offboard.link.interface import peer_name
from offboard.mavlink.decode import FIX_3D
from offboard.mavlink.events import CommandAck
from offboard.mavlink.telemetry import SHARE
from offboard.model.vehicle import DelayUncertainty
from offboard.reference.feasibility import check
from offboard.run.configuration import UNKNOWN_VEHICLE, build_track

Check = Callable[[Observation], Iterable[Finding]]

BAUDS = (57600, 115200, 230400, 460800, 921600)
LOST_SHARE, FULL_SHARE = 0.02, 0.9  # share of frames or bytes, share of the link's capacity
LATE_S = 0.25  # age of telemetry beyond the least
FOREIGN_TIMES = 3  # replies to TIMESYNC requests of another program; more are a warning
ELSEWHERE = (
    "if it runs elsewhere, listen on all addresses (--connect udpin:0.0.0.0:PORT); into a "
    "container publish the port (-p PORT:PORT/udp), from Windows send to the address that "
    "`hostname -I` prints in WSL"
)
STARTED = "start the vehicle, or the router before it, and let it send to this port"
SILENT = {  # what to do when nothing is heard, by kind of connection
    "udpout": "start the vehicle, and check the address",
    "tcp": "check which program listens there: it sends nothing",
    "tcpin": STARTED,
    "serial": "check baud rate and TX wire, and that the autopilot's port speaks MAVLink (PX4: "
    "MAV_x_CONFIG, ArduPilot: SERIALx_PROTOCOL 2)",
}
CLOSED = {  # what to do when it cannot be opened, by kind of connection
    "tcp": "start the vehicle, or the router, that listens there; ArduPilot's SITL listens on 5760",
    "serial": "plug it in, and see `ls /dev/serial/by-id`; may this user read it (group dialout)?",
}
LOW_BATTERY = 0.3  # remaining charge, 0 .. 1
SUSPICIOUS_RATIO = 0.5  # innovation ratio; the estimator rejects a measurement above 1
RELEASE = 255  # FIRMWARE_VERSION_TYPE
KINDS = {0: "development", 64: "alpha", 128: "beta", 192: "release candidate", RELEASE: "release"}
TEXTS = 2  # newest STATUSTEXT of the vehicle that are shown
HOVER_FACTOR = 1.3  # largest ratio of the hover thrusts in vehicle file and autopilot, either way
ok, warn = partial(Finding, Level.OK), partial(Finding, Level.WARN)
wait, blocks = partial(Finding, Level.WAIT), partial(Finding, Level.BLOCKS)


def port(seen: Observation) -> Iterable[Finding]:
    """Whether the connection can be opened, and which other processes use it."""
    others = ", ".join(seen.holders)
    if seen.link_error:
        known = CLOSED.get(_kind(seen), "check host and port, see `offboard doctor --help`")
        hint = f"stop {others}, or use another port" if others else known
        yield blocks(seen.link_error + (f": {others}" if others else ""), hint)
    elif others:
        yield warn(f"{others} reads from {seen.connection}, too", f"stop {others}")
    else:
        yield ok(f"{seen.connection} is open")


def vehicle(seen: Observation) -> Iterable[Finding]:
    """Whether an autopilot that can be flown is heard; otherwise, what is received."""
    found, senders, kind = seen.found, seen.senders.found, _kind(seen)
    received = seen.senders.splitter.bytes_received
    if seen.link_error:
        return
    if found:
        yield ok(f"{found.autopilot}, system {found.system_id}")
    elif autopilots := [sender for sender in senders if sender.is_autopilot]:
        why = seen.session.senders.why_none()
        yield blocks(why or f"{autopilots[0].name} is neither PX4 nor ArduCopter")
    elif senders:
        names = ", ".join(sender.name for sender in senders[:4])
        hint = "let the autopilot, or the router before it, send to this port"
        yield blocks(f"MAVLink is heard, but no autopilot: {names}", hint)
    elif received:
        hint = "check the baud rate, or which program sends to this port"
        yield blocks(f"{received} bytes are heard that are not MAVLink", hint)
    else:
        hint = SILENT.get(kind, STARTED)
        if "127.0.0.1" in seen.connection and kind == "udpin":
            hint += f"; {ELSEWHERE}"
        yield blocks(f"nothing is heard in {seen.listened_s:.0f} s", hint)


def senders(seen: Observation) -> Iterable[Finding]:
    """Other vehicles, ground stations and controllers on the link."""
    others = []
    for sender in seen.senders.found:
        peers = sender.peers
        if sender.ids == _ids(seen):
            if sender.shared:
                shared = "another program sends with the ids of the vehicle, system {} component {}"
                yield warn(shared.format(*sender.ids), "give it another component id")
            peers = peers - {peer_name(seen.session.peer)}
        if peers:
            places = f", from {', '.join(sorted(peers))}" if sender.is_autopilot else ""
            others.append(f"{sender.name}{places}")
    yield ok("other senders: " + ("; ".join(others) or "none"))


def uplink(seen: Observation) -> Iterable[Finding]:
    """Whether our messages reach the vehicle: it must acknowledge commands that change nothing."""
    if not seen.has_asked:
        return
    if CommandAck in seen.vehicle.heard_s:
        yield ok("the vehicle acknowledges our commands, so that heartbeat and texts reach it")
    elif seen.vehicle.parameters:
        yield warn("parameters are answered, but no command is acknowledged")
    else:
        yield blocks(
            "the vehicle does not reply: our messages do not reach it",
            "check the direction to the vehicle: router, firewall, TX wire; or another program "
            "has taken the vehicle's answers",
        )


def delay(seen: Observation) -> Iterable[Finding]:
    """Delay and jitter of the link by TIMESYNC, and telemetry that comes late."""
    delay, late_s = seen.clock.delay, seen.late_s
    if delay is None:
        return
    figures = f"delay {1e3 * delay.value:.0f} +- {1e3 * delay.sd:.0f} ms"
    if late_s > LATE_S:
        yield warn(f"{figures}, but telemetry came up to {1e3 * late_s:.0f} ms late")
    else:
        yield ok(figures)


def loss(seen: Observation) -> Iterable[Finding]:
    """Frames that are lost, and bytes that are damaged."""
    senders = seen.senders
    sender = next((each for each in senders.found if each.ids == _ids(seen)), None)
    if sender is None:
        return
    received, share = senders.splitter, 0.0
    damaged = received.bytes_skipped / max(received.bytes_received, 1)
    figures = f"{damaged:.1%} of the bytes damaged"
    # else two programs may count, or one vehicle that has changed its port
    if len(sender.peers) == 1 and not sender.shared:
        lost = senders.lost(sender)
        share = lost / (sender.frames + lost)
        figures = f"{share:.1%} of the frames lost, {figures}"
    if share > LOST_SHARE or damaged > LOST_SHARE:
        yield warn(figures, "move closer, or use another channel, a cable or a better radio")
    else:
        yield ok(figures)


def bandwidth(seen: Observation) -> Iterable[Finding]:
    """Whether the link carries the telemetry that a flight requests."""
    session = seen.session
    figures = f"{seen.bytes_ps / 1e3:.1f} kB/s received"
    most, wanted = session.settings.capacity_bytes_ps, session.telemetry.bytes_ps
    if most is None:
        yield ok(figures)
        return
    figures += f", the link can carry {most / 1e3:.1f} kB/s"
    if wanted > FULL_SHARE * most:
        needed = wanted / SHARE
        baud = next((each for each in BAUDS if each >= BITS_OF_A_BYTE * needed), BAUDS[-1])
        yield warn(
            f"{figures}; the telemetry of a flight needs {needed / 1e3:.1f} kB/s",
            f"use at least {baud} baud",
        )
    elif seen.bytes_ps > FULL_SHARE * most:
        first = ", ".join(name for name, _ in seen.senders.message_bytes.most_common(4))
        hint = "lower the rates of messages that nobody needs (PX4: MAV_x_RATE, ArduPilot: SRx_*)"
        yield warn(f"{figures}; most of it is {first}", hint)
    else:
        yield ok(figures)


def rates(seen: Observation) -> Iterable[Finding]:
    """Rates of the telemetry that a flight needs."""
    rates_hz = seen.session.telemetry.rates_hz
    figures = ", ".join(f"{name} {rates_hz.get(name, 0.0):.0f} Hz" for name in TELEMETRY)
    slow = [
        f"{each.name} {rates_hz.get(each.name, 0.0):.1f} of {each.rate_hz:g} Hz"
        for each in seen.slow(lambda each: each.rate_hz)
    ]
    if not seen.rates_requested:
        yield ok(f"{figures}; not requested, since the vehicle is armed")
    elif slow and seen.vehicle.has_state:  # else the preflight list says what is missing
        yield warn(f"slower than requested: {', '.join(slow)}", seen.known_dialect.slow_hint)
    elif not slow:
        yield ok(figures)


def clock(seen: Observation) -> Iterable[Finding]:
    """The vehicle's clock, and whether another program exchanges TIMESYNC with the vehicle."""
    system_id, _ = _ids(seen)
    if seen.rebooted:
        hint = "find out why, then check again"
        yield blocks("the vehicle restarted while it was observed", hint)
    if seen.clock.jumped_s:
        yield blocks(f"the vehicle's clock jumped by {seen.clock.jumped_s:.1f} s")
    masters = [s.name for s in seen.senders.found if s.times and s.system_id != system_id]
    if not masters and seen.foreign_replies > FOREIGN_TIMES:
        masters.append(f"the sender of {seen.foreign_replies} requests that are answered here")
    if len(masters) > 1:  # we do not answer the vehicle's requests, and one may
        hint = "let one program alone answer the vehicle's TIMESYNC: that which sends it vision"
        yield warn(f"several time masters: {', '.join(masters)}", hint)
    elif masters:
        yield ok(f"time master: {masters[0]}")
    rate = seen.clock.telemetry_rate
    if rate is not None:
        figures = f"the vehicle's clock runs {rate:.3f} times as fast as this computer's"
        yield warn(figures) if abs(rate - 1.0) > REAL_TIME else ok(figures)


def firmware(seen: Observation) -> Iterable[Finding]:
    """Version of the autopilot, and known defects of that version."""
    version, dialect = seen.vehicle.version, seen.known_dialect
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
    defects = [what for what, fixed_in in dialect.defects.items() if number < fixed_in]
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
    fix_type = seen.fix_type
    if fix_type == FIX_3D:
        yield ok("3D fix")
        return
    names = {None: "GPS_RAW_INT is not sent", 0: "no GPS is connected", 1: "no fix", 2: "2D fix"}
    found = names.get(fix_type, f"fix type {fix_type}")
    report = seen.vehicle.estimator
    if report and not report.problem:
        hints = "check that it has another source", seen.known_dialect.without_gps
        yield warn(
            f"{found}; the estimator still has a position", ", and ".join(filter(None, hints))
        )
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
    unanswered = [parameter.name for parameter in seen.known_dialect.without_reply(known)]
    for parameter in seen.known_dialect.watched_parameters:
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
    vehicle, name = seen.config.vehicle, seen.known_dialect.hover_parameter
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
    for name, unit in seen.known_dialect.tilt_parameters.items():
        value = seen.vehicle.parameters.get(name)
        if value is not None and needed_rad > value * unit:
            enough = math.ceil(math.degrees(needed_rad) + 1.0) * math.radians(1.0) / unit
            yield warn(
                f"the reference tilts by {math.degrees(needed_rad):.0f} deg, the autopilot's own "
                f"modes by at most {math.degrees(value * unit):.0f} deg ({name})",
                f"fly slower, or param set {name} {enough:g}",
            )


def _bandwidth(seen: Observation) -> Iterable[Finding]:
    config, delay = seen.config, seen.clock.delay
    wanted = getattr(config.controller, "bandwidth_radps", None)
    if wanted is None or delay is None:
        return
    uncertainty = DelayUncertainty(SDS * delay.sd, SDS * delay.sd, link_s=delay.value)
    possible = min(supported_bandwidth(config.vehicle, uncertainty, config.period_s, wanted))
    if possible < wanted:
        yield warn(
            f"with a delay of {1e3 * delay.value:.0f} +- {1e3 * delay.sd:.0f} ms the link allows a "
            f"bandwidth of {possible:g} rad/s, {wanted:g} is configured",
            f"the flight lowers it automatically; or --set controller.bandwidth_radps={possible:g}",
        )


def _kind(seen: Observation) -> str:
    return seen.connection.partition(":")[0]


def _ids(seen: Observation) -> tuple[int, int]:
    """System id and component id of the vehicle."""
    found = seen.found
    assert found is not None
    return found.system_id, found.component_id


# In the order of the report: link, vehicle, flight
OF_LINK: tuple[Check, ...] = (port, vehicle)
OF_VEHICLE: tuple[Check, ...] = (
    senders, uplink, delay, loss, bandwidth, rates, clock,
    firmware, state, estimator, gps, prearm, battery, parameters,
)  # fmt: skip
OF_FLIGHT: tuple[Check, ...] = (configuration,)
