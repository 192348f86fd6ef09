"""`offboard doctor` finds what is wrong with a vehicle, its link and this computer, and the lines
that it prints fix it."""

from __future__ import annotations

import random
import re
import threading
import time
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from faults import heartbeats
from pair import HOST_EPOCH_S, OBEDIENT, Bytes, decode, frames_of
from processes import register
from pydantic import TypeAdapter
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from offboard.doctor import computer, run
from offboard.doctor.checks import OF_VEHICLE
from offboard.doctor.listening import LONGEST_S, NOTHING_S, Observation
from offboard.doctor.run import OF_COMPUTER, Rows, examine, verdict
from offboard.flight.phases import Limits
from offboard.flight.preflight import Finding, Ground, Level, findings
from offboard.flight.vehicle_state import VehicleState
from offboard.link import clock
from offboard.link.interface import Chunk
from offboard.mavlink.events import ESTIMATE, Attitude, EstimatorReport, GpsFix, VehicleFound
from offboard.mavlink.senders import DIALECTS
from offboard.mavlink.session import Session, SessionSettings
from offboard.mavlink.signing import UNITS_PER_S, Signing
from offboard.run.configuration import FlightConfig, load
from offboard.run.flight import Connection
from simulator import config as simulated
from simulator.autopilot.firmware import Firmware
from simulator.config import Start
from simulator.faults import Fault
from simulator.firmware.ardupilot import ARDUPILOT
from simulator.firmware.px4 import PX4
from simulator.instance import Instance
from simulator.steps import STEP_S
from simulator.vehicle.conditions import Battery, Conditions

README = Path(__file__).parents[2] / "offboard" / "doctor" / "README.md"
OK, WARN, WAIT, BLOCKS = Level.OK, Level.WARN, Level.WAIT, Level.BLOCKS
GCS_HEARTBEAT = mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)
AUTOPILOT_HEARTBEAT = mavlink.MAVLink_heartbeat_message(2, 12, 81, 0, 3, 3)
UNKNOWN_HEARTBEAT = mavlink.MAVLink_heartbeat_message(2, 4, 0, 0, 3, 3)
CAMERA_HEARTBEAT = mavlink.MAVLink_heartbeat_message(30, 8, 0, 0, 4, 3)
SETPOINT = mavlink.MAVLink_set_attitude_target_message(0, 1, 1, 7, (1, 0, 0, 0), 0, 0, 0, 0.5)
TIME = mavlink.MAVLink_timesync_message(0, 12345)
ELSEWHERE = ("127.0.0.1", 14999)
SAME_PLACE = ("127.0.0.1", 14580)
COUNTED = mavlink.MAVLink(None, srcSystem=1)
KEY = bytes(range(32))
BOOT_S = {PX4.name: 6.0, ARDUPILOT.name: 5.0}
BOOT_SCALE = {PX4.name: 1.0, ARDUPILOT.name: 0.1}
# Parameters of a vehicle that was set up as the doctor advises
GOOD = {
    PX4.name: {"COM_OBL_RC_ACT": 4.0, "COM_RCL_EXCEPT": 4.0},
    ARDUPILOT.name: {
        "GUID_OPTIONS": 8.0, "GUID_TIMEOUT": 1.0, "PSC_JERK_XY": 10.0,
    },
}  # fmt: skip
PARAMETER = re.compile(r"param set (\w+) (\S+)")
PERMITTED = {"TIMESYNC", "PARAM_REQUEST_READ", "COMMAND_LONG"}
DOCTOR_ID = 193  # component id of the doctor, which differs from that of a flight
COMMANDS = {401, 511, 512}  # RUN_PREARM_CHECKS, SET_MESSAGE_INTERVAL, REQUEST_MESSAGE
BUSY = {check.__name__ for check in OF_COMPUTER}  # not checked: other tests keep the computer busy
REJECTED = {"fault": "velocity_error", "offset_ned_mps": (3.0, 0.0, 0.0), "for_s": 12.0}


