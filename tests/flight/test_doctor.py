"""`offboard doctor` finds what is wrong with a vehicle, and what it prints makes it right."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest
from doctor_bench import GOOD, bench, said
from pair import LEAN
from pair import make as flight

from offboard.doctor.run import verdict
from offboard.flight.phases import ExitCode, Limits
from offboard.flight.preflight import FIX_3D, Ground, Level, findings
from offboard.flight.vehicle_state import VehicleState
from offboard.mavlink.dialects.ardupilot import ARDUPILOT as ARDUPILOT_DIALECT
from offboard.mavlink.events import ESTIMATE, Attitude, EstimatorReport
from simulator.config import Scenario
from simulator.faults import GpsLoss
from simulator.firmware.ardupilot import ARDUPILOT
from simulator.firmware.base import Firmware
from simulator.firmware.px4 import PX4
from simulator.start import Start

OK, WARN, WAIT, BLOCKS = Level.OK, Level.WARN, Level.WAIT, Level.BLOCKS


@pytest.mark.parametrize("firmware", [PX4, ARDUPILOT], ids=["px4", "ardupilot"])
def test_nothing_is_said_of_a_good_vehicle(firmware: Firmware) -> None:
    patient = bench(firmware)
    began_s = patient.instance.time_s
    rows = patient.consult()
    assert said(rows) == {}
    assert len(rows) == 17
    assert patient.instance.time_s - began_s < 6.0  # 8 s with what comes before and after


@pytest.mark.parametrize(
    ("firmware", "name", "value", "level", "line"),
    [
        (LEAN, "COM_OF_LOSS_T", 0.0, BLOCKS, "param set COM_OF_LOSS_T 1"),
        (LEAN, "COM_OF_LOSS_T", 0.5, WARN, "param set COM_OF_LOSS_T 1"),
        (LEAN, "COM_OBL_RC_ACT", 0.0, WARN, "param set COM_OBL_RC_ACT 4"),
        (LEAN, "COM_RCL_EXCEPT", 0.0, WARN, "param set COM_RCL_EXCEPT 4"),
        (ARDUPILOT, "GUID_OPTIONS", 2.0, BLOCKS, "param set GUID_OPTIONS 10"),
        (ARDUPILOT, "ATC_ANGLE_BOOST", 0.0, BLOCKS, "param set ATC_ANGLE_BOOST 1"),
    ],
)
def test_line_for_a_parameter_mends_it(
    firmware: Firmware, name: str, value: float, level: Level, line: str
) -> None:
    patient = bench(firmware)
    patient.set_parameter(name, value)
    row = patient.consult("parameters")["parameters"]
    assert row.level is level
    assert row.findings[0].hint == line
    named = f"1 blocks: {name}" if level is BLOCKS else "ready to fly; warnings: "
    assert verdict([row], complete=True).startswith(named)
    assert (
        f"{line.split()[2]} is {value if line.split()[2] == name else 0:g}" in row.findings[0].found
    )
    for _ in range(2):  # a radio that is expected again is a finding of its own
        if row.level is not OK:
            patient.follow(row)
            row = patient.consult("parameters")["parameters"]
    assert row.level is OK


def test_parameters_as_arducopter_ships_them() -> None:
    patient = bench(ARDUPILOT)
    for name, shipped in (("GUID_OPTIONS", 0.0), ("GUID_TIMEOUT", 3.0)):
        patient.set_parameter(name, shipped)
    rows = patient.consult()
    assert set(said(rows)) == {"parameters"}
    assert rows["parameters"].level is BLOCKS
    patient.follow(rows["parameters"])
    assert said(patient.consult()) == {}
    assert {
        name: patient.instance.autopilot.parameters[name] for name in GOOD["ardupilot"]
    } == GOOD["ardupilot"]


def test_gps_that_is_lost_waits_and_comes_back() -> None:
    patient = bench(faults=[{"fault": "gps_loss", "at_s": 0.5, "for_s": 12.0, "drift_mps": 0.1}])
    rows = patient.consult()
    assert {name: row.level for name, row in rows.items() if row.level} == {
        "estimator": WAIT, "gps": WAIT,
    }  # fmt: skip
    assert (
        "no valid horizontal velocity, horizontal position" in rows["estimator"].findings[0].found
    )
    while patient.instance.time_s < 15.0:
        patient.step()
    assert said(patient.consult()) == {}


@pytest.mark.parametrize(("boot_s", "level"), [(33.0, WAIT), (300.0, BLOCKS)])
def test_estimator_without_position_although_the_gps_has_a_fix(boot_s: float, level: Level) -> None:
    """ArduCopter 4.6.3 reports a 3D fix 10 s after its start, and a position 42 s after it."""
    starting = VehicleState(
        estimator=EstimatorReport(frozenset(ESTIMATE) - {"horizontal position"}, ratios=()),
        attitude=Attitude(boot_s, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    )
    ground = Ground(starting, Limits(), ARDUPILOT_DIALECT, fix_type=FIX_3D)
    assert {found.level for check, _, found in findings(ground) if check == "estimator"} == {level}


@pytest.mark.parametrize(
    ("firmware", "text", "ratio"),
    [
        (
            PX4,
            "its pre-arm checks do not pass in AUTO.LOITER; unhealthy by SYS_STATUS: RC_RECEIVER",
            "4.00",
        ),
        (ARDUPILOT, "EKF velocity variance", "2.00"),
    ],
    ids=["px4", "ardupilot"],
)
def test_velocity_that_the_estimator_rejects(firmware: Firmware, text: str, ratio: str) -> None:
    """3 m/s are two of the gates of 1.5 m/s; PX4's ratios are squared."""
    fault = {"fault": "velocity_error", "offset_ned_mps": (3.0, 0.0, 0.0), "for_s": 12.0}
    patient = bench(firmware, faults=[fault])
    rows = patient.consult()
    assert {name: row.level for name, row in rows.items() if row.level} == {
        "estimator": BLOCKS, "prearm": WAIT,
    }  # fmt: skip
    assert (
        f"rejects GPS velocity (innovation ratio {ratio}, limit 1)"
        in rows["estimator"].findings[0].found
    )
    assert text in rows["prearm"].findings[0].found
    while patient.instance.time_s < 13.0:
        patient.step()
    assert said(patient.consult()) == {}


