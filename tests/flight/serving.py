"""The service and a simulated vehicle that exchange bytes in memory: `Pair` with `Flights` as its
companion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from pair import (
    HOST_EPOCH_S,
    LEAN,
    LEAN_COPTER,
    LOITER,
    SHORT,
    HostClock,
    Pair,
    command_of_ground,
    decode,
    level_setpoint,
)

from offboard.flight.phases import TRACKING, Anchor, Phase, ServiceOptions, Then
from offboard.identification.vehicle_estimate import IdentifiedVehicle
from offboard.mavlink.session import Session, SessionSettings
from offboard.run import configuration as config
from offboard.run.flight import Prepared, build
from offboard.service.flights import Flights
from offboard.service.preparation import VehicleFiles
from simulator import config as simulated
from simulator.autopilot.firmware import Rule
from simulator.config import Start
from simulator.instance import Instance

ARM, TAKEOFF, SET_MODE, LAND = 400, 22, 176, 21  # MAV_CMD
START, PAUSE_CONTINUE = 300, 193
NAN = float("nan")
HOVER = {"px4": 0.489, "ardupilot": 0.366}  # hover thrust
MODES = {  # parameters of MAV_CMD_DO_SET_MODE
    "px4": {"engage": (1, 6, 0), "pilot": (1, 4, LOITER), "land": (1, 4, 6)},
    "ardupilot": {"engage": (1, 4, 0), "pilot": (1, 17, 0), "land": (1, 9, 0)},
}


@dataclass
class Settings:
    """A `Preparation` whose configuration a test may replace."""

    newest: Prepared
    sentences: list[str] = field(default_factory=list)

    def news(self) -> list[str]:
        told, self.sentences = self.sentences, []
        return told


@dataclass
class Logs:
    """A `Recorder` that stores when each flight began and ended. As files do, it outlasts a restart
    of the service."""

    clock: HostClock
    begun: list[float] = field(default_factory=list)
    ended: list[float] = field(default_factory=list)
    left: str = ""

    def begin(self, session: Session, configuration: str, vehicle: str) -> str:
        self.begun.append(self.clock.now_s - HOST_EPOCH_S)
        self.left = vehicle
        return f"flight-{len(self.begun)}"

    def end(self, *, engaged: bool) -> None:
        self.ended.append(self.clock.now_s - HOST_EPOCH_S)
        self.left = self.left if engaged else ""

    def settle(self) -> None:
        self.left = ""


def prepared(*assignments: str, **choices: str) -> Prepared:
    resolved = config.load("flight", choices=choices, assignments=assignments, seed=7)
    return build(resolved)


@dataclass
class Serving(Pair):
    """A pair whose companion is the service. The pilot commands the vehicle on another link."""

    firmware: str = "px4"
    source: Any = None
    logs: Any = None
    memory: Any = None  # its `VehicleFiles`
    again: Callable[[Any], Flights] | None = None
    restarted: Callable[[], object] = lambda: None  # called after `restart`

    @property
    def state(self) -> Any:
        return self.service.current

    @property
    def remembered(self) -> IdentifiedVehicle | None:
        """The vehicle constants that the service has stored."""
        known: IdentifiedVehicle | None = self.memory.get(
            f"{self.firmware}-1-1", self.source.newest
        )
        return known

    @property
    def service(self) -> Flights:
        return self.companion  # type: ignore[return-value]

    def until(self, done: Callable[[], bool], longest_s: float = 60.0) -> None:
        """Advance until `done`."""
        end_s = self.time_s + longest_s
        while not done():
            assert self.time_s < end_s, (
                f"{self.service.phase} {self.mode}: {self.service.current.announced}"
            )
            self.advance()

    def run(self, seconds: float) -> None:
        end_s = self.time_s + seconds
        while self.time_s < end_s:
            self.advance()

    @property
    def phase(self) -> Phase:
        return self.service.phase

    @property
    def paused(self) -> bool:
        """Whether the process of the service is stopped."""
        return self.clock.now_s > HOST_EPOCH_S + self.time_s

    @property
    def place(self) -> np.ndarray:
        return np.array(self.instance.autopilot.state.truth.position_ned_m)

    def switch(self, to: str) -> None:
        self.ground(SET_MODE, *MODES[self.firmware][to])

    def engage(self) -> None:
        """Let the pilot switch to the mode of our setpoints, and wait until the service flies."""
        self.switch("engage")
        self.until(lambda: self.phase in TRACKING, 3.0)

    def fly_up(self, height_m: float = 3.0) -> None:
        """Let the pilot take off and hold, while the service waits."""
        self.until(lambda: self.phase is Phase.STANDBY)
        commander = self.instance.autopilot.commander
        if self.firmware == "px4":
            self.until(lambda: self.try_arm(commander), 30.0)
            self.instance.autopilot.parameters.set("MIS_TAKEOFF_ALT", height_m)
            self.ground(TAKEOFF, *(NAN,) * 7)
        else:
            self.switch("engage")
            self.until(lambda: self.try_arm(commander), 30.0)
            self.ground(TAKEOFF, 0, 0, 0, 0, 0, 0, height_m)
        self.until(lambda: -self.place[2] > 0.9 * height_m, 40.0)
        self.run(2.0)
        self.switch("pilot")
        self.run(4.0)

    def try_arm(self, commander: Any) -> bool:
        if self.steps % 250 == 0:
            self.ground(ARM, 1)
        return bool(commander.armed)

    def command(self, number: int, *params: float) -> None:
        """Send a command to our component; the vehicle forwards it on our link."""
        self.forwarded.append(command_of_ground(191, number, *params))

    forwarded: list[bytes] = field(default_factory=list)
    lost_down: bool = False
    lost_up: bool = False

    def deliver(self, _: float, datagrams: list[bytes]) -> list[bytes]:
        """Return what arrives at the service: the vehicle's datagrams, and those of others."""
        extra, self.forwarded = self.forwarded, []
        return [] if self.lost_down else datagrams + extra

    def send_up(self, _: float, frames: list[bytes]) -> list[bytes]:
        return [] if self.lost_up else frames

    def other_setpoint(self) -> None:
        """Let a setpoint of another program arrive at the service, as from a router."""
        self.forwarded.append(level_setpoint(0.5, 42, 190))

    def restart(self) -> None:
        """Restart the process of the service."""
        self.companion = self.again(self.logs)  # type: ignore[misc,assignment]
        self.restarted()

    @property
    def acks(self) -> list[tuple[int, int]]:
        """Command and result of each COMMAND_ACK that was sent."""
        decoded = (decode(frame) for _, _, frame in self.sent if frame[7] == 77)
        return [(message.command, message.result) for message in decoded]