@dataclass
class Bench:
    """A vehicle that the doctor examines. `before` is called at each step with the vehicle time and
    returns further chunks; `down` and `up` filter the datagrams of each direction."""

    instance: Instance
    config: FlightConfig
    capacity_bytes_ps: float | None = None
    before: Callable[[float], list[Chunk]] = lambda time_s: []
    down: Callable[[Bytes], Bytes] = lambda datagrams: datagrams
    up: Callable[[Bytes], Bytes] = lambda frames: frames
    has_vehicle: bool = True
    signing: Signing | None = None
    sent: list[Any] = field(default_factory=list)

    @property
    def now_s(self) -> float:
        return HOST_EPOCH_S + self.instance.time_s

    def step(self) -> list[Chunk]:
        datagrams = self.down(self.instance.step())
        heard = [Chunk(datagram, ("127.0.0.1", 14580), self.now_s) for datagram in datagrams]
        return (heard if self.has_vehicle else []) + self.before(self.instance.time_s)

    def run_to(self, time_s: float) -> None:
        """Step the vehicle to `time_s` while nobody listens."""
        while self.instance.time_s < time_s:
            self.step()

    def listen(self) -> Observation:
        settings = SessionSettings(capacity_bytes_ps=self.capacity_bytes_ps)
        link = "udpin:127.0.0.1:14540"
        seen = Observation(self.config, link, Path("."), self.now_s, settings, self.signing)
        while not seen.complete(self.now_s):
            for chunk in self.step():
                seen.take(chunk)
            if self.instance.steps % 5 == 0:
                for frame in self.up(seen.due(self.now_s)):
                    self.sent.append(decode(frame))
                    self.instance.feed(frame)
        seen.began_s = clock.monotonic_s()
        return seen

    def check(self, *names: str) -> Rows:
        """Examine the vehicle now, and return the rows by the name of the check."""
        seen = self.listen()
        assert_read_only(self.sent)
        chosen = run.chosen(names).items()
        return examine({name: check for name, check in chosen if name not in BUSY}, seen)

    def follow(self, row: list[Finding]) -> None:
        """Follow the hints of a row: set the parameters that they name."""
        lines = [line for finding in row for line in PARAMETER.findall(finding.hint)]
        assert lines, row
        for name, value in lines:
            self.instance.autopilot.parameters.set(name, float(value))


def assert_read_only(sent: Sequence[Any]) -> None:
    """Check that only the messages were sent that the help of the command names."""
    assert {message.get_type() for message in sent} <= PERMITTED
    assert {message.get_srcComponent() for message in sent} <= {DOCTOR_ID}
    commands = {message.command for message in sent if message.get_type() == "COMMAND_LONG"}
    assert commands <= COMMANDS


def bench(
    firmware: Firmware = OBEDIENT,
    faults: Sequence[dict[str, Any]] = (),
    start: Start | None = None,
    charge: float = 1.0,
    choices: dict[str, str] | None = None,
    assignments: Sequence[str] = (),
    parameters: dict[str, float] | None = None,
    mode: str = "",
    boot_s: float = 0.0,
    **options: Any,
) -> Bench:
    """Return a vehicle that has booted. Nothing is wrong with it except what the arguments change.
    Times of `faults` count from the boot, which takes BOOT_S."""
    conditions = Conditions(boot_scale=BOOT_SCALE[firmware.name], battery=Battery(remaining=charge))
    instance = Instance(
        firmware,
        simulated.vehicle(firmware.vehicle),
        conditions,
        seed=7,
        parameters=GOOD[firmware.name] | (parameters or {}),
        faults=TypeAdapter(list[Fault]).validate_python(list(faults)),
        start=start,
    )
    config = load("flight", choices=choices or {}, assignments=assignments)
    made = Bench(instance, config, **options)
    made.run_to(boot_s or BOOT_S[firmware.name])
    if mode:
        instance.autopilot.commander.switch(mode)
    return made


