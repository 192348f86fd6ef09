"""Checks of the link beyond the preflight list: the port, who sends on it, delay, loss, load and
clocks. A check is a function of an `Observation`; it returns nothing where there is nothing to
say."""

from __future__ import annotations

from collections.abc import Iterable

from offboard.doctor.observation import Observation
from offboard.flight.preflight import TELEMETRY, Finding, Level
from offboard.link.connection import BITS_OF_A_BYTE
from offboard.mavlink.telemetry import SHARE

BAUDS = (57600, 115200, 230400, 460800, 921600)
LOST_SHARE, FULL_SHARE, ENOUGH = 0.02, 0.9, 0.7
LATE_S, REAL_TIME = 0.25, 0.05
FOREIGN_TIMES = 3
ALL_ADDRESSES = "listen on all addresses: --connect udpin:0.0.0.0:PORT"
BRIDGES = {
    "": "if it runs elsewhere, " + ALL_ADDRESSES,
    "WSL": "if it runs on Windows, send to the address that `hostname -I` prints here, and "
    + ALL_ADDRESSES,
    "container": "if it runs outside of this container, start it with --network host, or with "
    "-p PORT:PORT/udp and " + ALL_ADDRESSES,
}
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


def ok(found: str) -> Finding:
    return Finding(Level.OK, found)


def warn(found: str, hint: str = "", about: str = "") -> Finding:
    return Finding(Level.WARN, found, hint, about)


def wait(found: str, hint: str = "") -> Finding:
    return Finding(Level.WAIT, found, hint)


def blocks(found: str, hint: str = "") -> Finding:
    return Finding(Level.BLOCKS, found, hint)


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
    found, kind = seen.vehicle.found, _kind(seen)
    if seen.link_error:
        return
    if found:
        yield ok(f"{found.autopilot}, system {found.system_id}")
    elif any(sender.is_autopilot for sender in seen.senders):
        yield blocks(seen.not_found or "the autopilot is neither PX4 nor ArduCopter")
    elif seen.senders:
        names = ", ".join(sender.name for sender in seen.senders[:4])
        hint = "let the autopilot, or the router before it, send to this port"
        yield blocks(f"MAVLink is heard, but no autopilot: {names}", hint)
    elif seen.link.bytes_received:
        hint = "check the baud rate, or which program sends to this port"
        yield blocks(f"{seen.link.bytes_received} bytes are heard that are not MAVLink", hint)
    else:
        hint = SILENT.get(kind, STARTED)
        if "127.0.0.1" in seen.connection and kind == "udpin":
            hint += f"; {BRIDGES[seen.surroundings]}"
        yield blocks(f"nothing is heard in {seen.listened_s:.0f} s", hint)


def senders(seen: Observation) -> Iterable[Finding]:
    """Other vehicles, ground stations and controllers on the link."""
    found = seen.vehicle.found
    if found is None:
        return
    ours = found.system_id, found.component_id
    others = []
    for sender in seen.senders:
        places = ", ".join(sorted(sender.places))
        if (sender.system_id, sender.component_id) != ours:
            others.append(f"{sender.name}, from {places}" if sender.is_autopilot else sender.name)
        elif len(sender.places) > 1:
            yield warn(
                f"two programs send as vehicle {ours[0]}/{ours[1]}: {places}",
                "give each vehicle its own system id (MAV_SYS_ID, SYSID_THISMAV) and port",
            )
    yield ok("besides the vehicle: " + ("; ".join(others) or "nobody"))


def uplink(seen: Observation) -> Iterable[Finding]:
    """Whether what we send reaches the vehicle: it acknowledges commands without effect."""
    if seen.vehicle.found is None or not seen.link.commands_sent:
        return
    if seen.link.acknowledged:
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
    link = seen.link
    if seen.vehicle.found is None:
        return
    if link.delay is None:
        yield wait("TIMESYNC is not answered: the delay of the link is unknown")
        return
    trip = "" if link.round_trip_s is None else f", round trip {1e3 * link.round_trip_s:.0f} ms"
    figures = f"delay {1e3 * link.delay.value:.0f} +- {1e3 * link.delay.sd:.0f} ms{trip}"
    if link.late_s > LATE_S:
        yield warn(f"{figures}, but telemetry came up to {1e3 * link.late_s:.0f} ms late")
    else:
        yield ok(figures)


