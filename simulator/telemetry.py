"""The messages the vehicle sends by itself: its state as field values, in the order of the XML.

One function per message, all in `BUILDERS`. Units and scales of MAVLink are applied here and
nowhere else on the simulator's side. Knows no links, rates or sequence numbers.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from simulator.attitude import Demand
from simulator.autopilot import Autopilot
from simulator.codec import layout
from simulator.firmware.base import MotionSetpoint, Quaternion, Triple
from simulator.frame_writer import RECORD, STATE
from simulator.geodesy import EARTH_RADIUS_M
from simulator.position_loop import GRAVITY_MPS2
from simulator.steps import STEP_US

_DEGREES_PER_M = math.degrees(1.0 / EARTH_RADIUS_M)
ON_POSITION_GRID = frozenset(
    {"LOCAL_POSITION_NED", "ODOMETRY", "GLOBAL_POSITION_INT", "HIL_STATE_QUATERNION"}
)

MAV_TYPE_QUADROTOR = 2
MAV_COMP_ID_AUTOPILOT = 1
_NAN21 = (math.nan,) * 21
LEAST_INTERVAL_US = {"GPS_RAW_INT": 125_000.0}  # a receiver gives eight fixes a second
_GPS, _PREARM = 0x20, 0x10000000  # MAV_SYS_STATUS_SENSOR


@dataclass(slots=True)
class Stuck:
    """A message that repeats its content; its first field, the time stamp, may run on."""

    stamp_runs: bool
    values: Sequence[Any] | None = None

    def instead_of(self, values: Sequence[Any]) -> Sequence[Any]:
        if self.values is None:
            self.values = values
        return (values[0], *self.values[1:]) if self.stamp_runs else self.values


@dataclass(slots=True)
class View:
    """What builders read: the autopilot, and what one step's messages share."""

    autopilot: Autopilot
    system: int
    epoch_us: int  # Unix time of boot
    ping_sequence: int = 0
    payloads: dict[str, bytes] = field(default_factory=dict)
    # What faults do to it
    clock_offset_us: int = 0
    silent: set[str] = field(default_factory=set)
    stuck: dict[str, Stuck] = field(default_factory=dict)
    builders: dict[str, Callable[[View], Sequence[Any]]] = field(init=False)
    _at_step: int = -1
    east_degrees_per_m: float = field(init=False)
    record: Any = field(init=False)  # what of this compiled code reads (`simulator.frame_writer`)
    _noted: tuple[Any, ...] = ()
    _noted_motion: MotionSetpoint | None = None
    _noted_demand: Demand | None = None

    def __post_init__(self) -> None:
        firmware = self.autopilot.firmware
        self.east_degrees_per_m = _DEGREES_PER_M / math.cos(math.radians(firmware.origin[0]))
        known = {n: b for n, b in BUILDERS.items() if n not in firmware.unknown_messages}
        self.builders = {**known, **firmware.own_messages}
        self.record = np.zeros(1, RECORD)
        self.record["system"] = self.system
        self.record["origin"] = firmware.origin
        self.record["east_degrees_per_m"] = self.east_degrees_per_m
        self.record["battery"] = self.autopilot.plant.battery_constants

    def is_common(self, name: str) -> bool:
        """Built here, not by the firmware in a way of its own."""
        return self.builders[name] is BUILDERS.get(name)

    def withheld(self, name: str) -> bool:
        """What the vehicle cannot say yet, whatever rate it granted."""
        autopilot = self.autopilot
        event = autopilot.firmware.withheld_until.get(name)
        return event is not None and event not in autopilot.health.reached

    def note(self) -> None:
        """Bring the record up to date."""
        autopilot, record = self.autopilot, self.record
        pilot = autopilot.pilot
        state = (
            self.clock_offset_us,
            autopilot.plant.reset_counter,
            autopilot.navigator.home_ned_m[2],
            self.sensor_bits,
            self.has_fix,
            self.landed_state,
        )
        if state != self._noted:
            self._noted = state
            for name, value in zip(STATE, state, strict=True):
                record[name] = value
        if pilot.motion is not self._noted_motion:
            self._noted_motion = pilot.motion
            record["motion"] = _fields(pilot.motion)
        demand = pilot.demand
        record["thrust"] = pilot.thrust_demanded
        if demand is not self._noted_demand:
            self._noted_demand = demand
            record["throttle"] = demand.thrust
            record["attitude"] = demand.attitude or (1.0, 0.0, 0.0, 0.0)
            record["rates_radps"] = demand.rates_frd_radps or (0.0, 0.0, 0.0)

    def payload(self, name: str) -> bytes:
        """Packed payload of message `name` now; built once per step for all links."""
        if self._at_step != self.autopilot.senses.steps:
            self._at_step = self.autopilot.senses.steps
            self.payloads.clear()
        packed = self.payloads.get(name)
        if packed is None:
            values = self.builders[name](self)
            if name in self.stuck:
                values = self.stuck[name].instead_of(values)
            packed = self.payloads[name] = layout(name).pack(values)
        return packed

    def restart(self, autopilot: Autopilot) -> None:
        """Another autopilot, after a reboot."""
        autopilot.senses.gps_healthy = self.autopilot.senses.gps_healthy
        self.autopilot = autopilot
        self.clock_offset_us = self.ping_sequence = 0
        self._at_step = -1

    @property
    def has_fix(self) -> bool:
        """No fault takes it away."""
        return self.autopilot.senses.gps_healthy

    @property
    def sensor_bits(self) -> tuple[int, int, int]:
        """MAV_SYS_STATUS_SENSOR: present, enabled, healthy."""
        autopilot = self.autopilot
        sensors = autopilot.firmware.sensors
        present, enabled, health = sensors.present, sensors.enabled, sensors.health
        if not autopilot.health.has_fix(autopilot.senses.time_s):
            present, enabled, health = present & ~_GPS, enabled & ~_GPS, health & ~_GPS
        elif not self.has_fix:
            health &= ~_GPS
        if autopilot.commander.healthy:
            health |= _PREARM
        return present, enabled, health

    @property
    def landed_state(self) -> int:
        """MAV_LANDED_STATE: 1 on ground, 2 in air, 3 taking off, 4 landing."""
        navigator = self.autopilot.navigator
        if self.autopilot.pilot.landed:
            return 1
        if navigator.landing:
            return 4
        return 3 if navigator.climbing else 2

    @property
    def time_ms(self) -> int:
        return self.time_us // 1000 & 0xFFFFFFFF

    @property
    def time_us(self) -> int:
        """The vehicle's clock, as its stamps show it."""
        return max(0, self.autopilot.senses.steps * STEP_US + self.clock_offset_us)

    def geodetic(self, north_m: float, east_m: float) -> tuple[int, int]:
        """Latitude and longitude in 1e-7 deg of a point near the origin (spherical Earth)."""
        latitude, longitude, _ = self.autopilot.firmware.origin
        north_deg = north_m * _DEGREES_PER_M
        east_deg = east_m * self.east_degrees_per_m
        return _fit((latitude + north_deg) * 1e7, 32), _fit((longitude + east_deg) * 1e7, 32)

    def altitude_mm(self, down_m: float) -> int:
        """AMSL, mm."""
        return _fit((self.autopilot.firmware.origin[2] - down_m) * 1e3, 32)


