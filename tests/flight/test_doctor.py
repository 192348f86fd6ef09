"""`offboard doctor` finds what is wrong with a vehicle, and what it prints makes it right."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest
from doctor_bench import bench, said
from pair import OBEDIENT
from pair import make as flight

from offboard.doctor.run import verdict
from offboard.flight.phases import ExitCode, Limits
from offboard.flight.preflight import Ground, Level, findings
from offboard.flight.timing import VehicleClock
from offboard.flight.vehicle_state import VehicleState
from offboard.mavlink.events import ESTIMATE, Attitude, EstimatorReport, GpsFix
from offboard.mavlink.session import Session, SessionSettings
from simulator.firmware.ardupilot import ARDUPILOT
from simulator.firmware.base import Firmware
from simulator.firmware.px4 import PX4
from simulator.start import Start

OK, WARN, WAIT, BLOCKS = Level.OK, Level.WARN, Level.WAIT, Level.BLOCKS


@pytest.mark.parametrize("firmware", [PX4, ARDUPILOT], ids=["px4", "ardupilot"])
def test_nothing_is_said_of_a_good_vehicle(firmware: Firmware) -> None:
    tested = bench(firmware)
    began_s = tested.instance.time_s
    rows = tested.check()
    assert said(rows) == {}
    assert len(rows) == 17
    assert tested.instance.time_s - began_s < 6.0  # 8 s with what comes before and after


@pytest.mark.parametrize(
    ("firmware", "name", "value", "level", "line"),
    [
        (OBEDIENT, "COM_OF_LOSS_T", 0.0, BLOCKS, "param set COM_OF_LOSS_T 1"),
        (OBEDIENT, "COM_OF_LOSS_T", 0.5, WARN, "param set COM_OF_LOSS_T 1"),
        (OBEDIENT, "COM_OBL_RC_ACT", 0.0, WARN, "param set COM_OBL_RC_ACT 4"),
        (OBEDIENT, "COM_RCL_EXCEPT", 0.0, WARN, "param set COM_RCL_EXCEPT 4"),
        (ARDUPILOT, "GUID_OPTIONS", 2.0, BLOCKS, "param set GUID_OPTIONS 10"),
        (ARDUPILOT, "ATC_ANGLE_BOOST", 0.0, BLOCKS, "param set ATC_ANGLE_BOOST 1"),
    ],
)
def test_line_for_a_parameter_mends_it(
    firmware: Firmware, name: str, value: float, level: Level, line: str
) -> None:
    tested = bench(firmware, parameters={name: value})
    row = tested.check("parameters")["parameters"]
    assert row.level is level
    assert row.findings[0].hint == line
    assert f"{name} is {value:g}" in row.findings[0].found
    named = f"1 blocks: {name}" if level is BLOCKS else "ready to fly; warnings: "
    assert verdict([row], complete=True).startswith(named)
    tested.follow(row)
    assert tested.check("parameters")["parameters"].level is OK


@pytest.mark.parametrize("start", [None, Start(height_m=3.0)], ids=["on_the_ground", "armed"])
def test_a_vehicle_that_falls_silent_is_not_ready_to_fly(start: Start | None) -> None:
    tested = bench(start=start)
    heard_until_s = tested.instance.time_s + 2.5
    tested.down = lambda datagrams: datagrams if tested.instance.time_s < heard_until_s else []
    rates = tested.check()["rates"]
    assert "no HEARTBEAT arrives" in [finding.found for finding in rates.findings]
    assert not verdict([rates], complete=True).startswith("ready to fly")


def test_gps_that_is_lost_waits_and_comes_back() -> None:
    tested = bench(faults=[{"fault": "gps_loss", "at_s": 0.5, "for_s": 12.0, "drift_mps": 0.1}])
    rows = tested.check()
    levels = {name: row.level for name, row in rows.items() if row.level}
    assert levels == {"estimator": WAIT, "gps": WAIT}
    (found, *_) = rows["estimator"].findings
    assert "no valid horizontal velocity, horizontal position" in found.found
    tested.run_to(15.0)
    assert said(tested.check()) == {}


@pytest.mark.parametrize(
    ("firmware", "text", "ratio"),
    [(PX4, "unhealthy by SYS_STATUS: RC_RECEIVER", 4), (ARDUPILOT, "EKF velocity variance", 2)],
    ids=["px4", "ardupilot"],
)
def test_velocity_that_the_estimator_rejects(firmware: Firmware, text: str, ratio: int) -> None:
    """3 m/s are two of the gates of 1.5 m/s; PX4's ratios are squared."""
    fault = {"fault": "velocity_error", "offset_ned_mps": (3.0, 0.0, 0.0), "for_s": 12.0}
    rows = bench(firmware, faults=[fault]).check()
    found = {name: (row.level, row.findings[0].found) for name, row in rows.items() if row.level}
    assert found.keys() == {"estimator", "prearm"}
    assert [level for level, _ in found.values()] == [BLOCKS, WAIT]
    rejected = f"rejects GPS velocity (innovation ratio {ratio}.00, limit 1)"
    assert rejected in found["estimator"][1]
    assert text in found["prearm"][1]


