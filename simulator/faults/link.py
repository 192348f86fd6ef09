"""Faults of the companion link and of the vehicle's messages; other MAVLink senders."""

from __future__ import annotations

import math
from itertools import count
from random import Random
from typing import Literal

from pydantic import Field, model_validator

from simulator.autopilot.firmware import Firmware
from simulator.faults.fault import Effect, MessageName, Running, Timed, Vehicle, until_the_end
from simulator.link.impairment import Channel, Impairment
from simulator.mavlink.codec import Encoder, fields_of
from simulator.mavlink.outbox import MAV_COMP_ID_AUTOPILOT
from simulator.mavlink.view import Stuck
from simulator.steps import STEP_S


class LinkFault(Timed, Impairment):
    """A bad companion link. With `both`, a round trip takes longer by twice `latency_s`.

    The fault does not apply to the TIMESYNC exchange of lockstep, the clock of the simulation.
    """

    fault: Literal["link"]
    direction: Literal["down", "up", "both"] = "both"  # telemetry is down, commands are up

    @model_validator(mode="after")
    def _ends(self) -> LinkFault:
        if self.stalled and self.for_s is None:
            raise ValueError(
                "a stalled link needs for_s: the waiting datagrams arrive when the fault ends"
            )
        return self

    def effect(self, vehicle: Vehicle, running: Running) -> Effect:
        channels = []
        for direction, path in (("down", vehicle.down), ("up", vehicle.up)):
            if self.direction in (direction, "both"):
                channels.append(Channel(self, Random(f"{running.seed} {direction}")))
                path.append(channels[-1])
        yield from until_the_end()
        for channel in channels:
            channel.on = False  # datagrams under way still arrive


class SilentMessage(Timed):
    """A message that is no longer sent on any link; one in `every` is still sent."""

    fault: Literal["silent_message"]
    message: MessageName
    every: int | None = Field(default=None, ge=2, le=1000)

    def effect(self, vehicle: Vehicle, running: Running) -> Effect:
        vehicle.view.silent[self.message] = self.every or 0
        yield from until_the_end()
        vehicle.view.silent.pop(self.message, None)


class StuckMessage(Timed):
    """A message that repeats the old values of `fields`. Without `fields` it repeats all of them
    or, with `stamp_runs`, all except the time stamp."""

    fault: Literal["stuck_message"]
    message: MessageName
    fields: tuple[str, ...] = ()
    stamp_runs: bool = True

    @model_validator(mode="after")
    def _has_fields(self) -> StuckMessage:
        known = fields_of(self.message)
        if unknown := [each for each in self.fields if each not in known]:
            raise ValueError(f"{self.message} has no field {unknown[0]}; it has {', '.join(known)}")
        return self

    def effect(self, vehicle: Vehicle, running: Running) -> Effect:
        known = fields_of(self.message)
        # the first field of telemetry is its time stamp
        stuck = self.fields or known[1 if self.stamp_runs else 0 :]
        vehicle.view.stuck[self.message] = Stuck([known.index(each) for each in stuck])
        yield from until_the_end()
        vehicle.view.stuck.pop(self.message, None)


class ClockJump(Timed):
    """All time stamps of the vehicle jump by `jump_s`."""

    fault: Literal["clock_jump"]
    jump_s: float = Field(ge=-1e7, le=1e7)

    def effect(self, vehicle: Vehicle, running: Running) -> Effect:
        jump_us, jumped = round(self.jump_s * 1e6), vehicle.autopilot
        vehicle.view.clock_offset_us += jump_us
        yield from until_the_end()
        if vehicle.autopilot is jumped:  # a reboot has reset the clock
            vehicle.view.clock_offset_us -= jump_us


_QUADROTOR, _ONBOARD_CONTROLLER, _NO_AUTOPILOT = 2, 18, 8  # MAV_TYPE, MAV_AUTOPILOT
_STANDBY, _ACTIVE, _MAVLINK = 3, 4, 3  # MAV_STATE; protocol version
_ATTITUDE_AND_THRUST = 7  # type_mask
_HEARTBEAT_HZ = 1.0
_DATAGRAMS_MAX = 2000  # datagrams of a stranger that wait to be sent


def _autopilot_heartbeat(sender: Encoder, firmware: Firmware) -> bytes:
    """HEARTBEAT of an autopilot with this firmware, disarmed, in the mode after boot."""
    mode = firmware.modes[firmware.boot_mode]
    kind, state = (_QUADROTOR, firmware.mav_autopilot), (_STANDBY, _MAVLINK)
    return sender.frame("HEARTBEAT", (*kind, mode.base_mode, mode.custom_mode, *state))


