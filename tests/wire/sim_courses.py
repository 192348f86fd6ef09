"""An ArduCopter in GUIDED, and where a bench's vehicle is and goes."""

from __future__ import annotations

import math

from sim_bench import Bench

from simulator.firmware.ardupilot import ARDUPILOT
from simulator.vehicle.sensors import EstimatorName


def copter() -> Bench:
    """An ArduCopter that holds 5 m in GUIDED."""
    bench = Bench(EstimatorName.PERFECT, firmware=ARDUPILOT, boot_scale=0.1)
    bench.run(4.5)
    bench.command(176, 1, 4)
    bench.command(400, 1)
    bench.command(22, *(0.0,) * 6, 5.0)
    bench.run(9.0)
    return bench


def heading_deg(bench: Bench) -> float:
    return math.degrees(bench.instance.autopilot.state.estimate.yaw_rad)


def place(bench: Bench) -> tuple[float, ...]:
    return tuple(bench.instance.autopilot.state.truth.position_ned_m.tolist())


def velocity(bench: Bench) -> tuple[float, ...]:
    return tuple(bench.instance.autopilot.state.truth.velocity_ned_mps.tolist())
