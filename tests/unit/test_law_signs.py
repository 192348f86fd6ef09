"""Which way every law pushes, at headings on both sides of the wrap."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np
import pytest
from attitude_plant import lemniscate
from laws import LEVEL, PX4, TRACKING, G, at, law_named

from offboard.control.base import Controller, Situation
from offboard.model.command import Command, PositionCommand, PredictedState
from offboard.model.frames import wrap_pi
from offboard.reference.base import FlatSample, Reference
from offboard.reference.track import hold

HEADINGS_RAD = np.radians([0.0, 90.0, 179.9, -179.9])
DIRECTIONS = tuple(itertools.product(range(3), (1.0, -1.0)))  # axis and sign, NED


@dataclass
class Leaving:
    """From rest with a constant acceleration, turning at a constant rate."""

    acceleration_ned_mps2: np.ndarray
    heading_rad: float
    turn_radps: float
    duration_s = 3600.0

    def sample(self, time_s: float | np.ndarray) -> FlatSample:
        time = np.asarray(time_s, dtype=np.float64)[..., None]
        a = self.acceleration_ned_mps2 + 0.0 * time
        none = np.zeros_like(a)
        heading = self.heading_rad + self.turn_radps * time[..., 0]
        turn = self.turn_radps + 0.0 * heading
        return FlatSample(0.5 * time**2 * a, time * a, a, none, none, heading, turn, 0.0 * heading)


def answer(
    law: Controller, state: PredictedState, reference: Reference
) -> tuple[np.ndarray, float]:
    """The first command in units of g, [b north, b east, thrust above hover's], and its heading."""
    law.reset()
    command = law.decide(Situation(0.0, state, reference, LEVEL)).command
    assert isinstance(command, Command)
    above = (command.thrust_mps2 - G) / G
    return np.array([*command.thrust_direction_ned[:2], above]), command.heading_rad


@pytest.mark.parametrize("name", TRACKING)
def test_an_error_is_pushed_back(name: str) -> None:
    """North of the target, or moving north of it, the vehicle leans north (the thrust acts along
    -b). Above the target, or climbing, the thrust is less than hover's. The heading commanded is
    the target's, across the wrap."""
    law = law_named(name)
    for heading, (axis, sign) in itertools.product(HEADINGS_RAD, DIRECTIONS):
        off = 0.1 * sign * np.eye(3)[axis]
        rest = at((1.0, 2.0, -3.0), wrap_pi(heading + 0.2))
        for state in (
            replace(rest, velocity_ned_mps=3.0 * off),
            replace(rest, position_ned_m=rest.position_ned_m + off),
        ):
            pushed, commanded = answer(law, state, hold((1.0, 2.0, -3.0), heading))
            assert sign * pushed[axis] > 0.05
            assert np.abs(np.delete(pushed, axis)).max() < 0.01
            assert wrap_pi(commanded - heading) == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize("name", TRACKING)
def test_a_reference_that_leaves_is_followed(name: str) -> None:
    """To the north leaning south, up with more thrust; one that turns with the heading ahead of
    it, through the wrap. The vehicle is on the reference."""
    law = law_named(name)
    for heading, (axis, sign) in itertools.product(HEADINGS_RAD, DIRECTIONS):
        reference = Leaving(sign * np.eye(3)[axis], heading, 0.4 * sign)
        sample = reference.sample(0.057)
        pull = np.array([0.0, 0.0, G]) - reference.acceleration_ned_mps2
        pull -= PX4.drag_per_mass_ps * sample.velocity_ned_mps
        thrust = float(np.linalg.norm(pull))
        state = replace(
            at((0, 0, 0), wrap_pi(float(sample.heading_rad))),
            position_ned_m=sample.position_ned_m,
            velocity_ned_mps=sample.velocity_ned_mps,
            thrust_direction_ned=pull / thrust,
            thrust_mps2=thrust,
        )
        led, commanded = answer(law, state, reference)
        assert -sign * led[axis] > 0.08
        assert np.abs(np.delete(led, axis)).max() < 0.02
        assert 0.1 < sign * wrap_pi(commanded - heading) < 0.3


def test_an_error_that_stays_is_answered_ever_more_by_the_integral() -> None:
    """5 cm for 3 s: 0.03 m/s^2 more along north and east, 0.15 along the vertical."""
    for axis, sign in DIRECTIONS:
        law, off = law_named("pid"), 0.05 * sign * np.eye(3)[axis]
        situation = Situation(0.0, at(tuple(off), 0.0), hold((0, 0, 0), 0.0), LEVEL)
        commands = [law.decide(situation).command for _ in range(31)]
        pushed = [
            (c.thrust_direction_ned[0] * G, c.thrust_direction_ned[1] * G, c.thrust_mps2)
            for c in commands
        ]
        more = np.subtract(pushed[-1], pushed[0])
        assert more == pytest.approx(sign * np.diag((0.03, 0.03, 0.15))[axis], abs=1e-9)


def test_the_autopilots_loop_is_given_the_reference() -> None:
    heading = HEADINGS_RAD[-1]
    reference = lemniscate(8.0, heading_rad=heading, vertical_m=0.3)
    situation = Situation(6.0, at((0, 0, -3), heading), reference, LEVEL)
    command = law_named("autopilot").decide(situation).command
    assert isinstance(command, PositionCommand)
    sample = reference.sample(6.05)  # the middle of the time it is held for
    assert command.position_ned_m == pytest.approx(tuple(sample.position_ned_m))
    assert command.velocity_ned_mps == pytest.approx(tuple(sample.velocity_ned_mps))
    assert command.acceleration_ned_mps2 == pytest.approx(tuple(sample.acceleration_ned_mps2))
    assert command.heading_rad == pytest.approx(heading)
