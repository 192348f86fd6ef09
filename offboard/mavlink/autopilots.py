"""Autopilots on a link: by their HEARTBEAT, which of them can be the vehicle, and why none is."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from types import MappingProxyType

from pymavlink.dialects.v20.ardupilotmega import enums

from offboard.mavlink.counters import Counters, DropReason
from offboard.mavlink.decode import Identity, decode_identity
from offboard.mavlink.dialects.ardupilot import ARDUPILOT
from offboard.mavlink.dialects.base import TYPE_GCS, TYPE_ONBOARD_CONTROLLER, Dialect
from offboard.mavlink.dialects.px4 import PX4
from offboard.mavlink.framing import HEARTBEAT, Frame

DIALECTS: Mapping[str, Dialect] = MappingProxyType({d.name: d for d in (PX4, ARDUPILOT)})
AUTOPILOT_COMPONENT = 1
SYSTEMS_MAX = 8  # that are remembered
HEARD_S = 10.0  # after its newest HEARTBEAT a system is gone
NOTED_EVERY_S = 1.0
_NO_AUTOPILOT = 8  # MAV_AUTOPILOT_INVALID
# MAV_TYPE: quadrotor, coaxial, hexarotor, octorotor, tricopter, dodecarotor, decarotor, any number
MULTIROTORS = frozenset({2, 3, 13, 14, 15, 29, 35, 43})
HELICOPTER = 4
# MAV_TYPE of what is no vehicle, whatever autopilot it names: antenna tracker, ground station,
# onboard controller, gimbal, ADS-B, camera, and the peripherals from charging station to GPS
_NO_VEHICLES = frozenset({5, 6, 18, 26, 27, 30, 31, 32, 33, 34, *range(36, 43), 44})


class Autopilots:
    """Systems with a supported autopilot that were heard. `wanted`: the only one that may be the
    vehicle; None: any. Times are `Session.link_time_s`.

    `systems` has when each was heard, to a second."""

    def __init__(self, wanted: int | None) -> None:
        self._wanted = wanted
        self.systems: dict[int, float] = {}

    def note(self, frame: Frame, now_s: float) -> Dialect | DropReason | None:
        """The autopilot that a frame shows, why it is none, or None if it is no HEARTBEAT of an
        autopilot's component."""
        if frame.message_id != HEARTBEAT or frame.component_id != AUTOPILOT_COMPONENT:
            return None
        found = _dialect(frame) if frame.verified else DropReason.NO_VEHICLE
        if isinstance(found, Dialect):
            self.hear(frame.system_id, now_s)
        return found

    def hear(self, system_id: int, now_s: float) -> None:
        """This system has an autopilot."""
        if now_s - self.systems.get(system_id, -math.inf) < NOTED_EVERY_S:
            return
        self.systems.pop(system_id, None)  # the newest is the last
        self.systems[system_id] = now_s
        if len(self.systems) > SYSTEMS_MAX:
            del self.systems[next(iter(self.systems))]

    def ambiguous(self, now_s: float) -> bool:
        """Several could be the vehicle, and none was chosen."""
        return self._wanted is None and len(self._present(now_s)) > 1

    def named(self, now_s: float) -> str:
        """The systems that are heard, for a sentence."""
        return _listed(self._present(now_s))

    def _present(self, now_s: float) -> list[int]:
        return [each for each, at_s in self.systems.items() if now_s - at_s <= HEARD_S]

    def why_none(self, counters: Counters) -> str:
        """Why no vehicle was found, as far as the frames that were dropped tell; else empty."""
        dropped = counters.dropped
        if dropped[DropReason.BAD_SIGNATURE]:
            return "frames arrive, but their signature does not match: it is another key's"
        if dropped[DropReason.OLD_STAMP] or dropped[DropReason.REPLAYED]:
            return (
                "signed frames arrive, but their time stamps are too old: the vehicle does not "
                "take ours; is the link one-way?"
            )
        if dropped[DropReason.UNSIGNED]:
            return "frames arrive unsigned: set the key on the vehicle, or omit --signing-key"
        if dropped[DropReason.NO_KEY]:
            return "the vehicle signs its messages: give its key with --signing-key"
        if self._wanted is not None and self.systems:
            return f"system {self._wanted} is not heard, but {_listed(self.systems)}; see --system"
        return ""


def _listed(systems: Collection[int]) -> str:
    *others, last = map(str, sorted(systems)) if systems else ("none",)
    return f"{', '.join(others)} and {last}" if others else last


def is_companion(frame: Frame, vehicle_system_id: int) -> bool:
    """Whether it is the HEARTBEAT of a companion computer. On PX4 some of them call themselves a
    ground station, but with the system id of the vehicle."""
    if frame.message_id != HEARTBEAT or not frame.verified:
        return False
    identity = decode_identity(frame.payload)
    as_ground_station = identity.vehicle_type == TYPE_GCS
    return identity.autopilot == _NO_AUTOPILOT and (
        identity.vehicle_type == TYPE_ONBOARD_CONTROLLER
        or (as_ground_station and frame.system_id == vehicle_system_id)
    )


def is_vehicle(identity: Identity) -> bool:
    """Whether this HEARTBEAT is of a vehicle with an autopilot, of any kind."""
    return identity.vehicle_type not in _NO_VEHICLES and identity.autopilot != _NO_AUTOPILOT


def unfit_type(vehicle_type: int, *, helicopter: bool) -> str:
    """Why a vehicle of this MAV_TYPE is not flown, in one sentence; empty if it is. `helicopter`:
    the vehicle file is that of a helicopter."""
    if vehicle_type in ({HELICOPTER} if helicopter else MULTIROTORS):
        return ""
    known = enums["MAV_TYPE"].get(vehicle_type)
    name = known.name.removeprefix("MAV_TYPE_") if known else f"MAV_TYPE {vehicle_type}"
    if helicopter:
        return f"the vehicle is a {name}; its vehicle file says airframe: helicopter"
    hint = " (airframe: helicopter in its vehicle file flies it)"
    return (
        f"the vehicle is a {name}; offboard flies multirotors"
        f"{hint if vehicle_type == HELICOPTER else ''}"
    )


def _dialect(heartbeat: Frame) -> Dialect | DropReason:
    identity = decode_identity(heartbeat.payload)
    if not is_vehicle(identity):
        return DropReason.NO_VEHICLE
    fitting = (d for d in DIALECTS.values() if d.mav_autopilot == identity.autopilot)
    return next(fitting, DropReason.UNSUPPORTED_AUTOPILOT)
