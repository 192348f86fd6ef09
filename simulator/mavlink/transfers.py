"""Parameter and mission protocol of one link.

Knows messages. Values and their ranges are in `simulator.autopilot.parameters`, the flight of a
mission is in `simulator.autopilot.mission`, and `Firmware.mission_refusal` decides which items are
accepted. Fences and rally points are stored without effect.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum

from simulator.autopilot.mission import ITEMS_MAX, Kind
from simulator.autopilot.parameters import HASH, MAV_PARAM_TYPE_UINT32
from simulator.autopilot.values import MissionItem
from simulator.mavlink.codec import Message, Peer, sender_of
from simulator.mavlink.outbox import Outbox

PER_STEP = 4  # parameters of a list that are sent at each step
NO_INDEX = 65535  # PARAM_VALUE.param_index of an answer without index


@dataclass(slots=True)
class ParameterTransfer:
    """Parameter transfers of one link."""

    outbox: Outbox
    _due: list[str] = field(default_factory=list)

    def step(self) -> None:
        """Queue the next parameters of a requested list."""
        if not self._due:
            return
        for name in self._due[:PER_STEP]:
            self.show(name, listed=True)
        del self._due[:PER_STEP]

    def show(self, name: str, *, listed: bool = False) -> None:
        """Queue PARAM_VALUE. `listed`: whether it is part of a list or was requested by index."""
        autopilot = self.outbox.view.autopilot
        if name == HASH:
            head = (HASH.encode(), autopilot.parameters.hash_on_wire, MAV_PARAM_TYPE_UINT32)
            self.outbox.send("PARAM_VALUE", *head, len(autopilot.parameters.names), NO_INDEX)
            return
        value, kind = autopilot.parameters.to_wire(name)
        names = autopilot.parameters.names
        numbered = listed or autopilot.firmware.px4_parameters
        index = names.index(name) if numbered else NO_INDEX
        self.outbox.send("PARAM_VALUE", name.encode(), value, kind, len(names), index)

    def request_read(self, message: Message) -> None:
        """Handle PARAM_REQUEST_READ, by index or by name."""
        names = self.outbox.view.autopilot.parameters.names
        if message.param_index >= 0:
            if message.param_index < len(names):
                self.show(names[message.param_index], listed=True)
        elif message.param_id in names or self._is_hash(message.param_id):
            self.show(message.param_id)

    def _is_hash(self, name: str) -> bool:
        return name == HASH and self.outbox.view.autopilot.firmware.px4_parameters

    def request_list(self, _: Message) -> None:
        """Handle PARAM_REQUEST_LIST. A list under way starts again, without _HASH_CHECK."""
        hashed = (HASH,) if self._is_hash(HASH) and not self._due else ()
        self._due = [*hashed, *self.outbox.view.autopilot.parameters.names]

    def set(self, message: Message) -> bool:
        """Handle PARAM_SET. Returns whether it is answered, with the parameter's value after it."""
        table = self.outbox.view.autopilot.parameters
        if self._is_hash(message.param_id):  # the client has the whole list and wants no more
            self._due = []
        return table.set_from_wire(message.param_id, message.param_value, message.param_type)


REPEAT_S, GIVE_UP_S = 0.25, 5.0
ALL_KINDS = 255  # MAV_MISSION_TYPE


class Ack(IntEnum):
    """The values of MAV_MISSION_RESULT that are used."""

    ACCEPTED = 0
    ERROR = 1
    UNSUPPORTED = 3
    NO_SPACE = 4
    CANCELLED = 15


@dataclass(slots=True)
class Upload:
    """An upload in progress."""

    peer: Peer
    kind: int  # MAV_MISSION_TYPE
    count: int
    items: list[MissionItem]  # received so far
    begun_s: float  # time since boot of the last progress
    requested_s: float  # time since boot of the last request
    rest: tuple[MissionItem, ...] | None = None  # stored items after the replaced ones; None: all


