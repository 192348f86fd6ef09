"""The same companion on a vehicle that takes off by command and divides thrust by its tilt."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from pair import on_arducopter

from offboard.flight.phases import TRACKING, ExitCode, Phase
from simulator.firmware.ardupilot import ARDUPILOT
from simulator.firmware.base import Rule
from simulator.firmware.values import Result

SET_MODE, ARM, TAKEOFF, LAND = 176, 400, 22, 21
GUIDED = 4
SHORT = ("reference.height_m=1.5", "reference.duration_s=3.0")


def test_guided_armed_takeoff_and_then_setpoints() -> None:
    pair = on_arducopter(*SHORT, reference="hover")
    assert pair.fly().exit_code == ExitCode.FLOWN
    asked = [(m.param1, m.param2) for m in pair.commands(SET_MODE)]
    assert set(asked) == {(1.0, GUIDED)}
    (takeoff,) = pair.commands(TAKEOFF)  # once: it was accepted
    assert takeoff.param7 == pytest.approx(1.5)  # the height of the reference
    assert all(phase in TRACKING | {Phase.LAND} for _, phase, _ in pair.setpoints)
    begun_s = pair.setpoints[0][0]
    lifted_s = next(at_s for at_s, phase in pair.phases if phase is Phase.CLIMB)
    assert begun_s == pytest.approx(lifted_s, abs=0.11)


def test_calm_lemniscate(tmp_path: Path) -> None:
    """1 cm at 2 m/s: u_h T b_z / g with the predicted b_z is what the tilt boost undoes."""
    pair = on_arducopter(reference="lemniscate")
    pair.track()
    flown = pair.score(tmp_path)
    assert flown.rmse_position_m < 0.01
    assert flown.hover_thrust == pytest.approx(0.3655, abs=0.001)


def test_thrust_as_climb_rate_is_refused_with_the_line_that_mends_it() -> None:
    pair = on_arducopter(*SHORT, reference="hover", guid_options=0.0)
    outcome = pair.fly()
    assert outcome.exit_code == ExitCode.REFUSED
    assert "param set GUID_OPTIONS 8" in outcome.sentence
    assert pair.commands(ARM) == pair.commands(SET_MODE) == pair.setpoints == []


def test_a_takeoff_that_is_refused_ends_on_the_ground_without_a_setpoint() -> None:
    refusal = Rule("takeoff", result=Result.FAILED)
    firmware = replace(ARDUPILOT, rules=(refusal, *ARDUPILOT.rules))
    pair = on_arducopter(*SHORT, reference="hover", firmware=firmware)
    outcome = pair.fly()
    assert outcome.exit_code == ExitCode.ABORTED
    assert "no lift-off" in outcome.sentence
    assert len(pair.commands(TAKEOFF)) >= 8
    assert pair.setpoints == []
    assert not pair.instance.autopilot.commander.armed
