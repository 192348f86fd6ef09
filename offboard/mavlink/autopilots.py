"""Autopilots on a link: by their HEARTBEAT, which of them can be the vehicle, and why none is."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from offboard.mavlink.counters import Counters, DropReason
from offboard.mavlink.decode import decode_identity
from offboard.mavlink.dialects.ardupilot import ARDUPILOT
from offboard.mavlink.dialects.base import TYPE_GCS, TYPE_ONBOARD_CONTROLLER, Dialect
from offboard.mavlink.dialects.px4 import PX4
from offboard.mavlink.framing import HEARTBEAT, Frame

DIALECTS: Mapping[str, Dialect] = MappingProxyType({d.name: d for d in (PX4, ARDUPILOT)})
AUTOPILOT_COMPONENT = 1
SYSTEMS_MAX = 8  # that are remembered
_NO_AUTOPILOT = 8  # MAV_AUTOPILOT_INVALID


class Autopilots:
    """Systems with a supported autopilot that were heard. `wanted`: the only one that may be the
    vehicle; None: any."""

    def __init__(self, wanted: int | None) -> None:
        self._wanted = wanted
        self.systems: list[int] = []

    def note(self, frame: Frame) -> Dialect | DropReason | None:
        """The autopilot that a frame shows, why it is none, or None if it is no HEARTBEAT of an
        autopilot's component."""
        if frame.message_id != HEARTBEAT or frame.component_id != AUTOPILOT_COMPONENT:
            return None
        found = _dialect(frame) if frame.verified else DropReason.NO_VEHICLE
        new = isinstance(found, Dialect) and frame.system_id not in self.systems
        if new and len(self.systems) < SYSTEMS_MAX:
            self.systems.append(frame.system_id)
        return found

    @property
    def ambiguous(self) -> bool:
        """Several could be the vehicle, and none was chosen."""
        return self._wanted is None and len(self.systems) > 1

    def named(self) -> str:
        """The systems, for a sentence."""
        if not self.systems:
            return "none"
        *others, last = map(str, sorted(self.systems))
        return f"{', '.join(others)} and {last}" if others else last

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
            return f"system {self._wanted} is not heard, but {self.named()}; see --system"
        return ""


def is_companion(frame: Frame, vehicle_system_id: int) -> bool:
    """Whether it is the HEARTBEAT of a companion computer. On PX4 some of them call themselves a
    ground station, as we do, but with the system id of the vehicle."""
    if frame.message_id != HEARTBEAT or not frame.verified:
        return False
    identity = decode_identity(frame.payload)
    as_ground_station = identity.vehicle_type == TYPE_GCS
    return identity.autopilot == _NO_AUTOPILOT and (
        identity.vehicle_type == TYPE_ONBOARD_CONTROLLER
        or (as_ground_station and frame.system_id == vehicle_system_id)
    )


def _dialect(heartbeat: Frame) -> Dialect | DropReason:
    identity = decode_identity(heartbeat.payload)
    if identity.vehicle_type == TYPE_GCS or identity.autopilot == _NO_AUTOPILOT:
        return DropReason.NO_VEHICLE
    fitting = (d for d in DIALECTS.values() if d.mav_autopilot == identity.autopilot)
    return next(fitting, DropReason.UNSUPPORTED_AUTOPILOT)