def loss(seen: Observation) -> Iterable[Finding]:
    """Frames that are lost, and bytes that are damaged."""
    found = seen.vehicle.found
    ours = (found.system_id, found.component_id) if found else None
    sender = next((s for s in seen.senders if (s.system_id, s.component_id) == ours), None)
    if sender is None:
        return
    share = sender.lost / (sender.frames + sender.lost)
    damaged = seen.link.bytes_skipped / max(seen.link.bytes_received, 1)
    figures = f"{share:.1%} of the frames lost, {damaged:.1%} of the bytes damaged"
    if share > LOST_SHARE or damaged > LOST_SHARE:
        yield warn(figures, "move closer, or use another channel, a cable or a better radio")
    else:
        yield ok(figures)


def bandwidth(seen: Observation) -> Iterable[Finding]:
    """Whether the link carries the telemetry that a flight requests."""
    link = seen.link
    if seen.vehicle.found is None:
        return
    figures = f"{link.bytes_ps / 1e3:.1f} kB/s received"
    if link.capacity_bytes_ps is None:
        yield ok(figures)
        return
    most = link.capacity_bytes_ps
    figures += f", the link carries {most / 1e3:.1f} kB/s"
    if link.wanted_bytes_ps > FULL_SHARE * most:
        needed = link.wanted_bytes_ps / SHARE
        baud = next((each for each in BAUDS if each >= BITS_OF_A_BYTE * needed), BAUDS[-1])
        yield warn(
            f"{figures}; the telemetry of a flight needs {needed / 1e3:.1f} kB/s",
            f"use at least {baud} baud",
        )
    elif link.bytes_ps > FULL_SHARE * most:
        first = sorted(link.messages_bytes_ps, key=lambda name: -link.messages_bytes_ps[name])[:4]
        hint = "lower the rates of messages that nobody needs (PX4: MAV_x_RATE, ArduPilot: SRx_*)"
        yield warn(f"{figures}; most of it is {', '.join(first)}", hint)
    else:
        yield ok(figures)


def rates(seen: Observation) -> Iterable[Finding]:
    """Rates of the telemetry that a flight needs."""
    link = seen.link
    if seen.vehicle.found is None:
        return
    figures = ", ".join(f"{name} {link.rates_hz.get(name, 0.0):.0f} Hz" for name in TELEMETRY)
    slow = [
        f"{each.name} {link.rates_hz.get(each.name, 0.0):.1f} of {each.rate_hz:g} Hz"
        for each in link.wanted
        if not each.optional and link.rates_hz.get(each.name, 0.0) < ENOUGH * each.rate_hz
    ]
    if not link.requested:
        yield ok(f"{figures}; not requested, since the vehicle is armed")
    elif slow:
        hint = seen.dialect.slow_hint if seen.dialect else ""
        yield warn(f"slower than requested: {', '.join(slow)}", hint)
    else:
        yield ok(figures)


def clock(seen: Observation) -> Iterable[Finding]:
    """The vehicle's clock, and whether somebody else sets it."""
    measured, found = seen.clock, seen.vehicle.found
    if found is None:
        return
    if measured.rebooted:
        hint = "find out why, then check again"
        yield blocks("the vehicle restarted while it was observed", hint)
    if measured.jumped_s:
        yield blocks(f"the vehicle's clock jumped by {measured.jumped_s:.1f} s")
    masters = [s.name for s in seen.senders if s.times and s.system_id != found.system_id]
    if seen.link.foreign_timesync > FOREIGN_TIMES:
        masters.append(
            f"the sender of {seen.link.foreign_timesync} requests that are answered here"
        )
    if masters:
        hint = "let one program alone exchange TIMESYNC with the vehicle"
        yield warn(f"another time master: {', '.join(masters)}", hint)
    if measured.rate is not None:
        figures = f"the vehicle's clock runs {measured.rate:.3f} times as fast as this computer's"
        yield warn(figures) if abs(measured.rate - 1.0) > REAL_TIME else ok(figures)


def _kind(seen: Observation) -> str:
    return seen.connection.partition(":")[0]