def due(rate_hz: float, step: int) -> range:
    """Return a range with one number for each message of this rate that is due in this step; the
    first message is due in step 0."""
    before, now = (math.floor(n * rate_hz * STEP_S + 1e-9) for n in (step - 1, step))
    return range(now - before)


class SecondSender(Timed):
    """Another companion or ground station sends to the vehicle, which obeys any source.

    It sends a command when the fault begins, and level attitude setpoints, heading north, with this
    thrust at `setpoint_rate_hz`. Its HEARTBEAT reaches the companion once a second, because the
    autopilot forwards it. In the HEARTBEAT of an `offboard`, `custom_mode` is the phase.
    """

    fault: Literal["second_sender"]
    system: int = Field(default=1, ge=1, le=255)
    component: int = Field(default=194, ge=1, le=255)
    custom_mode: int = Field(default=0, ge=0, le=255)
    setpoint_rate_hz: float = Field(default=10.0, ge=0, le=250)
    thrust: float = Field(default=0.5, ge=0, le=1)
    command: int | None = Field(default=None, ge=0, le=65535)  # MAV_CMD
    params: tuple[float, ...] = Field(default=(), max_length=7)  # param1, ...; missing ones are 0

    def effect(self, vehicle: Vehicle, running: Running) -> Effect:
        sender = Encoder(self.system, self.component)
        target = (vehicle.view.system, MAV_COMP_ID_AUTOPILOT)
        if self.command is not None:
            filled = (*self.params, *(0.0,) * (7 - len(self.params)))
            command = sender.frame("COMMAND_LONG", (*target, self.command, 0, *filled))
            vehicle.companion.receive(command)
        level = (0, *target, _ATTITUDE_AND_THRUST, (1.0, 0.0, 0.0, 0.0), 0.0, 0.0, 0.0, self.thrust)
        heartbeat = (_ONBOARD_CONTROLLER, _NO_AUTOPILOT, 0, self.custom_mode, _ACTIVE, _MAVLINK)
        for step in count():
            if not (yield):
                return
            for _ in due(self.setpoint_rate_hz, step):
                vehicle.companion.receive(sender.frame("SET_ATTITUDE_TARGET", level))
            for _ in due(_HEARTBEAT_HZ, step):
                vehicle.companion.outbox.forward(sender.frame("HEARTBEAT", heartbeat))


class SecondVehicle(Timed):
    """HEARTBEATs of another vehicle arrive on the companion link, as on a shared radio."""

    fault: Literal["second_vehicle"]
    system: int = Field(default=2, ge=1, le=255)
    component: int = Field(default=1, ge=1, le=255)
    rate_hz: float = Field(default=1.0, gt=0, le=250)

    def effect(self, vehicle: Vehicle, running: Running) -> Effect:
        sender = Encoder(self.system, self.component)
        for step in count():
            if not (yield):
                return
            for _ in due(self.rate_hz, step):
                heartbeat = _autopilot_heartbeat(sender, vehicle.autopilot.firmware)
                vehicle.companion.outbox.forward(heartbeat)


class Stranger(Timed):
    """Datagrams from another port of the vehicle's host reach the companion. UDP links only."""

    fault: Literal["stranger"]
    # random bytes, or HEARTBEATs of a disarmed autopilot with the vehicle's firmware
    sends: Literal["noise", "heartbeat"] = "noise"
    rate_hz: float = Field(default=100.0, gt=0, le=100_000)
    size_bytes: int = Field(default=64, ge=1, le=1400)  # of a datagram of noise
    system: int | None = Field(default=None, ge=1, le=255)  # None: the vehicle's id (spoofing)
    component: int = Field(default=1, ge=1, le=255)

    def effect(self, vehicle: Vehicle, running: Running) -> Effect:
        """Queue datagrams; if more than _DATAGRAMS_MAX wait to be sent, the oldest are dropped."""
        sender = Encoder(self.system or vehicle.view.system, self.component)
        random = Random(running.seed)
        for step in count():
            if not (yield):
                return
            for _ in due(self.rate_hz, step):
                if self.sends == "noise":
                    running.datagrams.append(random.randbytes(self.size_bytes))
                else:
                    heartbeat = _autopilot_heartbeat(sender, vehicle.autopilot.firmware)
                    running.datagrams.append(heartbeat)
            del running.datagrams[:-_DATAGRAMS_MAX]
