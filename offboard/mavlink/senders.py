"""Senders on the link: which one is the vehicle, which others control it, and which are ignored.

The first autopilot heard is the vehicle, identified by system id, component id and network address.
From then on other senders are ignored, and with a key all frames without its signature. Setpoints
and mode commands that another sender sends to our vehicle, and other companion computers, are
reported.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Hashable, Iterator, Mapping
from types import MappingProxyType
from typing import Any

from pymavlink.dialects.v20.all import enums

from offboard.mavlink.decode import ARMED, Address
from offboard.mavlink.dialects.ardupilot import ARDUPILOT
from offboard.mavlink.dialects.base import TYPE_GCS, TYPE_ONBOARD_CONTROLLER, Dialect
from offboard.mavlink.dialects.px4 import PX4
from offboard.mavlink.events import (
    ClockBehind,
    CommandRequest,
    Event,
    OtherCompanion,
    OtherSender,
    VehicleFound,
)
from offboard.mavlink.framing import (
    COMMAND_ACK,
    HEARTBEAT,
    SETPOINTS,
    TIMESYNC,
    Frame,
    FrameSplitter,
)
from offboard.mavlink.outgoing import Target
from offboard.mavlink.signing import Refusal, Signing

DIALECTS: Mapping[str, Dialect] = MappingProxyType({d.name: d for d in (PX4, ARDUPILOT)})
_BY_AUTOPILOT = {dialect.mav_autopilot: dialect for dialect in DIALECTS.values()}
AUTOPILOT_COMPONENT = 1
COMMANDS = COMMAND_INT, COMMAND_LONG = 75, 76
# MAV_CMD: return, land, take off, set the mode, go to a place, begin a mission, arm or disarm
_MODE_COMMANDS = frozenset({20, 21, 22, 176, 192, 300, 400})
PEER_SILENT_S = 0.5  # half of `Limits.silence_s`, so that the flight can continue on a new port
OTHER_VEHICLE_S = 5.0  # after a longer silence another vehicle may be on the link, or another host
SIGNS, GIVE_KEY = "the vehicle signs its messages", "give its key with --signing-key"
SYSTEMS_MAX = 8  # systems that are remembered
HEARD_S = 10.0  # a system counts as present for this time after its newest HEARTBEAT
NOTED_EVERY_S = 1.0  # a system is noted again only after this time
_NO_AUTOPILOT = 8  # MAV_AUTOPILOT_INVALID
# MAV_TYPE: quadrotor, coaxial, hexarotor, octorotor, tricopter, dodecarotor, decarotor, any number
MULTIROTORS = frozenset({2, 3, 13, 14, 15, 29, 35, 43})
HELICOPTER = 4
# MAV_TYPEs that are no vehicle, even if the HEARTBEAT names an autopilot: antenna tracker, ground
# station, onboard controller, gimbal, ADS-B, camera, and peripherals from charging station to GPS
_NO_VEHICLES = frozenset({5, 6, 18, 26, 27, 30, 31, 32, 33, 34, *range(36, 43), 44})


class Senders:
    """See the module. `wanted` is the only system id that the vehicle may have (None: any). Without
    `signing` the vehicle must not sign.

    `vehicle` and `dialect` are None until the vehicle was found. `own` are our ids; our system id
    is that of the vehicle. `systems` has the time at which each autopilot was heard, to a second;
    `twin_s` the time at which one with the vehicle's system id was heard from another address.
    `forged` counts the frames that signing refused. `signs`: whether the newest HEARTBEAT of an
    autopilot was signed although we have no key. `roams`: whether the vehicle may now send from
    another host. Times are `Session.link_time_s`, except
    `newest_frame_s`: `Session.elapsed_s` of the vehicle's newest frame.
    """

    def __init__(self, wanted: int | None, component_id: int, signing: Signing | None) -> None:
        self.own = Address(1, component_id)
        self.vehicle: VehicleFound | None = None
        self.dialect: Dialect | None = None
        self.target: Target | None = None  # the vehicle, as the receiver of our messages
        self.clock_behind = False  # whether an autopilot was heard whose signing time is behind
        self.systems: dict[int, float] = {}
        self.twin_s = -math.inf
        self.forged: Counter[Refusal] = Counter()
        self.signs = False
        self.roams = False
        self._news_at = 1  # number of forged frames at which `news` reports next
        self._other_component = 0  # newest component id of an autopilot with another one than 1
        self.newest_frame_s = 0.0
        self._wanted = wanted
        self._signing = signing
        # address of the vehicle, or of an autopilot whose signing time is behind
        self.peer: Hashable | None = None

    def set_vehicle(self, vehicle: VehicleFound, peer: Hashable) -> None:
        """Use this vehicle, which sends from `peer`, as ours."""
        self.vehicle, self.dialect, self.peer = vehicle, DIALECTS[vehicle.autopilot], peer
        self.own = Address(vehicle.system_id, self.own.component_id)
        divides = self.dialect.divides_by_tilt
        self.target = Target(vehicle.system_id, vehicle.component_id, divides)

    # --- datagrams from another address ---

    def moves_to(self, peer: Hashable, now_s: float, datagram: bytes) -> bool:
        """Make `peer` the vehicle's address if the known one is silent and `datagram`, from `peer`,
        has a frame of the vehicle. Returns whether the address has changed."""
        silent = now_s - self.newest_frame_s > PEER_SILENT_S
        if not (silent and (self.roams or same_host(peer, self.peer))):
            return False
        ids, frames = (self.own.system_id, AUTOPILOT_COMPONENT), self._genuine(datagram)
        moves = any((frame.system_id, frame.component_id) == ids for frame in frames)
        if moves:  # so the autopilot at the other address was the vehicle itself
            self.peer, self.twin_s = peer, -math.inf
        return moves

    def overhear(self, datagram: bytes, now_s: float) -> list[int]:
        """Note the autopilots in a datagram from another address. Returns their system ids, each
        at most once a second."""
        shown = {each.system_id for each in self._genuine(datagram) if self._autopilot(each)}
        return [each for each in sorted(shown) if self.hear_elsewhere(each, now_s)]

    def hear_elsewhere(self, system_id: int, now_s: float) -> bool:
        """Note an autopilot of this system at another address. Returns whether it was not noted
        within the last second."""
        if self.vehicle is None or system_id != self.vehicle.system_id:
            return self._hear(system_id, now_s)
        news = now_s - self.twin_s >= NOTED_EVERY_S
        self.twin_s = now_s if news else self.twin_s
        return news

    def _genuine(self, datagram: bytes) -> Iterator[Frame]:
        """The frames of a datagram that signing would accept. Frames are not counted, and their
        time stamps are not stored."""
        for frame in FrameSplitter(stream=False).split(datagram):
            if not (self._signing and self._signing.refusal(frame, note=False)):
                yield frame

    # --- frames ---

    def refuse(self, frame: Frame, peer: Hashable, now_s: float, events: list[Event]) -> bool:
        """Whether signing refuses a frame.

        Until a vehicle is found, adds ClockBehind to `events` for a HEARTBEAT of an autopilot with
        a valid signature and too old a time stamp: that autopilot will take over the signing time
        of our heartbeat. The frame may be a replay: nothing else in it is used.
        """
        refusal = self._signing.refusal(frame) if self._signing else None
        if refusal is None:
            return False
        self.forged[refusal] += 1
        behind = refusal is Refusal.OLD_STAMP and self.vehicle is None
        if behind and self.note(frame, now_s) and self._wanted in (None, frame.system_id):
            self.clock_behind, self.peer = True, peer
            armed = bool(frame.message.base_mode & ARMED)
            events.append(ClockBehind(frame.system_id, armed))
        return True

    def judge(self, frame: Frame, peer: Hashable, now_s: float, events: list[Event]) -> bool:
        """Whether a frame comes from our vehicle, is no command, and no COMMAND_ACK for others;
        before the vehicle is found, also a TIMESYNC frame. Adds to `events` the vehicle when it is
        found, commands to us, other companion computers, and senders that control the vehicle."""
        vehicle, message_id = self.vehicle, frame.message_id
        heard = self.note(frame, now_s)
        system_id = vehicle.system_id if vehicle else self._wanted
        theirs = frame.component_id == AUTOPILOT_COMPONENT and system_id in (None, frame.system_id)
        if vehicle is None:
            return theirs and self._find(frame, heard, peer, events)
        if message_id == HEARTBEAT:
            if self._is_companion(frame):
                ids = frame.system_id, frame.component_id
                events.append(OtherCompanion(*ids, frame.message.custom_mode))
            ours = theirs and heard is self.dialect
            if ours:
                self.signs = frame.signed and self._signing is None
            return ours
        if message_id in COMMANDS:
            self._note_command(frame, events)
            return False
        # only setpoints for all or for our vehicle: routers also forward those for other vehicles
        if message_id in SETPOINTS and frame.message.target_system in (0, vehicle.system_id):
            events.append(OtherSender(frame.system_id, frame.component_id))
        if message_id == COMMAND_ACK:
            pairs = zip(_receiver(frame), self.own, strict=True)
            return theirs and all(to in (0, own) for to, own in pairs)  # 0: broadcast
        return theirs

    def _find(
        self, frame: Frame, heard: Dialect | None, peer: Hashable, events: list[Event]
    ) -> bool:
        """Make the sender of the first HEARTBEAT of an autopilot the vehicle; return as `judge`."""
        if frame.message_id == TIMESYNC:
            return True  # a simulator in lockstep may need the reply before its first heartbeat
        if heard is None:
            return False
        self.signs = frame.signed and self._signing is None
        if self.signs:
            return False
        vehicle = VehicleFound(frame.system_id, frame.component_id, heard.name)
        self.set_vehicle(vehicle, peer)
        events.append(vehicle)
        return True

    def _note_command(self, frame: Frame, events: list[Event]) -> None:
        """Add to `events` a command to us, and a mode command from another companion computer of
        the vehicle's system. A mode command of a ground station is the pilot's: no event."""
        sender, receiver = Address(frame.system_id, frame.component_id), _receiver(frame)
        if receiver == self.own:
            if sender != self.own:
                events.append(CommandRequest(frame.message.command, _parameters(frame), *sender))
            return
        system_id = self.own.system_id
        companion = sender.system_id == system_id and sender.component_id != AUTOPILOT_COMPONENT
        controls = companion and frame.message.command in _MODE_COMMANDS
        if controls and receiver.system_id in (0, system_id):
            events.append(OtherSender(*sender))

    def _is_companion(self, frame: Frame) -> bool:
        """Whether a HEARTBEAT is that of another companion computer, which has the vehicle's system
        id as we do. With PX4, some companion computers send the type of a ground station."""
        no_autopilot = frame.message.autopilot == _NO_AUTOPILOT
        on_vehicle = frame.system_id == self.own.system_id
        is_type = frame.message.type in (TYPE_ONBOARD_CONTROLLER, TYPE_GCS)
        return no_autopilot and on_vehicle and is_type

    def note(self, frame: Frame, now_s: float) -> Dialect | None:
        """Note the autopilot that sent a frame, and return its dialect; None if the frame is no
        HEARTBEAT of a vehicle with a known autopilot and component id 1."""
        dialect = self._autopilot(frame)
        if dialect:
            self._hear(frame.system_id, now_s)
        return dialect

    def _autopilot(self, frame: Frame) -> Dialect | None:
        dialect = dialect_of(frame.message) if frame.message_id == HEARTBEAT else None
        if dialect and frame.component_id != AUTOPILOT_COMPONENT:
            self._other_component = frame.component_id
            return None
        return dialect

    def _hear(self, system_id: int, now_s: float) -> bool:
        """Note that this system has an autopilot. Returns whether it was not noted within the last
        second."""
        if now_s - self.systems.get(system_id, -math.inf) < NOTED_EVERY_S:
            return False
        self.systems.pop(system_id, None)  # so that the newest is the last
        self.systems[system_id] = now_s
        if len(self.systems) > SYSTEMS_MAX:
            del self.systems[next(iter(self.systems))]
        return True

    # --- what to say ---

    def candidates(self, now_s: float) -> str:
        """The system ids that could be the vehicle, as text, if there are several and `wanted` is
        None; else empty."""
        present = self._present(now_s)
        return _listed(present) if self._wanted is None and len(present) > 1 else ""

    def _present(self, now_s: float) -> list[int]:
        return [each for each, at_s in self.systems.items() if now_s - at_s <= HEARD_S]

    def others(self, now_s: float) -> str:
        """Which other autopilots are heard than the vehicle, as the end of a sentence that it is
        not heard; empty if none is."""
        others = [each for each in self._present(now_s) if each != self.own.system_id]
        known = f" from system {self.own.system_id}, but from {_listed(others)}; see --system"
        return known if others else ""

    def twin(self, now_s: float) -> str:
        """A sentence if another autopilot with the vehicle's system id sends from another address;
        else empty."""
        if self.vehicle is None or now_s - self.twin_s > HEARD_S:
            return ""
        return f"an autopilot sends as system {self.vehicle.system_id} from another address, too"

    def news(self) -> str:
        """A sentence about the frames that signing refused, on the 1st, 10th, 100th ... of them;
        else empty."""
        total = self.forged.total()
        if total < self._news_at:
            return ""
        self._news_at = 10 ** len(str(total))
        counted = ((each, self.forged[each]) for each in Refusal)
        named = (f"{number:,} x {each.value}" for each, number in counted if number)
        return f"frames refused by signing: {', '.join(named)}"

    def why_none(self) -> str:
        """Why no vehicle was found, if refused or unsuitable frames show a reason; else empty."""
        forged = self.forged
        if forged[Refusal.BAD_SIGNATURE]:
            return "frames arrive, but their signature does not match: it is another key's"
        if forged[Refusal.OLD_STAMP] or forged[Refusal.REPLAYED]:
            return (
                "signed frames arrive, but their time stamps are too old: the vehicle does not "
                "take ours; is the link one-way?"
            )
        if forged[Refusal.UNSIGNED]:
            return "frames arrive unsigned: set the key on the vehicle, or omit --signing-key"
        if self.signs:
            return f"{SIGNS}: {GIVE_KEY}"
        if self._wanted is not None and self.systems:
            return f"system {self._wanted} is not heard, but {_listed(self.systems)}; see --system"
        if self._other_component:
            return (
                f"an autopilot is heard as component {self._other_component}, but only component "
                f"{AUTOPILOT_COMPONENT} is flown: set its component id to 1 (PX4: MAV_COMP_ID)"
            )
        return ""


def _listed(systems: Collection[int]) -> str:
    *others, last = map(str, sorted(systems)) if systems else ("none",)
    return f"{', '.join(others)} and {last}" if others else last


def same_host(peer: Hashable, other: Hashable) -> bool:
    """Whether two UDP addresses (host, port) have the same host."""
    return isinstance(peer, tuple) and isinstance(other, tuple) and peer[0] == other[0]


def is_vehicle(heartbeat: Any) -> bool:
    """Whether this HEARTBEAT comes from a vehicle with an autopilot of any kind."""
    return heartbeat.type not in _NO_VEHICLES and heartbeat.autopilot != _NO_AUTOPILOT


def dialect_of(heartbeat: Any) -> Dialect | None:
    """The dialect of the vehicle that sends this HEARTBEAT; None if it is no vehicle, or has an
    autopilot other than PX4 and ArduPilot."""
    return _BY_AUTOPILOT.get(heartbeat.autopilot) if is_vehicle(heartbeat) else None


def unfit_type(vehicle_type: int, *, helicopter: bool) -> str:
    """A sentence that says why a vehicle of this MAV_TYPE is not flown; empty if it can be.
    `helicopter`: whether the vehicle file is that of a helicopter."""
    if vehicle_type in ({HELICOPTER} if helicopter else MULTIROTORS):
        return ""
    known = enums["MAV_TYPE"].get(vehicle_type)
    name = known.name.removeprefix("MAV_TYPE_") if known else f"MAV_TYPE {vehicle_type}"
    name = "VTOL" if name.startswith("VTOL") else name  # pymavlink has old names: VTOL_RESERVED2
    if helicopter:
        return f"the vehicle is a {name}; its vehicle file says airframe: helicopter"
    flies = f"the vehicle is a {name}; offboard flies multirotors"
    hint = " (airframe: helicopter in its vehicle file flies it)"
    return flies + hint if vehicle_type == HELICOPTER else flies


def _receiver(frame: Frame) -> Address:
    return Address(frame.message.target_system, frame.message.target_component)


def _parameters(command: Frame) -> tuple[float, ...]:
    """All parameters of a COMMAND_LONG; the first four of a COMMAND_INT, since 5 to 7 are a
    position."""
    given = 7 if command.message_id == COMMAND_LONG else 4
    return tuple(getattr(command.message, f"param{number + 1}") for number in range(given))