def said(rows: Rows) -> dict[str, tuple[Finding, ...]]:
    """Return the findings that are not OK, by check."""
    return {
        name: tuple(finding for finding in row if finding.level is not Level.OK)
        for name, row in rows.items()
        if row[0].level is not Level.OK
    }


def from_others(
    message: Any, system: int, component: int, rate_hz: float = 10.0, place: Hashable = ELSEWHERE
) -> Callable[[float], list[Chunk]]:
    """Return a function for `Bench.before` that is another sender on the link."""
    codec = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
    every = round(1.0 / (rate_hz * STEP_S))

    def before(time_s: float) -> list[Chunk]:
        if round(time_s / STEP_S) % every:
            return []
        data = message.pack(codec) if not isinstance(message, bytes) else message
        return [Chunk(data, place, HOST_EPOCH_S + time_s)]

    return before


def link(**fault: Any) -> dict[str, Any]:
    """Return options for a link fault that begins when the vehicle has booted, in both directions
    by default."""
    return {"faults": [{"fault": "link", "at_s": 5.9} | fault]}


def beside(*other: Any, **options: Any) -> dict[str, Any]:
    """Return options for another sender beside the vehicle."""
    return {"before": from_others(*other, **options)}


def alone(*other: Any) -> dict[str, Any]:
    """Return options for another sender without a vehicle."""
    return {"has_vehicle": False} | beside(*other)


def shared_counter(datagrams: Bytes) -> Bytes:
    """Add a frame of the camera, with the next sequence number, after each frame of the vehicle."""
    sent = []
    for frame in (each for datagram in datagrams for each in frames_of(datagram)):
        known = [] if decode(frame).get_type().startswith("UNKNOWN") else [(decode(frame), 1)]
        for message, component in (*known, (CAMERA_HEARTBEAT, 100)):
            COUNTED.srcComponent, COUNTED.seq = component, (COUNTED.seq + 1) % 256
            sent.append(message.pack(COUNTED))
    return sent


def with_events(datagrams: Bytes) -> Bytes:
    """Add an EVENT, which pymavlink does not know, with the next sequence number, after each frame
    of the vehicle."""
    sent = []
    for frame in (each for datagram in datagrams for each in frames_of(datagram)):
        if not decode(frame).get_type().startswith("UNKNOWN"):
            COUNTED.srcComponent, COUNTED.seq = 1, (COUNTED.seq + 1) % 256
            sent.append(decode(frame).pack(COUNTED))
        COUNTED.seq = (COUNTED.seq + 1) % 256
        sent.append(bytes((0xFD, 1, 0, 0, COUNTED.seq, 1, 1, 410 - 256, 1, 0, 7, 0, 0)))
    return sent


def test_good_vehicle_has_only_ok_findings() -> None:
    """The vehicle is an ArduCopter; other tests end with a PX4 with which nothing is wrong."""
    tested = bench(ARDUPILOT)
    began_s = tested.instance.time_s
    rows = tested.check()
    assert said(rows) == {}
    assert len(rows) == 17
    assert tested.instance.time_s - began_s < 6.0  # the whole command takes 8 s


def test_angular_acceleration_parameters_are_converted_by_release() -> None:
    """Hundredths of a degree/s^2 until ArduCopter 4.6, degree/s^2 since 4.7."""
    parameters = DIALECTS["ardupilot"].tilting_parameters
    shown = {"ATC_ACCEL_R_MAX": 11e4, "ATC_ACCEL_P_MAX": 11e4, "ATC_ACC_R_MAX": 1100.0}
    for name, value in (shown | {"ATC_ACC_P_MAX": 1100.0}).items():
        assert value * parameters[name][1] == pytest.approx(19.2, abs=0.01)


