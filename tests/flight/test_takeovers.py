"""A pilot takes the vehicle, at random moments of whole flights, on both firmwares.

From the arrival of the first report of a mode that is not ours nothing may leave that moves the
vehicle; no mode and no arming may be asked for again once the vehicle has done it. `Watch` judges
that from the bytes that cross the link and from the vehicle itself.

OFFBOARD_TAKEOVERS=200 flies 200 instead of the default number.
"""

from __future__ import annotations

import os
import random
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import pytest
from faults import CURRENT_MODE, HEARTBEAT, losing, without
from pair import HOST_EPOCH_S, STEP_S, Pair, decode, frames_of, hover, in_phase
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from watch import SET_MESSAGE_INTERVAL, aborted, begun_s, copter, flown, px4

from offboard.flight.authority import Standing
from offboard.flight.flight import Output
from offboard.flight.phases import ENDS, ExitCode, Phase
from offboard.link.interface import Chunk

SET_MODE, ARM, LAND = 176, 400, 21  # MAV_CMD
QUICK = 4  # in every run; the others by `-m slow`
FLIGHTS = int(os.environ.get("OFFBOARD_TAKEOVERS", "16"))
MOVING = {11, 75, 76, 82, 84, 86}  # SET_MODE, COMMAND_INT, COMMAND_LONG and all setpoints
LINGER_S = 2.5  # the companion is kept alive after the end of its flight

# The numbers of the modes on the wire, as both autopilots document them.
# In the order in which a flight may pass them: following setpoints, holding, landing
OURS = {"px4": [6 << 16, 4 << 16 | 3 << 24, 4 << 16 | 6 << 24], "ardupilot": [4, 17, 9]}
OUR_NAMES = {"px4": ["OFFBOARD", "AUTO.LOITER", "AUTO.LAND"],
             "ardupilot": ["GUIDED", "BRAKE", "LAND"]}  # fmt: skip
CHOSEN = {  # what the pilot takes
    "px4": ("POSCTL", "AUTO.LOITER", "AUTO.LAND", "AUTO.RTL", "STABILIZED"),
    "ardupilot": ("LOITER", "BRAKE", "LAND", "RTL", "ALT_HOLD"),
}
PHASES = (Phase.TAKEOFF, Phase.CLIMB, Phase.TRACK, Phase.HOVER, Phase.LAND)
REQUESTS = ("engage", "arm", "land")


@dataclass
class Watch:
    """Reads both directions of a pair's link. `gone_s` is when a report of another mode arrived."""

    pair: Pair
    firmware: str
    gone_s: float | None = None
    after: list[str] = field(default_factory=list)  # what left although the vehicle was gone
    again: list[str] = field(default_factory=list)  # what was asked for although it had been done
    requested_s: dict[str, float] = field(default_factory=dict)  # when each request left first
    _awaited_in: int | None = None  # the mode shown when we asked, until another one is
    _shown: int | None = None  # the newest one
    _allowed: list[int] = field(default_factory=list)
    _done: set[str] = field(default_factory=set)  # by the vehicle itself

    def __post_init__(self) -> None:
        self._turn = self.pair.companion.turn
        self.pair.companion.turn = self.turn

    def turn(self, chunks: list[Chunk], now_s: float) -> Output:
        """In place of the companion's."""
        for frame in (frame for chunk in chunks for frame in frames_of(chunk.data)):
            if int.from_bytes(frame[7:10], "little") in (HEARTBEAT, CURRENT_MODE):
                self._shows(int.from_bytes(frame[10:-2][:4].ljust(4, b"\0"), "little"))
        output = self._turn(chunks, now_s)
        for message in map(decode, output.send):
            command = getattr(message, "command", None)
            if message.get_msgId() in MOVING and command != SET_MESSAGE_INTERVAL:
                self._leaves(message, command)
        return output

    def _shows(self, mode: int) -> None:
        self._shown = mode
        if "engage" not in self.requested_s or mode == self._awaited_in:
            return
        self._awaited_in = None
        if mode in self._allowed:
            del self._allowed[: self._allowed.index(mode)]  # no step back
        elif self.gone_s is None:
            self.gone_s = self.pair.time_s

    def _leaves(self, message: Any, command: int | None) -> None:
        if self.gone_s is not None:
            self.after.append(f"{self.pair.time_s:.2f} {message}")
        name = self._name(message, command)
        if name in self._done:
            self.again.append(f"{self.pair.time_s:.2f} {name}")
        self.requested_s.setdefault(name, self.pair.time_s)
        if name == "engage" and not self._allowed:
            self._awaited_in = self._shown
        if name in ("engage", "hold", "land"):
            mode = OURS[self.firmware][("engage", "hold", "land").index(name)]
            if mode not in self._allowed:
                self._allowed.append(mode)

    def _name(self, message: Any, command: int | None) -> str:
        if command == SET_MODE:
            main = message.param2 if self.firmware == "ardupilot" else int(message.param2) << 16
            return "engage" if main == OURS[self.firmware][0] else "hold"
        if command == ARM:
            return "arm" if message.param1 else "disarm"
        return "land" if command == LAND else "other"

    def look(self) -> None:
        """At the vehicle: what it has done since it was asked to."""
        commander = self.pair.instance.autopilot.commander
        done = dict(zip(("engage", "hold", "land"), OUR_NAMES[self.firmware], strict=True))
        name = next((each for each, mode in done.items() if commander.mode.name == mode), None)
        self._done |= {name} & self.requested_s.keys()
        self._done |= {"arm"} & self.requested_s.keys() if commander.armed else set()


