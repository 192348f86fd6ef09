"""A mission: its items, how far it has come, and where it wants the vehicle to be.

Fences and rally points are kept beside it, and not heeded. Knows positions and time; knows no
modes, no links and no protocol (`simulator.mavlink.mission_transfer`). What it comes upon (an item
reached, its end, a return asked for) it says as events.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import IntEnum

from simulator.firmware.values import NAN3, MissionItem, MotionSetpoint, Triple
from simulator.geodesy import GLOBAL_FRAMES, RELATIVE_FRAMES, Origin, down_m, to_metres

ITEMS_MAX = 500
_ACCEPTED_M, _ACCEPTED_HEIGHT_M = 2.0, 0.8  # NAV_ACC_RAD of multicopters, NAV_MC_ALT_RAD


class Kind(IntEnum):
    """MAV_CMD, those that are flown; every other item is passed over."""

    WAYPOINT = 16
    LOITER_UNLIMITED = 17
    LOITER_TIME = 19
    RETURN = 20
    LAND = 21
    TAKEOFF = 22
    DELAY = 93
    CHANGE_SPEED = 178


_PLACES = frozenset(
    {Kind.WAYPOINT, Kind.LOITER_UNLIMITED, Kind.LOITER_TIME, Kind.LAND, Kind.TAKEOFF}
)
_WAITS = frozenset({Kind.WAYPOINT, Kind.LOITER_TIME, Kind.DELAY})


@dataclass(frozen=True, slots=True)
class Item(MissionItem):
    """One item, and what it means to who flies it."""

    @property
    def is_place(self) -> bool:
        return self.command in _PLACES

    @property
    def is_flown(self) -> bool:
        """Takes time, unlike a setting or a return, which is another mode's."""
        return self.is_place or self.command == Kind.DELAY

    @property
    def flyable(self) -> bool:
        """A place needs a frame and finite coordinates."""
        known = self.frame in GLOBAL_FRAMES | RELATIVE_FRAMES
        return not self.is_place or (known and math.isfinite(self.z))


