"""A pilot takes the vehicle at random moments of whole flights, on both firmwares.

Once the first report of a mode that is not ours has arrived, nothing that moves the vehicle may be
sent. `Judge` checks this on the bytes on the link.

OFFBOARD_TAKEOVERS=200 flies 200 flights instead of the default number.
"""

from __future__ import annotations

import os
import random
from collections.abc import Callable

import pytest
from faults import CURRENT_MODE, HEARTBEAT, losing, without
from pair import Pair, decode, frame_id, frames_of, in_phase, level_setpoint
from watch import SET_MESSAGE_INTERVAL, Vehicle, aborted, begun_s, copter, flown, px4, refused

from offboard.flight.authority import Standing
from offboard.flight.phases import ENDS, ExitCode, Phase
from offboard.link.interface import Chunk

SET_MODE, ARM, LAND = 176, 400, 21  # MAV_CMD
QUICK = 4  # flights of every run; the others need `-m slow`
FLIGHTS = int(os.environ.get("OFFBOARD_TAKEOVERS", "16"))
MOVING = {11, 75, 76, 82, 84, 86}  # SET_MODE, COMMAND_INT, COMMAND_LONG and all setpoints
LINGER_S = 2.5  # time for which turns go on after the end of the flight

# `custom_mode` of the modes that a flight requests, from the documentation of both autopilots
OURS = {"px4": {6 << 16, 4 << 16 | 3 << 24, 4 << 16 | 6 << 24}, "ardupilot": {4, 17, 9}}
CHOSEN = {  # modes that the pilot selects
    "px4": ("POSCTL", "AUTO.LOITER", "AUTO.LAND", "AUTO.RTL", "STABILIZED"),
    "ardupilot": ("LOITER", "BRAKE", "LAND", "RTL", "ALT_HOLD"),
}


class Judge:
    """Reads both directions of a pair's link. `gone_s` is the time at which, after our request for
    the mode, a report of a mode arrived that no flight requests; `wrong` are the messages sent
    after that. Hold and land may be ours or the pilot's; `test_gate.py` tests these."""

    def __init__(self, pair: Pair, on: Vehicle) -> None:
        self.gone_s: float | None = None
        self.wrong: list[str] = []
        self.asked_s: dict[int, float] = {}  # when each command was first sent
        self._pair, self._turn, self._ours = pair, pair.companion.turn, OURS[on.name]
        self._before: int | None = None  # the mode before our request, until it is left
        pair.companion.turn = self.turn  # type: ignore[method-assign]

    def turn(self, chunks: list[Chunk], now_s: float) -> tuple[bytes, ...]:
        for frame in (frame for chunk in chunks for frame in frames_of(chunk.data)):
            if frame_id(frame) in (HEARTBEAT, CURRENT_MODE):
                self._shows(int.from_bytes(frame[10:-2][:4].ljust(4, b"\0"), "little"))
        frames = self._turn(chunks, now_s)
        for message in map(decode, frames):
            command = getattr(message, "command", 0)
            if message.get_msgId() in MOVING and command != SET_MESSAGE_INTERVAL:
                self.asked_s.setdefault(command, self._pair.time_s)
                if self.gone_s is not None:
                    self.wrong.append(f"{self._pair.time_s:.2f} {message}")
        return frames

    def _shows(self, mode: int) -> None:
        if SET_MODE not in self.asked_s:
            self._before = mode
        elif mode != self._before:
            self._before = None
            if mode not in self._ours and self.gone_s is None:
                self.gone_s = self._pair.time_s


def asked(judge: Judge, command: int, after_s: float) -> Callable[[Pair], bool]:
    """Return the condition that `after_s` have passed since this command was first sent."""
    return lambda pair: pair.time_s >= judge.asked_s.get(command, 1e9) + after_s


