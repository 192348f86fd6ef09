"""Other MAVLink senders beside the vehicle."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Literal

from pydantic import Field

from simulator.faults.fault import Effect, Running, Timed, Vehicle
from simulator.firmware.base import Firmware
from simulator.mavlink.codec import Encoder, message_of
from simulator.mavlink.outbox import MAV_COMP_ID_AUTOPILOT
from simulator.steps import STEP_S

_QUADROTOR, _ONBOARD_CONTROLLER, _NO_AUTOPILOT = 2, 18, 8  # MAV_TYPE, MAV_AUTOPILOT
_STANDBY, _ACTIVE, _MAVLINK = 3, 4, 3  # MAV_STATE; protocol version
_ATTITUDE_AND_THRUST = 7  # type_mask
_HEARTBEAT_HZ = 1.0
_DATAGRAMS_MAX = 2000  # of a stranger, that wait


@dataclass(slots=True)
class Sender:
    """Another sender with its MAVLink ids. `step` counts the steps in which it sends, from 0."""

    system: int
    component: int
    step: int = -1
    _encoder: Encoder = field(init=False)

    def __post_init__(self) -> None:
        self._encoder = Encoder(self.system, self.component)

    def due(self, rate_hz: float) -> range:
        """As many numbers as messages of this rate are due in this step; the first is at once."""
        before, now = (math.floor(n * rate_hz * STEP_S + 1e-9) for n in (self.step - 1, self.step))
        return range(now - before)

    def frame(self, name: str, *values: object) -> bytes:
        """A message with these values, as one frame."""
        return self._encoder.frame(message_of(name, values))

    def autopilot_heartbeat(self, firmware: Firmware) -> bytes:
        """HEARTBEAT of an autopilot with this firmware, disarmed and in its first mode."""
        mode = firmware.modes[firmware.boot_mode]
        state = (mode.base_mode, mode.custom_mode, _STANDBY, _MAVLINK)
        return self.frame("HEARTBEAT", _QUADROTOR, firmware.mav_autopilot, *state)


class SecondSender(Timed):
    """Another companion or ground station sends to the vehicle, which obeys any source.

    Level attitude setpoints at `setpoint_rate_hz` with this thrust, heading north, and a command
    when it begins. Its HEARTBEAT with `custom_mode`, which is the phase of an `offboard`, reaches
    the companion once a second, as an autopilot forwards it.
    """

    fault: Literal["second_sender"]
    system: int = Field(default=1, ge=1, le=255)
    component: int = Field(default=194, ge=1, le=255)
    custom_mode: int = Field(default=0, ge=0, le=255)
    setpoint_rate_hz: float = Field(default=10.0, ge=0, le=250)
    thrust: float = Field(default=0.5, ge=0, le=1)
    command: int | None = Field(default=None, ge=0, le=65535)  # MAV_CMD
    params: tuple[float, ...] = Field(default=(), max_length=7)  # param1 .. param7; the rest is 0

    def effect(self, vehicle: Vehicle, running: Running) -> Effect:
        sender = Sender(self.system, self.component)
        target = (vehicle.view.system, MAV_COMP_ID_AUTOPILOT)
        if self.command is not None:
            filled = (*self.params, *(0.0,) * (7 - len(self.params)))
            command = sender.frame("COMMAND_LONG", *target, self.command, 0, *filled)
            vehicle.companion.receive(command)
        level = (_ATTITUDE_AND_THRUST, (1.0, 0.0, 0.0, 0.0), 0.0, 0.0, 0.0, self.thrust)
        heartbeat = (_ONBOARD_CONTROLLER, _NO_AUTOPILOT, 0, self.custom_mode, _ACTIVE, _MAVLINK)
        while (yield):
            sender.step += 1
            for _ in sender.due(self.setpoint_rate_hz):
                vehicle.companion.receive(sender.frame("SET_ATTITUDE_TARGET", 0, *target, *level))
            for _ in sender.due(_HEARTBEAT_HZ):
                vehicle.companion.outbox.forward(sender.frame("HEARTBEAT", *heartbeat))


class SecondVehicle(Timed):
    """HEARTBEATs of another vehicle arrive on the companion link, as on a shared radio."""

    fault: Literal["second_vehicle"]
    system: int = Field(default=2, ge=1, le=255)
    component: int = Field(default=1, ge=1, le=255)
    rate_hz: float = Field(default=1.0, gt=0, le=250)

    def effect(self, vehicle: Vehicle, running: Running) -> Effect:
        sender = Sender(self.system, self.component)
        while (yield):
            sender.step += 1
            for _ in sender.due(self.rate_hz):
                heartbeat = sender.autopilot_heartbeat(vehicle.autopilot.firmware)
                vehicle.companion.outbox.forward(heartbeat)


class Datagrams(StrEnum):
    """Content of a stranger's datagrams."""

    NOISE = "noise"  # random bytes
    HEARTBEAT = "heartbeat"  # of an autopilot like the vehicle's, disarmed


class Stranger(Timed):
    """Datagrams from another port of the vehicle's host reach the companion. UDP links only."""

    fault: Literal["stranger"]
    from_another_port = True
    sends: Datagrams = Datagrams.NOISE
    rate_hz: float = Field(default=100.0, gt=0, le=100_000)
    size_bytes: int = Field(default=64, ge=1, le=1400)  # of noise
    system: int | None = Field(default=None, ge=1, le=255)  # None: the vehicle's own id, a spoof
    component: int = Field(default=1, ge=1, le=255)

    def effect(self, vehicle: Vehicle, running: Running) -> Effect:
        """At most _DATAGRAMS_MAX datagrams wait to be sent; older ones are dropped."""
        sender = Sender(self.system or vehicle.view.system, self.component)
        while (yield):
            sender.step += 1
            for _ in sender.due(self.rate_hz):
                if self.sends is Datagrams.NOISE:
                    running.datagrams.append(running.random.randbytes(self.size_bytes))
                else:
                    heartbeat = sender.autopilot_heartbeat(vehicle.autopilot.firmware)
                    running.datagrams.append(heartbeat)
            del running.datagrams[:-_DATAGRAMS_MAX]