def test_arducopter_says_itself_why_it_cannot_arm() -> None:
    """Before it has a position; the texts are those of 4.6.3."""
    patient = bench(ARDUPILOT, faults=[{"fault": "gps_loss", "at_s": 0.1, "for_s": 30.0}])
    patient.instance.autopilot.commander.switch("GUIDED")
    while patient.instance.time_s < 9.0:
        patient.step()
    rows = patient.consult()
    (finding,) = rows["prearm"].findings
    assert "do not pass in GUIDED; the vehicle said: PreArm: Need Position" in finding.found
    assert rows["prearm"].level is WAIT


def test_px4_in_offboard_without_setpoints() -> None:
    """It is not blamed on the radio, which nobody needs; `fly` selects the mode that is named."""
    patient = bench()
    patient.instance.autopilot.commander.switch("OFFBOARD")
    (finding,) = patient.consult("prearm")["prearm"].findings
    assert finding.found == "its pre-arm checks pass in OFFBOARD only while setpoints arrive"
    assert finding.hint == "select AUTO.LOITER, as `offboard fly` does first"
    assert finding.level is WARN
    patient.instance.autopilot.commander.switch("AUTO.LOITER")
    assert said(patient.consult("prearm")) == {}


@pytest.mark.parametrize(
    ("options", "check", "level", "found"),
    [
        ({"charge": 0.05}, "battery", BLOCKS, "its battery has 5% left"),
        ({"charge": 0.2}, "battery", WARN, "20% left"),
        ({"firmware": dataclasses.replace(LEAN, version=0x010D03FF)}, "firmware", WARN,
         "px4 1.13.3 (release) is older than 1.14"),
        ({"firmware": dataclasses.replace(LEAN, version=0x01110000)}, "firmware", WARN,
         "px4 1.17.0 (development) is no release"),
        ({"start": Start(height_m=5.0, mode="AUTO.LOITER", by_failsafe=True)}, "state", BLOCKS,
         "a failsafe flies the vehicle, in AUTO.LOITER"),
    ],
)  # fmt: skip
def test_condition_of_the_vehicle(options: Any, check: str, level: Level, found: str) -> None:
    rows = bench(**options).consult()
    assert said(rows).keys() == {check}
    assert rows[check].level is level
    assert found in rows[check].findings[0].found


def test_armed_vehicle_is_left_alone() -> None:
    """No rates or pre-arm checks."""
    flying = bench(start=Start(height_m=5.0, mode="AUTO.LOITER"))
    rows = flying.consult()
    kinds = {message.get_type() for message in flying.sent}
    commands = {m.command for m in flying.sent if m.get_type() == "COMMAND_LONG"}
    assert kinds == {"TIMESYNC", "PARAM_REQUEST_READ", "COMMAND_LONG"}
    assert commands == {512}
    assert rows["state"].findings[0].found.startswith("armed, in AUTO.LOITER")
    assert said(rows) == {}


@pytest.mark.parametrize(
    ("wrong", "right"),
    [
        ({"assignments": ["vehicle.hover_thrust=0.3"], "choices": {"vehicle": "px4_sih"}},
         {"choices": {"vehicle": "neutral"}}),
        ({"parameters": {"MPC_TILTMAX_AIR": 20.0}, "choices": {"reference": "lemniscate_4mps"}},
         None),
    ],
    ids=["hover thrust", "tilt"],
)  # fmt: skip
def test_configuration_against_vehicle(
    wrong: dict[str, object], right: dict[str, object] | None
) -> None:
    patient = bench(**wrong)  # type: ignore[arg-type]
    row = patient.consult("configuration")["configuration"]
    assert row.level is WARN, row
    if right is None:
        patient.follow(row)
    else:
        patient = bench(**right)  # type: ignore[arg-type]
    assert patient.consult("configuration")["configuration"].level is OK


def test_reference_that_cannot_be_flown() -> None:
    row = bench(assignments=["reference.period_s=1.2"]).consult("configuration")["configuration"]
    assert row.level is BLOCKS
    assert "reference" in row.findings[0].found


@pytest.mark.parametrize(
    ("scenario", "battery", "sentence"),
    [
        # PX4 sends LOCAL_POSITION_NED also without a position, and arms: its estimator tells
        (Scenario(name="lost", faults=(GpsLoss(fault="gps_loss", drift_mps=0.1),)), 0.0,
         "its estimator has no valid horizontal velocity"),
        (None, 0.999, "its battery has 50% left, limits.battery is 100%"),
    ],
    ids=["gps", "battery"],
)  # fmt: skip
def test_flight_is_refused_as_the_doctor_says(
    scenario: Scenario | None, battery: float, sentence: str
) -> None:
    options = {} if scenario is None else {"scenario": scenario, "firmware": PX4}
    pair = flight(limits={"health_s": 9.0, "battery": battery}, **options)  # type: ignore[arg-type]
    pair.instance.autopilot.plant.set_battery(0.5)
    outcome = pair.fly()
    assert outcome.exit_code == ExitCode.REFUSED
    assert sentence in outcome.sentence
    assert pair.setpoints == []
