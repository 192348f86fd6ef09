"""Faults of a flight as data: what goes wrong, when, and for how long. Part of a scenario file.

A fault begins `at_s` after a moment of the flight and lasts `for_s`, or for good. What each one
does to the vehicle is in `simulator.effects`.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from offboard.documents.parameters import Parameters
from offboard.model.vehicle import Triple
from simulator.firmware.catalogue import FIRMWARES
from simulator.link.impairment import Impairment
from simulator.mavlink.codec import id_of


def _known(name: str) -> str:
    if id_of(name) is None:
        raise ValueError(f"{name[:40]!r} is not a MAVLink message")
    return name


def _flown(name: str) -> str:
    if all(firmware.mode_named(name) is None for firmware in FIRMWARES.values()):
        raise ValueError(f"{name[:40]!r} is not a mode of any firmware")
    return name


MessageName = Annotated[str, AfterValidator(_known)]
ModeName = Annotated[str, AfterValidator(_flown)]  # "AUTO." may be left out


class Moment(StrEnum):
    """Event from which the time of a fault counts: its first occurrence."""

    BOOT = "boot"
    ARMED = "armed"
    TOOK_OFF = "took_off"
    ENGAGED = "engaged"  # the vehicle obeys setpoints
    LANDING = "landing"  # in the air, in the final descent of a landing
    LANDED = "landed"  # after a flight


class Direction(StrEnum):
    """Direction of a link seen from the vehicle: telemetry is down, commands are up."""

    DOWN = "down"
    UP = "up"
    BOTH = "both"


class LandedState(StrEnum):
    """What EXTENDED_SYS_STATE can report wrongly."""

    ON_GROUND = "on_ground"
    IN_AIR = "in_air"


class Datagrams(StrEnum):
    """Content of a stranger's datagrams."""

    NOISE = "noise"  # random bytes
    HEARTBEAT = "heartbeat"  # of an autopilot like the vehicle's, disarmed


class Refusable(StrEnum):
    """Requests that a fault can make the autopilot refuse."""

    ARM = "arm"
    OFFBOARD = "offboard"
    TAKEOFF = "takeoff"


class Timed(Parameters):
    """When a fault begins and how long it lasts, seconds of vehicle time; None: for good."""

    at_s: float = Field(default=0.0, ge=0, le=1e5)
    after: Moment = Moment.BOOT
    for_s: float | None = Field(default=None, gt=0, le=1e5)


class LinkFault(Timed, Impairment):
    """A bad companion link; each direction by itself, so `both` doubles the round trip.

    It does not apply to the TIMESYNC exchange of lockstep, which is the simulation's clock.
    """

    fault: Literal["link"]
    direction: Direction = Direction.BOTH

    @model_validator(mode="after")
    def _ends(self) -> LinkFault:
        if self.stalled and self.for_s is None:
            raise ValueError("a stalled link needs for_s: what waits arrives when the fault ends")
        return self


class EstimatorJump(Timed):
    """The position estimate jumps, and its reset counter increases."""

    fault: Literal["estimator_jump"]
    offset_ned_m: Triple


class GpsLoss(Timed):
    """No GPS fix: the position estimate drifts to the north-east, faster and faster with
    `drift_mps2`, and jumps back with the fix."""

    fault: Literal["gps_loss"]
    drift_mps: float = Field(default=0.0, ge=0, le=10)
    drift_mps2: float = Field(default=0.0, ge=0, le=10)


class SilentMessage(Timed):
    """A message that is no longer sent, on any link; with `every`, every so many are still sent."""

    fault: Literal["silent_message"]
    message: MessageName
    every: int | None = Field(default=None, ge=2, le=1000)


class StuckMessage(Timed):
    """A message that repeats its content; with `stamp_runs` its time stamp increases."""

    fault: Literal["stuck_message"]
    message: MessageName
    stamp_runs: bool = True