@pytest.mark.parametrize(
    "replies",
    [
        # ArduCopter 4.6, 4.7.0 and 4.7.1
        "SYSID_MYGCS SYSID_ENFORCE PSC_JERK_XY ARMING_CHECK ANGLE_MAX ATC_ACCEL_R_MAX "
        "ATC_ACCEL_P_MAX",
        "MAV_GCS_SYSID MAV_OPTIONS PSC_JERK_NE ARMING_SKIPCHK ATC_ANGLE_MAX ATC_ACC_R_MAX "
        "ATC_ACC_P_MAX",
        "MAV_GCS_SYSID MAV_OPTIONS PSC_NE_JERK ARMING_SKIPCHK ATC_ANGLE_MAX ATC_ACC_R_MAX "
        "ATC_ACC_P_MAX",
    ],
)
def test_parameters_of_another_release_are_not_awaited(replies: str) -> None:
    known = dict.fromkeys(replies.split(), 1.0)
    missing = {each.name for each in DIALECTS["ardupilot"].without_reply(known)}
    assert missing == {
        "GUID_OPTIONS", "GUID_TIMEOUT", "MOT_THST_HOVER", "ATC_ANGLE_BOOST", "FS_GCS_ENABLE",
        "FS_THR_ENABLE", "ATC_RATE_R_MAX", "ATC_RATE_P_MAX",
    }  # fmt: skip


