"""The take-over of a vehicle whose hover thrust is not that of its file: at once, while it climbs.

The true hover thrust is the simulated vehicle's divided by the factor of its thrust.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from faults import TARGET, without
from pair import LEAN, Pair, make

from offboard.flight.hover_estimate import HoverEstimate
from offboard.flight.phases import Phase
from offboard.identification import vehicle_estimate
from offboard.identification.learner import IdentifySettings
from offboard.model.vehicle import Vehicle
from simulator import config as simulated
from simulator.firmware.ardupilot import ARDUPILOT
from simulator.firmware.base import Firmware
from simulator.instance import Instance
from simulator.start import Start
from simulator.steps import STEP_S

HEIGHT_M = 3.0
HOVER = (f"reference.height_m={HEIGHT_M}", "reference.duration_s=3.0")


@pytest.fixture(autouse=True)
def _any_hover_thrust(monkeypatch: pytest.MonkeyPatch) -> None:
    """Four times the thrust of the file would end the flight."""
    monkeypatch.setattr(vehicle_estimate, "FACTOR", 10.0)


def with_thrust(
    factor: float,
    name: str,
    firmware: Firmware,
    *,
    seed: int = 7,
    start: Start | None = None,
) -> Pair:
    """A hover of a vehicle with `factor` of its thrust."""
    vehicle = simulated.vehicle(name)
    pair = make(*HOVER, reference="hover", seed=seed, believed=vehicle, learning=IdentifySettings())
    conditions = simulated.scenario("thrust_doubled").conditions.model_copy(
        update={"boot_scale": 0.1, "thrust_scale": factor}
    )
    pair.instance = Instance(firmware, vehicle, conditions, seed, ground_link=False, start=start)
    if firmware is ARDUPILOT:
        pair.instance.autopilot.parameters.set("GUID_OPTIONS", 8.0)
    return pair


def heights_m(pair: Pair) -> list[float]:
    """Fills with the true height while `pair` flies."""
    heights: list[float] = []

    def look(flying: Pair) -> bool:
        heights.append(float(flying.instance.autopilot.plant.height_m))
        return False

    pair.at.append((look, lambda _: None))
    return heights


def taken_over_with(pair: Pair) -> float:
    """The hover thrust that was announced at the take-over; NaN if none was."""
    said = [line for line in pair.companion.announced if "before the take-over" in line]
    return float(said[0].split()[2]) if said else math.nan


@pytest.mark.parametrize(("factor", "seed"), [(2.0, 1), (0.75, 4)])
def test_arducopter_with_another_thrust_stays_at_its_height(factor: float, seed: int) -> None:
    """Without, it is 8 m too high with four times the thrust of its file."""
    pair = with_thrust(factor, "arducopter", ARDUPILOT, seed=seed)
    heights = heights_m(pair)
    pair.track()
    assert max(heights) < HEIGHT_M + 1.0
    true = simulated.vehicle("arducopter").hover_thrust / factor
    assert taken_over_with(pair) == pytest.approx(true, rel=0.03)


@pytest.mark.slow
def test_nothing_changes_without_a_difference_or_a_report_or_a_take_over() -> None:
    """PX4 takes off with our setpoints: the observer finds the difference out."""
    right = with_thrust(1.0, "arducopter", ARDUPILOT)
    silent = with_thrust(2.0, "arducopter", ARDUPILOT)
    silent.down = without(TARGET)
    for pair in (right, silent, with_thrust(0.8, "px4_sih", LEAN)):
        pair.track()
        assert math.isnan(taken_over_with(pair))


def test_px4_found_in_the_air_keeps_its_height() -> None:
    """It has not found its own hover thrust yet, and climbs until it is taken over."""
    pair = with_thrust(2.0, "px4_sih", LEAN, start=Start(height_m=HEIGHT_M))
    heights = heights_m(pair)
    pair.track()
    begun_s = next(at_s for at_s, phase in pair.phases if phase is Phase.CLIMB)
    landing_s = next(at_s for at_s, phase in pair.phases if phase is Phase.LAND)
    flown = heights[round(begun_s / STEP_S) : round(landing_s / STEP_S)]
    assert min(flown) > HEIGHT_M - 0.5
    assert max(flown) < flown[0] + 0.5
    true = simulated.vehicle("px4_sih").hover_thrust / 2.0
    assert taken_over_with(pair) == pytest.approx(true, rel=0.03)


VEHICLE = Vehicle.model_validate(
    simulated.vehicle("arducopter").model_dump()
    | {"hover_thrust": 0.4, "thrust_delay_s": 0.0, "thrust_lag_s": 0.0}
)


@pytest.mark.parametrize("true", [0.2, 0.4, 0.7])
@pytest.mark.parametrize("climb_mps", [-1.0, 0.0, 3.3])
def test_estimate_of_an_accelerated_climb(true: float, climb_mps: float) -> None:
    """Against the closed-form speed v(t) under constant thrust and linear drag."""
    gravity, drag = VEHICLE.gravity_mps2, VEHICLE.drag_per_mass_ps
    thrust = 1.15 * true
    final = (gravity - gravity * thrust / true) / drag  # down
    hover, rng = HoverEstimate(), np.random.default_rng(5)
    for step in range(101):
        time_s = 0.01 * step
        speed = final + (-climb_mps - final) * math.exp(-drag * time_s)
        hover.on_position(time_s, 1.0, speed + rng.normal(0.0, 0.01))
        if step % 10 == 0:
            hover.on_thrust(time_s, thrust, thrust)
    assert hover.hover_thrust(VEHICLE, 1.0) == pytest.approx(true, rel=0.02)


def test_no_estimate_from_too_little_or_on_the_ground_or_while_it_falls() -> None:
    for height_m, fall_mps2, thrust in ((1.0, 9.0, 0.05), (0.0, 0.0, 0.1)):
        hover = HoverEstimate()
        assert hover.hover_thrust(VEHICLE, 0.0) is None
        for step in range(60):
            hover.on_position(0.01 * step, height_m, fall_mps2 * 0.01 * step)
            hover.on_thrust(0.01 * step, thrust, thrust)
        assert hover.hover_thrust(VEHICLE, 0.6) is None
        assert hover.hover_thrust(VEHICLE, 2.0) is None  # reported too long ago
