"""The take-over of a vehicle whose hover thrust is not that of its file: at once, while it climbs.

The true hover thrust is the simulated vehicle's divided by the factor of its thrust.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
from pair import Pair, make, on_arducopter
from watch import scenario_of, watched

from offboard.flight.estimates import HoverEstimate
from offboard.flight.phases import FLYING
from offboard.identification.learner import IdentifySettings
from offboard.model.vehicle import Vehicle
from simulator import config as simulated

HEIGHT_M = 3.0


def with_thrust(factor: float, on: Callable[..., Pair] = on_arducopter, **options: Any) -> Pair:
    """A hover of a vehicle with `factor` of its thrust."""
    scenario = scenario_of(conditions={"estimator": "perfect", "thrust_scale": factor})
    hover = (f"reference.height_m={HEIGHT_M}", "reference.duration_s=3.0")
    return on(*hover, reference="hover", scenario=scenario, learning=IdentifySettings(), **options)


def taken_over_with(pair: Pair) -> float:
    """The hover thrust that was announced at the take-over; NaN if none was."""
    said = [line for line in pair.companion.announced if "before the take-over" in line]
    return float(said[0].split()[2]) if said else math.nan


def test_arducopter_with_another_thrust_stays_at_its_height() -> None:
    """Without, it is 8 m too high with four times the thrust of its file."""
    pair = with_thrust(2.0, seed=1)
    watch = watched(pair)
    pair.track()
    assert watch.top_m < HEIGHT_M + 1.0
    true = simulated.vehicle("arducopter").hover_thrust / 2.0
    assert taken_over_with(pair) == pytest.approx(true, rel=0.03)


def test_px4_found_in_the_air_keeps_its_height() -> None:
    """It has not found its own hover thrust yet, and climbs until it is taken over."""
    pair = with_thrust(2.0, make, vehicle="px4_sih", aloft=True)
    watch = watched(pair)
    pair.track()
    flown = [-moment.position_ned_m[2] for moment in watch.during(*FLYING)]
    assert min(flown) > HEIGHT_M - 0.5
    assert max(flown) < flown[0] + 0.5
    true = simulated.vehicle("px4_sih").hover_thrust / 2.0
    assert taken_over_with(pair) == pytest.approx(true, rel=0.03)


VEHICLE = Vehicle.model_validate(
    simulated.vehicle("arducopter").model_dump()
    | {"hover_thrust": 0.4, "thrust_delay_s": 0.0, "thrust_lag_s": 0.0}
)


def test_no_estimate_from_too_little_or_on_the_ground_or_while_it_falls() -> None:
    for height_m, fall_mps2, thrust in ((1.0, 9.0, 0.05), (0.0, 0.0, 0.1)):
        hover = HoverEstimate()
        assert hover.hover_thrust(VEHICLE, 0.0) is None
        for step in range(60):
            hover.on_position(0.01 * step, height_m, fall_mps2 * 0.01 * step)
            hover.on_thrust(0.01 * step, thrust, thrust)
        assert hover.hover_thrust(VEHICLE, 0.6) is None
        assert hover.hover_thrust(VEHICLE, 2.0) is None  # reported too long ago
