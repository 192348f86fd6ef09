"""Faults for tests of whole flights: of the link, the vehicle, and the control law."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import count
from typing import Any

from pair import LEAN, Bytes, Filter, Pair, decode, frame_id, frames_of
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from offboard.control.base import Controller, Decision, Situation
from offboard.model.command import Command
from simulator import config
from simulator.autopilot.firmware import Firmware, Rule
from simulator.autopilot.values import Result, Severity, StatusText
from simulator.instance import Instance

HEARTBEAT, ATTITUDE, POSITION, PARAM_VALUE, TIMESYNC = 0, 31, 32, 22, 111
EXTENDED_SYS_STATE, CURRENT_MODE = 245, 436
Action = Callable[[Pair], None]


# --- vehicles -------------------------------------------------------------------------------------


def refusing(event: str, text: str) -> Firmware:
    """A vehicle that refuses one event, for the reason `text`."""
    texts = (StatusText(Severity.CRITICAL, text),)
    rule = Rule(event, result=Result.TEMPORARILY_REJECTED, texts=texts)
    return replace(LEAN, rules=(rule, *LEAN.rules))


CANNOT_HOLD = Rule(
    "mode", when=("armed", "requests AUTO.LOITER"), result=Result.TEMPORARILY_REJECTED
)  # as PX4 without a global position


def with_default(name: str, value: float) -> Firmware:
    """A vehicle with another value of one parameter."""
    parameters = (
        replace(spec, default=value) if spec.name == name else spec for spec in LEAN.parameters
    )
    return replace(LEAN, parameters=tuple(parameters))


# --- links ----------------------------------------------------------------------------------------


def delivering(delays_s: Callable[[float, bytes], Sequence[float]]) -> Filter:
    """A link that delivers each datagram once after each of its delays. Datagrams that are due
    in the same step keep the order in which they were sent."""
    under_way: list[tuple[float, bytes]] = []

    def arriving(time_s: float, datagrams: Bytes) -> Bytes:
        for datagram in datagrams:
            under_way.extend((time_s + delay_s, datagram) for delay_s in delays_s(time_s, datagram))
        now = [datagram for due_s, datagram in under_way if due_s <= time_s]
        under_way[:] = [each for each in under_way if each[0] > time_s]
        return now

    return arriving


def losing(share: float, seed: int = 3) -> Filter:
    """A link that loses a share of the datagrams."""
    chance = random.Random(seed)
    return lambda _, datagrams: [d for d in datagrams if chance.random() >= share]


def stuttering(hold_s: float, every_s: float) -> Filter:
    """A link that stops for `hold_s` in every `every_s`, then delivers all datagrams at once."""
    return delivering(lambda time_s, _: [max(hold_s - time_s % every_s, 0.0)])


def late(delay_s: float) -> Filter:
    """A link with a constant delay."""
    return delivering(lambda *_: [delay_s])


def repeating(again_s: float) -> Filter:
    """A link that delivers each datagram twice at once, and once more later."""
    return delivering(lambda *_: [0.0, 0.0, again_s])


def shuffling() -> Filter:
    """A link that delays one datagram in five by 20 ms, duplicates another one in five, and delays
    one attitude or position in a hundred by 2.5 s."""
    chance = random.Random(5)

    def delays_s(_: float, datagram: bytes) -> Sequence[float]:
        draw = chance.random()
        if draw < 0.01 and frame_id(datagram) in (ATTITUDE, POSITION):
            return [2.5]
        return [0.02] if draw < 0.2 else [0.0] * (2 if draw < 0.4 else 1)

    return delivering(delays_s)


def noisy(_: float, datagrams: Bytes) -> Bytes:
    """A link that adds garbage before and after each datagram."""
    return [part for d in datagrams for part in (b"\xfd\x09garbage", d, b"\x00" * 7)]


def both(first: Filter, second: Filter) -> Filter:
    """A link with two faults, one after the other."""
    return lambda time_s, datagrams: second(time_s, first(time_s, datagrams))


def without(*message_ids: int) -> Filter:
    """A link on which messages with these ids do not arrive."""
    return lambda _, datagrams: [
        b"".join(frame for frame in frames_of(d) if frame_id(frame) not in message_ids)
        for d in datagrams
    ]


def rewritten(change: Callable[[Any], object], *kinds: int) -> Filter:
    """A link on which `change` edits every message with one of these ids."""
    codec = mavlink.MAVLink(None)

    def edit(frame: bytes) -> bytes:
        if frame_id(frame) not in kinds:
            return frame
        message = decode(frame)
        change(message)
        codec.seq, codec.srcSystem, codec.srcComponent = frame[4:7]
        return bytes(message.pack(codec))

    return lambda _, datagrams: [b"".join(map(edit, frames_of(d))) for d in datagrams]


def setting(**fields: object) -> Callable[[Any], object]:
    return lambda message: [setattr(message, name, value) for name, value in fields.items()]


def heartbeats(**changed: int) -> Filter:
    """A link on which these fields of every heartbeat have other values."""
    return rewritten(setting(**changed), HEARTBEAT)


def disarmed(most: float = math.inf) -> Filter:
    """A link on which the first `most` heartbeats wrongly show the vehicle disarmed."""
    wrong: list[Any] = []

    def change(message: Any) -> None:
        if len(wrong) < most:
            message.base_mode &= ~mavlink.MAV_MODE_FLAG_SAFETY_ARMED
            wrong.append(message)

    return rewritten(change, HEARTBEAT)


def restamped(less_s: float) -> Filter:
    """A link on which the time stamps of positions and attitudes are reduced by `less_s`, as if the
    vehicle had booted that much later."""

    def change(message: Any) -> None:
        message.time_boot_ms -= round(1e3 * less_s)

    return rewritten(change, ATTITUDE, POSITION)


# --- events ---------------------------------------------------------------------------------------


def stop(pair: Pair) -> None:
    pair.companion.request_stop()


def restart(pair: Pair) -> None:
    """Reboot the vehicle: it is on the ground and disarmed, and its time begins at zero."""
    conditions = config.scenario("calm").conditions
    pair.instance = Instance(LEAN, config.vehicle("px4_sih"), conditions, 7)


def downlink(fault: Filter) -> Action:
    """Apply `fault` to the telemetry from now on."""

    def change(pair: Pair) -> None:
        pair.down = fault

    return change


def cut(for_s: float, *kinds: int, ways: Sequence[str] = ("down", "up")) -> Action:
    """Drop all datagrams in these directions for `for_s` from now on; with `kinds`, only messages
    with these ids."""

    def change(pair: Pair) -> None:
        ends_s, rest = pair.time_s + for_s, without(*kinds)

        def passing(time_s: float, datagrams: Bytes) -> Bytes:
            if time_s >= ends_s:
                return datagrams
            return rest(time_s, datagrams) if kinds else []

        for way in ways:
            setattr(pair, way, both(getattr(pair, way), passing))

    return change


# --- laws -----------------------------------------------------------------------------------------


def failing(
    fail: Callable[[Situation], Decision], times: float = math.inf, after: int = 30
) -> Callable[[Controller], Controller]:
    """Make a controller fail in `times` decisions after the first `after` ones."""

    def wrap(law: Controller) -> Controller:
        decide, numbers = law.decide, count(1)

        def sometimes(situation: Situation) -> Decision:
            fails = after < next(numbers) <= after + times
            return fail(situation) if fails else decide(situation)

        law.decide = sometimes  # type: ignore[method-assign]
        return law

    return wrap


def raises(_: Situation) -> Decision:
    raise ZeroDivisionError("nothing to divide by")


def no_direction(_: Situation) -> Decision:
    return Decision(Command(9.8, (0.0, 0.0, 0.0), 0.0))


def overturns(_: Situation) -> Decision:
    return Decision(Command(1e6, (math.sin(2.5), 0.0, math.cos(2.5)), 0.0))
