"""MAVLink commands (MAV_CMD): their effects and acknowledgements.

Unused parameters of a command may be NaN or 0. Every command is acknowledged, unknown ones with
UNSUPPORTED, except those that the real autopilot leaves unanswered (`Firmware.command_answers`).
Knows one link's outbox and schedule, and the autopilot.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from offboard.model.frames import wrap_pi
from simulator.autopilot.autopilot import Autopilot
from simulator.autopilot.commander import Request
from simulator.autopilot.values import Asked, Behaviour, Circle, Result, Triple, critical, info
from simulator.geodesy import down_m, to_metres
from simulator.mavlink.codec import id_of, name_of
from simulator.mavlink.outbox import Outbox
from simulator.mavlink.telemetry import Schedule
from simulator.mavlink.view import fit

_HEIGHT_MAX_M = 83_000.0  # greatest height of home: ArduPilot's LOCATION_ALT_MAX_M
_RELATIVE = 3  # MAV_FRAME
_CHANGE_MODE = 1.0  # MAV_DO_REPOSITION_FLAGS
_MOTORS = 4
_RADIUS_MAX_M = 1000.0  # of an orbit: PX4's MC_ORBIT_RAD_MAX
_MISSION_PLANNER = 190  # MAV_COMP_ID_MISSIONPLANNER, the component id of ground stations


@dataclass(frozen=True, slots=True)
class Command:
    """A COMMAND_LONG or COMMAND_INT."""

    number: int
    params: tuple[float, ...]  # param1 .. param7; latitude and longitude in degrees
    system: int  # id of the sender
    component: int
    frame: int | None = None  # MAV_FRAME of COMMAND_INT; None: COMMAND_LONG


@dataclass(slots=True)
class Commands:
    """Carries out and acknowledges the commands of one link."""

    outbox: Outbox
    schedule: Schedule

    @property
    def _autopilot(self) -> Autopilot:
        return self.outbox.view.autopilot

    def run(self, command: Command) -> None:
        """Carry out a command and acknowledge it on the same link."""
        answers = self._autopilot.firmware.command_answers
        result: Result | None
        if command.number in answers:
            result = answers[command.number]
        elif (handler := HANDLERS.get(command.number)) is not None:
            result = handler(self, self._autopilot, command)
        else:
            result = Result.UNSUPPORTED
        if result is not None:
            self._acknowledge(command, result)

    def set_mode(self, base_mode: int, custom_mode: int, sender: tuple[int, int]) -> None:
        """Carry out SET_MODE, the deprecated message."""
        firmware = self._autopilot.firmware
        asked = firmware.set_mode(base_mode, custom_mode)
        result = self._enter(asked, sender[1] == _MISSION_PLANNER)
        if firmware.set_mode_acked_as is not None and result is not None:
            self._acknowledge(Command(firmware.set_mode_acked_as, (), *sender), result)

    def _acknowledge(self, command: Command, result: Result) -> None:
        self.outbox.send(
            "COMMAND_ACK", command.number, int(result), 0, 0, command.system, command.component
        )

    def _set_mode(self, autopilot: Autopilot, command: Command) -> Result | None:
        if autopilot.firmware.mode_acked_twice:
            self._acknowledge(command, Result.ACCEPTED)
        by_ground_station = command.component == _MISSION_PLANNER
        return self._enter(autopilot.firmware.command_mode(command.params), by_ground_station)

    def _refused(self, asked: Asked) -> Result | None:
        self._autopilot.commander.texts += () if asked.text is None else (asked.text,)
        return asked.refusal

    def _enter(self, asked: Asked, by_ground_station: bool) -> Result | None:
        if not asked.name:
            return self._refused(asked)
        request = Request(asked.name, by_ground_station=by_ground_station)
        return self._autopilot.handle("mode", request)

    def _arm_disarm(self, autopilot: Autopilot, command: Command) -> Result | None:
        asked = autopilot.firmware.arm_request(command.params[0])
        if not asked.name:
            return self._refused(asked)
        forced = command.params[1] == autopilot.firmware.force_codes[asked.name]
        return autopilot.handle(f"force {asked.name}" if forced else asked.name)

    def _takeoff(self, autopilot: Autopilot, command: Command) -> Result:
        height_m = command.params[6]
        if autopilot.firmware.ardupilot_commands:
            if command.frame not in (None, _RELATIVE):
                return Result.DENIED
            down_m = autopilot.guidance.home_ned_m[2] - height_m
            return autopilot.handle("takeoff", Request(takeoff_ned_m=(math.nan, math.nan, down_m)))
        place = to_metres(autopilot.firmware.origin, *command.params[4:6])
        down_m = autopilot.firmware.origin[2] - height_m
        finite = (value if math.isfinite(value) else math.nan for value in (*place, down_m))
        north, east, down = finite
        return autopilot.handle("takeoff", Request(takeoff_ned_m=(north, east, down)))

    def _set_home(self, autopilot: Autopilot, command: Command) -> Result:
        """MAV_CMD_DO_SET_HOME: home is the present position (param1 = 1; ArduCopter: also latitude
        and longitude 0), or a place in degrees and AMSL metres. It is kept when the vehicle arms,
        but PX4 does not keep a present position."""
        latitude, longitude, height_m = command.params[4:7]
        ardupilot = autopilot.firmware.ardupilot_commands
        here = command.params[0] == 1.0 or (ardupilot and latitude == longitude == 0.0)
        if self.outbox.view.withheld("HOME_POSITION"):
            return autopilot.firmware.request_refusal
        if here:
            autopilot.guidance.home_ned_m = autopilot.state.estimate.position_ned_m
        elif math.isfinite(latitude + longitude) and abs(height_m) <= _HEIGHT_MAX_M:
            north, east = to_metres(autopilot.firmware.origin, latitude, longitude)
            autopilot.guidance.home_ned_m = (north, east, autopilot.firmware.origin[2] - height_m)
        else:
            return Result.DENIED
        autopilot.guidance.home_kept = ardupilot or not here
        return autopilot.handle("home")

    def _reposition(self, autopilot: Autopilot, command: Command) -> Result:
        """MAV_CMD_DO_REPOSITION: fly to a place and hold it. The present position replaces
        coordinates that are not finite. For PX4 the height is above mean sea level in any frame."""
        ardupilot, mode = autopilot.firmware.ardupilot_commands, autopilot.firmware.reposition_mode
        there = ardupilot and autopilot.commander.mode.name == mode
        if command.params[1] != _CHANGE_MODE and not there:
            return Result.DENIED if ardupilot and command.frame is not None else Result.UNSUPPORTED
        yaw_rad, latitude, longitude, height_m = command.params[3:7]
        speed_mps = math.inf if ardupilot or not command.params[0] > 0.0 else command.params[0]
        if ardupilot:
            if command.frame is None:
                return Result.UNSUPPORTED
            on_earth = abs(latitude) <= 90.0 and abs(longitude) <= 180.0
            if not on_earth or not (latitude or longitude):
                return Result.DENIED
            yaw_rad = math.nan
        result = autopilot.handle("mode", Request(mode))
        if result is Result.ACCEPTED and autopilot.commander.armed:
            yaw_rad = yaw_rad if math.isfinite(yaw_rad) else math.nan
            frame = (ardupilot and command.frame) or 0
            place = self._place(latitude, longitude, height_m, frame)
            autopilot.go_to(place, yaw_rad)
            if math.isfinite(speed_mps):
                autopilot.guidance.cruise_mps = speed_mps
        return result

    def _change_altitude(self, autopilot: Autopilot, command: Command) -> Result:
        """MAV_CMD_DO_CHANGE_ALTITUDE: DO_REPOSITION of PX4 with a height only."""
        params = (math.nan, _CHANGE_MODE, *(math.nan,) * 4, command.params[0])
        return self._reposition(autopilot, replace(command, params=params, frame=None))

    def _orbit(self, autopilot: Autopilot, command: Command) -> Result:
        """MAV_CMD_DO_ORBIT: fly a circle. The present position replaces coordinates that are not
        finite."""
        result = autopilot.handle("orbit")
        if result is Result.ACCEPTED:
            given = zip(command.params, (1.0, 1.0, 0.0), strict=False)
            radius_m, speed_mps, yaw = (a if math.isfinite(a) else default for a, default in given)
            if not 1.0 <= abs(radius_m) <= _RADIUS_MAX_M:
                autopilot.commander.texts.append(critical("Orbit radius limit exceeded"))
                radius_m = 1.0
            speed_mps = min(abs(speed_mps), 10.0, math.sqrt(2.0 * abs(radius_m)))
            latitude, longitude, height_m = command.params[4:7]
            centre = self._place(latitude, longitude, height_m, 0)
            autopilot.guidance.circle = Circle(centre, radius_m, speed_mps, int(yaw))
        return result

    def go_to(self, place: tuple[float, float, float], frame: int) -> bool:
        """Fly to a place (latitude and longitude in degrees, height in metres). Return False in a
        mode that does not obey setpoints."""
        autopilot = self._autopilot
        obeys = autopilot.commander.mode.behaviour is Behaviour.SETPOINT
        if obeys and autopilot.commander.armed:
            autopilot.go_to(self._place(*place, frame), math.nan)
        return obeys

    def _place(self, latitude: float, longitude: float, height_m: float, frame: int) -> Triple:
        """Return the NED position of a place in degrees, with a height in this MAV_FRAME. The
        present position replaces coordinates that are not finite."""
        autopilot = self._autopilot
        origin, home_down_m = autopilot.firmware.origin, autopilot.guidance.home_ned_m[2]
        here = autopilot.state.estimate.position_ned_m
        north, east = to_metres(origin, latitude, longitude)
        if not math.isfinite(north + east):
            north, east = here[:2]
        down = down_m(height_m, frame, origin, home_down_m)
        return north, east, down if math.isfinite(down) else here[2]

    def _change_speed(self, autopilot: Autopilot, command: Command) -> Result:
        """MAV_CMD_DO_CHANGE_SPEED: set the horizontal speed of automatic flight until the next
        mode. A speed that is not positive restores the default.
        """
        kind, speed_mps = command.params[:2]
        result = autopilot.handle("speed")
        if result is not Result.ACCEPTED:
            return result
        if speed_mps > 0.0 and kind in autopilot.firmware.vertical_speeds:
            return Result.ACCEPTED
        known = 0.0 < speed_mps < math.inf
        autopilot.guidance.cruise_mps = speed_mps if known else math.inf
        return Result.ACCEPTED if known else autopilot.firmware.empty_refusal

    def _turn(self, autopilot: Autopilot, command: Command) -> Result:
        """MAV_CMD_CONDITION_YAW: turn to a yaw, or by an angle from the present one; degrees."""
        yaw_deg, speed_dps, sense, relative = command.params[:4]
        result = autopilot.handle("turn")
        if result is Result.ACCEPTED:
            if not (0.0 <= yaw_deg <= 360.0 and relative in (0.0, 1.0)):
                return Result.FAILED
            from_rad = autopilot.state.estimate.yaw_rad if relative else 0.0
            if relative:
                sense = -1.0 if sense < 0.0 else 1.0
            turn_rad = math.radians(yaw_deg) * (sense if relative else 1.0)
            turn_radps = math.radians(speed_dps) if speed_dps > 0.0 else math.inf
            yaw_rad = wrap_pi(from_rad + turn_rad)
            autopilot.guidance.turn_to(yaw_rad, turn_radps, sense)
        return result

    def _set_servo(self, autopilot: Autopilot, command: Command) -> Result:
        """MAV_CMD_DO_SET_SERVO: set the pulse width of an output that drives no motor."""
        (number, width_us), result = command.params[:2], autopilot.handle("servo")
        if result is Result.ACCEPTED:
            if not _MOTORS + 1 <= number <= len(autopilot.outputs_us):
                return Result.FAILED
            autopilot.outputs_us[int(number) - 1] = fit(width_us, 16, signed=False)
        return result

    def _face(self, autopilot: Autopilot, command: Command) -> Result:
        """MAV_CMD_DO_SET_ROI, _LOCATION and _NONE: face a place; latitude and longitude 0: none."""
        latitude, longitude = command.params[4:6]
        place = to_metres(autopilot.firmware.origin, latitude, longitude)
        autopilot.guidance.turn_to(math.nan, math.inf, 0.0)
        autopilot.guidance.region_ned_m = place if latitude or longitude else None
        return Result.ACCEPTED

    def _terminate(self, autopilot: Autopilot, command: Command) -> Result:
        """MAV_CMD_DO_FLIGHTTERMINATION: stop the motors; it cannot be revoked."""
        asked = command.params[0] > 0.5
        return autopilot.handle("terminate") if asked else autopilot.firmware.request_refusal

    def _reboot(self, autopilot: Autopilot, command: Command) -> Result:
        restart = command.params[0] >= 1.0
        return autopilot.handle("reboot") if restart else Result.UNSUPPORTED

    def _calibrate(self, autopilot: Autopilot, command: Command) -> Result:
        """MAV_CMD_PREFLIGHT_CALIBRATION, without effect."""
        return autopilot.handle("calibration") if any(command.params) else Result.UNSUPPORTED

    def _grip(self, _: Autopilot, command: Command) -> Result:
        """MAV_CMD_DO_GRIPPER, without effect: param2 is 0 or 1."""
        return Result.ACCEPTED if command.params[1] in (0.0, 1.0) else Result.DENIED

    def _start_mission(self, autopilot: Autopilot, command: Command) -> Result:
        """MAV_CMD_MISSION_START; for ArduCopter it is a request of mode AUTO."""
        ardupilot = autopilot.firmware.ardupilot_commands
        if ardupilot and any(command.params[:2]):
            return Result.DENIED
        first = command.params[0] if math.isfinite(command.params[0]) else 0.0
        if not -1 <= first < max(1, len(autopilot.mission.items)):
            return Result.DENIED
        modes = autopilot.firmware.modes.values()
        mode = next(mode.name for mode in modes if mode.behaviour is Behaviour.MISSION)
        return autopilot.handle("mode" if ardupilot else "mission", Request(mode))

    def _set_current_item(self, autopilot: Autopilot, command: Command) -> Result:
        number = command.params[0]
        known = math.isfinite(number) and autopilot.mission.go_to(int(number))
        return Result.ACCEPTED if known else Result.DENIED

    def _set_interval(self, autopilot: Autopilot, command: Command) -> Result:
        number, interval_us = command.params[:2]
        firmware, name = autopilot.firmware, message_name(number)
        if 0 < interval_us < 1e6 / firmware.rate_max_hz:
            return self._refuse_interval(number, firmware.too_fast_text)
        if number in firmware.never_sent and math.isfinite(interval_us):
            return Result.ACCEPTED
        known = name is not None and math.isfinite(interval_us)
        if not (known and self.schedule.set_interval(str(name), interval_us)):
            return self._refuse_interval(number, firmware.interval_refusal_text)
        return Result.ACCEPTED

    def _refuse_interval(self, number: float, text: str) -> Result:
        autopilot = self._autopilot
        if text and math.isfinite(number):
            autopilot.commander.texts.append(info(text.format(id=int(number))))
        return autopilot.firmware.interval_refusal

    def _get_interval(self, autopilot: Autopilot, command: Command) -> Result:
        name = message_name(command.params[0])
        firmware, number = autopilot.firmware, command.params[0]
        if name is None or name not in self.outbox.view.builders:
            unknown = int(number) & 0xFFFF if math.isfinite(number) else 0
            self.outbox.send("MESSAGE_INTERVAL", unknown, 0)
            return firmware.empty_refusal
        stream = self.schedule.streams.get(name)
        interval_us = firmware.no_interval_us if stream is None else stream.interval_us
        self.outbox.send("MESSAGE_INTERVAL", id_of(name), interval_us)
        return Result.ACCEPTED

    def _request_message(self, autopilot: Autopilot, command: Command) -> Result:
        """MAV_CMD_REQUEST_MESSAGE: ArduCopter accepts it for a message that it cannot send yet."""
        name = message_name(command.params[0])
        if name is not None and self.outbox.view.withheld(name):
            return Result.ACCEPTED
        return self._send(name)

    def _send(self, name: str | None) -> Result:
        view, firmware = self.outbox.view, self._autopilot.firmware
        if name not in view.builders or view.withheld(name) or name in firmware.not_on_request:
            return firmware.request_refusal
        self.outbox.send_now(name)
        return Result.ACCEPTED


# By MAV_CMD
HANDLERS: dict[int, Callable[[Commands, Autopilot, Command], Result | None]] = {
    17: lambda _, autopilot, __: autopilot.handle("loiter"),  # NAV_LOITER_UNLIM
    20: lambda _, autopilot, __: autopilot.handle("return"),  # NAV_RETURN_TO_LAUNCH
    21: lambda _, autopilot, __: autopilot.handle("land"),  # NAV_LAND
    22: Commands._takeoff,  # NAV_TAKEOFF
    34: Commands._orbit,  # DO_ORBIT
    115: Commands._turn,  # CONDITION_YAW
    176: Commands._set_mode,  # DO_SET_MODE
    178: Commands._change_speed,  # DO_CHANGE_SPEED
    179: Commands._set_home,  # DO_SET_HOME
    183: Commands._set_servo,  # DO_SET_SERVO
    185: Commands._terminate,  # DO_FLIGHTTERMINATION
    186: Commands._change_altitude,  # DO_CHANGE_ALTITUDE
    192: Commands._reposition,  # DO_REPOSITION
    193: lambda _, autopilot, asked: autopilot.handle("continue" if asked.params[0] else "pause"),
    195: Commands._face,  # DO_SET_ROI_LOCATION
    197: Commands._face,  # DO_SET_ROI_NONE
    201: Commands._face,  # DO_SET_ROI
    209: lambda _, autopilot, __: autopilot.handle("motor test"),  # DO_MOTOR_TEST
    211: Commands._grip,  # DO_GRIPPER
    224: Commands._set_current_item,  # DO_SET_MISSION_CURRENT
    241: Commands._calibrate,  # PREFLIGHT_CALIBRATION
    246: Commands._reboot,  # PREFLIGHT_REBOOT_SHUTDOWN
    300: Commands._start_mission,  # MISSION_START
    400: Commands._arm_disarm,  # COMPONENT_ARM_DISARM
    401: lambda _, autopilot, __: autopilot.handle("checks"),  # RUN_PREARM_CHECKS
    410: lambda commands, *_: commands._send("HOME_POSITION"),  # GET_HOME_POSITION
    510: Commands._get_interval,  # GET_MESSAGE_INTERVAL
    511: Commands._set_interval,  # SET_MESSAGE_INTERVAL
    512: Commands._request_message,  # REQUEST_MESSAGE
    520: lambda commands, *_: commands._send("AUTOPILOT_VERSION"),  # REQUEST_AUTOPILOT_CAPABILITIES
    42424: lambda _, autopilot, __: autopilot.handle("compass calibration"),  # DO_START_MAG_CAL
}


def message_name(number: float) -> str | None:
    """Return the name of the message whose id is in a float parameter; NaN is id 0."""
    if number != number:
        return name_of(0)
    return name_of(int(number)) if math.isfinite(number) and number >= 0 else None
