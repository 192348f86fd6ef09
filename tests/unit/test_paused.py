"""A paused reference: the same path, derivatives that fit, at rest, and on again."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from offboard.reference.paused import STOP_S, Paused
from offboard.reference.transfer import Moved
from offboard.run import configuration as config

BEGAN_S, PAUSED_S, RESUMED_S = 100.0, 108.3, 115.0
DERIVATIVES = ("position_ned_m", "velocity_ned_mps", "acceleration_ned_mps2", "jerk_ned_mps3",
               "snap_ned_mps4")  # fmt: skip


@pytest.fixture(scope="module")
def paused() -> Paused:
    track = config.build_track(config.load("flight"))
    return Paused(Moved(track, BEGAN_S), PAUSED_S).resumed(RESUMED_S)


def test_each_derivative_is_that_of_the_one_before(paused: Paused) -> None:
    times_s = np.linspace(105.0, 125.0, 20_001)
    sample = paused.sample(times_s)
    for below, above in pairwise(DERIVATIVES):
        slope = np.gradient(getattr(sample, below), times_s, axis=0)[5:-5]
        np.testing.assert_allclose(slope, getattr(sample, above)[5:-5], atol=2e-4)
    turned = np.gradient(sample.heading_rad, times_s)[5:-5]
    np.testing.assert_allclose(turned, sample.heading_rate_radps[5:-5], atol=1e-4)


def test_it_rests_on_the_path_and_continues_from_there(paused: Paused) -> None:
    rest = paused.sample(np.array([PAUSED_S + STOP_S, 112.0, RESUMED_S]))
    assert np.abs(rest.velocity_ned_mps).max() < 1e-9
    assert np.ptp(rest.position_ned_m, axis=0).max() < 1e-9
    at_s = paused.passed_s(112.0)
    assert at_s == pytest.approx(PAUSED_S + STOP_S / 2)
    own = paused.reference.sample(at_s).position_ned_m
    np.testing.assert_allclose(rest.position_ned_m[1], own, atol=1e-9)
    lost_s = RESUMED_S - PAUSED_S
    later = paused.sample(RESUMED_S + STOP_S + 1.0).position_ned_m
    undisturbed = paused.reference.sample(RESUMED_S + STOP_S + 1.0 - lost_s).position_ned_m
    np.testing.assert_allclose(later, undisturbed, atol=1e-8)
    before = paused.sample(107.0).position_ned_m
    np.testing.assert_allclose(before, paused.reference.sample(107.0).position_ned_m, atol=1e-8)
