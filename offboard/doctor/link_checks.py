"""Checks of the link: the port, who sends on it, delay, loss, load and clocks."""

from __future__ import annotations

from collections.abc import Iterable

from offboard.doctor.findings import Finding, blocks, ok, wait, warn
from offboard.doctor.observation import Observation
from offboard.flight.assessment import MINIMUM_TELEMETRY_HZ
from offboard.flight.phases import Limits
from offboard.link.connection import BITS_OF_A_BYTE
from offboard.mavlink.autopilots import unfit_type
from offboard.mavlink.telemetry_rates import SHARE

BAUDS = (57600, 115200, 230400, 460800, 921600)
LOST_SHARE, FULL_SHARE, ENOUGH = 0.02, 0.9, 0.7
LATE_S, REAL_TIME, CLOCK_OFF_S = 0.25, 0.05, 60.0
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
    """Whether an autopilot is heard, and what is heard if none is."""
    found = seen.vehicle.found
    if seen.link_error:
        return
    if found:
        shown = seen.vehicle.heartbeat
        helicopter = seen.config is not None and seen.config.vehicle.airframe == "helicopter"
        unfit = unfit_type(shown.vehicle_type, helicopter=helicopter) if shown else ""
        if unfit:
            yield blocks(unfit, "fly it with its own autopilot; is MAV_TYPE or FRAME_CLASS right?")
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
        hint = SILENT.get(_kind(seen), STARTED)
        if "127.0.0.1" in seen.connection and _kind(seen) == "udpin":
            hint += f"; {BRIDGES[seen.surroundings]}"
        yield blocks(f"nothing is heard in {seen.listened_s:.0f} s", hint)


def senders(seen: Observation) -> Iterable[Finding]:
    """Other vehicles, ground stations and controllers on the link."""
    found = seen.vehicle.found
    if found is None:
        return
    ours = found.system_id, found.component_id
    others = [each for each in seen.senders if (each.system_id, each.component_id) != ours]
    chosen = seen.system_id is not None  # then other vehicles are ignored in flight, too
    for sender in others:
        if sender.setpoints:
            yield blocks(
                f"{sender.name} sends setpoints ({sender.setpoints} were heard)",
                "stop it: two controllers of one vehicle fight each other",
            )
        elif sender.is_autopilot and not chosen:
            yield blocks(
                f"another vehicle is heard: {sender.name}, from {', '.join(sender.places)}",
                "choose one with --system, or give each vehicle its own port",
            )
    for sender in seen.senders:
        if (sender.system_id, sender.component_id) == ours and len(sender.places) > 1:
            places = ", ".join(sender.places)
            yield warn(
                f"two programs send as vehicle {ours[0]}/{ours[1]}: {places}",
                "give each vehicle its own system id (MAV_SYS_ID, SYSID_THISMAV) and port",
            )
    intruder = seen.vehicle.other_sender
    if intruder and not any(each.setpoints for each in others):
        name = f"system {intruder.system_id} component {intruder.component_id}"
        yield blocks(f"another program controls this vehicle: {name}", "stop it")
    harmless = [
        each.name for each in others if not each.setpoints and (chosen or not each.is_autopilot)
    ]
    yield ok("besides the vehicle: " + (", ".join(harmless) or "nobody"))


def delay(seen: Observation) -> Iterable[Finding]:
    """Delay and jitter of the link by TIMESYNC, and telemetry that comes late."""
    limits, link = _limits(seen), seen.link
    if seen.vehicle.found is None:
        return
    if link.delay is None:
        yield wait("TIMESYNC is not answered: the delay of the link is unknown")
        return
    value, sd = link.delay.value, link.delay.sd
    trip = "" if link.round_trip_s is None else f", round trip {1e3 * link.round_trip_s:.0f} ms"
    figures = f"delay {1e3 * value:.0f} +- {1e3 * sd:.0f} ms{trip}"
    if value > limits.link_delay_s or sd > limits.link_jitter_s:
        most = f"{1e3 * limits.link_delay_s:.0f} +- {1e3 * limits.link_jitter_s:.0f} ms"
        yield blocks(f"{figures}; at most {most} can be flown", "use a faster link")
    elif link.late_s > LATE_S:
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
    link, needed = seen.link, ("ATTITUDE_QUATERNION", "LOCAL_POSITION_NED")
    if seen.vehicle.found is None:
        return
    figures = ", ".join(f"{name} {link.rates_hz.get(name, 0.0):.0f} Hz" for name in needed)
    too_slow = [n for n in needed if link.rates_hz.get(n, 0.0) < MINIMUM_TELEMETRY_HZ]
    slow = [
        f"{each.name} {link.rates_hz.get(each.name, 0.0):.1f} of {each.rate_hz:g} Hz"
        for each in link.wanted
        if not each.optional and link.rates_hz.get(each.name, 0.0) < ENOUGH * each.rate_hz
    ]
    hint = seen.dialect.slow_hint if seen.dialect else ""
    if not link.requested:
        yield ok(f"{figures}; not requested, since the vehicle is armed")
    elif "LOCAL_POSITION_NED" in too_slow and not link.rates_hz.get("LOCAL_POSITION_NED"):
        yield wait("LOCAL_POSITION_NED does not arrive", "wait until the vehicle has a position")
    elif too_slow:
        yield blocks(f"{figures}; at least {MINIMUM_TELEMETRY_HZ:.0f} Hz are needed", hint)
    elif slow:
        yield warn(f"slower than requested: {', '.join(slow)}", hint)
    else:
        yield ok(figures)


def clock(seen: Observation) -> Iterable[Finding]:
    """The vehicle's clock, and whether somebody else sets it."""
    measured, found = seen.clock, seen.vehicle.found
    if found is None:
        return
    if measured.rebooted:
        yield blocks(
            "the vehicle restarted while it was observed", "find out why, then check again"
        )
    if measured.jumped_s:
        yield blocks(f"the vehicle's clock jumped by {measured.jumped_s:.1f} s")
    if measured.rate is not None and abs(measured.rate - 1.0) > REAL_TIME:
        yield warn(f"the vehicle's clock runs {measured.rate:.2f} times as fast as this computer's")
    masters = [s.name for s in seen.senders if s.times and s.system_id != found.system_id]
    if seen.link.foreign_timesync > FOREIGN_TIMES:
        masters.append(
            f"somebody whose {seen.link.foreign_timesync} TIMESYNC replies are sent here"
        )
    if masters:
        hint = "let one program alone exchange TIMESYNC with the vehicle"
        yield warn(f"another time master: {', '.join(masters)}", hint)
    offset_s = measured.unix_offset_s
    if offset_s is not None and abs(offset_s) > CLOCK_OFF_S:
        yield warn(
            f"the vehicle's date differs from this computer's by {offset_s:.0f} s",
            "only log files are affected; set this computer's clock",
        )
    if measured.rate is not None:
        yield ok(f"the vehicle's clock runs {measured.rate:.3f} times as fast as this computer's")


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


def _kind(seen: Observation) -> str:
    return seen.connection.partition(":")[0]


def _limits(seen: Observation) -> Limits:
    return seen.config.limits if seen.config else Limits()
