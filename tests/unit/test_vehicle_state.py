"""Age of position and attitude, with outages of one stream and of the whole link."""

from __future__ import annotations

import numpy as np
import pytest

from offboard.flight.vehicle_state import VehicleState
from offboard.mavlink.events import Attitude, LocalPosition

STILL = (0.0, 0.0, 0.0)
LEVEL = (1.0, 0.0, 0.0, 0.0)


def position(time_s: float) -> LocalPosition:
    return LocalPosition(time_s, STILL, STILL)


def attitude(time_s: float) -> Attitude:
    return Attitude(time_s, LEVEL, STILL)


def hovering() -> VehicleState:
    """Both streams at 10 Hz until 10 s."""
    state = VehicleState()
    for time_s in np.arange(1, 101) / 10.0:
        state.update(position(time_s), time_s)
        state.update(attitude(time_s), time_s)
    return state


def test_an_outage_of_the_whole_link_does_not_count_as_age() -> None:
    state = hovering()
    state.update(position(10.9), 10.9)
    assert state.attitude_age_s == pytest.approx(0.0)
    state.update(position(11.0), 11.0)
    assert state.attitude_age_s == pytest.approx(0.1)  # since the link is back
    state.update(attitude(11.0), 11.0)
    state.update(attitude(11.9), 11.9)  # a second one
    assert state.position_age_s == pytest.approx(0.0)


@pytest.mark.parametrize("interval_s", [0.05, 0.31, 0.9])
@pytest.mark.parametrize("stopped", ["position", "attitude"])
def test_a_stopped_stream_is_detected_at_any_rate_of_the_other(
    stopped: str, interval_s: float
) -> None:
    state, going = hovering(), attitude if stopped == "position" else position
    for time_s in 10.0 + np.arange(1, 11) * interval_s:
        state.update(going(time_s), time_s)
    assert getattr(state, f"{stopped}_age_s") >= 9 * interval_s - 1e-9
