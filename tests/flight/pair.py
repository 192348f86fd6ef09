"""A `Flight` (the companion) and a simulated vehicle that exchange bytes in memory and in vehicle
time, without socket or clock.

`Pair.fly` steps the vehicle by 4 ms and delivers each datagram at once, through the faults that a
test applies to either direction. Host time advances with vehicle time but from another zero, so
that code which confuses them fails.

As in `offboard.run.loop`, a turn gets all datagrams that have arrived, or none after 20 ms. A
control law that calls `HostClock.spend`, or `Pair.pause`, makes the companion take time. Meanwhile
the vehicle goes on; its datagrams wait for the next turn with their times of arrival.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from offboard.analysis import history, tlog
from offboard.analysis.history import History
from offboard.analysis.score import Score, score
from offboard.control.base import Adaptive, Controller
from offboard.estimation.observer import Observer
from offboard.flight.flight import Flight
from offboard.flight.flight_plan import FlightPlan
from offboard.flight.phases import Action, Outcome, Phase
from offboard.identification.learner import IdentifySettings, Learner
from offboard.link.interface import Chunk
from offboard.link.log import FlightLog
from offboard.mavlink.session import Session, SessionSettings
from offboard.mavlink.signing import Signing
from offboard.model.vehicle import Vehicle
from offboard.run import configuration as config
from simulator import config as simulated
from simulator.autopilot.firmware import Firmware
from simulator.config import Scenario, Start
from simulator.firmware.ardupilot import ARDUPILOT
from simulator.firmware.px4 import PX4
from simulator.instance import Instance
from simulator.steps import STEP_S

HOST_EPOCH_S = 5000.0
POLL_STEPS = 5
UNIX_EPOCH_US = 1_767_225_600_000_000
LONGEST_S = 350.0  # longest flight; includes 300 s of waiting for a vehicle that is not heard
QUICK_LANDING = {"MPC_LAND_SPEED": 1.2, "MPC_LAND_CRWL": 0.7, "COM_DISARM_LAND": 0.5}
LOITER = 3  # sub mode of PX4's AUTO
COMMAND_LONG, ATTITUDE_TARGET = 76, 82  # message ids

Bytes = list[bytes]
Filter = Callable[[float, Bytes], Bytes]

NEEDED = ("HEARTBEAT", "SYS_STATUS", "EXTENDED_SYS_STATE", "HOME_POSITION")


def with_rate(firmware: Firmware, rate_hz: float, *more: str) -> Firmware:
    """Return a firmware that sends position and attitude at `rate_hz`, whatever rate is requested.
    Of other messages it sends only those of NEEDED and `more`, and no true positions."""
    fixed = dict.fromkeys(("ATTITUDE_QUATERNION", "LOCAL_POSITION_NED"), rate_hz)
    known_hz = firmware.companion_rates_hz
    return replace(
        firmware,
        companion_rates_hz={name: known_hz[name] for name in (*NEEDED, *more) if name in known_hz}
        | fixed,
        fixed_streams=firmware.fixed_streams.union(fixed, ("HIL_STATE_QUATERNION", "SIM_STATE")),
    )


# 50 Hz, as on many telemetry links: a fifth of the requested traffic, and half the time of a test
LEAN, LEAN_COPTER = with_rate(PX4, 50.0), with_rate(ARDUPILOT, 50.0)
# A firmware that sends the requested rates, which are 100 Hz
OBEDIENT = replace(with_rate(PX4, 100.0), fixed_streams=PX4.fixed_streams)


def through(_: float, datagrams: Bytes) -> Bytes:
    """The link without a fault."""
    return datagrams


@dataclass
class HostClock:
    """Monotonic time of the companion computer."""

    now_s: float = HOST_EPOCH_S

    def __call__(self) -> float:
        return self.now_s

    def spend(self, seconds: float) -> None:
        """Let a computation of the companion take this time."""
        self.now_s += seconds


@dataclass
class Pair:
    """One flight. `at` has pairs of a condition and an action, which is done once, when the
    condition first holds.

    `down` and `up` get all datagrams (`up`: frames) with the vehicle time, and return those that
    arrive. While `dead` is set, the vehicle neither sends nor receives, and time goes on.
    """

    companion: Flight
    instance: Instance
    clock: HostClock = field(default_factory=HostClock)
    down: Filter = through
    up: Filter = through
    at: list[tuple[Callable[[Pair], bool], Callable[[Pair], object]]] = field(default_factory=list)
    dead: bool = False
    peer: Hashable = "vehicle"  # address that the vehicle sends from
    time_s: float = 0.0
    steps: int = 0
    turned: int = 0  # value of `steps` at the newest turn
    sent: list[tuple[float, Phase, bytes]] = field(default_factory=list)  # frames of the companion
    logged: Bytes = field(default_factory=list)
    phases: list[tuple[float, Phase]] = field(default_factory=list)
    failsafes: dict[str, Action] = field(default_factory=dict)  # rows that were active
    looks: list[tuple[int, Callable[[Pair], object]]] = field(default_factory=list)
    watch: Any = None  # the `watch.Watch` of this flight
    waiting: list[Chunk] = field(default_factory=list)  # chunks that the companion has not read yet
    leaving: Bytes = field(default_factory=list)  # frames that leave when the present turn ends
    lingers: bool = False  # whether turns go on after the end of the flight

    def fly(self, longest_s: float = LONGEST_S) -> Outcome:
        """Fly to the end of the flight, which must come within `longest_s`."""
        while not self.companion.has_ended():
            assert self.time_s < longest_s, f"no end after {longest_s} s: {self.companion.phase}"
            self.advance()
        assert self.companion.outcome is not None
        return self.companion.outcome

    def track(self) -> None:
        """Fly to the end of the reference, without the landing that follows."""
        while self.companion.phase is not Phase.LAND:
            outcome = self.companion.outcome
            assert outcome is None, outcome
            self.advance()
        assert "land: at rest" in self.companion.announced, self.companion.announced

    def advance(self) -> None:
        """Step the vehicle once, then run a turn of the companion if one is due."""
        self.steps += 1
        self.time_s = self.steps * STEP_S
        now_s = self.host_s
        datagrams = [] if self.dead else self.down(self.time_s, self.instance.step())
        self.waiting += [Chunk(datagram, self.peer, now_s) for datagram in datagrams]
        if now_s >= self.clock.now_s:
            self.clock.now_s = now_s
            self._feed()
            due = self.waiting or self.steps - self.turned >= POLL_STEPS
            if due and (self.lingers or not self.companion.has_ended()):
                chunks, self.waiting, self.turned = self.waiting, [], self.steps
                self._take(self.companion.turn(chunks, now_s))
        for moment in [moment for moment in self.at if moment[0](self)]:
            self.at.remove(moment)
            moment[1](self)
        if not self.phases or self.phases[-1][1] is not self.companion.phase:
            self.phases.append((self.time_s, self.companion.phase))
        for steps, see in self.looks:
            if self.steps % steps == 0:
                see(self)

    def _take(self, frames: tuple[bytes, ...]) -> None:
        self.sent.extend((self.time_s, self.companion.phase, frame) for frame in frames)
        self.leaving += self.up(self.time_s, list(frames))
        failsafe = self.companion.current.failsafe
        if failsafe.row:
            self.failsafes[failsafe.row] = failsafe.action
        if self.clock.now_s <= self.host_s:
            self._feed()
        self._keep(self.companion.current.finish_turn(self.clock.now_s))

    def _keep(self, frames: Iterable[bytes]) -> None:
        self.logged.extend(frames)

    def _feed(self) -> None:
        frames, self.leaving = self.leaving, []
        for frame in frames:
            if not self.dead:
                self.instance.feed(frame)

    def every(self, steps: int, see: Callable[[Pair], object]) -> None:
        """Call `see` with this flight every `steps` steps."""
        self.looks.append((steps, see))

    # -- what a test may do to the vehicle ------------------------------------------------------

    def ground(self, number: int, *params: float) -> None:
        """Send a command of the ground station to the vehicle, on a link of its own."""
        self.instance.feed_ground(command_of_ground(1, number, *params))

    def pilot_takes_over(self) -> None:
        self.ground(176, 1, 4, LOITER)

    @property
    def host_s(self) -> float:
        """Host time."""
        return HOST_EPOCH_S + self.time_s

    def pause(self, seconds: float) -> None:
        """Stop the process of the companion for this time, as SIGSTOP does."""
        self.clock.spend(seconds)

    @property
    def heard_s(self) -> float:
        """Time at which the newest telemetry arrived, on the scale of `time_s`."""
        return self.time_s - self.companion.current.silence_s

    # -- what a test may ask afterwards -----------------------------------------------------------

    @property
    def setpoints(self) -> list[tuple[float, Phase, Any]]:
        """Time, phase and message of every SET_ATTITUDE_TARGET."""
        return [
            (at_s, phase, decode(frame))
            for at_s, phase, frame in self.sent
            if frame_id(frame) == ATTITUDE_TARGET
        ]

    @property
    def payloads(self) -> Bytes:
        """The payload of every SET_ATTITUDE_TARGET, as on the wire."""
        return [frame[10:-2] for _, _, frame in self.sent if frame_id(frame) == ATTITUDE_TARGET]

    def commands(self, number: int) -> list[Any]:
        """Return every COMMAND_LONG with this MAV_CMD."""
        decoded = (decode(frame) for *_, frame in self.sent if frame_id(frame) == COMMAND_LONG)
        return [message for message in decoded if message.command == number]

    @property
    def modes(self) -> list[Any]:
        """Requests for a mode (MAV_CMD_DO_SET_MODE)."""
        return self.commands(176)

    @property
    def landings(self) -> list[Any]:
        """Requests to land (MAV_CMD_NAV_LAND)."""
        return self.commands(21)

    @property
    def armings(self) -> list[float]:
        """First parameters of the MAV_CMD_COMPONENT_ARM_DISARM sent: 1 to arm, 0 to disarm."""
        return [message.param1 for message in self.commands(400)]

    @property
    def armed(self) -> bool:
        return bool(self.instance.autopilot.commander.armed)

    @property
    def mode(self) -> str:
        """The mode that the vehicle is in."""
        return str(self.instance.autopilot.commander.mode.name)

    def went_through(self, phase: Phase) -> bool:
        return any(flown is phase for _, flown in self.phases)

    def log(self, directory: Path) -> tlog.Tlog:
        """Write the log of this flight into a directory, and open it."""
        log = FlightLog(directory, "")
        with log:
            for index, frame in enumerate(self.logged):
                log.write(UNIX_EPOCH_US + 100 * index, frame)
        return tlog.read(log.path)

    def history(self) -> History:
        """Return the history that is read from the log."""
        with TemporaryDirectory() as temporary:
            return history.gather(self.log(Path(temporary)))

    def score(self) -> Score:
        """Return the score of `history`."""
        return score(self.history())


def command_of_ground(component: int, number: int, *params: float) -> bytes:
    """Return a ground station's command to a component of the vehicle's system."""
    codec = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
    filled = (*params, *(0.0,) * (7 - len(params)))
    message = mavlink.MAVLink_command_long_message(1, component, number, 0, *filled)
    return bytes(message.pack(codec))


def level_setpoint(thrust: float, system: int, component: int) -> bytes:
    """Return a level setpoint of another program."""
    codec = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
    level = (1.0, 0.0, 0.0, 0.0)
    message = mavlink.MAVLink_set_attitude_target_message(0, 1, 1, 7, level, 0, 0, 0, thrust)
    return bytes(message.pack(codec))


def another_vehicle(system: int) -> bytes:
    """Return a HEARTBEAT of another vehicle."""
    codec = mavlink.MAVLink(None, srcSystem=system, srcComponent=1)
    return bytes(mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 3, 3).pack(codec))


def decode(frame: bytes) -> Any:
    return mavlink.MAVLink(None).decode(bytearray(frame))


def frame_id(frame: bytes) -> int:
    return int.from_bytes(frame[7:10], "little")


def frames_of(datagram: bytes) -> Iterable[bytes]:
    """Yield the frames of a datagram of unsigned MAVLink 2 frames."""
    at = 0
    while at < len(datagram):
        size = 12 + datagram[at + 1]
        yield datagram[at : at + size]
        at += size


def in_phase(phase: Phase, for_s: float = 0.0) -> Callable[[Pair], bool]:
    """Return the condition that the companion has been in `phase` for `for_s`."""

    def now(pair: Pair) -> bool:
        return (
            pair.companion.phase is phase
            and bool(pair.phases)
            and pair.phases[-1][1] is phase
            and pair.time_s - pair.phases[-1][0] >= for_s
        )

    return now


def make(
    *assignments: str,
    name: str = "flight",
    reference: str | None = None,
    vehicle: str | None = None,
    seed: int = 7,
    scenario: str | Scenario = "calm",
    firmware: Firmware = LEAN,
    wrap: Callable[[Controller], Controller] = lambda controller: controller,
    limits: dict[str, float] | None = None,
    flies: Vehicle | None = None,
    learning: IdentifySettings | None = None,
    believed: Vehicle | None = None,
    deadline_s: float | None = None,
    boot_scale: float = 0.25,
    clock: HostClock | None = None,
    system_id: int | None = None,
    key: bytes = b"",
    aloft: bool = False,
    **options: Any,
) -> Pair:
    """Return a pair with the settings of `offboard fly --sitl`. `flies` is the simulated vehicle,
    `believed` the controller's model of it, `learning` the settings of the identification. With
    `deadline_s` the companion does not wait for slow decisions. The vehicle starts and lands faster
    than by default, because few tests depend on either. With `aloft` it hovers at the height of the
    reference when its links open, unless the scenario has a start of its own."""
    named = {"reference": reference, "vehicle": vehicle}
    choices = {part: chosen for part, chosen in named.items() if chosen}
    clock = clock or HostClock()
    resolved = config.load(
        name, choices=choices, assignments=assignments, seed=seed, known_vehicle="px4_sih"
    )
    believed = believed or resolved.vehicle
    controller = resolved.controller.build(believed, period_s=resolved.period_s, seed=resolved.seed)
    observer = Observer(believed)
    track = config.build_track(resolved)
    flies_with = wrap(controller)
    companion = Flight(
        model=believed,
        session=Session(
            SessionSettings(system_id=system_id),
            Signing(key) if key else None,
        ),
        observer=observer,
        controller=flies_with,
        plan=FlightPlan(track),
        limits=resolved.limits.model_copy(update=limits or {}),
        period_s=resolved.period_s,
        deadline_s=deadline_s,
        stopwatch=lambda: 0.0 if deadline_s is None else clock.now_s,
        identification=(
            Learner(believed, learning) if learning and isinstance(flies_with, Adaptive) else None
        ),
    )
    flown = simulated.scenario(scenario) if isinstance(scenario, str) else scenario
    hovers = Start(height_m=-float(track.sample(0.0).position_ned_m[2])) if aloft else None
    instance = Instance(
        firmware,
        flies or simulated.vehicle(firmware.vehicle),
        flown.conditions.model_copy(update={"boot_scale": boot_scale}),
        seed,
        faults=flown.faults,
        start=flown.start or hovers,
    )
    if firmware.name == "px4":
        for parameter, value in QUICK_LANDING.items():
            instance.autopilot.parameters.set(parameter, value)
    return Pair(companion, instance, clock, **options)


def on_arducopter(*assignments: str, firmware: Firmware = LEAN_COPTER, **options: Any) -> Pair:
    """Return a flight on ArduCopter, which boots in a tenth of the 42 s of the real one."""
    pair = make(*assignments, vehicle="arducopter", firmware=firmware, boot_scale=0.1, **options)
    pair.instance.autopilot.parameters.set("GUID_OPTIONS", 8.0)
    return pair


SHORT = ("reference.height_m=1.0", "reference.duration_s=3.0")


def hover(*assignments: str, **options: Any) -> Pair:
    """Return a flight of 20 s: up to 1 m, three seconds of hover, down."""
    return make(*SHORT, *assignments, reference="hover", **options)


@cache
def calm_hover() -> Pair:
    """Return a finished flight of `hover` without options, for all tests that only read it."""
    pair = hover()
    assert pair.fly().exit_code == 0
    return pair
