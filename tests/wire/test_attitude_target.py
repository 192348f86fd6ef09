"""Signs, frames and thrust of SET_ATTITUDE_TARGET, read back by pymavlink and SciPy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from vehicle_frames import ARDUPILOT, PX4, Sender, pinned, understood

from offboard.mavlink.outgoing import AttitudeTarget

HEADINGS_RAD = [0.0, 0.5 * math.pi, math.pi, -0.5 * math.pi]
HOVER, GRAVITY = 0.489, 9.81


def target(**changes: object) -> AttitudeTarget:
    values: dict[str, object] = {
        "time_s": 12.345,
        "thrust_mps2": GRAVITY,
        "thrust_direction_ned": (0.0, 0.0, 1.0),
        "heading_rad": 0.0,
        "hover_thrust": HOVER,
        "gravity_mps2": GRAVITY,
    }
    return AttitudeTarget(**(values | changes))  # type: ignore[arg-type]


def sent(value: AttitudeTarget, autopilot: int = PX4) -> object:
    return understood(pinned(Sender(7), autopilot).encode(value))


def rotation(message: object) -> Rotation:
    w, x, y, z = message.q  # type: ignore[attr-defined]
    return Rotation.from_quat([x, y, z, w])


def tilted(north: float, east: float) -> tuple[float, float, float]:
    return north, east, math.sqrt(1.0 - north * north - east * east)


@pytest.mark.parametrize("heading_rad", HEADINGS_RAD)
@pytest.mark.parametrize("lean", [(0.3, 0.0), (-0.3, 0.0), (0.0, 0.3), (0.0, -0.3), (0.2, -0.4)])
def test_body_axes_have_the_commanded_direction(
    heading_rad: float, lean: tuple[float, float]
) -> None:
    direction = tilted(*lean)
    attitude = rotation(sent(target(thrust_direction_ned=direction, heading_rad=heading_rad)))
    np.testing.assert_allclose(attitude.apply([0.0, 0.0, 1.0]), direction, atol=1e-6)
    nose = attitude.apply([1.0, 0.0, 0.0])
    heading_error = math.atan2(nose[1], nose[0]) - heading_rad
    assert math.remainder(heading_error, 2.0 * math.pi) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize(
    ("heading_rad", "roll_rad", "pitch_rad"),
    [
        # acceleration is -T b: b to the south accelerates north; seen from each heading
        (HEADINGS_RAD[0], 0.0, -0.2),  # nose north: nose down
        (HEADINGS_RAD[1], -0.2, 0.0),  # nose east: roll left
        (HEADINGS_RAD[2], 0.0, 0.2),  # nose south: nose up
        (HEADINGS_RAD[3], 0.2, 0.0),  # nose west: roll right
    ],
)
def test_tilt_that_accelerates_north(heading_rad: float, roll_rad: float, pitch_rad: float) -> None:
    direction = (-math.sin(0.2), 0.0, math.cos(0.2))
    message = sent(target(thrust_direction_ned=direction, heading_rad=heading_rad))
    yaw, pitch, roll = rotation(message).as_euler("ZYX")
    assert (roll, pitch) == pytest.approx((roll_rad, pitch_rad), abs=1e-6)
    assert math.remainder(yaw - heading_rad, 2.0 * math.pi) == pytest.approx(0.0, abs=1e-6)


def test_fields() -> None:
    message = sent(target())
    assert message.get_type() == "SET_ATTITUDE_TARGET"  # type: ignore[attr-defined]
    fields = message.to_dict()  # type: ignore[attr-defined]
    assert fields["time_boot_ms"] == 12345
    assert (fields["target_system"], fields["target_component"]) == (7, 1)
    assert fields["type_mask"] == 7
    assert fields["body_roll_rate"] == fields["body_pitch_rate"] == fields["body_yaw_rate"] == 0.0
    assert fields["q"] == [1.0, 0.0, 0.0, 0.0]


@pytest.mark.parametrize("seed", range(20))
def test_quaternion_has_unit_length_and_positive_w(seed: int) -> None:
    generator = np.random.default_rng(seed)
    direction = generator.normal(size=3) + np.array([0.0, 0.0, 3.0])
    direction *= generator.uniform(0.95, 1.05) / np.linalg.norm(direction)
    message = sent(
        target(
            thrust_direction_ned=tuple(direction),
            heading_rad=generator.uniform(-20.0, 20.0),
        ),
        ARDUPILOT,
    )
    q = np.array(message.q)  # type: ignore[attr-defined]
    assert abs(np.linalg.norm(q) - 1.0) < 1e-6  # ArduCopter drops what is off by 5e-4
    assert q[0] >= 0.0


@pytest.mark.parametrize(
    ("autopilot", "thrust_mps2", "direction", "body_z_down", "expected"),
    [
        (PX4, 9.81, (0.0, 0.0, 1.0), None, 0.489),
        (PX4, 12.0, tilted(0.5, 0.0), None, 0.489 * 12.0 / 9.81),  # the tilt is not compensated
        (PX4, 12.0, tilted(0.5, 0.0), 0.9, 0.489 * 12.0 / 9.81),
        (ARDUPILOT, 9.81, (0.0, 0.0, 1.0), None, 0.489),
        # 30 degrees, thrust holding the height: hover thrust, since the boost divides by cos
        (ARDUPILOT, 9.81 / math.cos(math.pi / 6), (0.5, 0.0, math.cos(math.pi / 6)), None, 0.489),
        (ARDUPILOT, 12.0, tilted(0.5, 0.0), 0.9, 0.489 * 12.0 * 0.9 / 9.81),
        (PX4, 100.0, (0.0, 0.0, 1.0), None, 1.0),
        (PX4, -1.0, (0.0, 0.0, 1.0), None, 0.0),
        (ARDUPILOT, 100.0, (0.0, 0.0, 1.0), None, 1.0),
        (ARDUPILOT, 9.81, (0.0, 0.0, -1.0), None, 0.0),
    ],
)
def test_thrust_rules(
    autopilot: int,
    thrust_mps2: float,
    direction: tuple[float, float, float],
    body_z_down: float | None,
    expected: float,
) -> None:
    message = sent(
        target(thrust_mps2=thrust_mps2, thrust_direction_ned=direction, body_z_down=body_z_down),
        autopilot,
    )
    assert message.thrust == pytest.approx(expected, abs=1e-6)  # type: ignore[attr-defined]


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize(
    "field", ["time_s", "thrust_mps2", "heading_rad", "hover_thrust", "gravity_mps2", "body_z_down"]
)
def test_what_is_not_finite_is_refused(field: str, bad: float) -> None:
    session = pinned(Sender(), ARDUPILOT)
    with pytest.raises(ValueError, match="finite"):
        session.encode(target(**{field: bad}))


@pytest.mark.parametrize(
    ("direction", "match"),
    [
        ((math.nan, 0.0, 1.0), "finite"),
        ((0.0, math.inf, 1.0), "finite"),
        ((0.0, 0.0, 0.0), "unit vector"),
        ((0.0, 0.0, 2.0), "unit vector"),
    ],
)
def test_a_direction_that_is_no_unit_vector_is_refused(
    direction: tuple[float, float, float], match: str
) -> None:
    with pytest.raises(ValueError, match=match):
        pinned(Sender()).encode(target(thrust_direction_ned=direction))


def test_hover_thrust_out_of_range_is_refused() -> None:
    for hover in (0.0, 1.0, -0.5):
        with pytest.raises(ValueError, match="hover thrust"):
            pinned(Sender()).encode(target(hover_thrust=hover))