@dataclass(frozen=True)
class TakeOver:
    """One flight: when, to which mode (None: disarm), and when the pilot changes his mind."""

    firmware: str
    moment: Phase | str  # a phase, or one of our requests
    after_s: float
    mode: str | None
    back_s: float | None
    share_lost: float
    seed: int


def drawn(seed: int) -> TakeOver:
    chance = random.Random(seed)
    firmware = ("px4", "ardupilot")[seed % 2]
    if chance.random() < 0.4:
        moment, after_s = chance.choice(REQUESTS), chance.uniform(0.0, 1.0)
    else:
        moment = chance.choice(PHASES)
        longest_s = {Phase.TAKEOFF: 1.2, Phase.CLIMB: 1.5, Phase.HOVER: 0.45}
        after_s = chance.uniform(0.0, longest_s.get(moment, 2.5))
    mode = None if chance.random() < 0.1 else chance.choice(CHOSEN[firmware])
    back_s = chance.uniform(0.2, 2.0) if chance.random() < 0.35 else None
    return TakeOver(firmware, moment, after_s, mode, back_s, 0.05 * (seed % 4 == 3), seed)


def start(firmware: str, **options: Any) -> Pair:
    return {"px4": px4.hop, "ardupilot": copter.hop}[firmware](**options)


def taken_over(take_over: TakeOver) -> tuple[Pair, Watch, list[Phase]]:
    """The flight, and the phases in which the pilot acted."""
    pair = start(take_over.firmware, seed=take_over.seed)
    if take_over.share_lost:
        pair.down = losing(take_over.share_lost, take_over.seed)
        pair.up = losing(take_over.share_lost, take_over.seed + 1000)
    watch = Watch(pair, take_over.firmware)
    acted: list[Phase] = []

    def switch(pair: Pair) -> None:
        commander = pair.instance.autopilot.commander
        before = commander.mode.name
        acted.append(pair.companion.phase)
        if take_over.mode is None:
            pair.ground(ARM, 0, 21196)
        else:
            commander.switch(take_over.mode)
        if take_over.back_s is not None:
            back_at_s = pair.time_s + take_over.back_s
            pair.at.append((lambda p: p.time_s >= back_at_s, lambda _: commander.switch(before)))

    pair.at.append((lambda _: watch.look() or False, lambda _: None))
    pair.at.append((due(take_over.moment, take_over.after_s, watch), switch))
    pair.fly()
    linger(pair)
    return pair, watch, acted


def due(moment: Phase | str, after_s: float, watch: Watch) -> Callable[[Pair], bool]:
    """So long after a phase began, or after one of our requests left."""
    if isinstance(moment, Phase):
        return in_phase(moment, after_s)
    return lambda pair: pair.time_s >= watch.requested_s.get(moment, 1e9) + after_s


def linger(pair: Pair) -> None:
    """Time goes on after the end of the flight, and so does the companion."""
    end_s = pair.time_s + LINGER_S
    while pair.time_s < end_s:
        pair.time_s += STEP_S
        now_s = HOST_EPOCH_S + pair.time_s
        for datagram in pair.down(pair.time_s, pair.instance.step()):
            pair.companion.turn([Chunk(datagram, "vehicle", now_s)], now_s)
        for moment in [moment for moment in pair.at if moment[0](pair)]:
            pair.at.remove(moment)
            moment[1](pair)


