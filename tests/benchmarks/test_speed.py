"""Time of a decision and of a second of the simulated vehicle: run with `--benchmark-enable`.
Nothing here asserts on time.

The vehicle is in memory, with PX4's estimator and the default rates of PX4's companion link. 1000 /
(milliseconds per second of flight) is the ratio to real time.
"""

from __future__ import annotations

import math
import subprocess
import sys
from dataclasses import replace
from itertools import cycle
from typing import Any

import numpy as np
import pytest
from laws import LEVEL, at

from offboard.control.base import Situation
from offboard.control.catalogue import settings_of
from offboard.reference.transfer import transfer
from offboard.run.configuration import load
from simulator import config
from simulator.config import Start
from simulator.firmware.px4 import PX4
from simulator.instance import Instance
from simulator.vehicle.conditions import Conditions
from simulator.vehicle.sensors import EstimatorName

pytestmark = pytest.mark.slow
SPHERES = [
    {"shape": "sphere", "north_m": north, "east_m": east, "height_m": 3.0, "radius_m": 0.4}
    for north, east in ((1.5, 0.3), (3.0, 1.3), (4.5, 1.2))
]
VEHICLE = load("flight").vehicle


def situations() -> list[Situation]:
    """Fifty states about a brisk transfer, a decision apart."""
    rng, found = np.random.default_rng(3), []
    reference = transfer((0, 0, -3), (6, 2, -4), 0.0, 0.5)
    for at_s in 0.1 * np.arange(50):
        sample = reference.sample(at_s + 0.057)
        tilt = 0.03 * rng.normal(size=2)
        state = replace(
            at(sample.position_ned_m + 0.1 * rng.normal(size=3), 0.0),
            time_s=at_s + 0.057,
            velocity_ned_mps=sample.velocity_ned_mps + 0.1 * rng.normal(size=3),
            thrust_direction_ned=np.array([*tilt, math.sqrt(1.0 - tilt @ tilt)]),
        )
        found.append(Situation(float(at_s), state, reference, LEVEL))
    return found


@pytest.mark.benchmark(group="one decision")
@pytest.mark.parametrize(
    ("law", "steps", "volumes"),
    [("paper", None, 0), ("pid", None, 0), ("lqr", None, 0), ("pso", None, 0), ("mpc", 10, 0),
     ("horizon", 10, 0), ("horizon", 20, 1), ("horizon", 20, 3)],
)  # fmt: skip
def test_time_of_one_decision(law: str, steps: int | None, volumes: int, benchmark: Any) -> None:
    """The 99th percentile of 1000 is printed with `-s` and kept by `--benchmark-json`; on a busy
    machine ask for `--benchmark-timer=time.process_time`."""
    settings: dict[str, Any] = {"law": law}
    if steps:
        settings["steps"] = steps
    if volumes:
        settings["keep_out"] = SPHERES[:volumes]
    controller = settings_of(law)(**settings).build(VEHICLE, period_s=0.1, seed=7)
    met = cycle(situations())
    decision = benchmark.pedantic(
        lambda: controller.decide(next(met)), rounds=1000, warmup_rounds=50
    )
    assert np.linalg.norm(decision.command.thrust_direction_ned) == pytest.approx(1.0)
    if benchmark.stats:
        p99_ms = 1e3 * float(np.percentile(benchmark.stats.stats.data, 99))
        benchmark.extra_info["p99_ms"] = p99_ms
        print(f"99th percentile {p99_ms:.2f} ms")


def _fly(instance: Instance, duration_s: float) -> int:
    """Fly for `duration_s`; return the bytes sent at its barriers."""
    end_s, sent = instance.time_s + duration_s, 0
    while instance.advance_to_barrier(end_s):
        sent += sum(map(len, instance.barrier()[1]))
    return sent


@pytest.mark.benchmark(group="a second of the simulator")
@pytest.mark.parametrize(
    "start", [None, Start(height_m=3.0)], ids=["on the ground", "holding position"]
)
def test_time_of_one_simulated_second(benchmark: Any, start: Start | None) -> None:
    vehicle, conditions = config.vehicle(PX4.vehicle), Conditions(estimator=EstimatorName.PX4_LIKE)
    instance = Instance(PX4, vehicle, conditions, 1, lockstep=True, ground_link=False, start=start)
    _fly(instance, 6.0)
    sent = benchmark(_fly, instance, 1.0)
    assert 20_000 < sent < 60_000


@pytest.mark.benchmark(group="twenty vehicles in real time")
def test_time_of_twenty_instances(benchmark: Any) -> None:
    """The last line says how many steps ended later than the next one was due."""
    command = [sys.executable, "-m", "simulator", "--instances", "20", "--gcs", "none",
               "--connect", "udpout:127.0.0.1:24540", "--duration", "5"]  # fmt: skip

    def run() -> str:
        output = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        return output.splitlines()[-1]

    output = benchmark.pedantic(run, rounds=1)
    print(f"\n{output}")
    assert "of 1250 deadlines missed" in output
