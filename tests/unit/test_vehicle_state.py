"""What a flight knows of its vehicle: ground contact, jumps of the position, ages of telemetry."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from offboard.flight.estimates import PositionJumps
from offboard.flight.ground_contact import GroundContact
from offboard.flight.vehicle_state import VehicleState
from offboard.mavlink.events import Attitude, Heartbeat, Landed, LocalPosition, StatusText


class Standing:
    """A vehicle that rests 2 m below its local origin, disarmed; time goes on with `at`."""

    def __init__(self) -> None:
        self.vehicle = VehicleState()
        self.contact = GroundContact(self.vehicle)
        self.heartbeat(0.0, armed=False)
        self.position(0.0)

    def heartbeat(self, now_s: float, *, armed: bool) -> None:
        self.vehicle.update(Heartbeat("POSCTL", armed, 4, 2), now_s)

    def position(self, now_s: float, height_m: float = 0.0, climb_mps: float = 0.0) -> None:
        noise = 1e-6 * now_s  # a real estimate never repeats exactly
        place = (5.0 + noise, noise - 3.0, 2.0 - height_m + noise)
        event = LocalPosition(now_s, place, (noise, noise, -climb_mps + noise))
        self.vehicle.update(event, now_s)
        self.contact.on_position(now_s, place, -climb_mps + noise)

    def at(self, now_s: float) -> GroundContact:
        self.vehicle.now_s = now_s
        return self.contact


def armed(height_m: float = 0.0, climb_mps: float = 0.0, detector: str = "on_ground") -> Standing:
    standing = Standing()
    standing.heartbeat(1.0, armed=True)
    standing.position(1.0, height_m, climb_mps)
    standing.vehicle.update(Landed(detector), 1.0)
    return standing


@pytest.mark.parametrize(
    ("signs", "certain"),
    [
        ({"height_m": 0.7}, True),
        ({"height_m": 0.8}, False),
        ({"height_m": -0.8}, False),
        ({"climb_mps": 0.45}, True),
        ({"climb_mps": 0.55}, False),
        ({"climb_mps": -0.55}, False),
        ({"detector": "unknown"}, False),
        ({"detector": "in_air"}, False),
    ],
)
def test_armed_vehicle_is_on_ground_only_if_all_signs_agree(
    signs: dict[str, Any], certain: bool
) -> None:
    vehicle = armed(**signs)
    assert vehicle.at(1.0).on_ground is certain
    assert vehicle.at(1.0).in_the_air is not certain
    assert vehicle.at(2.4).on_ground is certain
    assert vehicle.at(2.6).in_the_air  # the land detector is not heard any more
    vehicle.vehicle.position = None
    assert vehicle.at(1.0).in_the_air


@pytest.mark.parametrize(("detector", "certain"), [("in_air", False), ("unknown", True)])
def test_disarmed_vehicle_is_on_ground_unless_its_land_detector_shows_flight(
    detector: str, certain: bool
) -> None:
    """Regression: HEARTBEATs of a second vehicle with the same ids, which was disarmed, made the
    service stream setpoints without thrust to the one in flight."""
    standing = armed(2.5, detector=detector)
    standing.heartbeat(1.0, armed=False)
    assert standing.at(1.0).on_ground is certain


@pytest.mark.parametrize(
    ("heights_m", "climb_mps", "lifted"),
    [
        ((0.16, 0.16), 0.0, False),
        ((0.16, 0.16, 0.16), 0.0, True),
        ((0.14, 0.14, 0.14), 0.0, False),
        ((0.16, 0.16, 0.14, 0.16, 0.16), 0.0, False),
        ((0.05, 0.05, 0.05), 0.41, True),
        ((0.05, 0.05, 0.05), 0.39, False),
        ((0.04, 0.04, 0.04), 3.0, False),  # an estimate that is in motion on the ground
    ],
)
def test_lift_off_needs_three_positions_in_a_row(
    heights_m: tuple[float, ...], climb_mps: float, lifted: bool
) -> None:
    standing = armed()
    for number, height_m in enumerate(heights_m):
        standing.position(2.0 + 0.1 * number, height_m, climb_mps)
    assert standing.contact.lifted_off is lifted


@pytest.mark.parametrize(
    ("low_m", "high_m", "for_s", "stood"),
    [
        (0.0, 0.0, 16.0, True),
        (0.0, 0.08, 16.0, True),
        (0.0, 0.12, 16.0, False),
        (-0.08, 0.08, 16.0, False),  # the range counts
        (0.4, 0.4, 16.0, False),  # hovers low
        (0.0, 0.0, 13.0, False),
    ],
)
def test_standing_needs_15_s_without_motion(
    low_m: float, high_m: float, for_s: float, stood: bool
) -> None:
    standing = armed(height_m=low_m)
    for number in range(1, round(10 * for_s) + 1):
        standing.position(1.0 + 0.1 * number, high_m if number % 2 else low_m)
    assert standing.contact.stood_for(15.0) is stood


# --- jumps ----------------------------------------------------------------------------------------


SPEED = (1.0, -0.5, 0.2)


def found(sd_m: float, jump_m: float) -> list[float]:
    """Sizes of the jumps found in 20 s at 100 Hz of steady motion with white noise and, at 10 s,
    a jump to the east."""
    random, jumps = np.random.default_rng(4), PositionJumps()
    sizes = []
    for time_s in np.arange(2000) / 100.0:
        place = time_s * np.array(SPEED) + random.normal(0.0, sd_m, 3)
        place[1] += jump_m * (time_s >= 10.0)
        jump = jumps.on_position(LocalPosition(float(time_s), tuple(place.tolist()), SPEED))
        if jump is not None and time_s > 1.0:
            sizes.append(float(np.linalg.norm(jump)))
    return sizes


@pytest.mark.parametrize(
    ("sd_m", "jump_m"), [(0.0, 0.35), (0.02, 0.5), (0.05, 0.0), (0.07, 0.0), (0.1, 2.0), (0.2, 0.0)]
)
def test_position_jumps_are_found_and_noise_is_ignored(sd_m: float, jump_m: float) -> None:
    assert found(sd_m, jump_m) == [pytest.approx(jump_m, abs=6.0 * sd_m + 1e-9)][: jump_m > 0.0]


# --- age of position and attitude -----------------------------------------------------------------


def position(time_s: float) -> LocalPosition:
    return LocalPosition(time_s, (0.0,) * 3, (0.0,) * 3)


def attitude(time_s: float) -> Attitude:
    return Attitude(time_s, (1.0, 0.0, 0.0, 0.0), (0.0,) * 3)


def test_link_outage_does_not_count_as_telemetry_age() -> None:
    """Both streams arrive at 10 Hz until 10 s; the next message comes at 10.9 s."""
    state = VehicleState()
    for time_s in np.arange(1, 101) / 10.0:
        state.update(position(time_s), time_s)
        state.update(attitude(time_s), time_s)
    state.update(position(10.9), 10.9)
    assert state.attitude_age_s == pytest.approx(0.0)
    state.update(position(11.0), 11.0)
    assert state.attitude_age_s == pytest.approx(0.1)  # since the link is back
    state.update(attitude(11.0), 11.0)
    state.update(attitude(11.9), 11.9)  # after a second outage
    assert state.position_age_s == pytest.approx(0.0)


def test_explanation_quotes_vehicle_texts_down_to_notice() -> None:
    """Only by a NOTICE ArduCopter says that a fence made it leave the mode; we once reported the
    change of mode without a reason."""
    vehicle = VehicleState()
    for severity, text in ((6, "EKF3 IMU0 is using GPS"), (5, "Circle fence breached")):
        vehicle.update(StatusText(severity, text), 1.0)
    assert vehicle.explanation("") == "; the vehicle said: Circle fence breached"
