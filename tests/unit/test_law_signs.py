"""Which way every law pushes, at every heading; each sign swapped once, and the flight is lost."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from attitude_plant import Lemniscate, Truth, fly
from test_tracking_law import LEVEL, PX4, G

from offboard.control.base import (
    Command,
    Controller,
    Decision,
    PositionCommand,
    PredictedState,
    Situation,
)
from offboard.control.catalogue import LAWS, build
from offboard.model.frames import wrap_pi
from offboard.reference.transfer import Hold

# Those that track by themselves; the paper's law is slow, and the autopilot's own loop not ours
TRACKING = [name for name in LAWS if name not in ("paper", "autopilot")]
HEADINGS_DEG = (0.0, 90.0, 179.9, -179.9, -90.0)


def law_named(name: str) -> Controller:
    return build(LAWS[name].model_validate({"law": name}), PX4, 0.1, 7)  # type: ignore[arg-type]


def at(position: tuple[float, float, float], course_rad: float) -> PredictedState:
    """At rest and level."""
    return PredictedState(
        0.057, np.array(position), np.zeros(3), np.array([0.0, 0.0, 1.0]), np.zeros(3),
        course_rad, 0.0, G, np.zeros(3), np.zeros(3),
    )  # fmt: skip


@pytest.mark.parametrize("heading_deg", HEADINGS_DEG)
@pytest.mark.parametrize("name", TRACKING)
def test_every_error_is_pushed_back(name: str, heading_deg: float) -> None:
    """b points where the vehicle came from: north of the target it leans north. Above the target
    the thrust is less than hover's. The course commanded is the target's, across the wrap."""
    law, course = law_named(name), math.radians(heading_deg)
    reference = Hold((1.0, 2.0, -3.0), course)

    def asked(north: float, east: float, down: float) -> Command:
        law.reset()
        place = (1.0 + north, 2.0 + east, -3.0 + down)
        state = at(place, wrap_pi(course + 0.2))
        command = law.decide(Situation(0.0, state, reference, LEVEL)).command
        assert isinstance(command, Command)
        assert wrap_pi(command.course_rad - course) == pytest.approx(0.0, abs=1e-3)
        return command

    for sign in (1.0, -1.0):
        north, east, down = (
            asked(sign * 0.1, 0, 0),
            asked(0, sign * 0.1, 0),
            asked(0, 0, sign * 0.1),
        )
        assert sign * north.thrust_direction_ned[0] > 0.05
        assert abs(north.thrust_direction_ned[1]) < 0.01
        assert sign * east.thrust_direction_ned[1] > 0.05
        assert abs(east.thrust_direction_ned[0]) < 0.01
        assert sign * (down.thrust_mps2 - G) > 1.0
        assert abs(down.thrust_direction_ned[0]) < 0.01


@pytest.mark.parametrize("heading_deg", HEADINGS_DEG)
def test_the_autopilots_loop_is_given_the_reference(heading_deg: float) -> None:
    law, course = law_named("autopilot"), math.radians(heading_deg)
    reference = Lemniscate(8.0, course_rad=course, heave_m=0.3)
    command = law.decide(Situation(6.0, at((0, 0, -3), course), reference, LEVEL)).command
    assert isinstance(command, PositionCommand)
    sample = reference.sample(6.05)  # the middle of the time it is held for
    assert command.position_ned_m == pytest.approx(tuple(sample.position_ned_m))
    assert command.velocity_ned_mps == pytest.approx(tuple(sample.velocity_ned_mps))
    assert command.acceleration_ned_mps2 == pytest.approx(tuple(sample.acceleration_ned_mps2))
    assert command.course_rad == pytest.approx(course)


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
            case "course":
                command = replace(command, course_rad=-command.course_rad)
        return replace(decision, command=command)

    def reset(self) -> None:
        self._law.reset()


@pytest.mark.parametrize("name", TRACKING)
@pytest.mark.parametrize("heading_deg", [90.0, -179.9])
def test_climbing_and_descending_flights_at_all_headings(name: str, heading_deg: float) -> None:
    """Half a lap, heaving by 0.4 m, without noise: the laws agree to centimetres."""
    reference = Lemniscate(8.0, course_rad=math.radians(heading_deg), heave_m=0.4)
    flown = fly(Truth(PX4, noisy=False), law_named(name), PX4, reference, 1, laps=0.5)
    assert flown.rmse_m < 0.03


@pytest.mark.parametrize("output", ["north", "east", "thrust"])
@pytest.mark.parametrize("name", TRACKING)
def test_one_sign_swapped_is_seen(name: str, output: str) -> None:
    """What the flights above would show."""
    reference = Lemniscate(8.0, course_rad=math.radians(90.0), heave_m=0.4)
    law = Swapped(law_named(name), output)
    flown = fly(Truth(PX4, noisy=False), law, PX4, reference, 1, laps=0.1)
    assert flown.rmse_m > 0.3


def test_a_swapped_course_is_seen() -> None:
    law, reference = Swapped(law_named("pid"), "course"), Hold((0.0, 0.0, -3.0), 1.5)
    command = law.decide(Situation(0.0, at((0, 0, -3), 1.5), reference, LEVEL)).command
    assert isinstance(command, Command)
    assert abs(wrap_pi(command.course_rad - 1.5)) > 1.0