@pytest.mark.parametrize(
    "seed",
    [*range(QUICK), *(pytest.param(n, marks=pytest.mark.slow) for n in range(QUICK, FLIGHTS))],
)
def test_nothing_is_sent_after_a_pilot_takes_over(seed: int) -> None:
    """After a request of ours, or in a phase, the pilot selects a mode or disarms, and perhaps
    switches back. Some links lose one datagram in twenty."""
    chance, on = random.Random(seed), (px4, copter)[seed % 2]
    pair = on.hop(seed=seed)
    judge = Judge(pair, on)
    if chance.random() < 0.4:
        request, after_s = chance.choice((SET_MODE, ARM, LAND)), chance.uniform(0.0, 1.0)
        due = asked(judge, request, after_s)
    else:
        phases = {Phase.TAKEOFF: 1.2, Phase.CLIMB: 1.5, Phase.TRACK: 2.5, Phase.HOVER: 0.45,
                  Phase.LAND: 2.5}  # fmt: skip
        phase = chance.choice(list(phases))
        due = in_phase(phase, chance.uniform(0.0, phases[phase]))
    mode = None if chance.random() < 0.1 else chance.choice(CHOSEN[on.name])
    back_s = chance.uniform(0.2, 2.0) if chance.random() < 0.35 else None
    if seed % 4 == 3:
        pair.down, pair.up = losing(0.05, seed), losing(0.05, seed + 1000)
    commander, acted = pair.instance.autopilot.commander, []

    def switch(pair: Pair) -> None:
        before = commander.mode.name
        acted.append((pair.companion.phase, mode, back_s))
        if mode is None:
            pair.ground(ARM, 0, 21196)
        else:
            commander.switch(mode)
        if back_s is not None:
            back_at_s = pair.time_s + back_s
            pair.at.append((lambda p: p.time_s >= back_at_s, lambda _: commander.switch(before)))

    pair.at.append((due, switch))
    pair.fly()
    pair.lingers, end_s = True, pair.time_s + LINGER_S
    while pair.time_s < end_s:
        pair.advance()
    print(acted)
    assert pair.companion.phase in ENDS
    assert judge.wrong == []
    if judge.gone_s is not None and acted:
        assert pair.companion.authority.standing is Standing.LOST or mode is None


def test_mode_that_a_pilot_selects_while_setpoints_stream_is_kept() -> None:
    """Regression: within the second before its request, the vehicle was engaged and armed."""
    pair = px4.hop()
    switch = pair.instance.autopilot.commander.switch
    pair.at.append((in_phase(Phase.STREAM, 0.5), lambda _: switch("POSCTL")))
    refused(pair, "POSCTL was selected before OFFBOARD")
    assert (pair.modes, pair.armings, pair.mode) == ([], [], "POSCTL")


def test_hold_requested_before_the_stream_may_be_shown_during_it() -> None:
    """A PX4 without CURRENT_MODE shows OFFBOARD late in HEALTH, and hold, as `fly` requests, in the
    next HEARTBEAT. Regression: that mode was taken for a pilot's, and the flight refused."""
    pair = px4.hop(down=without(CURRENT_MODE))
    switch = pair.instance.autopilot.commander.switch
    pair.at.append((in_phase(Phase.HEALTH, 1.0), lambda _: switch("OFFBOARD")))
    flown(pair)
    assert len(pair.modes) > 1


def test_hold_requested_on_the_ground_is_requested_again_in_flight() -> None:
    """PX4 is in OFFBOARD since its last landing. In flight another program sends setpoints."""
    pair = px4.hop()
    setpoint = level_setpoint(0.5, 1, 195)
    tracking, switch = in_phase(Phase.TRACK, 1.0), pair.instance.autopilot.commander.switch
    pair.down = lambda _, datagrams: [*datagrams, setpoint] if tracking(pair) else datagrams
    pair.at.append((lambda pair: pair.time_s > 0.1, lambda _: switch("OFFBOARD")))
    aborted(pair)
    assert [(m.param2, m.param3) for m in pair.modes] == [(4.0, 3.0), (6.0, 0.0), (4.0, 3.0)]
    held_s, landed_s = begun_s(pair, Phase.HOLD), begun_s(pair, Phase.LAND)
    assert [at_s for at_s, _, _ in pair.setpoints if at_s > held_s + 0.1] == []
    assert landed_s - held_s == pytest.approx(2.1)


def test_mode_is_not_requested_again_after_a_pilot_switches_back() -> None:
    """PX4 sends no CURRENT_MODE, so that neither OFFBOARD nor the switch back may be reported."""
    pair = px4.hop(down=without(CURRENT_MODE))
    commander, judge = pair.instance.autopilot.commander, Judge(pair, px4)
    before = commander.mode.name
    pair.at.append((asked(judge, SET_MODE, 0.7), lambda _: commander.switch(before)))
    outcome = pair.fly()
    assert outcome.exit_code == ExitCode.REFUSED
    assert len(pair.modes) == 1
    assert not any(pair.armings) or "left OFFBOARD" in outcome.sentence
