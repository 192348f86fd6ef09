"""Recorded sessions with a real PX4 and ArduCopter, repeated with the simulator; every difference
is listed here with its reason.

Recordings are trimmed: setpoints to 5 Hz, telemetry to messages that give the time or a row.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from sim_bench import Bench
from sim_rows import Rows, ask_again, compare
from vehicle_frames import RECORDINGS, recorded

from simulator.firmware import FIRMWARES
from simulator.vehicle.conditions import Battery
from simulator.vehicle.sensors import EstimatorName

NOT_OURS = (
    "[logger]",  # about its log file
    "GPS Vertical Pos Drift",  # a check on the ground that the simulator does not have
    "Calibrating barometer",  # sent before the recording begins
    "RC7: SaveWaypoint LOW",  # a switch on SITL's simulated remote control
    "in-flight yaw alignment",  # the simulator aligns its heading on the ground
    "SIM Hit ground at",  # a text of SITL itself
    "PreArm:",  # repeated every minute
    # texts that no client reads, which the simulator does not send
    "Using default takeoff altitude", "RTL: start return", "RTL: land at", "Executing Mission",
    "Climb to", "Barometer", "AHRS: DCM active", "AHRS: EKF3 active", "EKF3 IMU0 initialised",
    "EKF3 IMU1 initialised", "alignment complete", "GPS 1:", "origin set", "Field Elevation",
)  # fmt: skip
COMPARED = {"HEARTBEAT", "EXTENDED_SYS_STATE", "LOCAL_POSITION_NED"}  # of unrequested messages
PROMPT_S = 0.15
NORTH, EAST = 0, 1
# Tolerances in s of rows that depend on how estimates wander near the ground, and on the jerk of
# PX4's climbs and descents, which the simulator does not limit
FLOWN_S = {
    "text 6 Takeoff detected": 0.5,
    "landed 2": 2.6,
    "landed 3": 0.5,
    "text 6 Landing detected": 4.0,
    "text 6 Disarmed by landing": 4.0,
    "landed 1": 4.0,
    "landed": 0.3,
    "state": 4.2,
}


Array = NDArray[np.float64]
RELEASES = {"px4": "px4-1.16.1", "ardupilot": "arducopter-4.6.3"}
ESTIMATORS = {"px4": EstimatorName.PX4_LIKE, "ardupilot": EstimatorName.ARDUPILOT_LIKE}


@dataclass(frozen=True)
class Session:
    """A recorded session. `seed`: of the estimator, such that landings are near the real ones."""

    name: str
    seed: int
    equal: int
    differing: tuple[str, ...] = ()
    flown_s: tuple[tuple[str, float], ...] = ()
    kinds: tuple[str, ...] = ("ack", "text", "state", "landed")
    firmware: str = "px4"

    @property
    def recording(self) -> Path:
        packed = RECORDINGS / f"{RELEASES[self.firmware]}-{self.name}.tlog.xz"
        return packed if packed.exists() else packed.with_suffix("")


SESSIONS = [
    # A flight by attitude setpoints: refusals, arming, climb, a lost stream, landing
    Session("offboard", seed=3, equal=35),
    # Stream lost and resumed with each COM_OBL_RC_ACT and two COM_OF_LOSS_T, then a landing
    Session("failsafes", seed=2, equal=55),
    # Takeoff to the default height, landing; to 12 m, reposition, return from 30 m
    Session(
        "takeoff_land",
        seed=2,
        equal=38,
        flown_s=(("landed 4", 3.0), ("state", 4.6)),
    ),
    # On the ground: 95 commands, modes, arming in each mode; a mode lasts half a second, so that
    # heartbeats are not compared
    Session(
        "ground",
        seed=3,
        equal=220,
        kinds=("ack", "text"),
        differing=(
            "real ack 84: 0",  # NAV_VTOL_TAKEOFF: PX4 enters its mode, without a VTOL
            "ours ack 84: 3",
            "real ack 511: 0",  # an interval of NaN for a message that does not exist
            "ours ack 511: 4",
            "real ack 512: 2",  # PX4 had just sent the message and had no newer one
            "ours ack 512: 0",
        ),
        flown_s=(("text 6 Disarmed by auto preflight", 1.1), ("ack 512", 0.7)),
    ),
    # Ground station lost with each NAV_DLL_ACT, in the air and on the ground
    Session(
        "losses",
        seed=3,
        equal=48,
        differing=(
            # at the end of the 5 s in which a silent ground station still gets texts
            "ours text 6 Connection to ground station lost",
        ),
    ),
    # The battery emptied in half a minute, COM_LOW_BAT_ACT 3
    Session(
        "battery",
        seed=2,
        equal=24,
        differing=(
            "real text 2 System does not support shutdown",  # a text of SITL itself
            "real text 0 Low battery",  # SITL's battery refills while it is disarmed
        ),
        # the charge comes from SYS_STATUS, in hundredths, once a second
        flown_s=(("text 0", 1.1), ("text 2 Failsafe", 1.1), ("landed 4", 1.1)),
    ),
    # Two missions, one that returns and one that lands, the first paused and commanded to jump
    Session(
        "mission",
        seed=2,
        equal=64,
        kinds=("ack", "text", "state", "landed", "mission"),
        differing=(
            # the simulator allows downloads in any order
            "real text 2 WPM: REJ. CMD: Req. WP was unexpected",
            "ours state 29 0x4040000 0",  # MISSION without a mission, after the recording's end
            "real mission MISSION_ACK 1",
        ),
        # estimates change the times of takeoffs and landings, so that later rows are earlier
        flown_s=(
            ("text 6 Returning", 3.0),
            ("text 6 Landing detected", 5.6),
            ("text 6 Mission finished", 5.6),
            ("text 6 Disarmed by landing", 5.6),
            ("landed 1", 5.6),
            ("landed", 3.0),
            ("state", 5.6),
            ("mission MISSION_ITEM_REACHED 2", 5.6),  # on the ground
            ("mission MISSION_ITEM_REACHED", 3.0),
        ),
    ),
    # Setpoints of position, velocity, acceleration, yaw and yaw rate, in every frame; body rates
    Session(
        "setpoints",
        seed=2,
        equal=29,
        differing=(
            # the simulator lands 5 s earlier, the real one disarms after the recording's end
            "ours text 6 Disarmed by landing",
            "ours state 17 0x60000 0",
        ),
        flown_s=(
            ("text 6 Landing detected", 5.5),
            ("landed 1", 5.5),
            # answers to setpoints, of which the recording has every fourth
            ("text 2", 0.25),
        ),
    ),
    # Ground station lost with each FS_GCS_ENABLE, battery low and critical
    Session(
        "failsafes",
        seed=2,
        equal=82,
        firmware="ardupilot",
        kinds=("ack", "text", "state"),  # landings follow returns: seconds off
        differing=(
            "ours state 217 0x11 4",  # lasts a second on the real one: too brief
        ),
        flown_s=(
            ("text 4", 0.3),  # ArduCopter checks three times a second
            ("text 6 Disarming motors", 6.6),
            ("state 89 0x9 5", 6.6),
        ),
    ),
    # Setpoints as in the session with PX4; SYSID_ENFORCE
    Session(
        "setpoints",
        seed=2,
        equal=48,
        firmware="ardupilot",
        differing=(
            "real state 81 0x6 3",  # after a landing by hand, until the next heartbeat
            "ours state 89 0x6 3",
        ),
        flown_s=(
            ("text 6 Disarming motors", 6.5),  # ours returns without limits of acceleration, jerk
            ("landed 4", 6.5),
            ("landed 1", 6.5),
        ),
    ),
    # Arming in each mode, by every number and force
    Session(
        "arming",
        seed=2,
        equal=103,
        firmware="ardupilot",
        differing=(
            "real text 6 waiting for throw",
            "ours state 89 0x0 1",  # rebooted, after the recording's end
        ),
    ),
    # From boot (42 s): parameters, arming, takeoff, steps of roll and pitch, a lost stream, landing
    Session(
        "guided",
        seed=2,
        equal=56,
        firmware="ardupilot",
        kinds=("ack", "text", "state", "landed", "filter"),
        flown_s=(
            # here 27 s of thrust are 0.14 % below the weight: the landing begins 1 m lower
            ("text 6 Disarming motors", 2.5),
            ("landed 1", 2.5),
            ("state", 2.5),
            ("filter", 0.6),  # 2 Hz
        ),
    ),
    # On the ground: 85 commands, addresses, messages, parameters, modes
    Session(
        "talk",
        seed=2,
        equal=160,
        firmware="ardupilot",
        differing=(
            "real ack 520: 4",  # its param1 is not 1, which no client sends
            "ours ack 520: 0",
            # texts that say why a request is refused
            "real text 4 Unable to start landing sequence",
            "real text 4 Mode change to AUTO RTL failed: No landing sequence found",
            "real text 6 Invalid channel option (0)",
            "real text 4 Set FOLL_ENABLE = 1",
            "real text 4 No axis selected, SID_AXIS = 0",
            "real text 4 Unable to start landing sequence",
        ),
        kinds=("ack", "text"),  # a mode lasts 0.2 s, too brief for heartbeats
    ),
]


def _system(recording: Path) -> int:
    messages = (message for _, _, message in recorded(recording) if message is not None)
    return next(m.get_srcSystem() for m in messages if m.get_srcComponent() == 1)


@functools.cache
def heard(session: Session) -> tuple[Rows, Rows]:
    """Rows of the real autopilot and of the simulator."""
    real, ours, firmware = Rows(), Rows(), FIRMWARES[session.firmware]
    rates_hz = {name: hz for name, hz in firmware.companion_rates_hz.items() if name in COMPARED}
    bench = Bench(
        ESTIMATORS[session.firmware],
        seed=session.seed,
        heartbeat_type=None,
        system=_system(session.recording),
        firmware=replace(firmware, companion_rates_hz=rates_hz),
    )

    def drain(message: Any) -> None:
        """Set the battery as recorded: PX4's empties within a minute, ArduCopter's has the voltage
        that SIM_BATT_VOLTAGE sets."""
        plant, kind = bench.instance.autopilot.plant, message.get_type()
        if session.name == "battery" and kind == "SYS_STATUS":
            plant.set_battery(max(0, message.battery_remaining) / 100)
        elif kind == "PARAM_VALUE" and message.param_id == "SIM_BATT_VOLTAGE":
            plant.set_battery((message.param_value / Battery().cells - 3.5) / 0.7)

    ask_again(session.recording, bench, real, ours, run_on_s=2.0, each=drain)
    return real, ours


def limit_s(session: Session, row: str) -> float:
    known = {**dict(session.flown_s), **FLOWN_S, **dict(session.flown_s)}
    return next((known[start] for start in known if row.startswith(start)), PROMPT_S)


@pytest.mark.parametrize("session", SESSIONS, ids=lambda s: f"{s.firmware}-{s.name}")
def test_replayed_sessions_match_the_real_autopilot(session: Session) -> None:
    compared = compare(*heard(session), session.kinds, NOT_OURS)
    assert compared.differing == list(session.differing)
    assert compared.equal == session.equal
    assert [(row, s) for row, s in compared.late if not abs(s) <= limit_s(session, row)] == []


def named(name: str, firmware: str) -> Session:
    return next(s for s in SESSIONS if (s.name, s.firmware) == (name, firmware))


@pytest.mark.parametrize(
    ("name", "firmware", "equal"),
    [
        ("talk", "ardupilot", 51),
        ("failsafes", "ardupilot", 33),
        ("failsafes", "px4", 11),
        ("ground", "px4", 78),  # also out of range, NaN, of another type and unknown
    ],
)
def test_parameter_replies_match_the_real_autopilot(name: str, firmware: str, equal: int) -> None:
    """Parameters that the simulator has are read, listed and set with the same types, except the
    ids of sensors."""
    compared = compare(*heard(named(name, firmware)), ("param",), (*NOT_OURS, "CAL_"))
    assert [row for row in compared.differing if row.startswith("ours")] == []
    assert compared.equal == equal


def at(rows: Rows, times_s: Any) -> Array:
    """Position and velocity (N, 6) at these times."""
    path = np.array(rows.path)
    return np.stack([np.interp(times_s, path[:, 0], path[:, i]) for i in range(1, 7)], axis=-1)


def test_setpoints_reach_the_positions_of_the_real_vehicle() -> None:
    """Places agree at the end of each setpoint that has one; both estimates wander half a metre."""
    ends_s = (57.2, 63.1, 66.1, 69.1, 81.0, 84.0, 87.0, 98.9, 104.8, 119.6, 134.5)
    there, here = (at(rows, ends_s)[:, :3] for rows in heard(named("setpoints", "px4")))
    assert np.linalg.norm(there - here, axis=1).max() < 1.1


@pytest.mark.parametrize(
    ("axis", "begin_s", "end_s"),
    [
        (EAST, 59.0, 60.5),  # after roll by 8 degrees for 1 s, then -8 for 2 s, then 8
        (NORTH, 63.5, 65.0),  # the same in pitch
        (EAST, 72.0, 75.0),  # 5 degrees of roll and 3 s of silence
        (EAST, 75.0, 76.5),  # levelled by the timeout
    ],
)
def test_attitude_steps_move_the_vehicle_like_the_real_one(
    axis: int, begin_s: float, end_s: float
) -> None:
    """Displacements under the recorded commands, in open loop, 0.7 to 3 m long, are compared."""
    real, ours = heard(named("guided", "ardupilot"))
    assert ours.path[0][0] == pytest.approx(real.path[0][0], abs=0.06)
    there_m, here_m = (np.diff(at(rows, (begin_s, end_s))[:, axis])[0] for rows in (real, ours))
    assert abs(there_m) > 0.4
    assert here_m == pytest.approx(there_m, abs=0.35)


# -- automatic flight of PX4, recorded in real time: takeoffs to 2.5 and 10 m, a landing, 20 m
# across, 20 m up, a return; and a mission of legs from 20 to 40 m, one with a stop. The simulator
# limits acceleration, not jerk: its takeoffs are 2 s shorter.


@functools.cache
def flown(name: str) -> tuple[Rows, Rows]:
    """Rows of the real flight and of the simulator's, whose estimator has no errors."""
    real, ours = Rows(), Rows()
    bench = Bench(EstimatorName.PERFECT, heartbeat_type=None)
    ask_again(Session(name, 1, 0).recording, bench, real, ours, run_on_s=2.0)
    return real, ours


