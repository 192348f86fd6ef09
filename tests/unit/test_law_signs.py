"""Which way every law pushes, at every heading; each sign swapped once, and it is seen."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from attitude_plant import Lemniscate, Truth, fly
from laws import LEVEL, PX4, TRACKING, G, at, law_named

from offboard.control.base import Controller, Decision, Situation
from offboard.model.command import Command, PositionCommand
from offboard.model.frames import wrap_pi
from offboard.reference.base import FlatSample
from offboard.reference.track import hold

HEADINGS_DEG = (0.0, 90.0, 179.9, -179.9, -90.0)


class Swapped:
    """A law with one sign of its command swapped."""

    def __init__(self, law: Controller, output: str) -> None:
        self._law, self._output = law, output

    def decide(self, situation: Situation) -> Decision:
        decision = self._law.decide(situation)
        command = decision.command
        assert isinstance(command, Command)
        north, east, down = command.thrust_direction_ned
        match self._output:
            case "north":
                command = replace(command, thrust_direction_ned=(-north, east, down))
            case "east":
                command = replace(command, thrust_direction_ned=(north, -east, down))
            case "thrust":
                command = replace(command, thrust_mps2=2 * G - command.thrust_mps2)
            case "heading":
                command = replace(command, heading_rad=-command.heading_rad)
        return replace(decision, command=command)

    def reset(self) -> None:
        self._law.reset()


@dataclass
class Leaving:
    """From rest with a constant acceleration, turning at a constant rate."""

    acceleration_ned_mps2: tuple[float, float, float]
    heading_rad: float
    turn_radps: float = 0.0
    duration_s = 3600.0

    def sample(self, time_s: float | np.ndarray) -> FlatSample:
        time = np.asarray(time_s, dtype=np.float64)[..., None]
        a = np.array(self.acceleration_ned_mps2) + 0.0 * time
        none = np.zeros_like(a)
        heading = self.heading_rad + self.turn_radps * time[..., 0]
        turn = self.turn_radps + 0.0 * heading
        return FlatSample(0.5 * time**2 * a, time * a, a, none, none, heading, turn, 0.0 * heading)


def answers(law: Controller, situation: Situation) -> Command:
    law.reset()
    command = law.decide(situation).command
    assert isinstance(command, Command)
    return command


def push_back(law: Controller, heading: float) -> None:
    """b points where the vehicle came from: north of the target, or moving north of it, it leans
    north. Above the target, or climbing, the thrust is less than hover's. The heading commanded is
    the target's, across the wrap."""
    reference = hold((1.0, 2.0, -3.0), heading)
    for axis, sign, moving in itertools.product(range(3), (1.0, -1.0), (False, True)):
        off = np.zeros(3)
        off[axis] = 0.1 * sign
        rest = at((1.0, 2.0, -3.0), wrap_pi(heading + 0.2))
        state = (
            replace(rest, velocity_ned_mps=3.0 * off)
            if moving
            else replace(rest, position_ned_m=rest.position_ned_m + off)
        )
        command = answers(law, Situation(0.0, state, reference, LEVEL))
        pushed = np.array([*command.thrust_direction_ned[:2], (command.thrust_mps2 - G) / G])
        assert sign * pushed[axis] > 0.05
        assert np.abs(np.delete(pushed, axis)).max() < 0.01
        assert wrap_pi(command.heading_rad - heading) == pytest.approx(0.0, abs=1e-3)


