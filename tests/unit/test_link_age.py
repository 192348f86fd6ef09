"""The estimate of a vehicle behind a link with a delay."""

from __future__ import annotations

import pytest

from offboard.identification.uncertainty import Estimate
from offboard.identification.vehicle_estimate import VehicleEstimate
from offboard.model.vehicle import AxisResponse, Vehicle

PX4 = Vehicle(
    name="px4",
    mass_kg=1.0,
    inertia_kgm2=(0.025, 0.025, 0.03),
    drag_translation_npmps=(1.0, 1.0, 1.0),
    drag_rotation_nmpradps=(0.02, 0.02, 0.02),
    hover_thrust=0.5,
    thrust_delay_s=0.015,
    tilt=AxisResponse(delay_s=0.057, natural_frequency_radps=11.4, damping=0.56),
    yaw=AxisResponse(delay_s=0.148, natural_frequency_radps=3.1, damping=0.4),
)


def new_estimate() -> VehicleEstimate:
    return VehicleEstimate(
        PX4, factor=4.0, blend_s=1.0, unknown_delay_s=0.28, period_s=0.1, bandwidth_radps=7.0
    )


@pytest.mark.parametrize("late_s", [0.1, 0.2, 0.3])
def test_every_delay_of_the_vehicle_is_later_by_the_link(late_s: float) -> None:
    estimate, direct = new_estimate(), new_estimate()
    (sentence,) = estimate.apply_link_delay(Estimate(late_s + 0.004, 0.003))
    assert f"link delay {1e3 * late_s + 4:.0f} +- 3 ms" in sentence
    assert estimate.settled
    now = estimate.now
    assert now.tilt.delay_s == pytest.approx(0.057 + late_s)
    assert now.yaw.delay_s == pytest.approx(0.148 + late_s, abs=0.001)
    assert now.thrust_delay_s == pytest.approx(0.015 + late_s)
    assert now.tilt.natural_frequency_radps == 11.4
    assert direct.apply_link_delay(Estimate(0.004, 0.001)) == []
    assert direct.now == PX4
    assert new_estimate().cautious_radps == pytest.approx(direct.cautious_radps, abs=0.1)
    assert estimate.cautious_radps <= direct.cautious_radps


def test_a_link_that_scatters_bears_less() -> None:
    steady, scattering = new_estimate(), new_estimate()
    steady.apply_link_delay(Estimate(0.2, 0.001))
    scattering.apply_link_delay(Estimate(0.2, 0.03))
    assert scattering.cautious_radps < 0.9 * steady.cautious_radps