_RANGES = {
    (bits, signed): (-(1 << bits - 1), (1 << bits - 1) - 1) if signed else (0, (1 << bits) - 1)
    for bits in (8, 16, 32)
    for signed in (False, True)
}


def _fit(value: float, bits: int, *, signed: bool = True) -> int:
    """Nearest integer that a field of `bits` holds; what is not finite becomes 0."""
    if value - value != 0.0:  # infinite or not a number
        return 0
    low, high = _RANGES[bits, signed]
    return min(high, max(low, round(value)))


def _centi(velocity: Triple) -> tuple[int, int, int]:
    return _fit(velocity[0] * 100, 16), _fit(velocity[1] * 100, 16), _fit(velocity[2] * 100, 16)


def _heading_cdeg(yaw_rad: float) -> int:
    return round(math.degrees(yaw_rad) * 100) % 36000


def _in_body(attitude: Quaternion, vector_ned: Triple) -> Triple:
    """An NED vector in body axes: v + 2 r x (r x v - w v) with the quaternion (w, r)."""
    w, x, y, z = attitude
    north, east, down = vector_ned
    a, b, c = y * down - z * east, z * north - x * down, x * east - y * north
    a, b, c = a - w * north, b - w * east, c - w * down
    return (
        north + 2.0 * (y * c - z * b),
        east + 2.0 * (z * a - x * c),
        down + 2.0 * (x * b - y * a),
    )


