"""One simulated vehicle with its two links, in memory: it takes and returns datagrams as bytes.

Tests and campaigns call it directly; `simulator.run` adds sockets and a clock. The same seed and
the same received datagrams at the same steps give the same sent datagrams.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence

from offboard.documents.errors import DocumentError
from offboard.model.vehicle import Vehicle
from simulator.autopilot.autopilot import Autopilot
from simulator.autopilot.commander import Request
from simulator.autopilot.firmware import Firmware
from simulator.autopilot.position_controller import OFF
from simulator.config import Start
from simulator.faults import Fault
from simulator.faults.fault import Injection
from simulator.faults.link import Stranger
from simulator.link.framing import frames
from simulator.link.impairment import Channel, carry
from simulator.mavlink.codec import Keyring
from simulator.mavlink.server import Server
from simulator.mavlink.telemetry import builders
from simulator.mavlink.view import View
from simulator.steps import STEP_S, STEP_US
from simulator.vehicle.conditions import Conditions
from simulator.vehicle.plant import Plant

VIRTUAL_EPOCH_US = 1_767_225_600_000_000  # 2026-01-01: Unix time at which virtual time begins
BARRIER_STEPS = 5  # 20 ms
RESTART_S = 1.0  # silence of the vehicle during a reboot by command
_TIMESYNC = 111
# A start in the air
_CLIMB_S = 120.0  # timeout: 100 m at 1.5 m/s, and then until estimate and truth agree
_SETTLE_S = 2.0  # from the boot event "ready" until the vehicle is armed
_REACHED_M, _STILL_MPS = 0.3, 0.1  # it hovers: true height error, estimated vertical speed


class Instance:
    """A vehicle with its autopilot, its companion link and its ground station link.

    Args:
        firmware: `PX4` or `ARDUPILOT`.
        vehicle: physical parameters, as `simulator.config.vehicle` reads them.
        conditions: wind, estimator errors, battery and other conditions of the flight.
        seed: seed of all noise.
        system: MAVLink system id.
        lockstep: whether barriers (`barrier_due`) replace the TIMESYNC stream of the companion
            link.
        ground_link: whether there is a link to a ground station.
        epoch_us: Unix time of boot in SYSTEM_TIME, microseconds.
        parameters: values of autopilot parameters that replace the defaults.
        faults: what goes wrong, and when (`simulator.faults`).
        start: how the vehicle hovers when its links open; None: it boots on the ground.
        signing_key: 32 bytes, with which the vehicle signs what it sends and checks what it
            receives; empty: no signing.

    Example:
        >>> from simulator import config
        >>> from simulator.firmware.px4 import PX4
        >>> from simulator.vehicle.conditions import Conditions
        >>> instance = Instance(PX4, config.vehicle("px4_sih"), Conditions(), seed=1)
        >>> telemetry = []
        >>> while instance.time_s < 1.0:
        ...     telemetry += instance.step()
        >>> instance.feed(b"")  # a datagram of the companion
    """

    def __init__(
        self,
        firmware: Firmware,
        vehicle: Vehicle,
        conditions: Conditions,
        seed: int,
        *,
        system: int = 1,
        lockstep: bool = False,
        ground_link: bool = True,
        epoch_us: int = VIRTUAL_EPOCH_US,
        parameters: Mapping[str, float] | None = None,
        faults: Sequence[Fault] = (),
        start: Start | None = None,
        signing_key: bytes = b"",
    ) -> None:
        self.autopilot = Autopilot(
            firmware, Plant(vehicle, conditions, seed), boot_scale=conditions.boot_scale
        )
        self.autopilot.parameters.set(firmware.system_parameter, system)
        for name, value in (parameters or {}).items():
            self.autopilot.parameters.set(name, value)
        if start is not None:
            _take_off(self.autopilot, start)
        clock_us = round(conditions.clock_start_s * 1e6)
        self.view = View(
            self.autopilot,
            system,
            epoch_us - clock_us,
            builders(firmware),
            conditions.clock_rate,
        )
        self.view.clock_offset_us = clock_us
        self.keyring = Keyring(
            firmware.accepted_unsigned,
            self._unix_us if firmware.stamps_follow_clock else None,
            signing_key,
        )
        rates_hz = firmware.companion_rates_hz
        self.companion = Server(self.view, rates_hz, self.keyring, number=0, barrier=lockstep)
        self.links = [self.companion]
        if ground_link:
            ground = Server(self.view, firmware.ground_rates_hz, self.keyring, number=1)
            ground.others, self.companion.others = (self.companion,), (ground,)
            self.links.append(ground)
        self.steps = 0
        self._faults = Injection(faults, seed)
        self.down: list[Channel] = []  # link faults of the telemetry
        self.up: list[Channel] = []  # link faults of what the companion sends
        # Datagrams that other senders send to the companion, one list for each of their ports; the
        # caller sends them and clears the lists
        self.strangers = [
            one.datagrams for one in self._faults.unfinished if isinstance(one.fault, Stranger)
        ]
        self._by_step = bool(faults)  # link faults need the datagrams of each step by itself
        self._arrived: list[bytes] = []
        self._barrier_at_step = 0
        self._back_at_step = 0  # end of a reboot

    @property
    def time_s(self) -> float:
        """Seconds since the links opened; a reboot does not reset them."""
        return self.steps * STEP_S

    @property
    def refusals(self) -> Counter[str]:
        """Number of received messages that were refused because of their signature, by reason."""
        return sum((link.decoder.refused for link in self.links), Counter())

    def _unix_us(self) -> int:
        """Unix time of the vehicle's clock in microseconds, as in SYSTEM_TIME."""
        return self.view.epoch_us + self.view.time_us

    def advance(self) -> None:
        """Simulate one step of STEP_S; telemetry waits in the links until `drain`."""
        self.steps += 1
        if self._faults.unfinished:
            self._faults.step(self.time_s, self)
            self.autopilot.state.invalidate()
        for datagram in carry(self.up, [], self._now_us):
            self._handle(datagram)
        if self.steps <= self._back_at_step:
            self.autopilot.plant.advance(STEP_S, OFF)
            return
        self.autopilot.step()
        if self.autopilot.commander.reboot_requested:
            self.reboot(RESTART_S)
            return
        if self.autopilot.commander.texts or self.autopilot.commander.announcements:
            self._send_texts()
        for link in self.links:
            link.step()
        if self._by_step:
            self._arrived = self.drain()

    def advance_to_barrier(self, end_s: float = math.inf) -> bool:
        """Advance to the next barrier, at most to vehicle time `end_s`; return whether a barrier
        is due."""
        while self.time_s < end_s:
            self.advance()
            if self.barrier_due():
                return True
        return False

    def step(self) -> list[bytes]:
        """Advance by one step and return the datagrams for the companion; those for the ground
        station are dropped."""
        self.advance()
        self.drain_ground()
        return self.drain()

    def drain(self) -> list[bytes]:
        """Return the datagrams that have arrived at the companion since the last call."""
        sent = carry(self.down, self.companion.outbox.drain(), self._now_us)
        arrived, self._arrived = self._arrived + sent, []
        return arrived

    def drain_ground(self) -> list[bytes]:
        """Return the datagrams for the ground station since the last call."""
        return [datagram for link in self.links[1:] for datagram in link.outbox.drain()]

    def feed(self, datagram: bytes) -> None:
        """Receive one datagram of the companion at the present vehicle time."""
        for piece in self._without_clock(datagram):
            for arrived in carry(self.up, [piece], self._now_us):
                self._handle(arrived)

    def feed_ground(self, datagram: bytes) -> None:
        """Receive one datagram of the ground station."""
        if self.steps < self._back_at_step:
            return
        self.links[1].receive(datagram)
        self._send_texts()

    def barrier_due(self) -> bool:
        """Whether lockstep waits for the companion at this step.

        This is the first step with a new position at or after each multiple of 20 ms. So a command
        takes effect at the time stamp of the newest position, nearly as in real time.
        """
        position_steps = self.autopilot.firmware.position_grid_steps
        if self.steps < self._barrier_at_step or self.steps % position_steps:
            return False
        self._barrier_at_step = (self.steps // BARRIER_STEPS + 1) * BARRIER_STEPS
        return True

    def barrier(self) -> tuple[int, list[bytes]]:
        """Queue the TIMESYNC request of lockstep after all telemetry.

        Link faults do not apply to the request, because it is the clock of the simulation.

        Returns:
            The time stamp of the request in nanoseconds, and all datagrams for the companion.
        """
        stamp_ns = self._now_us * 1000
        datagrams = self.drain() if self._by_step else []
        self.companion.send_barrier(stamp_ns)
        return stamp_ns, datagrams + self.companion.outbox.drain()

    def reboot(self, silent_s: float) -> None:
        """Restart the autopilot. For `silent_s` the motors are off and no message is sent or
        handled; a vehicle in the air falls."""
        old = self.autopilot
        self.autopilot = Autopilot(
            old.firmware, old.plant, old.parameters, old.mission, boot_scale=old.health.boot_scale
        )
        self.autopilot.position_controller.detector.set_landed(old.plant.on_ground)
        self.autopilot.commander.refused = old.commander.refused  # a `refusal` fault goes on
        self.view.restart(self.autopilot)
        self.keyring.restart()
        for link in self.links:
            link.restart()
        self._back_at_step = self.steps + round(silent_s / STEP_S)

    @property
    def _now_us(self) -> int:
        return self.steps * STEP_US

    def _handle(self, datagram: bytes) -> None:
        if self.steps >= self._back_at_step:
            self.companion.receive(datagram)
            self._send_texts()

    def _without_clock(self, datagram: bytes) -> list[bytes]:
        """Handle the TIMESYNC answers of lockstep (tc1 is not 0) at once. Return the other frames,
        to which link faults and the silence of a reboot apply."""
        if not self.companion.barrier:
            return [datagram]
        rest: list[bytes] = []
        for message_id, frame in frames(datagram):
            if message_id == _TIMESYNC and any(frame[10:18]):
                self.companion.receive(frame)
            else:
                rest.append(frame)
        return rest

    def _send_texts(self) -> None:
        """Queue new texts and announced messages on every link."""
        commander = self.autopilot.commander
        for text in commander.texts:
            for link in self.links:
                link.outbox.send_text(text)
        commander.texts.clear()
        for name in commander.announcements:
            for link in self.links:
                link.outbox.send_now(name)
        commander.announcements.clear()


def _take_off(autopilot: Autopilot, start: Start) -> None:
    """Boot, arm, climb to the height of `start` and enter its mode.

    Raises:
        DocumentError: the vehicle does not hover at the height within _CLIMB_S.
    """
    ready_s = autopilot.firmware.boot_events_s["ready"] * autopilot.health.boot_scale + _SETTLE_S
    while autopilot.state.time_s < ready_s:
        autopilot.step()
    # the commands of a ground station, in a mode in which the firmware accepts a takeoff
    autopilot.handle("mode", Request(autopilot.firmware.reposition_mode))
    autopilot.handle("arm")
    autopilot.handle("takeoff", Request(takeoff_ned_m=(math.nan, math.nan, -start.height_m)))
    end_s = ready_s + _CLIMB_S
    while not (hovers := _hovers(autopilot, start.height_m)) and autopilot.state.time_s < end_s:
        autopilot.step()
    if not hovers:
        raise DocumentError(f"start.height_m: the vehicle does not hover at {start.height_m:g} m")
    named = autopilot.firmware.mode_named(start.mode or autopilot.firmware.hold_mode)
    assert named is not None
    autopilot.commander.switch(named.name, by_failsafe=start.by_failsafe)
    autopilot.commander.texts.clear()
    autopilot.commander.announcements.clear()


def _hovers(autopilot: Autopilot, height_m: float) -> bool:
    off_m = abs(autopilot.plant.height_m - height_m)
    return off_m < _REACHED_M and abs(autopilot.state.estimate.velocity_ned_mps[2]) < _STILL_MPS
