"""The true motion of a vehicle in flight, and what several tests of safety ask."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pair import SHORT, Bytes, Filter, Pair, decode, make, on_arducopter, through

from offboard.flight.phases import TRACKING, Phase
from simulator import config as simulated
from simulator.config import Scenario

SET_MODE, LAND, ARM, SET_MESSAGE_INTERVAL = 176, 21, 400, 511  # MAV_CMD
LOW, HIGH = "reference.height_m=1.0", "reference.height_m=3.0"  # low: a short climb and landing
ONE_LAP = "reference.laps=1"
FIRMWARES = (("px4", make), ("ardupilot", on_arducopter))
# one lap, by a vehicle that hovers when its links open; or a hover after its own take-off
BOTH, FROM_THE_GROUND = (
    pytest.mark.parametrize(
        "fly",
        [partial(fly, *reference, aloft=aloft, **named) for _, fly in FIRMWARES],
        ids=[name for name, _ in FIRMWARES],
    )
    for reference, named, aloft in (
        ((LOW, ONE_LAP), {}, True),
        (SHORT, {"reference": "hover"}, False),
    )
)


def alternately(*cases: Any) -> list[Any]:
    """Arguments (case, fly), as for `BOTH`: each case is flown on one of the firmwares, in turn."""
    each = ((case, *FIRMWARES[index % 2]) for index, case in enumerate(cases))
    return [
        pytest.param(case, partial(fly, LOW, ONE_LAP, aloft=True), id=f"{index}-{name}")
        for index, (case, name, fly) in enumerate(each)
    ]


REACTION_S = 0.13  # a report of the mode at 10 Hz, and a turn
WATCHED_STEPS = 5  # 20 ms


@dataclass(frozen=True)
class Moment:
    """The truth. `error_m` is the distance from the reference while it is tracked, else NaN."""

    time_s: float
    phase: Phase
    mode: str
    armed: bool
    position_ned_m: NDArray[np.float64]
    down_mps: float
    error_m: float


@dataclass
class Watch:
    """A downlink that notes the truth every 20 ms, and has the fault `link`."""

    pair: Pair
    link: Filter = through
    moments: list[Moment] = field(default_factory=list)

    def __call__(self, time_s: float, datagrams: Bytes) -> Bytes:
        if self.pair.steps % WATCHED_STEPS == 0:
            self.moments.append(self._now(time_s))
        return self.link(time_s, datagrams)

    def _now(self, time_s: float) -> Moment:
        autopilot, companion = self.pair.instance.autopilot, self.pair.companion
        truth, commander = autopilot.state.truth, autopilot.commander
        position = np.array(truth.position_ned_m)
        vehicle_s = autopilot.state.time_s + 1e-6 * self.pair.instance.view.clock_offset_us
        tracked = companion.phase in TRACKING
        wanted = companion.current.plan.sample(vehicle_s) if tracked else None
        error = np.nan if wanted is None else np.linalg.norm(position - wanted.position_ned_m)
        return Moment(
            time_s,
            companion.phase,
            commander.mode.name,
            commander.armed,
            position,
            float(truth.velocity_ned_mps[2]),
            float(error),
        )

    def during(self, *phases: Phase) -> list[Moment]:
        return [moment for moment in self.moments if moment.phase in phases]

    @property
    def error_m(self) -> float:
        """Largest true distance from the reference while it was tracked."""
        return max(moment.error_m for moment in self.during(*TRACKING))

    @property
    def top_m(self) -> float:
        return max(-moment.position_ned_m[2] for moment in self.moments)

    @property
    def height_m(self) -> float:
        """The newest."""
        return -float(self.moments[-1].position_ned_m[2])

    @property
    def fall_mps(self) -> float:
        """Largest downward speed."""
        return max(moment.down_mps for moment in self.moments)

    @property
    def armings(self) -> int:
        armed = [moment.armed for moment in self.moments]
        return sum(now and not before for before, now in pairwise(armed))

    def left_s(self, mode: str) -> float:
        """When the vehicle first left `mode`."""
        modes = [(moment.time_s, moment.mode) for moment in self.moments]
        return next(at_s for (_, before), (at_s, now) in pairwise(modes) if before == mode != now)


def watched(pair: Pair) -> Watch:
    """Watch `pair`; its present downlink stays."""
    watch = Watch(pair, pair.down)
    pair.down = watch
    return watch


def engage_mode(pair: Pair) -> str:
    dialect = pair.companion.current.dialect
    assert dialect is not None
    return dialect.engage_mode


def sent_after(pair: Pair, time_s: float) -> list[str]:
    """Setpoints and commands, but requests for telemetry, that left after `time_s`."""
    frames = [(at_s, decode(frame)) for at_s, _, frame in pair.sent if at_s > time_s]
    return [
        f"{message.get_type()} at {at_s:.2f}"
        for at_s, message in frames
        if message.get_type() in ("COMMAND_LONG", "SET_ATTITUDE_TARGET")
        and getattr(message, "command", None) != SET_MESSAGE_INTERVAL
    ]


def said(pair: Pair, words: str) -> bool:
    return any(words in sentence for sentence in pair.companion.announced)


def scenario_of(*faults: dict[str, Any], **more: Any) -> Scenario:
    """A scenario with these faults."""
    return Scenario.model_validate({"name": "test", "faults": faults, **more})


def early(name: str, at_s: float = 7.0) -> Scenario:
    """A shipped scenario whose faults in track begin in the first lap of a vehicle that hovered."""
    scenario = simulated.scenario(name)
    first_s = min(fault.at_s for fault in scenario.faults)
    earlier = [
        each.model_copy(update={"at_s": each.at_s - first_s + at_s}) for each in scenario.faults
    ]
    return scenario.model_copy(update={"faults": earlier})


Fly = Callable[..., Pair]
