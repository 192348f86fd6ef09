"""A mission: its items, its progress, and the place to fly to.

It raises an event when it reaches an item, its end, or an item that returns home. Knows positions
and time; knows no modes, no links and no protocol (`simulator.mavlink.transfers`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import IntEnum

from offboard.model.frames import wrap_pi
from simulator.autopilot.firmware import Firmware
from simulator.autopilot.parameters import ParameterTable
from simulator.autopilot.state import StateEstimate
from simulator.autopilot.values import NAN3, MissionItem, MotionSetpoint, StatusText, Triple, info
from simulator.geodesy import down_m, to_metres

ITEMS_MAX = 500


class Kind(IntEnum):
    """MAV_CMDs of items that are carried out; other items count as reached and are skipped."""

    WAYPOINT = 16
    LOITER_UNLIMITED = 17
    LOITER_TURNS = 18
    LOITER_TIME = 19
    RETURN = 20
    LAND = 21
    TAKEOFF = 22
    LOITER_TO_ALTITUDE = 31
    SPLINE_WAYPOINT = 82  # flown in a straight line
    DELAY = 93
    TURN = 115
    JUMP = 177
    CHANGE_SPEED = 178
    FACE_PLACE = 195
    FACE_NONE = 197
    FACE = 201


_PLACES = frozenset({
    Kind.WAYPOINT, Kind.LOITER_UNLIMITED, Kind.LOITER_TURNS, Kind.LOITER_TIME, Kind.LAND,
    Kind.TAKEOFF, Kind.LOITER_TO_ALTITUDE, Kind.SPLINE_WAYPOINT,
})  # fmt: skip
# reported as "Reached command" (`Firmware.item_titles`)
_TOLD = frozenset({Kind.WAYPOINT, Kind.LOITER_TIME, Kind.SPLINE_WAYPOINT})
_FACING = frozenset({Kind.FACE_PLACE, Kind.FACE_NONE, Kind.FACE})
# param1: duration of stay, s
_TIMED = frozenset({Kind.WAYPOINT, Kind.LOITER_TIME, Kind.SPLINE_WAYPOINT, Kind.DELAY})
_CIRCLE_M, _CIRCLE_RADPS = 10.0, math.radians(20.0)  # ArduCopter CIRCLE_RADIUS, CIRCLE_RATE


@dataclass(slots=True)
class Mission:
    """Items and progress of one vehicle's mission. The autopilot gives `events` to the commander,
    which shares `texts`."""

    firmware: Firmware
    parameters: ParameterTable
    # by MAV_MISSION_TYPE: items of the mission; fences and rally points, which have no effect
    stored: dict[int, tuple[MissionItem, ...]] = field(
        default_factory=lambda: {0: (), 1: (), 2: ()}
    )
    current: int = 0
    reached: int = -1
    finished: bool = False
    under_way: bool = False
    speed_mps: float = math.inf
    events: list[str] = field(default_factory=list)
    texts: list[StatusText] = field(default_factory=list)
    _climb_down_m: float = math.nan  # NED down to which it climbs vertically from the ground first
    _since_s: float = math.nan  # time at which the current place was reached
    _target_ned_m: Triple = NAN3
    _approaching: bool = False  # whether the current place was not yet reached in the last call
    _bearing_rad: float = 0.0  # from the centre of a circle to the vehicle, when it was reached
    _turned_rad: float = math.nan  # yaw of a TURN, until the next place is reached
    _faced_ned_m: tuple[float, float] | None = None  # place to which the nose points
    _jumps: dict[int, int] = field(default_factory=dict)  # number of a JUMP -> jumps made

    @property
    def items(self) -> tuple[MissionItem, ...]:
        """Items of the mission itself."""
        return self.stored[0]

    @property
    def first(self) -> int:
        """Number of the item with which the mission begins."""
        return int(self.firmware.ardupilot_commands)

    @property
    def flyable(self) -> bool:
        """Whether the mission has a place or a return."""
        flown = _PLACES | {Kind.RETURN}
        return any(item.command in flown for item in self.items[self.first :])

    @property
    def takes_off(self) -> bool:
        """Whether the first place of the mission is a takeoff."""
        places = (item.command for item in self.items[self.first :] if item.command in _PLACES)
        return next(places, None) == Kind.TAKEOFF

    def store(
        self, items: tuple[MissionItem, ...], kind: int = 0, *, continues: bool = False
    ) -> None:
        """Replace the items of a MAV_MISSION_TYPE. A new mission starts from its beginning, unless
        it continues the present one."""
        self.stored[kind] = items
        if kind:
            return
        if self.under_way and not items:
            self.events.append("mission cleared")
        self.parameters.set("MIS_TOTAL", len(items))  # PX4 has no such parameter
        if not continues:
            self.reset()
            self.finished = False

    def reset(self) -> None:
        """Go back to the beginning; a finished mission stays so until it begins again."""
        self.current, self.reached = self.first, -1
        self.speed_mps, self._since_s = math.inf, math.nan
        self._jumps.clear()

    def go_to(self, number: int) -> bool:
        """Continue with this item, or with the first one if `number` is home's (ArduCopter). Return
        False if there is no such item."""
        item = max(number, self.first)
        if number < 0 or item >= len(self.items):
            return False
        self.current, self.finished = item, False
        self._since_s = math.nan
        if self.under_way:
            self._tell()
        return True

    def pause(self) -> None:
        """Interrupt the mission; the next `fly` continues it."""
        self.under_way = False

    @property
    def climbing(self) -> bool:
        """Whether the vehicle climbs vertically from the ground."""
        return self.under_way and not math.isnan(self._climb_down_m)

    @property
    def landing(self) -> bool:
        """Whether the vehicle has reached the place of a landing item and descends."""
        reached = not math.isnan(self._since_s) and self.current < len(self.items)
        return reached and self.items[self.current].command == Kind.LAND

    def fly(self, estimate: StateEstimate, home_ned_m: Triple, *, landed: bool) -> MotionSetpoint:
        """Return the place to fly to now; the caller replaces it in the descent of a landing."""
        if not self.under_way:
            self._begin(estimate.position_ned_m, home_ned_m, landed)
        if not math.isnan(self._climb_down_m):
            self._target_ned_m = (*self._target_ned_m[:2], self._climb_down_m)
            within_m = self.parameters.role("climbed_within_m")
            if estimate.position_ned_m[2] < self._climb_down_m + within_m:
                self._climb_down_m = math.nan
            return MotionSetpoint(self._target_ned_m)
        self._run_settings(estimate.yaw_rad)
        if not self._has_item:
            return MotionSetpoint(self._target_ned_m)
        item = self.items[self.current]
        if item.command in _PLACES:
            self._target_ned_m = self._target(item, estimate, home_ned_m)
        yaw_rad = self._yaw_rad(item, estimate)
        self._progress(item, estimate, landed)
        self._run_settings(estimate.yaw_rad)
        return MotionSetpoint(self._target_ned_m, yaw_rad=yaw_rad, faces_way=True)

    def _begin(self, here_ned_m: Triple, home_ned_m: Triple, landed: bool) -> None:
        """Start the mission, or continue it where it was paused. A finished one starts again."""
        self.under_way = True
        if self.finished:
            self.reset()
            self.finished = False
        self._tell()
        self._target_ned_m = here_ned_m
        self._since_s = self._climb_down_m = self._turned_rad = math.nan
        self._faced_ned_m = None
        first = next((item for item in self.items[self.current :] if item.command in _PLACES), None)
        if landed and first is not None and first.command != Kind.LAND:
            self._climb_down_m = self._position(first, home_ned_m)[2]

    # -- progress ----------------------------------------------------------------------------

    @property
    def _has_item(self) -> bool:
        """Whether there is an item left to fly."""
        return not self.finished and self.current < len(self.items)

    def _progress(self, item: MissionItem, estimate: StateEstimate, landed: bool) -> None:
        """Check whether the place of an item is reached, and whether the stay there is over."""
        lands = item.command == Kind.LAND
        if math.isnan(self._since_s) and self._near(item, estimate.position_ned_m):
            self._since_s = estimate.time_s
            if lands and self._approaching and not self.firmware.ardupilot_commands:
                self._report_reached()
        self._approaching = math.isnan(self._since_s)
        if self._approaching:
            return
        if landed if lands else estimate.time_s - self._since_s >= self._stay_s(item):
            self._report_reached()
            self._advance()

    def _run_settings(self, yaw_rad: float) -> None:
        """Carry out items that take no time; of several in a row, only the last is reported. A loop
        of jumps without a place ends."""
        for _ in self.items:
            item = self.items[self.current]
            if not self._has_item or item.command in _PLACES or item.command == Kind.DELAY:
                return
            if item.command == Kind.JUMP:
                self._jump(item)
                continue
            if item.command in _FACING:
                place = to_metres(self.firmware.origin, item.x * 1e-7, item.y * 1e-7)
                self._faced_ned_m = place if item.x or item.y else None
            if item.command == Kind.TURN:
                angle_deg, _, sense, relative = item.params
                turn_rad = math.radians(angle_deg if sense >= 0.0 or not relative else -angle_deg)
                self._turned_rad = wrap_pi(turn_rad + (yaw_rad if relative else 0.0))
            vertical = item.params[0] in self.firmware.vertical_speeds
            if item.command == Kind.CHANGE_SPEED and item.params[1] > 0 and not vertical:
                self.speed_mps = item.params[1]
            if item.command == Kind.RETURN:
                self._finish("mission return")
            else:
                self._report_reached()
                self._advance()

    def _jump(self, item: MissionItem) -> None:
        """Jump to item param1, at most param2 times; a negative number: always."""
        target, times = item.params[:2]
        made = self._jumps.get(self.current, 0)
        if self.first <= target < len(self.items) and (times < 0 or made < times):
            self._jumps[self.current] = made + 1
            if self.firmware.item_titles:
                most = "unlimited" if times < 0 else f"{times:.0f}"
                self.texts.append(info(f"Mission: {self.current} Jump {made + 1}/{most}"))
            self._go_on(int(target))
        else:
            self._advance()

    def _advance(self) -> None:
        """Go to the next item, or finish."""
        self._since_s = math.nan
        if self.items[self.current].command in _PLACES:
            self._turned_rad = math.nan
        if self.current + 1 < len(self.items):
            self._go_on(self.current + 1)
        else:
            self._finish("mission finished")

    def _go_on(self, number: int) -> None:
        self.current = number
        self._report("mission progress")
        self._tell()

    def _tell(self) -> None:
        """Say which item begins."""
        titles = self.firmware.item_titles
        if self._has_item and (title := titles.get(self.items[self.current].command)):
            self.texts.append(info(f"Mission: {self.current} {title}"))
            if self.items[self.current].command == Kind.DELAY:
                self.texts.append(info(f"Delaying {self.items[self.current].params[0]:.0f} sec"))

    def _finish(self, event: str) -> None:
        self.finished = True
        self._report(event)

    def _report_reached(self) -> None:
        self.reached = self.current
        self._report("item reached")
        if self.firmware.item_titles and self.items[self.current].command in _TOLD:
            self.texts.append(info(f"Reached command #{self.current}"))

    def _report(self, event: str) -> None:
        if event not in self.events:
            self.events.append(event)

    # -- items -------------------------------------------------------------------------------

    def _position(self, item: MissionItem, home_ned_m: Triple) -> Triple:
        """NED position of an item. An item without coordinates has those of the last place."""
        north, east = to_metres(self.firmware.origin, item.x * 1e-7, item.y * 1e-7)
        if item.x == 0 and item.y == 0:
            north, east = self._target_ned_m[:2]
        return north, east, down_m(item.z, item.frame, self.firmware.origin, home_ned_m[2])

    def _target(self, item: MissionItem, estimate: StateEstimate, home_ned_m: Triple) -> Triple:
        here_ned_m = estimate.position_ned_m
        north, east, down = self._position(item, home_ned_m)
        if item.command == Kind.TAKEOFF:
            north, east = self._target_ned_m[:2]
            down = min(down, here_ned_m[2]) if self.firmware.ardupilot_commands else down
        if item.command == Kind.LAND:
            down = here_ned_m[2] if self.landing else self._target_ned_m[2]
        if item.command == Kind.LOITER_TURNS:
            if math.isnan(self._since_s):  # the nearest place of the circle
                self._bearing_rad = math.atan2(here_ned_m[1] - east, here_ned_m[0] - north)
            bearing_rad = self._circle_rad(item, estimate.time_s)
            radius_m = abs(_finite_or_zero(item.params[2])) or _CIRCLE_M
            north += radius_m * math.cos(bearing_rad)
            east += radius_m * math.sin(bearing_rad)
        return north, east, down

    def _circle_rad(self, item: MissionItem, now_s: float) -> float:
        """Bearing of the target from the centre of a circle. A negative radius: anticlockwise."""
        moved_s = 0.0 if math.isnan(self._since_s) else now_s - self._since_s
        return self._bearing_rad + math.copysign(moved_s * _CIRCLE_RADPS, item.params[2])

    def _near(self, item: MissionItem, here_ned_m: Triple) -> bool:
        if item.command not in _PLACES:
            return True
        has_radius = item.command == Kind.WAYPOINT and item.params[1] > 0
        radius_m = item.params[1] if has_radius else self.parameters.role("reached_m")
        north, east, down = self._target_ned_m
        x, y, z = here_ned_m
        takes_off = item.command == Kind.TAKEOFF
        height_m = self.parameters.role("climbed_within_m" if takes_off else "reached_height_m")
        return math.hypot(x - north, y - east) < radius_m and abs(z - down) < height_m

    def _stay_s(self, item: MissionItem) -> float:
        if item.command in (Kind.LOITER_UNLIMITED, Kind.LAND):
            return math.inf
        if item.command == Kind.LOITER_TURNS:
            return _finite_or_zero(item.params[0]) * math.tau / _CIRCLE_RADPS
        return _finite_or_zero(item.params[0]) if item.command in _TIMED else 0.0

    def _yaw_rad(self, item: MissionItem, estimate: StateEstimate) -> float:
        """Yaw that the mission demands; NaN: the nose points in the direction of flight."""
        if self._faced_ned_m is not None:
            north, east = self._faced_ned_m
            return math.atan2(east - estimate.position_ned_m[1], north - estimate.position_ned_m[0])
        if not math.isnan(self._turned_rad):
            return self._turned_rad
        if item.command == Kind.LOITER_TURNS and not math.isnan(self._since_s):
            return wrap_pi(self._circle_rad(item, estimate.time_s) + math.pi)
        yaw_deg = item.params[3]
        if item.command in self.firmware.turning_items and math.isfinite(yaw_deg):
            return wrap_pi(math.radians(yaw_deg))
        return math.nan


def _finite_or_zero(value: float) -> float:
    return value if math.isfinite(value) else 0.0
