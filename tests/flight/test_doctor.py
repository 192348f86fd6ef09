"""`offboard doctor` finds what is wrong with a vehicle, and what it prints makes it right."""

from __future__ import annotations

import dataclasses

import pytest
from doctor_bench import GOOD, bench, said
from pair import LEAN
from pair import make as flight

from offboard.doctor.observation import Observation
from offboard.doctor.table import Check, checks, examine, verdict
from offboard.flight.phases import ExitCode
from offboard.flight.preflight import FIX_3D, Level
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
    assert len(rows) == 20
    assert patient.instance.time_s - began_s < 6.0  # 8 s with what comes before and after


@pytest.mark.parametrize(
    ("firmware", "name", "value", "level", "line"),
    [
        (LEAN, "COM_OF_LOSS_T", 0.0, BLOCKS, "param set COM_OF_LOSS_T 1"),
        (LEAN, "COM_OF_LOSS_T", 30.0, BLOCKS, "param set COM_OF_LOSS_T 1"),
        (LEAN, "COM_OF_LOSS_T", 0.5, WARN, "param set COM_OF_LOSS_T 1"),
        (LEAN, "COM_OBL_RC_ACT", 0.0, WARN, "param set COM_OBL_RC_ACT 4"),
        (LEAN, "COM_OBL_RC_ACT", 7.0, BLOCKS, "param set COM_OBL_RC_ACT 4"),
        (LEAN, "COM_RC_IN_MODE", 4.0, WARN, "param set COM_RC_IN_MODE 3"),
        (LEAN, "COM_RCL_EXCEPT", 0.0, WARN, "param set COM_RCL_EXCEPT 4"),
        (ARDUPILOT, "GUID_OPTIONS", 2.0, BLOCKS, "param set GUID_OPTIONS 10"),
        (ARDUPILOT, "GUID_TIMEOUT", 0.1, BLOCKS, "param set GUID_TIMEOUT 1"),
        (ARDUPILOT, "GUID_TIMEOUT", 3.0, WARN, "param set GUID_TIMEOUT 1"),
        (ARDUPILOT, "PSC_JERK_XY", 5.0, WARN, "param set PSC_JERK_XY 10"),
        (ARDUPILOT, "ATC_ANGLE_BOOST", 0.0, BLOCKS, "param set ATC_ANGLE_BOOST 1"),
        (ARDUPILOT, "ARMING_CHECK", 0.0, WARN, "param set ARMING_CHECK 1"),
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
    seen = Observation(vehicle=starting, dialect=ARDUPILOT_DIALECT, fix_type=FIX_3D)
    (row,) = examine(checks(["estimator"]), seen)
    assert row.level is level


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


def test_empty_battery() -> None:
    assert bench(charge=0.05).consult("battery")["battery"].level is BLOCKS
    assert bench(charge=0.2).consult("battery")["battery"].level is WARN


def test_old_and_unreleased_firmware() -> None:
    old = dataclasses.replace(LEAN, version=0x010D03FF)
    row = bench(old).consult("firmware")["firmware"]
    assert row.level is WARN
    assert "px4 1.13.3 (release) is older than 1.14" in row.findings[0].found
    development = dataclasses.replace(LEAN, version=0x01110000)
    row = bench(development).consult("firmware")["firmware"]
    assert "px4 1.17.0 (development) is no release" in row.findings[0].found
    assert "known defect" not in row.findings[1].found


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


def test_vehicle_that_a_failsafe_flies() -> None:
    rows = bench(start=Start(height_m=5.0, mode="AUTO.LOITER", by_failsafe=True)).consult()
    assert said(rows).keys() == {"state"}
    assert rows["state"].level is BLOCKS


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


def test_check_that_fails_is_a_row() -> None:
    broken = Check("broken", "", lambda seen: seen.vehicle.no_such_thing)  # type: ignore[attr-defined]
    failed, port = examine([broken, *checks(["port"])], Observation())
    assert failed.level is WARN
    assert "the check itself failed: AttributeError" in failed.findings[0].found
    assert port.level is OK


def test_flight_is_refused_as_the_doctor_says() -> None:
    """PX4 sends LOCAL_POSITION_NED also without a position, and arms: its estimator tells."""
    lost = Scenario(name="lost", faults=(GpsLoss(fault="gps_loss", drift_mps=0.1),))
    pair = flight(scenario=lost, firmware=PX4, limits={"health_s": 9.0})
    outcome = pair.fly()
    assert outcome.exit_code == ExitCode.REFUSED
    assert "its estimator has no valid horizontal velocity" in outcome.sentence
    assert pair.setpoints == []


def test_flight_with_an_empty_battery_is_refused() -> None:
    pair = flight(limits={"battery": 0.999, "health_s": 9.0})
    pair.instance.autopilot.plant.set_battery(0.5)
    outcome = pair.fly()
    assert outcome.exit_code == ExitCode.REFUSED
    assert "its battery has 50% left, limits.battery is 100%" in outcome.sentence
    assert pair.setpoints == []