class VelocityError(Timed):
    """The velocity estimate has an offset, without an estimator reset."""

    fault: Literal["velocity_error"]
    offset_ned_mps: Triple


class WrongLandedState(Timed):
    """EXTENDED_SYS_STATE reports this state; the autopilot itself knows the true one."""

    fault: Literal["wrong_landed_state"]
    reports: LandedState


class BlindLandDetector(Timed):
    """The land detector never detects a landing, so that the vehicle does not disarm."""

    fault: Literal["blind_land_detector"]


class WeakMotor(Timed):
    """One of four motors has `motor_scale` of its thrust; the mixer keeps the torques."""

    fault: Literal["weak_motor"]
    motor_scale: float = Field(ge=0, le=1)


class MotorsCut(Timed):
    """No motor has thrust any more, from the first time on that the vehicle is below `below_m`."""

    fault: Literal["motors_cut"]
    below_m: float = Field(default=1e4, ge=0, le=1e4)  # above the ground


class ThrustChange(Timed):
    """Thrust of all motors multiplied by `thrust_scale`."""

    fault: Literal["thrust_change"]
    thrust_scale: float = Field(ge=0.1, le=3)


class MassChange(Timed):
    """A load picked up or dropped: mass multiplied by `mass_scale`."""

    fault: Literal["mass_change"]
    mass_scale: float = Field(ge=0.2, le=5)


class BatteryDrop(Timed):
    """The charge of the battery drops to `remaining` of its capacity, permanently."""

    fault: Literal["battery_drop"]
    remaining: float = Field(ge=0, le=1)


class Reboot(Timed):
    """The autopilot restarts, disarmed, with its time from zero, after `for_s` of silence."""

    fault: Literal["reboot"]
    for_s: float = Field(default=2.0, gt=0, le=60)


class ClockJump(Timed):
    """All time stamps of the vehicle jump by `jump_s`."""

    fault: Literal["clock_jump"]
    jump_s: float = Field(ge=-1e7, le=1e7)


class Refusal(Timed):
    """The autopilot refuses a request, with a text."""

    fault: Literal["refusal"]
    of: Refusable
    text: str = Field(default="Resolve system health failures first", min_length=1, max_length=200)


class PilotTakesOver(Timed):
    """The pilot switches to a mode; after `for_s` back to the one before.

    Sticks are centred or, where they are not simulated, missing: POSCTL then descends slowly.
    """

    fault: Literal["pilot_takes_over"]
    mode: ModeName | None = None  # None: the one that holds position


class PilotDisarms(Timed):
    """The pilot disarms, also in the air."""

    fault: Literal["pilot_disarms"]


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


class SecondVehicle(Timed):
    """HEARTBEATs of another vehicle arrive on the companion link, as on a shared radio."""

    fault: Literal["second_vehicle"]
    system: int = Field(default=2, ge=1, le=255)
    component: int = Field(default=1, ge=1, le=255)
    rate_hz: float = Field(default=1.0, gt=0, le=250)


class Stranger(Timed):
    """Datagrams from another port of the vehicle's host reach the companion. UDP links only."""

    fault: Literal["stranger"]
    sends: Datagrams = Datagrams.NOISE
    rate_hz: float = Field(default=100.0, gt=0, le=100_000)
    size_bytes: int = Field(default=64, ge=1, le=1400)  # of noise
    system: int | None = Field(default=None, ge=1, le=255)  # None: the vehicle's own id, a spoof
    component: int = Field(default=1, ge=1, le=255)


Fault = Annotated[
    LinkFault
    | EstimatorJump
    | GpsLoss
    | SilentMessage
    | StuckMessage
    | VelocityError
    | WrongLandedState
    | BlindLandDetector
    | WeakMotor
    | MotorsCut
    | ThrustChange
    | MassChange
    | BatteryDrop
    | Reboot
    | ClockJump
    | Refusal
    | PilotTakesOver
    | PilotDisarms
    | SecondSender
    | SecondVehicle
    | Stranger,
    Field(discriminator="fault"),
]