def go_along(law: Controller, heading: float) -> None:
    """A reference that leaves to the north, on which the vehicle is, is followed leaning south,
    one that climbs with more thrust, one that turns with its heading ahead, through the wrap."""
    for axis, sign in itertools.product(range(3), (1.0, -1.0)):
        acceleration = [0.0, 0.0, 0.0]
        acceleration[axis] = sign
        reference = Leaving(
            (acceleration[0], acceleration[1], acceleration[2]), heading, 0.4 * sign
        )
        sample = reference.sample(0.057)
        pull = (
            np.array([0.0, 0.0, G])
            - acceleration
            - PX4.drag_per_mass_ps * (sample.velocity_ned_mps)
        )
        thrust = float(np.linalg.norm(pull))
        state = replace(
            at((0, 0, 0), wrap_pi(float(sample.heading_rad))),
            position_ned_m=sample.position_ned_m,
            velocity_ned_mps=sample.velocity_ned_mps,
            thrust_direction_ned=pull / thrust,
            thrust_mps2=thrust,
        )
        command = answers(law, Situation(0.0, state, reference, LEVEL))
        led = np.array([*command.thrust_direction_ned[:2], (command.thrust_mps2 - G) / G])
        assert -sign * led[axis] > 0.08
        assert np.abs(np.delete(led, axis)).max() < 0.02
        assert 0.1 < sign * wrap_pi(command.heading_rad - heading) < 0.3


CHECKS = (push_back, go_along)


@pytest.mark.parametrize("name", TRACKING)
def test_signs(name: str) -> None:
    for heading_deg, check in itertools.product(HEADINGS_DEG, CHECKS):
        check(law_named(name), math.radians(heading_deg))


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("axis", range(3))
def test_an_error_that_stays_is_answered_ever_more_by_the_integral(axis: int, sign: float) -> None:
    """5 cm for 3 s: 0.03 m/s^2 more along north and east, 0.15 along the vertical."""
    law, off = law_named("pid"), np.zeros(3)
    off[axis] = 0.05 * sign
    situation = Situation(0.0, at((off[0], off[1], off[2]), 0.0), hold((0, 0, 0), 0.0), LEVEL)
    pushed = []
    for _ in range(31):
        command = law.decide(situation).command
        assert isinstance(command, Command)
        north, east, _ = command.thrust_direction_ned
        pushed.append(np.array([north * G, east * G, command.thrust_mps2]))
    more = np.zeros(3)
    more[axis] = sign * (0.03, 0.03, 0.15)[axis]
    assert pushed[-1] - pushed[0] == pytest.approx(more, abs=1e-9)


@pytest.mark.parametrize("name", TRACKING)
def test_each_sign_swapped_is_seen(name: str) -> None:
    for output, check in itertools.product(("north", "east", "thrust", "heading"), CHECKS):
        with pytest.raises(AssertionError):
            check(Swapped(law_named(name), output), math.radians(90.0))


def test_the_autopilots_loop_is_given_the_reference() -> None:
    heading_deg = -179.9
    law, heading = law_named("autopilot"), math.radians(heading_deg)
    reference = Lemniscate(8.0, heading_rad=heading, heave_m=0.3)
    command = law.decide(Situation(6.0, at((0, 0, -3), heading), reference, LEVEL)).command
    assert isinstance(command, PositionCommand)
    sample = reference.sample(6.05)  # the middle of the time it is held for
    assert command.position_ned_m == pytest.approx(tuple(sample.position_ned_m))
    assert command.velocity_ned_mps == pytest.approx(tuple(sample.velocity_ned_mps))
    assert command.acceleration_ned_mps2 == pytest.approx(tuple(sample.acceleration_ned_mps2))
    assert command.heading_rad == pytest.approx(heading)


# pso and lqr decide alike where no bound is met
FLIGHTS = [("lqr", heading_deg) for heading_deg in HEADINGS_DEG[:-1]] + [
    (name, -90.0) for name in TRACKING if name != "lqr"
]


@pytest.mark.parametrize(("name", "heading_deg"), FLIGHTS)
def test_climbing_and_descending_flights_at_all_headings(name: str, heading_deg: float) -> None:
    """Half a lap, heaving by 0.4 m, without noise: the laws agree to centimetres."""
    reference = Lemniscate(8.0, heading_rad=math.radians(heading_deg), heave_m=0.4)
    flown = fly(Truth(PX4, noisy=False), law_named(name), PX4, reference, 1, laps=0.5)
    assert flown.rmse_m < 0.03
