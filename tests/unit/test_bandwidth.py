"""The delay margin against flights: an independent plant, integrated in steps of 1 ms, with the
observer and the law as they fly, delayed by a little less and a little more than the margin."""

from __future__ import annotations

import pytest
from attitude_plant import Flight, Lemniscate, Truth, fly

from offboard.control.bandwidth import LEAST_MARGIN_S, SHARE_OF_DELAY, supported_bandwidth
from offboard.control.law import LqrLaw, LqrSettings
from offboard.estimation.noise import Noise
from offboard.model.vehicle import AxisResponse, DelayUncertainty, Vehicle

PX4 = Vehicle(
    name="px4",
    mass_kg=1.0,
    inertia_kgm2=(0.025, 0.025, 0.03),
    drag_translation_npmps=(1.02, 1.02, 1.02),
    drag_rotation_nmpradps=(0.02, 0.02, 0.02),
    hover_thrust=0.49,
    thrust_delay_s=0.015,
    thrust_lag_s=0.05,
    tilt=AxisResponse(delay_s=0.057, natural_frequency_radps=11.4, damping=0.56),
    yaw=AxisResponse(delay_s=0.148, natural_frequency_radps=3.1, damping=0.4),
)


def delayed(delay_s: float) -> Vehicle:
    tilt = PX4.tilt.model_copy(update={"delay_s": delay_s})
    return PX4.model_copy(update={"tilt": tilt})


def delay_margin(vehicle: Vehicle, bandwidth: float, period_s: float) -> float:
    """The least further delay of the tilt, in steps of 10 ms, that lowers the bandwidth; at least
    what is always allowed for."""

    def suffices(extra_s: float) -> bool:
        uncertainty = DelayUncertainty(tilt_s=extra_s)
        return bandwidth == supported_bandwidth(vehicle, uncertainty, period_s, bandwidth)

    return next((step / 100 for step in range(60) if not suffices(step / 100)), 0.6)


def flown(believed: Vehicle, bandwidth: float, extra_s: float) -> Flight:
    late = believed.tilt.model_copy(update={"delay_s": believed.tilt.delay_s + extra_s})
    truth = Truth(believed.model_copy(update={"tilt": late}), noisy=False)
    law = LqrLaw(believed, LqrSettings(bandwidth_radps=bandwidth))
    return fly(
        truth, law, believed, Lemniscate(15.0), 1, Noise(velocity_sd_mps=1.0),
        score_from_s=12.0, laps=1.0, offset_ned_m=(0.05, 0.05, 0.0),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("delay_s", "bandwidth"), [(0.057, 5.0), (0.057, 7.0), (0.17, 5.0), (0.17, 7.0)]
)
def test_margin_divides_flights_that_settle_from_those_that_do_not(delay_s, bandwidth):
    believed = delayed(delay_s)
    margin_s = delay_margin(believed, bandwidth, 0.1)
    assert flown(believed, bandwidth, margin_s - 0.03).rmse_m < 0.03
    assert flown(believed, bandwidth, margin_s + 0.03).rmse_m > 0.08


def test_margins_of_the_flights_on_a_real_px4():
    """113 ms that nobody knew of: bandwidth 5 flew, bandwidth 7 diverged, 10 was worse."""
    margins = [delay_margin(PX4, bandwidth, 0.1) for bandwidth in (3.0, 5.0, 7.0, 10.0)]
    assert margins == sorted(margins, reverse=True)
    assert margins[1] > 0.113 > margins[2]


def supported(vehicle: Vehicle, bandwidth: float, sd_s: float, thrust_sd_s: float = 0.0) -> float:
    uncertainty = DelayUncertainty(3.0 * sd_s, 3.0 * thrust_sd_s)
    return supported_bandwidth(vehicle, uncertainty, 0.1, bandwidth)


def test_bandwidth_is_kept_where_the_delay_bears_it():
    for delay_s in (0.01, 0.057, 0.17):
        for bandwidth in (3.0, 5.0, 7.0):
            assert supported(delayed(delay_s), bandwidth, 0.002) == bandwidth


@pytest.mark.parametrize(("delay_s", "sd_s"), [(0.4, 0.002), (0.057, 0.05), (0.45, 0.002)])
def test_bandwidth_is_lowered_until_the_margin_suffices(delay_s, sd_s):
    vehicle = delayed(delay_s)
    lowered = supported(vehicle, 7.0, sd_s)
    assert 1.0 <= lowered < 7.0
    needed_s = max(LEAST_MARGIN_S, SHARE_OF_DELAY * vehicle.tilt.delay_s, 3.0 * sd_s)
    assert delay_margin(vehicle, lowered, 0.1) >= needed_s - 0.01
    assert delay_margin(vehicle, lowered + 0.5, 0.1) <= needed_s + 0.02


@pytest.mark.parametrize("wrong_s", [-0.09, 0.09])
def test_bandwidth_allows_for_an_uncertain_delay_of_the_thrust(wrong_s):
    """What the steps show of it may be too long as well as too short; at 9 rad/s the height is
    unstable either way."""
    believed = delayed(0.182).model_copy(update={"thrust_delay_s": 0.196})
    lowered = supported(believed, 9.0, 0.003, thrust_sd_s=0.03)
    assert 4.0 < lowered < 7.0
    truth = Truth(believed.model_copy(update={"thrust_delay_s": 0.196 + wrong_s}), noisy=False)

    def rmse_m(bandwidth: float) -> float:
        law = LqrLaw(believed, LqrSettings(bandwidth_radps=bandwidth))
        return fly(
            truth, law, believed, Lemniscate(15.0, heave_m=0.3), 1,
            Noise(velocity_sd_mps=1.0), score_from_s=12.0, laps=1.0,
        ).rmse_m  # fmt: skip

    assert rmse_m(lowered) < 0.05
    assert rmse_m(9.0) > 0.1