@dataclass(slots=True)
class Mission:
    """Items and progress; `events` are for whoever flies it to take away."""

    origin: Origin
    first: int = 0  # the item with which it begins
    turning: frozenset[int] = frozenset()  # MAV_CMD of items that ask for a course
    tells_above: bool = False  # a landing is reached above its place too, if it is not near
    keeps_speed: bool = False  # asked for before a pause
    items: tuple[Item, ...] = ()
    beside: dict[int, tuple[Item, ...]] = field(default_factory=dict)  # by MAV_MISSION_TYPE
    current: int = 0
    reached: int = -1
    finished: bool = False
    speed_mps: float = math.inf
    climb_m: float = math.nan  # above home, of the climb it begins with
    events: list[str] = field(default_factory=list)
    under_way: bool = False
    _climb_to_z_m: float = math.nan  # first, from the ground, straight up to here
    _since_s: float = math.nan  # when the current item's place was reached
    _held: Triple = NAN3
    _goes: bool = False  # to a place that was not near
    before_ned_m: Triple = NAN3  # the place before the one flown to; no numbers: none
    behind_ned_m: Triple = NAN3  # the one to go on to without a stop

    @property
    def flyable(self) -> bool:
        to_do = self.items[self.first :]
        return any(item.is_place or item.command == Kind.RETURN for item in to_do)

    def listed(self, kind: int) -> tuple[Item, ...]:
        """Items of this MAV_MISSION_TYPE."""
        return self.beside.get(kind, ()) if kind else self.items

    def keep(self, kind: int, items: tuple[Item, ...]) -> None:
        """Other items of this MAV_MISSION_TYPE, or none."""
        if kind:
            self.beside[kind] = items
        else:
            self.replace(items)

    def replace(self, items: tuple[Item, ...]) -> None:
        """Another mission, or none; from its beginning."""
        self.items = items
        self.current, self.reached, self.finished = self.first, -1, False
        self._since_s = math.nan

    def go_to(self, number: int) -> bool:
        """Continue with this item; False when there is none."""
        if not 0 <= number < len(self.items):
            return False
        self.current, self.finished, self._since_s = number, False, math.nan
        self.before_ned_m = NAN3
        return True

    def pause(self) -> None:
        """It is not flown for now; the next `fly` begins it."""
        self.under_way = False

    def _begin(self, position_ned_m: Triple, landed: bool, home_ned_m: Triple) -> None:
        """Start, or continue where it was left; anew if it had come to its end."""
        self.under_way = True
        self.events.append("mission begun")
        if self.finished:
            self.go_to(self.first)
        self.speed_mps = self._speed_so_far if self.keeps_speed else math.inf
        self._held, self.before_ned_m = position_ned_m, NAN3
        self._since_s = self._climb_to_z_m = math.nan
        first = next((item for item in self.items[self.current :] if item.is_place), None)
        if landed and first is not None and first.command != Kind.LAND:
            self._climb_to_z_m = self._place(first, home_ned_m)[2]
            self.climb_m = home_ned_m[2] - self._climb_to_z_m
            self.events.append("mission climbs")

    @property
    def _speed_so_far(self) -> float:
        done = self.items[: self.current]
        asked = [i.params[1] for i in done if i.command == Kind.CHANGE_SPEED and i.params[1] > 0]
        return asked[-1] if asked else math.inf

    @property
    def climbing(self) -> bool:
        """Straight up from the ground."""
        return self.under_way and not math.isnan(self._climb_to_z_m)

    @property
    def landing(self) -> bool:
        """On the spot where it lands."""
        return not math.isnan(self._since_s) and self._item_is(Kind.LAND)

    def fly(
        self, now_s: float, position_ned_m: Triple, home_ned_m: Triple, *, landed: bool
    ) -> MotionSetpoint:
        """Where to be now. `landing` tells that the height is the pilot's affair."""
        if not self.under_way:
            self._begin(position_ned_m, landed, home_ned_m)
        if not math.isnan(self._climb_to_z_m):
            self._held = (self._held[0], self._held[1], self._climb_to_z_m)
            if position_ned_m[2] < self._climb_to_z_m + _ACCEPTED_HEIGHT_M:
                self._climb_to_z_m, self.before_ned_m = math.nan, self._held
            return MotionSetpoint(self._held)
        self._pass_over()
        if not self._to_do:
            return MotionSetpoint(self._held)
        item = self.items[self.current]
        if item.is_place:
            self._held = self._target(item, position_ned_m, home_ned_m)
            self.behind_ned_m = self._next_place(item, home_ned_m)
        self._progress(item, now_s, position_ned_m, landed)
        self._pass_over()
        return MotionSetpoint(self._held, yaw_rad=self._yaw(item), faces_way=True)

    # -- one item ----------------------------------------------------------------------------

    def _progress(self, item: Item, now_s: float, position_ned_m: Triple, landed: bool) -> None:
        """See whether its place is reached, and whether it is done there."""
        if math.isnan(self._since_s) and self._arrived(item, position_ned_m):
            self._since_s = now_s
            if item.command == Kind.LAND and self.tells_above and self._goes:
                self._note_reached()
        self._goes = math.isnan(self._since_s)
        if self._goes:
            return
        stayed = now_s - self._since_s >= self._stay_s(item)
        if landed if item.command == Kind.LAND else stayed:
            self._note_reached()
            self._advance()

    @property
    def _to_do(self) -> bool:
        """There is a current item; none where home is all there is."""
        return not self.finished and self.current < len(self.items)

    def _item_is(self, kind: Kind) -> bool:
        return self.current < len(self.items) and self.items[self.current].command == kind

    def _pass_over(self) -> None:
        """Items that are done at once; of several the last is told."""
        while self._to_do and not self.items[self.current].is_flown:
            item = self.items[self.current]
            if item.command == Kind.CHANGE_SPEED and item.params[1] > 0:
                self.speed_mps = item.params[1]
            if item.command == Kind.RETURN:
                self._end("mission return")
            else:
                self._note_reached()
                self._advance()

    def _advance(self) -> None:
        """To the next item, or to the end."""
        if self.items[self.current].is_place:
            self.before_ned_m = self._held
        self._since_s = math.nan
        if self.current + 1 < len(self.items):
            self.current += 1
            self._tell("mission progress")
        else:
            self._end("mission finished")

    def _end(self, event: str) -> None:
        self.finished = True
        self._tell(event)

    def _note_reached(self) -> None:
        self.reached = self.current
        self._tell("item reached")

    def _tell(self, event: str) -> None:
        if event not in self.events:
            self.events.append(event)

    def _place(self, item: Item, home_ned_m: Triple) -> Triple:
        north, east = to_metres(self.origin, item.x * 1e-7, item.y * 1e-7)
        return north, east, down_m(item.z, item.frame, self.origin, home_ned_m[2])

    def _target(self, item: Item, position_ned_m: Triple, home_ned_m: Triple) -> Triple:
        north, east, down = self._place(item, home_ned_m)
        nowhere = item.x == 0 and item.y == 0
        if item.command == Kind.TAKEOFF or nowhere:
            north, east = self._held[0], self._held[1]
        if item.command == Kind.LAND:
            down = position_ned_m[2] if self.landing else self._held[2]
        return north, east, down

    def _next_place(self, item: Item, home_ned_m: Triple) -> Triple:
        """Behind an item at which it does not stop; no numbers where there is none."""
        rest = self.items[self.current + 1 :]
        following = next((other for other in rest if other.is_place), None)
        if following is None or self._stay_s(item) > 0.0:
            return NAN3
        north, east, down = self._place(following, home_ned_m)
        if following.x == 0 and following.y == 0:
            north, east = self._held[:2]
        return north, east, down

    @property
    def accepted_m(self) -> float:
        """From the current place across; no number where the item does not say."""
        item = self.items[self.current] if self.current < len(self.items) else None
        asked = item is not None and item.command == Kind.WAYPOINT and item.params[1] > 0
        return item.params[1] if item is not None and asked else math.nan

    def _arrived(self, item: Item, position_ned_m: Triple) -> bool:
        if not item.is_place:
            return True
        radius_m = _ACCEPTED_M if math.isnan(self.accepted_m) else self.accepted_m
        north, east, down = self._held
        x, y, z = position_ned_m
        near = math.hypot(x - north, y - east) < radius_m
        return near and abs(z - down) < _ACCEPTED_HEIGHT_M

    def _stay_s(self, item: Item) -> float:
        if item.command in (Kind.LOITER_UNLIMITED, Kind.LAND):
            return math.inf
        asked_s = item.params[0] if item.command in _WAITS else 0.0
        return asked_s if math.isfinite(asked_s) else 0.0

    def _yaw(self, item: Item) -> float:
        """Asked for; NaN keeps the course."""
        asked_deg = item.params[3]
        if item.command in self.turning and math.isfinite(asked_deg):
            return math.remainder(math.radians(asked_deg), 2.0 * math.pi)
        return math.nan
