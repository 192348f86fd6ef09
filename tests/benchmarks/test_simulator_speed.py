"""What a second of the simulated vehicle costs: run with `--benchmark-enable`.

In memory, default rates of PX4's companion link, PX4's estimator. Nothing here asserts on time:
1000 / (milliseconds per second of flight) is the ratio to real time.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from typing import Any

import pytest

from simulator import config
from simulator.autopilot.commander import Request
from simulator.firmware.px4 import PX4
from simulator.instance import Instance
from simulator.vehicle.conditions import Conditions
from simulator.vehicle.sensors import EstimatorName

pytestmark = pytest.mark.slow


def _fly(instance: Instance, duration_s: float) -> int:
    """Bytes sent at the barriers of so much flight."""
    end_s, sent = instance.time_s + duration_s, 0
    while instance.advance_to_barrier(end_s):
        sent += sum(map(len, instance.barrier()[1]))
    return sent


def _standing() -> Instance:
    conditions = Conditions(estimator=EstimatorName.PX4_LIKE)
    vehicle = config.vehicle(PX4.vehicle)
    instance = Instance(PX4, vehicle, conditions, 1, lockstep=True, ground_link=False)
    _fly(instance, 6.0)
    return instance


def _holding() -> Instance:
    instance = _standing()
    instance.autopilot.handle("mode", Request("AUTO.TAKEOFF"))
    instance.autopilot.handle("arm")
    _fly(instance, 25.0)  # until it rests there
    return instance


@pytest.mark.benchmark(group="a second of the simulator")
@pytest.mark.parametrize("begin", [_standing, _holding], ids=["on the ground", "holding position"])
def test_a_second_in_memory(benchmark: Any, begin: Callable[[], Instance]) -> None:
    instance = begin()
    sent = benchmark(_fly, instance, 1.0)
    assert 20_000 < sent < 60_000


@pytest.mark.benchmark(group="twenty vehicles in real time")
def test_instances(benchmark: Any) -> None:
    """The last line says how many steps ended later than the next one was due."""
    command = [sys.executable, "-m", "simulator", "--instances", "20", "--gcs", "none",
               "--connect", "udpout:127.0.0.1:24540", "--duration", "5"]  # fmt: skip

    def run() -> str:
        output = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        return output.splitlines()[-1]

    output = benchmark.pedantic(run, rounds=1)
    print(f"\n{output}")
    assert "of 1250 deadlines missed" in output