def heartbeat(view: View) -> Sequence[Any]:
    autopilot = view.autopilot
    base_mode, status = autopilot.commander.heartbeat
    return (
        MAV_TYPE_QUADROTOR,
        autopilot.firmware.mav_autopilot,
        base_mode,
        autopilot.commander.mode.custom_mode,
        status,
        3,
    )


def attitude(view: View) -> Sequence[Any]:
    nav = view.autopilot.senses.look()
    w, x, y, z = nav.attitude
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = math.asin(min(1.0, max(-1.0, 2.0 * (w * y - z * x))))
    return (view.time_ms, roll, pitch, nav.yaw_rad, *nav.rates_frd_radps)


def attitude_quaternion(view: View) -> Sequence[Any]:
    nav = view.autopilot.senses.look()
    return (view.time_ms, *nav.attitude, *nav.rates_frd_radps, (0.0, 0.0, 0.0, 0.0))


def local_position_ned(view: View) -> Sequence[Any]:
    nav = view.autopilot.senses.look()
    return (view.time_ms, *nav.position_ned_m, *nav.velocity_ned_mps)


def odometry(view: View) -> Sequence[Any]:
    nav = view.autopilot.senses.look()
    frame = 1  # MAV_FRAME_LOCAL_NED, velocities too, as PX4 sends it
    return (
        view.time_us,
        frame,
        frame,
        *nav.position_ned_m,
        nav.attitude,
        *nav.velocity_ned_mps,
        *nav.rates_frd_radps,
        _NAN21,
        _NAN21,
        nav.reset_counter,
        8,  # MAV_ESTIMATOR_TYPE_AUTOPILOT
        0,
    )


def global_position_int(view: View) -> Sequence[Any]:
    nav = view.autopilot.senses.look()
    north, east, down = nav.position_ned_m
    home_down = view.autopilot.navigator.home_ned_m[2]
    return (
        view.time_ms,
        *view.geodetic(north, east),
        view.altitude_mm(down),
        _fit((home_down - down) * 1e3, 32),
        *_centi(nav.velocity_ned_mps),
        _heading_cdeg(nav.yaw_rad),
    )


def altitude(view: View) -> Sequence[Any]:
    down = view.autopilot.senses.look().position_ned_m[2]
    amsl = view.altitude_mm(down) / 1e3
    relative = view.autopilot.navigator.home_ned_m[2] - down
    return (view.time_us, amsl, amsl, -down, relative, math.nan, math.nan)


def pressure_hpa(height_m: float) -> float:
    """Of the air at this height above the sea, in a standard atmosphere."""
    return 1013.25 * math.pow(1.0 - 2.25577e-5 * height_m, 5.25588)


def scaled_pressure(view: View) -> Sequence[Any]:
    """hPa; 25 degrees."""
    down_m = view.autopilot.senses.look().position_ned_m[2]
    height_m = view.autopilot.firmware.origin[2] - down_m
    return (view.time_ms, pressure_hpa(height_m), 0.0, 2500, 0)


