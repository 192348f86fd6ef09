"""Mission protocol of one link: upload, download, clear and current item.

Knows messages and items; the flight of a mission is in `simulator.autopilot.mission`, and which
items a firmware takes in its `mission_refusal`. Fences and rally points are refused; there are none
to download.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import IntEnum

from simulator.autopilot.mission import ITEMS_MAX, Kind, Mission
from simulator.firmware.base import Firmware
from simulator.firmware.values import MissionItem
from simulator.mavlink.codec import Message, Peer, sender_of
from simulator.mavlink.outbox import Outbox, Texts

REPEAT_S, GIVE_UP_S = 0.25, 5.0


class Ack(IntEnum):
    """MAV_MISSION_RESULT, those in use."""

    ACCEPTED = 0
    ERROR = 1
    UNSUPPORTED = 3
    NO_SPACE = 4
    INVALID_SEQUENCE = 13
    CANCELLED = 15


@dataclass(slots=True)
class Upload:
    """An upload in progress: sender, items received, times of the last progress and request."""

    peer: Peer
    count: int
    items: list[MissionItem]
    begun_s: float
    requested_s: float


@dataclass(slots=True)
class MissionTransfer:
    """Mission transfers of one link; `texts`: of this link. A download needs no state."""

    outbox: Outbox
    texts: Texts
    mission: Mission = field(init=False)
    _firmware: Firmware = field(init=False)
    _upload: Upload | None = None
    _taken: int = 0  # count of the last upload
    _whole: bool = False  # the peer uses the _INT messages, in 1e-7 degrees

    def __post_init__(self) -> None:
        autopilot = self.outbox.view.autopilot
        self.mission, self._firmware = autopilot.mission, autopilot.firmware

    def handle(self, message: Message, now_s: float) -> None:
        """Handle one message of the mission protocol addressed to this vehicle."""
        HANDLERS[message.get_type()](self, message, now_s)

    def step(self, now_s: float) -> None:
        """Request a missing item again, and give up after a while."""
        upload = self._upload
        if upload is None:
            return
        if now_s - upload.begun_s > GIVE_UP_S:
            self._acknowledge(upload.peer, Ack.CANCELLED)
            self._upload = None
        elif now_s - upload.requested_s > REPEAT_S:
            self._request_item(upload, now_s)

    # -- up ----------------------------------------------------------------------------------

    def _count(self, message: Message, now_s: float) -> None:
        peer = sender_of(message)
        if message.mission_type:
            self._acknowledge(peer, Ack.UNSUPPORTED, message.mission_type)
        elif message.count > ITEMS_MAX:
            self._acknowledge(peer, Ack.NO_SPACE)
        elif message.count == 0:
            self.mission.store(())
            self._acknowledge(peer, Ack.ACCEPTED)
        else:
            self._upload = Upload(peer, message.count, [], now_s, now_s)
            self._request_item(self._upload, now_s)

    def _request_item(self, upload: Upload, now_s: float) -> None:
        upload.requested_s = now_s
        whole = self._whole and self._firmware.requests_kind_of_peer
        name = "MISSION_REQUEST_INT" if whole else "MISSION_REQUEST"
        self.outbox.send(name, *upload.peer, len(upload.items), 0)

    def _item(self, message: Message, now_s: float) -> None:
        self._whole = message.get_type() == "MISSION_ITEM_INT"
        upload, peer = self._upload, sender_of(message)
        if upload is None:  # the last one again, whose answer was lost, or one without an upload
            last = message.seq + 1 == self._taken and not message.mission_type
            self._acknowledge(peer, Ack.ACCEPTED if last else Ack.ERROR, message.mission_type)
            return
        if upload.peer != peer or message.seq != len(upload.items):  # a duplicate
            return
        item = _read(message)
        refused = self._firmware.mission_refusal(item)
        if refused is not None:
            result, text = refused
            self._acknowledge(upload.peer, result)
            if text is not None:
                self.texts.send(text)
            self._upload = None
            return
        upload.items.append(item)
        upload.begun_s = now_s
        if len(upload.items) < upload.count:
            self._request_item(upload, now_s)
            return
        self.mission.store(tuple(upload.items))
        self._upload, self._taken = None, upload.count
        self._acknowledge(upload.peer, Ack.ACCEPTED)
        if self._firmware.mission_text is not None:
            self.texts.send(self._firmware.mission_text)

    def _ack(self, message: Message, now_s: float) -> None:
        """MISSION_ACK of the peer: it wants the other kind of request, or cancels."""
        upload = self._upload
        if upload is None or upload.peer != sender_of(message):
            return
        if message.type == Ack.UNSUPPORTED:
            self._whole = not self._whole
            self._request_item(upload, now_s)
        elif message.type == Ack.CANCELLED:
            self._upload = None

    def _acknowledge(self, peer: Peer, ack: int, mission_type: int = 0) -> None:
        self.outbox.send("MISSION_ACK", *peer, int(ack), mission_type)

    # -- down, and the rest ------------------------------------------------------------------

    def _list(self, message: Message, _: float) -> None:
        count = 0 if message.mission_type else len(self.mission.items)
        self.outbox.send("MISSION_COUNT", *sender_of(message), count, message.mission_type)

    def _request(self, message: Message, _: float) -> None:
        peer, items = sender_of(message), self.mission.items
        self._whole = whole = message.get_type() == "MISSION_REQUEST_INT"
        is_home = self._firmware.home_item_first and message.seq == 0
        if message.mission_type or not (is_home or message.seq < len(items)):
            self._acknowledge(peer, Ack.INVALID_SEQUENCE, message.mission_type)
            return
        item = self._home() if is_home else items[message.seq]
        places = (item.x, item.y) if whole else (item.x * 1e-7, item.y * 1e-7)
        current = int(message.seq == self.mission.current)
        head = (*peer, message.seq, item.frame, item.command)
        name = "MISSION_ITEM_INT" if whole else "MISSION_ITEM"
        self.outbox.send(name, *head, current, 1, *item.params, *places, item.z, 0)

    def _home(self) -> MissionItem:
        """Home as an item of a mission."""
        view = self.outbox.view
        north_m, east_m, down_m = view.autopilot.guidance.home_ned_m
        place = view.geodetic(north_m, east_m)
        return MissionItem(0, Kind.WAYPOINT, (0.0,) * 4, *place, view.altitude_mm(down_m) * 1e-3)

    def _clear(self, message: Message, _: float) -> None:
        if message.mission_type in (0, 255):  # the mission, or all
            self.mission.store(())
        self._acknowledge(sender_of(message), Ack.ACCEPTED, message.mission_type)

    def _set_current(self, message: Message, _: float) -> None:
        if self.mission.go_to(message.seq):
            self.outbox.send_now("MISSION_CURRENT")


def _read(message: Message) -> MissionItem:
    """MISSION_ITEM_INT, or MISSION_ITEM with its places in degrees."""
    x, y = message.x, message.y
    if message.get_type() == "MISSION_ITEM":
        x, y = (_integer(value * 1e7) for value in (x, y))
    params = (message.param1, message.param2, message.param3, message.param4)
    return MissionItem(message.frame, message.command, params, x, y, message.z)


def _integer(value: float) -> int:
    return int(min(2e9, max(-2e9, value))) if value == value else 0


HANDLERS: dict[str, Callable[[MissionTransfer, Message, float], None]] = {
    "MISSION_ACK": MissionTransfer._ack,
    "MISSION_COUNT": MissionTransfer._count,
    "MISSION_ITEM": MissionTransfer._item,
    "MISSION_ITEM_INT": MissionTransfer._item,
    "MISSION_REQUEST_LIST": MissionTransfer._list,
    "MISSION_REQUEST": MissionTransfer._request,
    "MISSION_REQUEST_INT": MissionTransfer._request,
    "MISSION_CLEAR_ALL": MissionTransfer._clear,
    "MISSION_SET_CURRENT": MissionTransfer._set_current,
}
