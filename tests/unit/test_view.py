"""How old position and attitude are, with outages of one stream and of the whole link."""

from __future__ import annotations

import numpy as np
import pytest

from offboard.flight.view import VehicleView
from offboard.mavlink.events import Attitude, LocalPosition

STILL = (0.0, 0.0, 0.0)
LEVEL = (1.0, 0.0, 0.0, 0.0)


def position(time_s: float) -> LocalPosition:
    return LocalPosition(time_s, STILL, STILL)


def attitude(time_s: float) -> Attitude:
    return Attitude(time_s, LEVEL, STILL)


def hovering_view() -> VehicleView:
    """Both streams at 10 Hz until 10 s."""
    view = VehicleView()
    for time_s in np.arange(1, 101) / 10.0:
        view.note(position(time_s))
        view.note(attitude(time_s))
    return view


def test_an_outage_of_the_whole_link_ages_nothing() -> None:
    view = hovering_view()
    view.note(position(10.9))
    assert view.attitude_age_s == pytest.approx(0.0)
    view.note(position(11.0))
    assert view.attitude_age_s == pytest.approx(0.1)  # since the link is back
    view.note(attitude(11.0))
    view.note(attitude(11.9))  # a second one
    assert view.position_age_s == pytest.approx(0.0)


@pytest.mark.parametrize("interval_s", [0.05, 0.2, 0.31, 0.4, 0.9])
def test_one_stream_that_stops_is_seen_however_slow_the_other_is(interval_s: float) -> None:
    for stopped in ("position", "attitude"):
        view = hovering_view()
        going = attitude if stopped == "position" else position
        for time_s in 10.0 + np.arange(1, 11) * interval_s:
            view.note(going(time_s))
        age_s = getattr(view, f"{stopped}_age_s")
        assert age_s >= 10 * interval_s - interval_s - 1e-9