# What is wrong with a vehicle that has booted, and the expected findings: check, level, pattern. If
# a hint sets parameters, following it must fix the finding
FOUND: list[tuple[Any, ...]] = [
    ({"parameters": {"COM_OF_LOSS_T": 0.5, "COM_OBL_RC_ACT": 0.0, "COM_RCL_EXCEPT": 0.0,
                     "MPC_TILTMAX_AIR": 20.0},
      "choices": {"reference": "lemniscate_4mps"}, "charge": 0.2,
      "firmware": replace(OBEDIENT, version=0x010D03FF)},
     ("parameters", WARN, "COM_OF_LOSS_T is 0.5.* param set COM_OF_LOSS_T 1$"),
     ("parameters", WARN, "param set COM_OBL_RC_ACT 4"),
     ("parameters", WARN, "param set COM_RCL_EXCEPT 4"),
     ("configuration", WARN, "param set MPC_TILTMAX_AIR "), ("battery", WARN, "20% left"),
     ("firmware", WARN, r"px4 1.13.3 \(release\) is older than 1.14")),
    ({"parameters": {"COM_OF_LOSS_T": 0.0}, "charge": 0.5, "choices": {"vehicle": "px4_sih"},
      "assignments": ["vehicle.hover_thrust=0.3", "limits.battery=0.9"],
      "firmware": replace(OBEDIENT, version=0x01110000)},
     ("parameters", BLOCKS, "COM_OF_LOSS_T is 0: .* param set COM_OF_LOSS_T 1$"),
     ("battery", BLOCKS, "its battery has 50% left, limits.battery is 90%"),
     ("configuration", WARN, "hover_thrust 0.3, the autopilot has MPC_THR_HOVER 0.5"),
     ("firmware", WARN, r"px4 1.17.0 \(development\) is no release")),
    ({"firmware": ARDUPILOT, "parameters": {"GUID_OPTIONS": 2.0, "ATC_ANGLE_BOOST": 0.0}},
     ("parameters", BLOCKS, "param set GUID_OPTIONS 10$"),
     ("parameters", BLOCKS, "param set ATC_ANGLE_BOOST 1$")),
    ({"assignments": ["reference.period_s=1.2"]}, ("configuration", BLOCKS, "reference")),
    # in the words of ArduCopter 4.6.3
    ({"firmware": ARDUPILOT, "mode": "GUIDED", "boot_s": 9.0,
      "faults": [{"fault": "gps_loss", "at_s": 0.1, "for_s": 30.0}]},
     ("prearm", WAIT, "do not pass in GUIDED; the vehicle said: PreArm: Need Position")),
    ({"start": Start(height_m=5.0, mode="AUTO.LOITER", by_failsafe=True)},
     ("state", BLOCKS, "a failsafe flies the vehicle, in AUTO.LOITER")),
    # the missing transmitter, which is not needed, is not given as the cause
    ({"mode": "OFFBOARD"},
     ("prearm", WARN, "its pre-arm checks pass in OFFBOARD only while setpoints arrive. "
       "Fix: select AUTO.LOITER, as `offboard fly` does first")),
    # its estimator: 3 m/s are twice the gate of 1.5 m/s
    ({"faults": [REJECTED]},
     ("estimator", BLOCKS, r"rejects velocity \(innovation ratio 2.00, limit 1\)"),
     ("prearm", WAIT, "unhealthy by SYS_STATUS: RC_RECEIVER")),
    ({"firmware": ARDUPILOT, "faults": [REJECTED]},
     ("estimator", BLOCKS, r"rejects velocity \(innovation ratio 2.00, limit 1\)"),
     ("prearm", WAIT, "EKF velocity variance")),
    # other programs on the link
    (beside(AUTOPILOT_HEARTBEAT, 1, 1, 1.0, ("::1", 14999, 0, 0)),
     ("senders", BLOCKS,
      "an autopilot sends as system 1 from another address, too. Fix: switch one off")),
    (beside(SETPOINT, 1, 194, place=SAME_PLACE), ("senders", BLOCKS, "component 194")),
    (beside(SETPOINT, 1, 191, place=SAME_PLACE), ("senders", BLOCKS, "component 191")),
    (beside(GCS_HEARTBEAT, 255, 190, 1.0),
     ("senders", OK, "other senders: ground station 255/190")),
    (beside(GCS_HEARTBEAT, 1, 1, 1.0, place=SAME_PLACE),
     ("senders", WARN, "another program sends with the ids of the vehicle, system 1 component 1"),
     ("loss", OK, "^0.0% of the bytes damaged")),
    (beside(TIME, 255, 190, 2.0), ("clock", OK, "time master: component 255/190")),
    # the link
    (link(latency_s=0.3), ("delay", BLOCKS, "the delay of the link is")),
    (link(jitter_s=0.8, direction="up"), ("delay", BLOCKS, "the delay of the link is")),
    (link(corruption=0.2, direction="down"), ("loss", WARN, "of the bytes damaged")),
    # half of the sequence numbers are those of its camera, and no frame is lost
    ({"down": shared_counter}, ("loss", OK, "0.0% of the frames lost")),
    ({"down": with_events}, ("loss", OK, "^0.0% of the frames lost")),
    (link(message_rate_hz=30.0, direction="down"),
     ("rates", WARN, "LOCAL_POSITION_NED 30.0 of 100 Hz")),
    (link(message_rate_hz=5.0, direction="down", for_s=20.0),
     ("rates", BLOCKS, "at least 10 Hz are needed.*MAV_x_RATE")),
    # requested rates are reduced to fit the link; 38400 baud cannot carry the lowest ones
    ({"capacity_bytes_ps": 3840.0}, ("bandwidth", WARN, "use at least 115200 baud$")),
    ({"capacity_bytes_ps": 11520.0}, ("bandwidth", OK, "the link can carry")),
    ({"faults": [{"fault": "clock_jump", "at_s": 9.0, "jump_s": 30.0}]},
     ("clock", BLOCKS, "the vehicle's clock jumped by 30.0 s")),
    ({"faults": [{"fault": "reboot", "at_s": 7.0, "for_s": 0.5}]},
     ("clock", BLOCKS, "the vehicle restarted while it was observed")),
    ({"up": lambda _: []},
     ("parameters", WARN, "no reply for MPC_THR_HOVER, "), ("uplink", BLOCKS, ""),
     ("delay", WAIT, "")),
    ({"firmware": PX4} | link(loss=0.2, direction="down"),
     ("loss", WARN, r"^(1[7-9]|2[0-3])\.[0-9]% of the frames")),
    # no vehicle
    (alone(random.Random(1).randbytes(300), 0, 0, 20.0),
     ("vehicle", BLOCKS, "bytes are heard that are not")),
    (alone(GCS_HEARTBEAT, 255, 190, 1.0),
     ("vehicle", BLOCKS, "but no autopilot: ground station 255/190")),
    (alone(UNKNOWN_HEARTBEAT, 1, 50, 1.0),
     ("vehicle", BLOCKS, "autopilot 1/50 is neither PX4 nor ArduCopter")),
    # the same words as those of `fly`
    (alone(AUTOPILOT_HEARTBEAT, 1, 50, 1.0), ("vehicle", BLOCKS,
       "heard as component 50, but only component 1 is flown: set its component id to 1")),
]  # fmt: skip


