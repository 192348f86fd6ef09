"""The delay of the link from TIMESYNC replies, and the estimate of a vehicle behind this link."""

from __future__ import annotations

import math

import numpy as np
import pytest

from offboard.flight.link_age import DELAY_MAX_S, LEAST_GROWTH_S, STEADY_S, LinkDelay, LinkGrowth
from offboard.identification.uncertainty import Estimate
from offboard.identification.vehicle_estimate import VehicleEstimate
from offboard.mavlink.events import TimesyncReply
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


def reply(link: LinkDelay, telemetry_s: float, delay_s: float) -> TimesyncReply:
    request_ns = link.request(telemetry_s, 0.0).ts1_ns
    return TimesyncReply(request_ns, request_ns + round(delay_s * 1e9))


def test_median_and_spread_of_the_replies() -> None:
    link, rng = LinkDelay(), np.random.default_rng(3)
    for number, delay_s in enumerate(rng.normal(0.12, 0.01, 40)):
        link.on_reply(reply(link, 5.0 + 0.1 * number, delay_s))
    assert link.estimate is not None
    assert link.estimate.value == pytest.approx(0.12, abs=0.005)
    assert link.estimate.sd == pytest.approx(0.01, rel=0.4)
    link.reset()
    assert link.estimate is None


def test_replies_to_others_late_and_duplicate_ones_are_ignored() -> None:
    link = LinkDelay()
    for number in range(5):
        at_s = float(number)
        own = reply(link, at_s, 0.05)
        link.on_reply(TimesyncReply(own.request_ns + 1, own.vehicle_ns))  # another sender's request
        link.on_reply(reply(link, at_s + 0.2, -0.01))  # other clocks
        link.on_reply(reply(link, at_s + 0.4, DELAY_MAX_S + 0.01))
        assert link.estimate is None
        link.on_reply(own)
        link.on_reply(TimesyncReply(own.request_ns, own.vehicle_ns + 10**9))  # a duplicate
    assert link.estimate == Estimate(pytest.approx(0.05), 0.0)


@pytest.mark.parametrize(("delay_s", "measured_s"), [(0.05, 2.0), (4.4, 6.3), (math.inf, 10.1)])
def test_link_is_measured_by_twenty_replies(delay_s: float, measured_s: float) -> None:
    """Behind a full buffer of 50 kB, at 11.5 kB/s, the first one takes 4.4 s. Without any, the
    vehicle does not answer."""
    link = LinkDelay()
    waiting: list[tuple[float, TimesyncReply]] = []
    for tick in range(120):
        now_s = 0.1 * tick
        for each in [each for each in waiting if each[0] <= now_s]:
            waiting.remove(each)
            link.on_reply(each[1])
        if link.is_measured(now_s):
            break
        waiting.append((now_s + delay_s, reply(link, now_s, min(delay_s, DELAY_MAX_S))))
    assert now_s == pytest.approx(measured_s, abs=0.15)


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


def test_growth_is_followed_and_unsteady_until_it_has_lasted() -> None:
    growth = LinkGrowth()
    assert not growth.step(1.0, 0.9 * LEAST_GROWTH_S)
    assert growth.step(2.0, 0.2)
    assert (growth.added_s, growth.changed_s) == (0.2, 0.2)
    assert not growth.step(2.1, 0.2 + 0.9 * LEAST_GROWTH_S)
    assert not growth.step(1.9 + STEADY_S, 0.2)
    assert growth.step(2.0 + STEADY_S, 0.2)
    assert (growth.added_s, growth.changed_s) == (0.2, 0.0)
    assert growth.step(10.0, 0.0)
    assert (growth.added_s, growth.changed_s) == (0.0, 0.2)
    assert growth.step(10.0 + STEADY_S, 0.0)
    assert (growth.added_s, growth.changed_s) == (0.0, 0.0)


def test_growth_that_comes_and_goes_stays_unsteady() -> None:
    growth = LinkGrowth()
    for tick in range(200):
        growth.step(0.1 * tick, 0.15 if tick // 10 % 2 else 0.05)
        assert tick < 10 or growth.changed_s >= 0.0999
