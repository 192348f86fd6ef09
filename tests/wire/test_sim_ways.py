"""Automatic flight of the simulated PX4 compared with a real one.

Recorded from PX4 1.16.1 SITL (SIH) in real time and trimmed to 5 Hz: takeoffs to 2.5 and 10 m, a
landing, 20 m across, 20 m up, a return; and a mission of legs from 20 to 40 m, one with a stop.
The simulator limits acceleration, not jerk: its takeoffs are 2 s shorter.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from sim_bench import Bench
from sim_talk import ask_again

from simulator.vehicle.sensors import EstimatorName

RECORDINGS = Path(__file__).parent / "recordings"
HOPS, LEGS = (RECORDINGS / f"px4-1.16.1-{name}.tlog.xz" for name in ("hops", "legs"))
Array = NDArray[np.float64]


@dataclass
class Flown:
    """Rows of time, position and velocity (NED, SI), and when items were told as reached."""

    rows: list[tuple[float, ...]] = field(default_factory=list)
    reached_s: dict[int, float] = field(default_factory=dict)

    def hear(self, time_s: float, message: Any) -> None:
        kind, m = message.get_type(), message
        if kind == "LOCAL_POSITION_NED":
            self.rows.append((time_s, m.x, m.y, m.z, m.vx, m.vy, m.vz))
        elif kind == "MISSION_ITEM_REACHED":
            self.reached_s.setdefault(m.seq, time_s)

    def between(self, times_s: Array) -> Array:
        rows = np.array(self.rows)
        return np.stack([np.interp(times_s, rows[:, 0], rows[:, i]) for i in range(1, 7)], axis=1)


@functools.cache
def flown(recording: Path) -> tuple[Flown, Flown]:
    """The real one's flight and the simulator's, which sees itself without errors."""
    real, ours = Flown(), Flown()
    bench = Bench(EstimatorName.PERFECT, heartbeat_type=None)
    ask_again(recording, bench, real, ours, run_on_s=2.0)
    return real, ours


@dataclass(frozen=True)
class Way:
    """From a place to a goal (north, east, down, m), begun at this time and long over at that."""

    title: str
    begin_s: float
    end_s: float
    start: tuple[float, float, float]
    goal: tuple[float, float, float]

    def along(self, side: Flown) -> tuple[Array, Array, Array]:
        """Seconds since it began, share gone and speed on the straight line. The real one's
        estimates wander by decimetres beside it and along it."""
        times_s = np.arange(0.0, self.end_s - self.begin_s, 0.02)
        rows = side.between(self.begin_s + times_s)
        line = np.subtract(self.goal, self.start)
        length_m = float(np.linalg.norm(line))
        gone_m = length_m + (rows[:, :3] - self.goal) @ line / length_m
        return times_s, gone_m / length_m, rows[:, 3:] @ line / length_m

    def passed_s(self, side: Flown, share: float) -> float:
        """When so much of the way is behind it."""
        times_s, gone, _ = self.along(side)
        return float(times_s[np.argmax(gone > share)])


WAYS = [
    Way("takeoff to 2.5 m", 7.4, 22.0, (0, 0, 0), (0, 0, -2.5)),
    Way("takeoff to 10 m", 40.4, 62.0, (0, 0, 0), (0, 0, -10)),
    Way("20 m across", 63.2, 80.0, (0, 0, -10), (20, 0, -10)),
    Way("20 m up", 81.2, 98.0, (20, 0, -10), (20, 0, -30)),
    Way("20 m home", 99.2, 107.0, (20, 0, -30), (0, 0, -30)),
]


@pytest.mark.parametrize("way", WAYS, ids=lambda way: way.title)
def test_a_leg_has_the_times_and_the_speed_of_the_real_vehicle(way: Way) -> None:
    real, ours = flown(HOPS)
    for share in (0.25, 0.5, 0.75):
        theirs_s = way.passed_s(real, share)
        assert way.passed_s(ours, share) == pytest.approx(theirs_s, rel=0.1, abs=2.0)
    theirs_mps, ours_mps = (way.along(side)[2].max() for side in (real, ours))
    assert abs(ours_mps - theirs_mps) < 0.1 * theirs_mps + 0.15


def test_mission_items_are_reached_at_the_time_of_the_real_vehicle() -> None:
    """From item to item; the first, a takeoff, from the start on."""
    real, ours = (np.diff([9.3, *side.reached_s.values()]) for side in flown(LEGS))
    assert list(flown(LEGS)[1].reached_s) == list(flown(LEGS)[0].reached_s)[: len(ours)]
    assert len(real) == 6
    for theirs_s, mine_s in zip(real, ours, strict=True):
        assert mine_s == pytest.approx(theirs_s, rel=0.1, abs=2.0)