@pytest.mark.parametrize("case", FOUND)
def test_doctor_finds_faults_and_its_hints_fix_them(case: tuple[Any, ...]) -> None:
    options, *expected = case
    tested = bench(**options)
    began_s = tested.instance.time_s
    rows = tested.check(*dict.fromkeys(check for check, _, _ in expected))
    assert tested.instance.time_s - began_s < LONGEST_S + 1.1  # the whole command takes 15 s
    for check, level, found in expected:
        row = rows[check]
        assert row[0].level is level
        assert any(re.search(found, each.sentence) for each in row if each.level is level)
        about = row[0].about or check
        said_at_last = {
            BLOCKS: f"not ready to fly, blocked by: {about}",
            WARN: "ready to fly; warnings: ",
        }
        if len(row) == 1:
            assert verdict({check: row}, complete=True).startswith(said_at_last.get(level, ""))
        if PARAMETER.search(row[0].hint):
            tested.follow(row)
            assert tested.check(check)[check][0].level is OK


# --- the vehicle ----------------------------------------------------------------------------------


@pytest.mark.parametrize("start", [None, Start(height_m=3.0)], ids=["on_the_ground", "armed"])
def test_silent_vehicle_is_not_ready_to_fly(start: Start | None) -> None:
    tested = bench(start=start)
    heard_until_s = tested.instance.time_s + 2.5
    tested.down = lambda datagrams: datagrams if tested.instance.time_s < heard_until_s else []
    rates = tested.check()["rates"]
    assert "no HEARTBEAT arrives" in [finding.found for finding in rates]
    assert not verdict({"rates": rates}, complete=True).startswith("ready to fly")


def test_a_missing_position_has_one_cause() -> None:
    """Not also that it is slower than requested."""
    silent = {"fault": "silent_message", "message": "LOCAL_POSITION_NED"}
    (missing,) = bench(faults=[silent]).check("rates")["rates"]
    assert missing.found.startswith("no LOCAL_POSITION_NED arrives")


def test_another_type_of_vehicle_has_no_other_rows() -> None:
    """Its telemetry and its parameters mean something else."""
    rover = partial(heartbeats(type=10), 0.0)
    rows = bench(firmware=ARDUPILOT, parameters={"GUID_OPTIONS": 0.0}, down=rover).check()
    (finding,) = (each for each in rows["vehicle"] if each.level is BLOCKS)
    assert finding.found == "the vehicle is a GROUND_ROVER; offboard flies multirotors"
    assert not rows.keys() & {check.__name__ for check in OF_VEHICLE}


def test_gps_loss_waits_until_the_fix_returns() -> None:
    tested = bench(faults=[{"fault": "gps_loss", "at_s": 0.5, "for_s": 12.0, "drift_mps": 0.1}])
    rows = tested.check()
    levels = {name: row[0].level for name, row in rows.items() if row[0].level}
    assert levels == {"estimator": WAIT, "gps": WAIT}
    (found, *_) = rows["estimator"]
    assert "no valid horizontal velocity, horizontal position" in found.found
    tested.run_to(15.0)
    assert said(tested.check()) == {}


