"""Records what the simulated vehicle truly did in a flight, and checks how the flight ended."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pair import SHORT, Pair, decode, in_phase, make, on_arducopter

from offboard.analysis.history import OUR_COMPONENTS
from offboard.analysis.score import score
from offboard.flight.phases import ENDS, TRACKING, Action, ExitCode, Phase
from simulator import config as simulated
from simulator.config import Scenario

SET_MESSAGE_INTERVAL, REQUEST_MESSAGE = 511, 512  # MAV_CMD
HIGH = "reference.height_m=3.0"
LANDED = "flown and landed$"
REACTION_S = 0.13  # a report of the mode at 10 Hz, and a turn
WATCHED_STEPS = 5  # 20 ms
LAP = ("reference.height_m=1.0", "reference.laps=1", "reference.run_in_s=2.0",
       "reference.run_out_s=1.0")  # fmt: skip  # low, so that climb and landing are short


@dataclass(frozen=True)
class Vehicle:
    """Creates flights of one firmware."""

    name: str
    make: Callable[..., Pair]

    def lap(self, *assignments: str, **options: Any) -> Pair:
        """Create a flight of one lap of a lemniscate. The vehicle hovers when its links open."""
        return self.make(*LAP, *assignments, **{"aloft": True} | options)

    def hover(self, *assignments: str, **options: Any) -> Pair:
        """Create a hover of three seconds at 1 m. The vehicle hovers when its links open."""
        return self.hop(*assignments, **{"aloft": True} | options)

    def hop(self, *assignments: str, **options: Any) -> Pair:
        """Create the same hover with a takeoff."""
        return self.make(*SHORT, *assignments, reference="hover", **options)

    def __str__(self) -> str:
        return self.name


px4, copter = Vehicle("px4", make), Vehicle("ardupilot", on_arducopter)
BOTH = pytest.mark.parametrize("on", [px4, copter], ids=str)


@dataclass(frozen=True)
class Moment:
    """The true state of the vehicle. `error_m` is the distance from the reference in the phases
    from climb to hover, else NaN."""

    time_s: float
    phase: Phase
    mode: str
    armed: bool
    position_ned_m: NDArray[np.float64]
    down_mps: float
    error_m: float


@dataclass
class Watch:
    """Records the true state every 20 ms."""

    moments: list[Moment] = field(default_factory=list)

    def __call__(self, pair: Pair) -> None:
        autopilot, companion = pair.instance.autopilot, pair.companion
        truth = autopilot.state.truth
        position = np.array(truth.position_ned_m)
        vehicle_s = autopilot.state.time_s + 1e-6 * pair.instance.view.clock_offset_us
        tracked = companion.phase in TRACKING
        wanted = companion.current.plan.sample(vehicle_s) if tracked else None
        error = np.nan if wanted is None else np.linalg.norm(position - wanted.position_ned_m)
        down_mps = float(truth.velocity_ned_mps[2])
        self.moments.append(
            Moment(pair.time_s, companion.phase, pair.mode, pair.armed, position, down_mps,
                   float(error))
        )  # fmt: skip

    def during(self, *phases: Phase) -> list[Moment]:
        return [moment for moment in self.moments if moment.phase in phases]

    @property
    def error_m(self) -> float:
        """Largest true distance from the reference from climb to hover."""
        return max((moment.error_m for moment in self.during(*TRACKING)), default=0.0)

    @property
    def top_m(self) -> float:
        return max((-moment.position_ned_m[2] for moment in self.moments), default=0.0)

    @property
    def height_m(self) -> float:
        """Height now."""
        return -float(self.moments[-1].position_ned_m[2])

    @property
    def fall_mps(self) -> float:
        """Largest downward speed."""
        return max((moment.down_mps for moment in self.moments), default=0.0)

    def left_s(self, mode: str) -> float:
        """Return the time at which the vehicle first left `mode`."""
        modes = [(moment.time_s, moment.mode) for moment in self.moments]
        return next(at_s for (_, before), (at_s, now) in pairwise(modes) if before == mode != now)


def watched(pair: Pair) -> Watch:
    """Watch `pair` from now on."""
    pair.watch = Watch()
    pair.every(WATCHED_STEPS, pair.watch)
    return pair.watch


def flown(
    pair: Pair,
    code: int | None = ExitCode.FLOWN,
    says: str = LANDED,
    *,
    failsafes: Collection[str] | None = None,
    ended_by: str = "",
    error_m: float = math.inf,
    top_m: float = math.inf,
    fall_mps: float = math.inf,
) -> Watch:
    """Fly `pair` to its end and check it. The exit code must be `code` (None: any). The outcome's
    sentence must begin with `says`, a regular expression. The active rows of the failsafe must be
    `failsafes`, and `ended_by` that of the score. The true state must stay within the limits.

    In every flight, setpoints must be finite and valid, and none may be sent after the end. After a
    flown flight the vehicle must be on the ground and disarmed, and no failsafe action may have
    been worse than LEVEL. After a refusal no landing may have been requested, and the vehicle must
    be where it was.
    """
    watch = watched(pair)
    outcome = pair.fly()
    assert code in (outcome.exit_code, None), outcome
    assert re.match(says, outcome.sentence), outcome.sentence
    if failsafes is not None:
        assert set(pair.failsafes) == set(failsafes)
    assert watch.error_m < error_m
    assert watch.top_m < top_m
    assert watch.fall_mps < fall_mps
    for _, phase, setpoint in pair.setpoints:
        assert phase not in ENDS
        assert all(math.isfinite(value) for value in (*setpoint.q, setpoint.thrust))
        assert 0.0 <= setpoint.thrust <= 1.0
        assert setpoint.type_mask == 7
    autopilot = pair.instance.autopilot
    if code == ExitCode.FLOWN:
        assert not autopilot.commander.armed
        assert autopilot.position_controller.landed
        assert max(pair.failsafes.values(), default=Action.FLY) <= Action.LEVEL
    if code == ExitCode.REFUSED and watch.moments:
        assert pair.landings == []
        assert abs(watch.height_m + watch.moments[0].position_ned_m[2]) < 0.05
    if ended_by:
        completed, *rest = verdict(pair)
        assert (completed, rest[0]) == (code == ExitCode.FLOWN, ended_by)
        assert rest[1] or completed
        assert completed or any(line.endswith(f": {rest[1]}") for line in announced(pair))
        assert (completed, *rest) == verdict(without_texts(pair))
    return watch


def refused(pair: Pair, says: str = "", **more: Any) -> Watch:
    """Check as `flown` that the flight is refused on the ground with this sentence."""
    return flown(pair, ExitCode.REFUSED, says, **more)


def aborted(pair: Pair, says: str = "", **more: Any) -> Watch:
    """Check as `flown` that the flight is ended early with this sentence."""
    return flown(pair, ExitCode.ABORTED, says, **more)


def verdict(pair: Pair) -> tuple[Any, ...]:
    """Return what the score of the log says about the end of the flight, and the events of the log.
    Numbers that may be NaN are given as text, because NaN does not equal itself."""
    logged = pair.history()
    judged = score(logged)
    ended = (judged.completed, judged.ended_by, judged.reason)
    events = [repr(replace(event, unix_s=0.0)) for event in logged.events()]
    return *ended, repr(judged.touchdown_mps), events


def without_texts(pair: Pair) -> Pair:
    """Return the same flight with a log without our STATUSTEXT, which the verdict does not need."""
    ours = [
        frame
        for frame in pair.logged
        if frame[7:10] == b"\xfd\0\0" and decode(frame).get_srcComponent() in OUR_COMPONENTS
    ]
    assert len(ours) > 5
    return replace(pair, logged=[frame for frame in pair.logged if frame not in ours])


def announced(pair: Pair) -> tuple[str, ...]:
    return tuple(pair.companion.current.announced)


def engage_mode(pair: Pair) -> str:
    dialect = pair.companion.current.dialect
    assert dialect is not None
    return dialect.engage_mode


def sent_after(pair: Pair, time_s: float) -> list[str]:
    """Return setpoints and commands sent after `time_s`, except requests for messages."""
    frames = [(at_s, decode(frame)) for at_s, _, frame in pair.sent if at_s > time_s]
    return [
        f"{message.get_type()} at {at_s:.2f}"
        for at_s, message in frames
        if message.get_type() in ("COMMAND_LONG", "SET_ATTITUDE_TARGET")
        and getattr(message, "command", None) not in (SET_MESSAGE_INTERVAL, REQUEST_MESSAGE)
    ]


def begun_s(pair: Pair, phase: Phase) -> float:
    """Return the time at which this phase first began."""
    return next(at_s for at_s, flown in pair.phases if flown is phase)


def said(pair: Pair, words: str) -> bool:
    return any(words in sentence for sentence in announced(pair))


def scenario_of(*faults: dict[str, Any], **more: Any) -> Scenario:
    """Return a scenario with these faults."""
    return Scenario.model_validate({"name": "test", "faults": faults, **more})


def early(name: str, at_s: float = 7.0) -> Scenario:
    """Return a shipped scenario whose first fault is moved to `at_s`, and the others with it, so
    that they occur in the first lap of a vehicle that begins in a hover."""
    scenario = simulated.scenario(name)
    first_s = min(fault.at_s for fault in scenario.faults)
    earlier = [
        each.model_copy(update={"at_s": each.at_s - first_s + at_s}) for each in scenario.faults
    ]
    return scenario.model_copy(update={"faults": earlier})


# --- rows: one flight each ------------------------------------------------------------------------

Check = Callable[[Pair], object]
Row = tuple[Callable[[], Pair], Phase, bool, tuple[Check, ...], dict[str, Any]]
JUDGED = {"ended_by", "failsafes", "error_m", "top_m", "fall_mps"}  # arguments of `flown`


def row(
    code: int | None, end: Phase, says: str, *checks: Check, fly: Callable[..., Pair] = px4.hop,
    armed: bool = False, **options: Any,
) -> Row:  # fmt: skip
    """Return a test case: a flight by `fly` with these options, and the arguments of `flown`. It
    must end in the phase `end` with the vehicle `armed` or not, and the checks must then hold."""
    expected = {name: options.pop(name) for name in JUDGED & options.keys()}
    return partial(fly, **options), end, armed, checks, {"code": code, "says": says, **expected}


refusal = partial(row, ExitCode.REFUSED, Phase.FAILED)
flies = partial(row, ExitCode.FLOWN, Phase.DISARMED, LANDED)
aborts = partial(row, ExitCode.ABORTED)
ends = partial(aborts, Phase.DISARMED)


def judged(flight: Row) -> None:
    """Fly a row and check it. All actions of `Pair.at` must have been done."""
    fly, end, armed, checks, expected = flight
    pair = fly()
    flown(pair, **expected)
    ended = (pair.companion.phase, pair.armed)
    assert ended == (end, armed), ended
    assert pair.at == []
    for check in checks:
        check(pair)


def then(phase: Phase, for_s: float, act: Callable[[Pair], object]) -> list[Any]:
    """Return `act` for `Pair.at`, to be done once the flight has been in `phase` for `for_s`."""
    return [(in_phase(phase, for_s), act)]


def tracking(act: Callable[[Pair], object]) -> list[Any]:
    return then(Phase.TRACK, 1.0, act)


def landed(pair: Pair) -> None:
    """Check that the vehicle is on the ground, after a landing that was requested."""
    assert pair.instance.autopilot.position_controller.landed
    assert pair.landings