def vibration(view: View) -> Sequence[Any]:
    """None."""
    return (view.time_us, 0.0, 0.0, 0.0, 0, 0, 0)


def highres_imu(view: View) -> Sequence[Any]:
    """Specific force of the truth in body axes, rates as estimated."""
    nav = view.autopilot.senses.look()
    w, x, y, z, *_, down, a_north, a_east, a_down = view.autopilot.plant.motion()
    force = _in_body((w, x, y, z), (a_north, a_east, a_down - GRAVITY_MPS2))
    height = view.autopilot.firmware.origin[2] - down
    return (
        view.time_us,
        *force,
        *nav.rates_frd_radps,
        *(0.21, 0.0, 0.43),
        pressure_hpa(height),
        0.0,
        height,
        15.0,
        0x1BFF,
        0,
    )


def attitude_target(view: View) -> Sequence[Any]:
    demand = view.autopilot.pilot.demand
    rates = demand.rates_frd_radps or (0.0, 0.0, 0.0)
    return (
        view.time_ms,
        0,
        demand.attitude or (1.0, 0.0, 0.0, 0.0),
        *rates,
        view.autopilot.pilot.thrust_demanded,
    )


def position_target_local_ned(view: View) -> Sequence[Any]:
    return (view.time_ms, 1, 0, *_fields(view.autopilot.pilot.motion))


def _fields(motion: MotionSetpoint) -> tuple[float, ...]:
    """As POSITION_TARGET_LOCAL_NED and its like have them."""
    return (
        *motion.position_ned_m,
        *motion.velocity_ned_mps,
        *motion.acceleration_ned_mps2,
        motion.yaw_rad,
        motion.yaw_rate_radps,
    )


def timesync(view: View) -> Sequence[Any]:
    return (0, view.time_us * 1000)


def vfr_hud(view: View) -> Sequence[Any]:
    autopilot = view.autopilot
    nav = autopilot.senses.look()
    north, east, down = nav.velocity_ned_mps
    return (
        0.0,
        math.hypot(north, east),
        _heading_cdeg(nav.yaw_rad) // 100,
        _fit(autopilot.pilot.demand.thrust * 100, 16, signed=False),
        view.altitude_mm(nav.position_ned_m[2]) / 1e3,
        -down,
    )


def gps_raw_int(view: View) -> Sequence[Any]:
    """Its accuracies are PX4's SIH's: larger than the errors."""
    if not view.has_fix:
        return (view.time_us, 1, 0, 0, 0, 65535, 65535, 65535, 65535, 0, *(0,) * 6)
    fix = view.autopilot.plant.fix
    north, east, down = fix.position_ned_m.tolist()
    v_north, v_east = fix.velocity_ne_mps.tolist()
    course = _heading_cdeg(math.atan2(v_east, v_north))
    speed = _fit(math.hypot(v_north, v_east) * 100, 16, signed=False)
    height = view.altitude_mm(down)
    latitude, longitude = view.geodetic(north, east)
    return (
        view.time_us, 3, latitude, longitude, height, 70, 110, speed, course, 10, height,
        900, 1780, 400, 0, 0,
    )  # fmt: skip


def sys_status(view: View) -> Sequence[Any]:
    autopilot = view.autopilot
    battery = autopilot.senses.truth.battery
    present, enabled, health = view.sensor_bits
    return (
        present, enabled, health, 80,
        _fit(battery.voltage_v * 1e3, 16, signed=False),
        _fit(battery.current_a * 100, 16),
        _fit(battery.remaining * 100, 8),
        0, 0, 0, 0, 0, 0, 0, 0, 1,
    )  # fmt: skip


def extended_sys_state(view: View) -> Sequence[Any]:
    return (0, view.landed_state)