def test_arducopter_says_itself_why_it_cannot_arm() -> None:
    """Before it has a position; the texts are those of 4.6.3."""
    tested = bench(ARDUPILOT, faults=[{"fault": "gps_loss", "at_s": 0.1, "for_s": 30.0}])
    tested.instance.autopilot.commander.switch("GUIDED")
    tested.run_to(9.0)
    (finding,) = tested.check()["prearm"].findings
    assert "do not pass in GUIDED; the vehicle said: PreArm: Need Position" in finding.found
    assert finding.level is WAIT


def test_px4_in_offboard_without_setpoints() -> None:
    """It is not blamed on the radio, which nobody needs; `fly` selects the mode that is named."""
    tested = bench()
    tested.instance.autopilot.commander.switch("OFFBOARD")
    (finding,) = tested.check("prearm")["prearm"].findings
    assert finding.found == "its pre-arm checks pass in OFFBOARD only while setpoints arrive"
    assert finding.hint == "select AUTO.LOITER, as `offboard fly` does first"
    assert finding.level is WARN
    tested.instance.autopilot.commander.switch("AUTO.LOITER")
    assert said(tested.check("prearm")) == {}


@pytest.mark.parametrize(
    ("options", "check", "level", "found"),
    [
        ({"charge": 0.08}, "battery", BLOCKS, "its battery has 8% left"),
        ({"charge": 0.2}, "battery", WARN, "20% left"),
        ({"firmware": dataclasses.replace(OBEDIENT, version=0x010D03FF)}, "firmware", WARN,
         "px4 1.13.3 (release) is older than 1.14"),
        ({"firmware": dataclasses.replace(OBEDIENT, version=0x01110000)}, "firmware", WARN,
         "px4 1.17.0 (development) is no release"),
        ({"start": Start(height_m=5.0, mode="AUTO.LOITER", by_failsafe=True)}, "state", BLOCKS,
         "a failsafe flies the vehicle, in AUTO.LOITER"),
        ({"assignments": ["vehicle.hover_thrust=0.3"], "choices": {"vehicle": "px4_sih"}},
         "configuration", WARN, "hover_thrust 0.3, the autopilot has MPC_THR_HOVER 0.5"),
        ({"assignments": ["reference.period_s=1.2"]}, "configuration", BLOCKS, "reference"),
    ],
)  # fmt: skip
def test_condition_of_the_vehicle(options: Any, check: str, level: Level, found: str) -> None:
    rows = bench(**options).check()
    assert said(rows).keys() == {check}
    assert rows[check].level is level
    assert found in rows[check].findings[0].found


def test_tilt_limit_of_the_vehicle_that_the_reference_exceeds() -> None:
    tested = bench(parameters={"MPC_TILTMAX_AIR": 20.0}, choices={"reference": "lemniscate_4mps"})
    row = tested.check("configuration")["configuration"]
    assert row.level is WARN
    tested.follow(row)
    assert tested.check("configuration")["configuration"].level is OK


def test_armed_vehicle_is_left_alone() -> None:
    """No rates or pre-arm checks."""
    flying = bench(start=Start(height_m=5.0, mode="AUTO.LOITER"))
    rows = flying.check()
    kinds = {message.get_type() for message in flying.sent}
    commands = {m.command for m in flying.sent if m.get_type() == "COMMAND_LONG"}
    assert kinds == {"TIMESYNC", "PARAM_REQUEST_READ", "COMMAND_LONG"}
    assert commands == {512}
    assert rows["state"].findings[0].found.startswith("armed, in AUTO.LOITER")
    assert said(rows) == {}


def test_flight_is_refused_as_the_doctor_says() -> None:
    pair = flight(limits={"health_s": 9.0, "battery": 0.999})
    pair.instance.autopilot.plant.set_battery(0.5)
    outcome = pair.fly()
    assert outcome.exit_code == ExitCode.REFUSED
    assert "its battery has 50% left, limits.battery is 100%" in outcome.sentence
    assert pair.setpoints == []


@pytest.mark.parametrize(("boot_s", "level"), [(33.0, WAIT), (300.0, BLOCKS)])
def test_estimator_without_position_although_the_gps_has_a_fix(boot_s: float, level: Level) -> None:
    """ArduCopter 4.6.3 reports a 3D fix 10 s after its start, and a position 42 s after it."""
    starting = VehicleState(
        estimator=EstimatorReport(frozenset(ESTIMATE) - {"horizontal position"}, ratios=()),
        attitude=Attitude(boot_s, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    )
    starting.heard_s[GpsFix] = starting.now_s
    ground = Ground(starting, Limits(), Session(SessionSettings()), VehicleClock(), 0.0)
    assert {found.level for check, _, found in findings(ground) if check == "estimator"} == {level}
