"""Mission protocol of one link: upload, download, clear and current item.

Missions, fences and rally points are transferred alike. Knows messages and items; the flight of a
mission is in `simulator.autopilot.mission`, and which items a firmware takes in its `MissionRules`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

from simulator.autopilot.mission import ITEMS_MAX, Kind, Mission
from simulator.firmware.base import MissionRules
from simulator.firmware.values import MissionItem, Severity, StatusText
from simulator.mavlink.codec import Message
from simulator.mavlink.outbox import Outbox, Texts

REPEAT_S, GIVE_UP_S = 0.25, 5.0
CHECK_S = 0.03  # from the last item until a strict firmware has checked the mission
_ANY_TYPE = 255
_KINDS = frozenset({0, 1, 2})  # MAV_MISSION_TYPE: mission, fence, rally points


_UNEXPECTED = StatusText(Severity.CRITICAL, "WPM: REJ. CMD: Req. WP was unexpected")
_BUSY = StatusText(Severity.CRITICAL, "WPM: IGN MISSION_COUNT: Busy")
_TIMEOUT = StatusText(Severity.CRITICAL, "Operation timeout")
_NOT_REQUESTED = StatusText(Severity.CRITICAL, "IGN MISSION_ITEM: No transfer")


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
    """An upload in progress: sender, items received, time of the last request."""

    peer: tuple[int, int]
    kind: int
    count: int
    items: list[MissionItem]
    begun_s: float
    requested_s: float


@dataclass(slots=True)
class Download:
    """A download in progress: receiver and next item."""

    peer: tuple[int, int]
    kind: int
    active_s: float
    due: int = 0


@dataclass(slots=True)
class MissionTransfer:
    """Mission transfers of one link."""

    outbox: Outbox
    texts: Texts  # of this link
    mission: Mission
    rules: MissionRules
    _upload: Upload | None = None
    _download: Download | None = None
    _taken: tuple[int, int] = (0, 0)  # count and kind of the last upload
    _unchecked: tuple[tuple[MissionItem, ...], float] | None = None  # a mission; arrival time
    _whole: bool = False  # the peer uses the _INT messages, in 1e-7 degrees

    @property
    def under_way(self) -> bool:
        """A transfer waits for its next message or its time-out."""
        return not (self._upload is None and self._download is None and self._unchecked is None)

    def handle(self, message: Message, now_s: float) -> None:
        """Handle one message of the mission protocol addressed to this vehicle."""
        self._check(math.inf)
        HANDLERS[message.name](self, message, now_s)

    def _check(self, now_s: float) -> None:
        """Replace the vehicle's mission by the uploaded one once it has been checked."""
        if self._unchecked is not None and now_s - self._unchecked[1] >= CHECK_S:
            self.mission.store(0, self._unchecked[0])
            self._unchecked = None

    def step(self, now_s: float) -> None:
        """Request a missing item again, and give up after a while."""
        self._check(now_s)
        download = self._download
        if download is not None and now_s - download.active_s > GIVE_UP_S:
            self._download = None
            if self.rules.strict:
                self.texts.send(_TIMEOUT)
        upload = self._upload
        if upload is None:
            return
        if now_s - upload.begun_s > GIVE_UP_S:
            self._acknowledge(upload.peer, Ack.CANCELLED, upload.kind)
            self._upload = None
        elif now_s - upload.requested_s > REPEAT_S:
            self._request_item(upload, now_s)

    # -- up ----------------------------------------------------------------------------------

    def _count(self, message: Message, now_s: float) -> None:
        peer = (message.system, message.component)
        kind = message.mission_type
        if self.rules.strict and self._download is not None:
            self._acknowledge(peer, Ack.ERROR, self._download.kind)
            self.texts.send(_BUSY)
        elif kind not in _KINDS:
            self._acknowledge(peer, self.rules.unknown_kind, kind)
        elif message.count > ITEMS_MAX:
            self._acknowledge(peer, Ack.NO_SPACE, kind)
        elif message.count == 0:
            self.mission.store(kind, ())
            self._acknowledge(peer, Ack.ACCEPTED, kind)
        else:
            self._upload = Upload(peer, kind, message.count, [], now_s, now_s)
            self._request_item(self._upload, now_s)

    def _request_item(self, upload: Upload, now_s: float) -> None:
        upload.requested_s = now_s
        whole = self._whole and self.rules.strict
        name = "MISSION_REQUEST_INT" if whole else "MISSION_REQUEST"
        self.outbox.send(name, *upload.peer, len(upload.items), upload.kind)

    def _item(self, message: Message, now_s: float) -> None:
        self._whole = message.name == "MISSION_ITEM_INT"
        upload, peer = self._upload, (message.system, message.component)
        if self.rules.strict and upload is None and self._download is None:
            self._take_late(message, peer)
        if upload is None or upload.peer != peer:
            return
        if message.seq != len(upload.items):  # a duplicate
            return
        item = _read(message)
        refused = self.rules.refusal(upload.kind, item)
        if refused is not None:
            result, text = refused
            self._acknowledge(upload.peer, result, upload.kind)
            if text is not None:
                self.texts.send(text)
            self._upload = None
            return
        upload.items.append(item)
        upload.begun_s = now_s
        if len(upload.items) < upload.count:
            self._request_item(upload, now_s)
            return
        if self.rules.strict and upload.kind == 0:
            self._unchecked = (tuple(upload.items), now_s)
        else:
            self.mission.store(upload.kind, tuple(upload.items))
        self._upload, self._taken = None, (upload.count, upload.kind)
        self._acknowledge(upload.peer, Ack.ACCEPTED, upload.kind)
        if upload.kind in self.rules.texts:
            self.texts.send(self.rules.texts[upload.kind])

    def _take_late(self, message: Message, peer: tuple[int, int]) -> None:
        """An item without an upload: the last one repeated, or one that was not requested."""
        if (message.seq + 1, message.mission_type) == self._taken:
            self._acknowledge(peer, Ack.ACCEPTED, message.mission_type)
            return
        self._acknowledge(peer, Ack.ERROR, message.mission_type)
        self.texts.send(_NOT_REQUESTED)

    def _ack(self, message: Message, now_s: float) -> None:
        """MISSION_ACK of the peer: it wants the other kind of request, or cancels."""
        peer, upload = (message.system, message.component), self._upload
        if self._download is not None and self._download.peer == peer:
            self._download = None
        if upload is None or upload.peer != peer:
            return
        if message.type == Ack.UNSUPPORTED:
            self._whole = not self._whole
            self._request_item(upload, now_s)
        elif message.type == Ack.CANCELLED:
            self._upload = None

    def _acknowledge(self, peer: tuple[int, int], ack: int, kind: int) -> None:
        self.outbox.send("MISSION_ACK", *peer, int(ack), kind)

    # -- down, and the rest ------------------------------------------------------------------

    def _list(self, message: Message, now_s: float) -> None:
        kind, peer = message.mission_type, (message.system, message.component)
        self._download = Download(peer, kind, now_s)
        self.outbox.send("MISSION_COUNT", *peer, len(self.mission.items_of(kind)), kind)

    def _request(self, message: Message, now_s: float) -> None:
        peer, kind = (message.system, message.component), message.mission_type
        self._whole = whole = message.name == "MISSION_REQUEST_INT"
        items = self.mission.items_of(kind)
        is_home = self.rules.home_first and kind == 0 and message.seq == 0
        exists = is_home or message.seq < len(items)
        if self.rules.strict and not self._is_due(peer, kind, message.seq, exists):
            return
        if self._download is not None:
            self._download.active_s = now_s
        if not exists:
            self._acknowledge(peer, Ack.INVALID_SEQUENCE, kind)
            return
        item = self._home() if is_home else items[message.seq]
        places = (item.x, item.y) if whole else (item.x * 1e-7, item.y * 1e-7)
        current = int(not kind and message.seq == self.mission.current)
        autocontinue = int(kind not in self.rules.without_autocontinue)
        head = (*peer, message.seq, self.rules.frame_shown(item, whole), item.command)
        name = "MISSION_ITEM_INT" if whole else "MISSION_ITEM"
        self.outbox.send(name, *head, current, autocontinue, *item.params, *places, item.z, kind)

    def _home(self) -> MissionItem:
        """Home as an item of a mission."""
        view = self.outbox.view
        north_m, east_m, down_m = view.autopilot.guidance.home_ned_m
        place = view.geodetic(north_m, east_m)
        return MissionItem(0, Kind.WAYPOINT, (0.0,) * 4, *place, view.altitude_mm(down_m) * 1e-3)

    def _is_due(self, peer: tuple[int, int], kind: int, number: int, exists: bool) -> bool:
        """Whether it is the next item or the last one again; any other ends the download."""
        download = self._download
        if download is None or (download.peer, download.kind) != (peer, kind):
            return False
        if not exists or number not in (download.due - 1, download.due):
            self._download = None
            self._acknowledge(peer, Ack.ERROR, kind)
            self.texts.send(_UNEXPECTED)
            return False
        download.due = number + 1
        return True

    def _clear(self, message: Message, _: float) -> None:
        asked = message.mission_type
        for kind in _KINDS if asked == _ANY_TYPE else _KINDS & {asked}:
            self.mission.store(kind, ())
        self._acknowledge((message.system, message.component), Ack.ACCEPTED, asked)

    def _set_current(self, message: Message, _: float) -> None:
        if self.mission.go_to(message.seq):
            self.outbox.send_now("MISSION_CURRENT")


def _read(message: Message) -> MissionItem:
    """MISSION_ITEM_INT, or MISSION_ITEM with its places in degrees."""
    x, y = message.x, message.y
    if message.name == "MISSION_ITEM":
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