def test_duplicate_system_ids_do_not_count_as_loss() -> None:
    tested = bench(**beside(AUTOPILOT_HEARTBEAT, 1, 1, 1.0))
    (finding,) = tested.check("loss")["loss"]
    assert finding == Finding(OK, "0.0% of the bytes damaged")


def test_armed_vehicle_gets_only_read_requests() -> None:
    """No rates and no pre-arm checks are requested."""
    flying = bench(start=Start(height_m=5.0, mode="AUTO.LOITER"))
    rows = flying.check()
    kinds = {message.get_type() for message in flying.sent}
    commands = {m.command for m in flying.sent if m.get_type() == "COMMAND_LONG"}
    assert kinds == {"TIMESYNC", "PARAM_REQUEST_READ", "COMMAND_LONG"}
    assert commands == {512}
    assert rows["state"][0].found.startswith("armed, in AUTO.LOITER")
    assert said(rows) == {}


@pytest.mark.parametrize(("boot_s", "level"), [(33.0, WAIT), (300.0, BLOCKS)])
def test_estimator_without_position_waits_then_blocks(boot_s: float, level: Level) -> None:
    """ArduCopter 4.6.3 reports a 3D fix 10 s after its start, and a position 42 s after it."""
    starting = VehicleState(
        estimator=EstimatorReport(frozenset(ESTIMATE) - {"horizontal position"}, ratios=()),
        attitude=Attitude(boot_s, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    )
    starting.heard_s[GpsFix] = starting.now_s
    session = Session(SessionSettings())
    session.senders.set_vehicle(VehicleFound(1, 1, "px4"), None)
    model = load("flight").vehicle
    ground = Ground(limits=Limits(), session=session, model=model, vehicle=starting)
    assert {found.level for check, _, found in findings(ground) if check == "estimator"} == {level}


# --- the link -------------------------------------------------------------------------------------


def test_silent_link_blocks_with_connection_hints() -> None:
    tested = bench(has_vehicle=False)
    began_s = tested.instance.time_s
    rows = tested.check()
    assert tested.instance.time_s - began_s == pytest.approx(NOTHING_S, abs=0.1)
    assert said(rows).keys() == {"vehicle"}
    assert rows["vehicle"][0].found == "nothing is heard in 6 s"
    assert rows["vehicle"][0].level is BLOCKS
    for hint in ("--connect udpin:0.0.0.0", "-p PORT:PORT/udp", "hostname -I"):
        assert hint in rows["vehicle"][0].hint
    assert tested.sent == []
    tested.has_vehicle = True
    assert said(tested.check()) == {}


def test_armed_vehicle_with_old_signing_time_gets_no_frames() -> None:
    """The time is behind by ten minutes. Only a disarmed vehicle is sent the right time by a signed
    frame: `test_doctor_finds_no_fault_on_a_good_vehicle`."""
    tested = bench(signing=Signing(KEY, 100 * 60 * UNITS_PER_S), start=Start(height_m=5.0))
    tested.instance.keyring.set_up(KEY, 90 * 60 * UNITS_PER_S)
    rows = tested.check()
    assert rows["vehicle"][0].level is BLOCKS
    assert "their time stamps are too old" in rows["vehicle"][0].found
    assert tested.sent == []


def test_link_delay_lowers_the_advised_bandwidth() -> None:
    tested = bench(**link(latency_s=0.2))
    row = tested.check("configuration")["configuration"]
    assert row[0].level is WARN
    measured_ms = float(row[0].found.removeprefix("with a delay of ").split()[0])
    assert measured_ms == pytest.approx(400.0, abs=30.0)  # both directions
    possible = row[0].hint.rpartition("=")[2]
    assert 1.0 <= float(possible) < 7.0
    again = bench(**link(latency_s=0.2), assignments=[f"controller.bandwidth_radps={possible}"])
    assert again.check("configuration")["configuration"][0].level is OK


def test_number_of_stored_senders_is_bounded() -> None:
    generator = random.Random(3)

    def before(time_s: float) -> list[Any]:
        ids, port = generator.sample(range(1, 255), 2), generator.randrange(9999)
        return from_others(GCS_HEARTBEAT, *ids, 250.0, ("10.0.0.1", port))(time_s)

    seen = bench(before=before).listen()
    assert len(seen.senders.found) == 64
    assert seen.found is not None


# --- checks by name, and this computer ------------------------------------------------------------


def test_checks_of_other_packages_get_rows_even_if_broken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The checks are the example of the README, one that cannot be imported, two that raise
    SystemExit, and one with the name of a check of `offboard`."""
    (code,) = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    (tmp_path / "site_checks.py").write_text(code)
    (tmp_path / "exiting.py").write_text("raise SystemExit(3)\n")
    checks = {"ceiling": "site_checks:ceiling", "gone": "no_such_module:check", "gps": "json:loads",
              "imported": "exiting:check", "called": "sys:exit"}  # fmt: skip
    register(tmp_path, "site_checks", run.GROUP, **checks)
    monkeypatch.syspath_prepend(tmp_path)
    seen = bench().listen()
    rows = run.examine(run.chosen(list(checks)), seen)
    assert rows["ceiling"][0].hint == "--set limits.ceiling_m=6"
    for name, error in (("gone", "ModuleNotFound"), ("imported", "System"), ("called", "System")):
        assert f"failed: {error}" in rows[name][0].found
    assert rows["gps"][0].level is Level.OK


def test_doctor_ends_in_time_despite_hanging_checks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The link does not open, and the examination of the computer never ends."""
    never = threading.Event()
    monkeypatch.setattr(run, "OPEN_S", 0.1)
    monkeypatch.setattr(run, "LOOK_S", 0.4)
    monkeypatch.setattr(run, "open_link", lambda connection: never.wait())
    monkeypatch.setattr(computer, "build", lambda config: never.wait())
    monkeypatch.setattr(computer, "_not_compiled", lambda: 0)
    began_s = time.monotonic()
    seen = run.observe(Connection("tcp:10.0.0.1:5760"), load("flight"), tmp_path)
    rows = run.examine(run.chosen(["port", "computer"]), seen)
    assert time.monotonic() - began_s < 2.0
    assert "cannot be opened in 0.1 s" in rows["port"][0].found
    assert rows["computer"][0].level is Level.WAIT


def test_doctor_warns_of_a_full_disk_and_a_slow_computer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk is full, a decision is slow, and the process wakes up late."""
    monkeypatch.setattr(computer, "LEAST_FREE_BYTES", 10**18)
    monkeypatch.setattr(computer, "_not_compiled", lambda: 0)
    monkeypatch.setattr(computer, "rehearse", lambda prepared, keeps_deadline: 0.04)
    monkeypatch.setattr(computer, "_sleep", lambda: 0.03)
    now_s = time.monotonic()
    seen = Observation(load("flight"), "udpin:127.0.0.1:1", Path(), now_s, SessionSettings())
    rows = run.examine(run.chosen(["disk", "compiled", "computer"]), seen)
    levels = {name: [finding.level for finding in row] for name, row in rows.items()}
    assert levels == {"disk": [Level.WARN], "compiled": [Level.OK], "computer": [Level.WARN] * 2}
    found = " ".join(finding.found for finding in rows["computer"])
    assert "a decision takes 40.0 ms of 50 ms" in found
    assert "wakes up at most 30.0 ms late" in found
    (tmp_path / "file").touch()
    seen.directory = tmp_path / "file/flights"
    assert run.examine(run.chosen(["disk"]), seen)["disk"][0].level is Level.BLOCKS
