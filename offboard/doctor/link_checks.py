"""What is said of the link beside the preflight list: the port, who sends on it, delay, loss, load
and clocks. A check is a function of an `Observation`; it returns nothing where there is nothing to
say. All but the first two need a vehicle that was found."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial

from offboard.doctor.listening import Observation
from offboard.flight.preflight import TELEMETRY, Finding, Level
from offboard.flight.timing import REAL_TIME
from offboard.link.connection import BITS_OF_A_BYTE
from offboard.mavlink.events import CommandAck
from offboard.mavlink.telemetry import SHARE

BAUDS = (57600, 115200, 230400, 460800, 921600)
LOST_SHARE, FULL_SHARE = 0.02, 0.9
LATE_S = 0.25
FOREIGN_TIMES = 3
ELSEWHERE = (
    "if it runs elsewhere, listen on all addresses (--connect udpin:0.0.0.0:PORT); into a "
    "container publish the port (-p PORT:PORT/udp), from Windows send to the address that "
    "`hostname -I` prints in WSL"
)
STARTED = "start the vehicle, or the router before it, and let it send to this port"
SILENT = {  # by kind of connection: what to do when nothing is heard
    "udpout": "start the vehicle, and check the address",
    "tcp": "check which program listens there: it sends nothing",
    "tcpin": STARTED,
    "serial": "check baud rate and TX wire, and that the autopilot's port speaks MAVLink (PX4: "
    "MAV_x_CONFIG, ArduPilot: SERIALx_PROTOCOL 2)",
}
CLOSED = {  # why it cannot be opened
    "tcp": "start the vehicle, or the router, that listens there; ArduPilot's SITL listens on 5760",
    "serial": "plug it in, and see `ls /dev/serial/by-id`; may this user read it (group dialout)?",
}
ok, warn = partial(Finding, Level.OK), partial(Finding, Level.WARN)
wait, blocks = partial(Finding, Level.WAIT), partial(Finding, Level.BLOCKS)


def port(seen: Observation) -> Iterable[Finding]:
    """Whether the connection can be opened, and which other process has it."""
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
    """Whether an autopilot that can be flown is heard, and what is heard if none is."""
    found, heard, kind = seen.found, seen.heard, _kind(seen)
    senders, received = heard.senders.found, heard.senders.splitter.bytes_received
    if seen.link_error:
        return
    if found:
        yield ok(f"{found.autopilot}, system {found.system_id}")
    elif autopilots := [sender for sender in senders if sender.is_autopilot]:
        why = heard.session.senders.why_none()
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
        yield blocks(f"nothing is heard in {heard.listened_s:.0f} s", hint)


def senders(seen: Observation) -> Iterable[Finding]:
    """Other vehicles, ground stations and controllers on the link."""
    others = []
    for sender in seen.heard.senders.found:
        if sender.ids != _ids(seen) or len(sender.peers) > 1:
            peers = f", from {', '.join(sorted(sender.peers))}" if sender.is_autopilot else ""
            others.append(f"{sender.name}{peers}")
    yield ok("besides the vehicle: " + ("; ".join(others) or "nobody"))


def uplink(seen: Observation) -> Iterable[Finding]:
    """Whether what we send reaches the vehicle: it acknowledges commands without effect."""
    if not seen.heard.has_asked:
        return
    if CommandAck in seen.vehicle.heard_s:
        yield ok("the vehicle acknowledges our commands, so that heartbeat and texts reach it")
    elif seen.vehicle.parameters:
        yield warn("parameters are answered, but no command is acknowledged")
    else:
        yield blocks(
            "the vehicle answers nothing: what is sent to it does not arrive",
            "check the direction to the vehicle: router, firewall, TX wire; or another program "
            "has taken the vehicle's answers",
        )


def delay(seen: Observation) -> Iterable[Finding]:
    """Delay and jitter of the link by TIMESYNC, and telemetry that comes late."""
    delay, late_s = seen.heard.clock.delay, seen.heard.late_s
    if delay is None:
        return
    figures = f"delay {1e3 * delay.value:.0f} +- {1e3 * delay.sd:.0f} ms"
    if late_s > LATE_S:
        yield warn(f"{figures}, but telemetry came up to {1e3 * late_s:.0f} ms late")
    else:
        yield ok(figures)


def loss(seen: Observation) -> Iterable[Finding]:
    """Frames that are lost, and bytes that are damaged."""
    senders = seen.heard.senders
    sender = next((each for each in senders.found if each.ids == _ids(seen)), None)
    if sender is None:
        return
    lost, received = senders.lost(sender), senders.splitter
    share = lost / (sender.frames + lost)
    damaged = received.bytes_skipped / max(received.bytes_received, 1)
    figures = f"{share:.1%} of the frames lost, {damaged:.1%} of the bytes damaged"
    if share > LOST_SHARE or damaged > LOST_SHARE:
        yield warn(figures, "move closer, or use another channel, a cable or a better radio")
    else:
        yield ok(figures)


def bandwidth(seen: Observation) -> Iterable[Finding]:
    """Whether the link carries the telemetry that a flight requests."""
    heard, session = seen.heard, seen.heard.session
    figures = f"{heard.bytes_ps / 1e3:.1f} kB/s received"
    most, wanted = session.settings.capacity_bytes_ps, session.telemetry.bytes_ps
    if most is None:
        yield ok(figures)
        return
    figures += f", the link carries {most / 1e3:.1f} kB/s"
    if wanted > FULL_SHARE * most:
        needed = wanted / SHARE
        baud = next((each for each in BAUDS if each >= BITS_OF_A_BYTE * needed), BAUDS[-1])
        yield warn(
            f"{figures}; the telemetry of a flight needs {needed / 1e3:.1f} kB/s",
            f"use at least {baud} baud",
        )
    elif heard.bytes_ps > FULL_SHARE * most:
        first = ", ".join(name for name, _ in heard.senders.message_bytes.most_common(4))
        hint = "lower the rates of messages that nobody needs (PX4: MAV_x_RATE, ArduPilot: SRx_*)"
        yield warn(f"{figures}; most of it is {first}", hint)
    else:
        yield ok(figures)


def rates(seen: Observation) -> Iterable[Finding]:
    """Rates of the telemetry that a flight needs."""
    rates_hz = seen.heard.session.telemetry.rates_hz
    figures = ", ".join(f"{name} {rates_hz.get(name, 0.0):.0f} Hz" for name in TELEMETRY)
    slow = [
        f"{each.name} {rates_hz.get(each.name, 0.0):.1f} of {each.rate_hz:g} Hz"
        for each in seen.heard.slow(lambda each: each.rate_hz)
    ]
    if not seen.heard.requested:
        yield ok(f"{figures}; not requested, since the vehicle is armed")
    elif slow:
        yield warn(f"slower than requested: {', '.join(slow)}", seen.dialect.slow_hint)
    else:
        yield ok(figures)


def clock(seen: Observation) -> Iterable[Finding]:
    """The vehicle's clock, and whether somebody else sets it."""
    heard, (system_id, _) = seen.heard, _ids(seen)
    if heard.rebooted:
        hint = "find out why, then check again"
        yield blocks("the vehicle restarted while it was observed", hint)
    if heard.clock.jumped_s:
        yield blocks(f"the vehicle's clock jumped by {heard.clock.jumped_s:.1f} s")
    masters = [s.name for s in heard.senders.found if s.times and s.system_id != system_id]
    if heard.foreign_replies > FOREIGN_TIMES:
        masters.append(f"the sender of {heard.foreign_replies} requests that are answered here")
    if masters:
        hint = "let one program alone exchange TIMESYNC with the vehicle"
        yield warn(f"another time master: {', '.join(masters)}", hint)
    rate = heard.clock.telemetry_rate
    if rate is not None:
        figures = f"the vehicle's clock runs {rate:.3f} times as fast as this computer's"
        yield warn(figures) if abs(rate - 1.0) > REAL_TIME else ok(figures)


def _kind(seen: Observation) -> str:
    return seen.connection.partition(":")[0]


def _ids(seen: Observation) -> tuple[int, int]:
    """System and component of the vehicle."""
    found = seen.found
    assert found is not None
    return found.system_id, found.component_id
