"""The delay margin against flights: an independent plant, integrated in steps of 1 ms, with the
observer and the law as they fly, delayed by a little less and a little more than the margin."""

from __future__ import annotations

from bisect import bisect_left

import pytest
from attitude_plant import Truth, fly, lemniscate
from laws import PX4

from offboard.control.bandwidth import LEAST_MARGIN_S, SHARE_OF_DELAY, supported_bandwidth
from offboard.control.law import LqrLaw, LqrSettings
from offboard.estimation.noise import Noise
from offboard.model.vehicle import DelayUncertainty, Vehicle


def delayed(delay_s: float) -> Vehicle:
    tilt = PX4.tilt.model_copy(update={"delay_s": delay_s})
    return PX4.model_copy(update={"tilt": tilt})


def delay_margin(vehicle: Vehicle, bandwidth: float, period_s: float) -> float:
    """The least further delay of the tilt, in steps of 10 ms, that lowers the bandwidth; at least
    what is always allowed for."""

    def lowers(step: int) -> bool:
        uncertainty = DelayUncertainty(tilt_s=step / 100)
        return supported_bandwidth(vehicle, uncertainty, period_s, bandwidth) < bandwidth

    return bisect_left(range(60), True, key=lowers) / 100


def rmse_m(truth: Vehicle, believed: Vehicle, bandwidth: float, **offset: object) -> float:
    law, reference = (
        LqrLaw(believed, LqrSettings(bandwidth_radps=bandwidth)),
        lemniscate(15.0, vertical_m=0.3),
    )
    noise = Noise(velocity_sd_mps=1.0)
    return fly(
        Truth(truth), law, believed, reference, 27.0, noise=noise, score_from_s=12.0, **offset
    )


@pytest.mark.parametrize(("delay_s", "bandwidth"), [(0.057, 7.0), (0.17, 5.0)])
def test_margin_divides_flights_that_settle_from_those_that_do_not(delay_s, bandwidth):
    believed, off = delayed(delay_s), (0.05, 0.05, 0.0)
    margin_s = delay_margin(believed, bandwidth, 0.1)
    for extra_s, settles in ((margin_s - 0.03, True), (margin_s + 0.03, False)):
        error_m = rmse_m(delayed(delay_s + extra_s), believed, bandwidth, offset_ned_m=off)
        assert error_m < 0.03 if settles else error_m > 0.08


def test_margins_of_the_flights_on_a_real_px4():
    """113 ms that nobody knew of: bandwidth 5 flew, bandwidth 7 diverged, 10 was worse."""
    margins = [delay_margin(PX4, bandwidth, 0.1) for bandwidth in (3.0, 5.0, 7.0, 10.0)]
    assert margins == sorted(margins, reverse=True)
    assert margins[1] > 0.113 > margins[2]


def supported(vehicle: Vehicle, bandwidth: float, sd_s: float, thrust_sd_s: float = 0.0) -> float:
    uncertainty = DelayUncertainty(3.0 * sd_s, 3.0 * thrust_sd_s)
    return supported_bandwidth(vehicle, uncertainty, 0.1, bandwidth)


@pytest.mark.parametrize(("delay_s", "sd_s"), [(0.4, 0.002), (0.057, 0.05)])
def test_bandwidth_is_lowered_until_the_margin_suffices(delay_s, sd_s):
    vehicle = delayed(delay_s)
    lowered = supported(vehicle, 7.0, sd_s)
    assert 1.0 <= lowered < 7.0
    needed_s = max(LEAST_MARGIN_S, SHARE_OF_DELAY * vehicle.tilt.delay_s, 3.0 * sd_s)
    assert delay_margin(vehicle, lowered, 0.1) >= needed_s - 0.01
    assert delay_margin(vehicle, lowered + 0.5, 0.1) <= needed_s + 0.02


@pytest.mark.parametrize("wrong_s", [-0.09, 0.09])
def test_bandwidth_allows_for_an_uncertain_delay_of_the_thrust(wrong_s):
    """What the steps show of it may be too long as well as too short; at 14 rad/s the height is
    unstable either way."""
    believed = delayed(0.182).model_copy(update={"thrust_delay_s": 0.196})
    lowered = supported(believed, 9.0, 0.003, thrust_sd_s=0.03)
    assert 4.0 < lowered < 7.0
    truth = believed.model_copy(update={"thrust_delay_s": 0.196 + wrong_s})
    assert rmse_m(truth, believed, lowered) < 0.05
    assert rmse_m(truth, believed, 14.0) > 0.1