@pytest.mark.parametrize(
    "seed",
    [*range(QUICK), *(pytest.param(n, marks=pytest.mark.slow) for n in range(QUICK, FLIGHTS))],
)
def test_nothing_leaves_after_a_take_over(seed: int) -> None:
    take_over = drawn(seed)
    print(take_over)
    pair, watch, acted = taken_over(take_over)
    assert pair.companion.phase in ENDS
    assert watch.after == []
    assert watch.again == []
    if watch.gone_s is not None and acted:
        standing = pair.companion.authority.standing
        assert standing is Standing.LOST or take_over.mode is None


@pytest.mark.parametrize("firmware", ["px4", "ardupilot"])
def test_a_vehicle_found_in_our_mode_can_be_taken(firmware: str) -> None:
    """Engaging has nothing to wait for, and is over within one tick."""
    pair = start(firmware)
    engaged, other = ("OFFBOARD", "POSCTL") if firmware == "px4" else ("GUIDED", "LOITER")
    ready = in_phase(Phase.STREAM, 0.5) if firmware == "px4" else lambda p: p.time_s > 4.2
    switch = pair.instance.autopilot.commander.switch
    pair.at.append((ready, lambda _: switch(engaged)))
    pair.at.append((in_phase(Phase.TRACK, 1.0), lambda _: switch(other)))
    aborted(pair, f".*left {engaged} for {other}")
    assert pair.modes == pair.landings == []
    assert pair.companion.phase is Phase.YIELDED


def test_leaving_the_landing_mode_as_it_disarms_is_no_take_over() -> None:
    """PX4 returns to OFFBOARD, which CURRENT_MODE shows before HEARTBEAT shows it disarmed."""
    for duration_s in (3.3, 3.7):
        flown(hover(f"reference.duration_s={duration_s}", aloft=True))


def test_a_hold_that_was_asked_for_on_the_ground_is_asked_for_again_in_flight() -> None:
    """PX4 in OFFBOARD since its last landing; in flight another program sends setpoints."""
    pair = start("px4")
    switch = pair.instance.autopilot.commander.switch
    codec = mavlink.MAVLink(None, srcSystem=1, srcComponent=195)
    setpoint = mavlink.MAVLink_set_attitude_target_message(0, 1, 1, 7, (1, 0, 0, 0), 0, 0, 0, 0.5)
    tracking = in_phase(Phase.TRACK, 1.0)
    pair.down = lambda _, datagrams: (
        [*datagrams, setpoint.pack(codec)] if tracking(pair) else datagrams
    )
    pair.at.append((lambda pair: pair.time_s > 0.1, lambda _: switch("OFFBOARD")))
    aborted(pair)
    asked = [(m.param2, m.param3) for m in pair.modes]
    assert asked == [(4.0, 3.0), (6.0, 0.0), (4.0, 3.0)]
    held_s, landed_s = begun_s(pair, Phase.HOLD), begun_s(pair, Phase.LAND)
    assert [at_s for at_s, _, _ in pair.setpoints if at_s > held_s + 0.1] == []
    assert landed_s - held_s == pytest.approx(2.1)


@pytest.mark.parametrize("after_s", [0.02, 0.7])
def test_a_pilot_who_switches_back_between_two_heartbeats_is_not_asked_again(
    after_s: float,
) -> None:
    """A PX4 without CURRENT_MODE: neither OFFBOARD nor the way back may be shown."""
    pair = start("px4", down=without(CURRENT_MODE))
    commander, watch = pair.instance.autopilot.commander, Watch(pair, "px4")
    before = commander.mode.name
    pair.at.append((due("engage", after_s, watch), lambda _: commander.switch(before)))
    outcome = pair.fly()
    assert outcome.exit_code == ExitCode.REFUSED
    assert len(pair.modes) == 1
    assert not any(pair.armings) or "left OFFBOARD" in outcome.sentence


@pytest.mark.parametrize(
    ("firmware", "after_s"), [("px4", 0.02), ("ardupilot", 0.3), ("px4", 0.7), ("ardupilot", 0.7)]
)
def test_a_vehicle_that_is_disarmed_just_after_arming_is_not_armed_again(
    firmware: str, after_s: float
) -> None:
    pair = start(firmware)
    watch = Watch(pair, firmware)
    pair.at.append((due("arm", after_s, watch), lambda pair: pair.ground(ARM, 0, 21196)))
    outcome = pair.fly()
    assert outcome.exit_code in (ExitCode.REFUSED, ExitCode.ABORTED)
    assert "disarmed" in outcome.sentence
    assert pair.armings.count(1.0) == 1
    assert not pair.armed