def estimator_status(view: View) -> Sequence[Any]:
    autopilot = view.autopilot
    flags = 895 if autopilot.health.has_fix(autopilot.senses.time_s) else 1024
    return (view.time_us, flags, 0.12, 0.03, 0.03, 0.14, 0.02, math.nan, 0.3, 0.31)


def system_time(view: View) -> Sequence[Any]:
    return (view.epoch_us + view.time_us, view.time_ms)


def ping(view: View) -> Sequence[Any]:
    view.ping_sequence += 1
    return (view.time_us, view.ping_sequence & 0xFFFFFFFF, 0, 0)


def battery_status(view: View) -> Sequence[Any]:
    battery = view.autopilot.senses.truth.battery
    voltage = _fit(battery.voltage_v * 1e3, 16, signed=False)
    return (
        0, 1, 1, 32767, (voltage, *(65535,) * 9), _fit(battery.current_a * 100, 16), 0, -1,
        _fit(battery.remaining * 100, 8), 0, 1, (0, 0, 0, 0), 0, 0,
    )  # fmt: skip


def home_position(view: View) -> Sequence[Any]:
    north, east, down = view.autopilot.navigator.home_ned_m
    yaw_rad = view.autopilot.navigator.home_yaw_rad
    return (
        *view.geodetic(north, east),
        view.altitude_mm(down),
        north,
        east,
        down,
        (math.cos(0.5 * yaw_rad), 0.0, 0.0, math.sin(0.5 * yaw_rad)),
        0.0,
        0.0,
        0.0,
        view.time_us,
    )


def hil_state_quaternion(view: View) -> Sequence[Any]:
    """The truth. Latitude and longitude are in steps of 1 cm; PX4 leaves time_usec 0."""
    truth = view.autopilot.senses.truth
    north, east, down = truth.position_ned_m.tolist()
    a, b, c = (_fit(value / GRAVITY_MPS2 * 1e3, 16) for value in truth.acceleration_ned_mps2)
    v_north, v_east, v_down = truth.velocity_ned_mps.tolist()
    airspeed = _fit(math.hypot(v_north, v_east) * 100, 16, signed=False)
    return (
        view.time_us,
        truth.attitude.tolist(),
        *truth.rates_frd_radps.tolist(),
        *view.geodetic(north, east),
        view.altitude_mm(down),
        *_centi((v_north, v_east, v_down)),
        airspeed,
        airspeed,
        a,
        b,
        c,
    )


def gps_global_origin(view: View) -> Sequence[Any]:
    return (*view.geodetic(0.0, 0.0), view.altitude_mm(0.0), view.time_us)


def mission_current(view: View) -> Sequence[Any]:
    """Number and count of items; PX4 has 65535 items when it has none, and leaves the rest 0."""
    mission = view.autopilot.mission
    return (mission.current, len(mission.items) or 65535, 0, 0)


def mission_item_reached(view: View) -> Sequence[Any]:
    return (max(0, view.autopilot.mission.reached),)


def autopilot_version(view: View) -> Sequence[Any]:
    firmware = view.autopilot.firmware
    return (
        firmware.capabilities, firmware.version, 0, 0, 0,
        (0,) * 8, (0,) * 8, (0,) * 8, 0, 0, view.system, (0,) * 18,
    )  # fmt: skip


BUILDERS: dict[str, Callable[[View], Sequence[Any]]] = {
    builder.__name__.upper(): builder
    for builder in (
        heartbeat,
        attitude,
        attitude_quaternion,
        local_position_ned,
        odometry,
        global_position_int,
        altitude,
        highres_imu,
        attitude_target,
        position_target_local_ned,
        timesync,
        vfr_hud,
        gps_raw_int,
        sys_status,
        extended_sys_state,
        estimator_status,
        system_time,
        ping,
        battery_status,
        home_position,
        hil_state_quaternion,
        gps_global_origin,
        mission_current,
        mission_item_reached,
        autopilot_version,
        scaled_pressure,
        vibration,
    )
}
