"""The simulated autopilot's position loop against SciPy's rotations and the thrust balance."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from simulator.autopilot.parameters import ParameterTable
from simulator.autopilot.position_loop import GRAVITY_MPS2, Limits, PositionLoop
from simulator.autopilot.state import StateEstimate
from simulator.firmware.px4 import PX4
from simulator.firmware.values import NAN3, MotionSetpoint, Quaternion, Triple

GAINS = PX4.gains(ParameterTable(PX4).__getitem__)
HOVER = Limits(hover_thrust=0.5)
ZERO = (0.0, 0.0, 0.0)
ESTIMATE = StateEstimate(0.0, ZERO, ZERO, (1.0, 0.0, 0.0, 0.0), ZERO, False, 0, 1.0)


def _stepped(
    loop: PositionLoop, motion: MotionSetpoint, limits: Limits = HOVER
) -> tuple[Quaternion, float, Triple]:
    """One period at the origin, at rest."""
    return loop.step(motion, limits, ESTIMATE)


@pytest.mark.parametrize("yaw_rad", [0.0, 0.7, math.pi / 2, 2.5, math.pi, -1.9])
@pytest.mark.parametrize(
    "acceleration", [(0.0, 0.0, 0.0), (3.0, 0.0, 0.0), (0.0, -4.0, 1.0), (-2.0, 2.5, -3.0)]
)
def test_attitude_and_thrust_give_the_acceleration(
    yaw_rad: float, acceleration: tuple[float, float, float]
) -> None:
    """Thrust along the body axis, hover thrust per g: lateral as asked at constant height."""
    loop = PositionLoop(GAINS)
    motion = MotionSetpoint(NAN3, NAN3, acceleration, yaw_rad)
    attitude, thrust, _ = _stepped(loop, motion)
    w, x, y, z = attitude
    turned = Rotation.from_quat([x, y, z, w])
    down = turned.apply([0.0, 0.0, 1.0])
    produced = np.array([0, 0, GRAVITY_MPS2]) - thrust / 0.5 * GRAVITY_MPS2 * down
    assert produced[2] == pytest.approx(acceleration[2], abs=1e-9)
    share = (GRAVITY_MPS2 - acceleration[2]) / GRAVITY_MPS2  # the tilt is chosen for hover
    assert produced[:2] == pytest.approx(share * np.array(acceleration[:2]), abs=1e-9)
    assert turned.as_euler("ZYX")[0] == pytest.approx(math.remainder(yaw_rad, 2 * math.pi))


def test_tilt_and_thrust_are_limited() -> None:
    loop = PositionLoop(GAINS)
    motion = MotionSetpoint(NAN3, NAN3, (100.0, 0.0, 100.0))
    attitude, thrust, _ = _stepped(loop, motion)
    w, x, y, z = attitude
    down = Rotation.from_quat([x, y, z, w]).apply([0.0, 0.0, 1.0])
    assert math.acos(down[2]) == pytest.approx(GAINS.tilt_max_rad)
    assert thrust == 0.0


def test_speed_limits() -> None:
    loop = PositionLoop(GAINS)
    motion = MotionSetpoint((300.0, 400.0, -100.0))
    *_, wanted = _stepped(loop, motion, Limits(0.5, across_mps=5.0))
    assert wanted == pytest.approx((3.0, 4.0, -GAINS.speed_up_mps))