class MissionTransfer:
    """Mission transfers of one link. A download needs no state."""

    def __init__(self, outbox: Outbox) -> None:
        self.outbox = outbox
        autopilot = outbox.view.autopilot
        self.mission, self._firmware = autopilot.mission, autopilot.firmware
        self._upload: Upload | None = None
        self._taken = (0, 0)  # kind and count of the last complete upload
        self._whole = False  # whether the peer uses the _INT messages, in 1e-7 degrees

    @property
    def _now_s(self) -> float:
        return self.outbox.view.autopilot.state.time_us * 1e-6

    def step(self) -> None:
        """Request a missing item again after REPEAT_S; cancel the upload after GIVE_UP_S."""
        upload = self._upload
        if upload is None:
            return
        now_s = self._now_s
        if now_s - upload.begun_s > GIVE_UP_S:
            self._acknowledge(upload.peer, Ack.CANCELLED, upload.kind)
            self._upload = None
        elif now_s - upload.requested_s > REPEAT_S:
            self._request_item(upload)

    # -- up ----------------------------------------------------------------------------------

    def count(self, message: Message) -> None:
        """Handle MISSION_COUNT: begin an upload."""
        peer, kind = sender_of(message), message.mission_type
        if kind not in self.mission.stored:
            self._acknowledge(peer, Ack.UNSUPPORTED, kind)
        elif message.count > ITEMS_MAX:
            self._acknowledge(peer, Ack.NO_SPACE, kind)
        elif message.count == 0:
            self.mission.store((), kind)
            self._acknowledge(peer, Ack.ACCEPTED, kind)
        else:
            self._upload = Upload(peer, kind, message.count, [], self._now_s, self._now_s)
            self._request_item(self._upload)

    def write_partial_list(self, message: Message) -> None:
        """Handle MISSION_WRITE_PARTIAL_LIST: begin to replace some of the stored items."""
        peer, kind = sender_of(message), message.mission_type
        first, last = message.start_index, message.end_index
        stored = self.mission.stored.get(kind)
        if stored is None:
            self._acknowledge(peer, Ack.UNSUPPORTED, kind)
        elif not 0 <= first <= last <= min(len(stored), ITEMS_MAX - 1):
            self._acknowledge(peer, Ack.ERROR, kind)
        else:
            kept, rest, now_s = list(stored[:first]), stored[last + 1 :], self._now_s
            self._upload = Upload(peer, kind, last + 1, kept, now_s, now_s, rest)
            self._request_item(self._upload)

    def _request_item(self, upload: Upload) -> None:
        upload.requested_s = self._now_s
        whole = self._whole and self._firmware.requests_kind_of_peer
        name = "MISSION_REQUEST_INT" if whole else "MISSION_REQUEST"
        self.outbox.send(name, *upload.peer, len(upload.items), upload.kind)

    def item(self, message: Message) -> None:
        """Handle MISSION_ITEM or MISSION_ITEM_INT of an upload."""
        self._whole = message.get_type() == "MISSION_ITEM_INT"
        upload, peer, kind = self._upload, sender_of(message), message.mission_type
        if upload is None:  # the MISSION_ACK of the last item was lost, or there is no upload
            last = (kind, message.seq + 1) == self._taken
            self._acknowledge(peer, Ack.ACCEPTED if last else Ack.ERROR, kind)
            return
        expected = (upload.peer, upload.kind, len(upload.items))
        if (peer, kind, message.seq) != expected:  # a duplicate
            return
        item = _read(message)
        refused = self._firmware.mission_refusal(item, kind, whole=self._whole)
        if refused is not None:
            result, text = refused
            self._acknowledge(upload.peer, result, upload.kind)
            if text is not None:
                self.outbox.send_text(text)
            self._upload = None
            return
        upload.items.append(item)
        upload.begun_s = self._now_s
        if len(upload.items) < upload.count:
            self._request_item(upload)
            return
        items = (*upload.items, *(upload.rest or ()))
        self.mission.store(items, kind, continues=upload.rest is not None)
        self._upload, self._taken = None, (kind, upload.count)
        self._acknowledge(upload.peer, Ack.ACCEPTED, kind)
        if not kind and self._firmware.mission_text is not None:
            self.outbox.send_text(self._firmware.mission_text)

    def ack(self, message: Message) -> None:
        """Handle MISSION_ACK of the peer: it wants the other kind of request, or cancels."""
        upload = self._upload
        if upload is None or upload.peer != sender_of(message):
            return
        if message.type == Ack.UNSUPPORTED:
            self._whole = not self._whole
            self._request_item(upload)
        elif message.type == Ack.CANCELLED:
            self._upload = None

    def _acknowledge(self, peer: Peer, ack: int, mission_type: int) -> None:
        self.outbox.send("MISSION_ACK", *peer, int(ack), mission_type)

    # -- down, and the rest ------------------------------------------------------------------

    def request_list(self, message: Message) -> None:
        """Handle MISSION_REQUEST_LIST."""
        kind = message.mission_type
        if not self._refuses(message):
            count = len(self.mission.stored.get(kind, ()))
            self.outbox.send("MISSION_COUNT", *sender_of(message), count, kind)

    def request(self, message: Message) -> None:
        """Handle MISSION_REQUEST or MISSION_REQUEST_INT of a download."""
        peer, kind = sender_of(message), message.mission_type
        items = self.mission.stored.get(kind, ())
        self._whole = whole = message.get_type() == "MISSION_REQUEST_INT"
        is_home = self._firmware.ardupilot_commands and message.seq == kind == 0
        if not (is_home or message.seq < len(items)):
            self._acknowledge(peer, Ack.ERROR, kind)
            return
        item = self._home() if is_home else items[message.seq]
        places = (item.x, item.y) if whole else (item.x * 1e-7, item.y * 1e-7)
        current = int(not kind and message.seq == self.mission.current)
        name = "MISSION_ITEM_INT" if whole else "MISSION_ITEM"
        frame = self._firmware.item_frames[name].get(item.frame, item.frame)
        frame = 0 if item.command in self._firmware.frameless_items else frame
        head = (*peer, message.seq, frame, item.command)
        self.outbox.send(name, *head, current, 1, *item.params, *places, item.z, kind)

    def _home(self) -> MissionItem:
        """Home as a mission item; zeros before it is set."""
        view = self.outbox.view
        if view.withheld("HOME_POSITION"):
            return MissionItem(0, Kind.WAYPOINT, (0.0,) * 4, 0, 0, 0.0)
        north_m, east_m, down_m = view.autopilot.guidance.home_ned_m
        place = view.geodetic(north_m, east_m)
        return MissionItem(0, Kind.WAYPOINT, (0.0,) * 4, *place, view.altitude_mm(down_m) * 1e-3)

    def _refuses(self, message: Message) -> bool:
        """Refuse an unknown MAV_MISSION_TYPE, also ALL_KINDS, as ArduCopter does."""
        kind = message.mission_type
        refused = self._firmware.ardupilot_commands and kind not in self.mission.stored
        if refused:
            self._acknowledge(sender_of(message), Ack.UNSUPPORTED, kind)
        return refused

    def clear_all(self, message: Message) -> None:
        """Handle MISSION_CLEAR_ALL."""
        if self._refuses(message):
            return
        flown = self._firmware.ardupilot_commands and self.mission.under_way
        if flown and not message.mission_type:
            self._acknowledge(sender_of(message), Ack.ERROR, 0)
            return
        for kind in self.mission.stored:
            if message.mission_type in (kind, ALL_KINDS):
                self.mission.store((), kind)
        self._acknowledge(sender_of(message), Ack.ACCEPTED, message.mission_type)

    def set_current(self, message: Message) -> None:
        """Handle MISSION_SET_CURRENT."""
        if self.mission.go_to(message.seq):
            self.outbox.send_now("MISSION_CURRENT")


def _read(message: Message) -> MissionItem:
    """Read MISSION_ITEM_INT, or MISSION_ITEM, which has x and y in degrees."""
    x, y = message.x, message.y
    if message.get_type() == "MISSION_ITEM":
        x, y = (_integer(value * 1e7) for value in (x, y))
    params = (message.param1, message.param2, message.param3, message.param4)
    return MissionItem(message.frame, message.command, params, x, y, message.z)


def _integer(value: float) -> int:
    return int(min(2e9, max(-2e9, value))) if value == value else 0