def serve(
    *assignments: str,
    on: str = "px4",
    reference: str = "hover",
    then: Then = "hold",
    anchor: Anchor = "here",
    arms: bool = False,
    known: IdentifiedVehicle | None = None,
    aloft: bool = False,
    rules: tuple[Rule, ...] = (),
) -> Serving:
    """Return a service and a vehicle, which is booting on the ground, or with `aloft` holds at 3 m
    by its pilot. `known` are constants of it that an earlier flight identified; `rules` are more
    rules of its firmware."""
    vehicle = "px4_sih" if on == "px4" else "arducopter"
    clock = HostClock()
    short = SHORT if reference == "hover" else ()
    source = Settings(prepared(*short, *assignments, reference=reference, vehicle=vehicle))
    logs, memory = Logs(clock), VehicleFiles(Path("/dev/null"), print)  # writes no file
    if known:
        memory.keep(f"{on}-1-1", source.newest, known)

    def again(logs: Any) -> Flights:
        return Flights(
            session=Session(SessionSettings()),
            source=source,
            record=logs,
            memory=memory,
            options=ServiceOptions(anchor, then, arms),
            stopwatch=lambda: 0.0,
        )

    conditions = simulated.scenario("calm").conditions
    firmware = LEAN if on == "px4" else LEAN_COPTER
    firmware = replace(firmware, rules=(*rules, *firmware.rules))
    instance = Instance(
        firmware,
        simulated.vehicle(firmware.vehicle),
        conditions.model_copy(update={"boot_scale": 1.0 if on == "px4" else 0.1}),
        seed=7,
        start=Start(height_m=3.0) if aloft else None,
    )
    if on == "ardupilot":
        instance.autopilot.parameters.set("GUID_OPTIONS", 8.0)
    pair = Serving(again(logs), instance, clock, firmware=on, source=source, logs=logs,
                   memory=memory, again=again)  # fmt: skip
    pair.down, pair.up = pair.deliver, pair.send_up
    return pair