@pytest.mark.parametrize(
    ("begin_s", "end_s", "start", "goal"),
    [
        (7.4, 22.0, (0, 0, 0), (0, 0, -2.5)),  # takeoffs
        (40.4, 62.0, (0, 0, 0), (0, 0, -10)),
        (63.2, 80.0, (0, 0, -10), (20, 0, -10)),
        (81.2, 98.0, (20, 0, -10), (20, 0, -30)),
        (99.2, 107.0, (20, 0, -30), (0, 0, -30)),
    ],
)
def test_legs_have_the_times_and_speed_of_the_real_vehicle(
    begin_s: float, end_s: float, start: tuple[float, ...], goal: tuple[float, ...]
) -> None:
    """Compared are the times after a quarter, a half and three quarters of the straight line."""
    line = np.subtract(goal, start)
    times_s = np.arange(0.0, end_s - begin_s, 0.02)
    passed_s, fastest_mps = [], []
    for rows in flown("hops"):
        motion = at(rows, begin_s + times_s)
        gone = 1.0 + (motion[:, :3] - goal) @ line / (line @ line)
        passed_s.append([times_s[np.argmax(gone > share)] for share in (0.25, 0.5, 0.75)])
        fastest_mps.append((motion[:, 3:] @ line).max() / np.linalg.norm(line))
    assert passed_s[1] == pytest.approx(passed_s[0], rel=0.1, abs=2.0)
    assert abs(fastest_mps[1] - fastest_mps[0]) < 0.1 * fastest_mps[0] + 0.15


def test_mission_items_are_reached_at_the_time_of_the_real_vehicle() -> None:
    """Compared are the times from item to item; the first one, a takeoff, counts from the start."""
    sides = []
    for rows in flown("legs"):
        told = [row for row in rows.by_kind["mission"] if "REACHED" in row[1]]
        first = {what: at_s for at_s, what in reversed(told)}
        sides.append((sorted(first), np.diff([9.3, *sorted(first.values())])))
    (items, theirs_s), (reached, mine_s) = sides
    assert reached == items
    assert len(items) == 6
    assert mine_s == pytest.approx(theirs_s, rel=0.1, abs=2.0)
