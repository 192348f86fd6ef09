"""The payloads of the messages that are nearly all of the traffic, written by compiled code.

Each is laid out here byte for byte behind its time stamp, apart from
`simulator.mavlink.motion_messages` and `simulator.mavlink.status_messages`, which say the same
slowly and readably: a test holds every byte of the one against the other. Reads the plant's record
and the one of `simulator.mavlink.seen`; knows no frames.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.model.kernel import kernel
from simulator.autopilot.position_law import GRAVITY_MPS2
from simulator.geodesy import DEGREES_PER_M
from simulator.vehicle.airframe import CHARGE, THRUST
from simulator.vehicle.dynamics import receive_fix

Array = NDArray[np.float64]

PAYLOAD = np.dtype(
    {
        "names": ["octets", "shorts", "words", "integers", "floats"],
        "formats": [("u1", 256), ("u2", 128), ("u4", 64), ("i4", 64), ("f4", 64)],
        "offsets": [0] * 5,
    }
)
"""Scratch: one message's payload, in whatever size its fields have."""

_NAN_WORD = 0x7FC00000
_ONE_DEGREE = 180.0 / math.pi
# As typed numbers: compiled code is made once more for each plain constant that is handed on
_ZERO, _BYTE_MAX, _SHORT_MAX, _USHORT_MAX, _LONG_MAX = (
    np.int64(value) for value in (0, 0x7F, 0x7FFF, 0xFFFF, 0x7FFFFFFF)
)


@kernel
def _fitted(value: float, low: np.int64, high: np.int64) -> int:
    """Nearest integer within these bounds; what is not finite becomes 0."""
    if value - value != 0.0:
        return 0
    if value >= high:
        return int(high)
    return max(int(low), int(np.rint(value)))


@kernel
def _fitted_short(value: float) -> int:
    """As a field of two bytes holds it, signed, in its unsigned reading."""
    return _fitted(value, -_SHORT_MAX - 1, _SHORT_MAX) & 0xFFFF


@kernel
def _fitted_long(value: float) -> int:
    return _fitted(value, -_LONG_MAX - 1, _LONG_MAX)


@kernel
def _centidegrees(angle_rad: float) -> int:
    """0 .. 35999."""
    return int(np.rint(angle_rad * _ONE_DEGREE * 100)) % 36000


@kernel
def _yaw(plant: Any) -> float:
    w, x, y, z = plant.report[6], plant.report[7], plant.report[8], plant.report[9]
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


@kernel
def _altitude_mm(seen: Any, down_m: float) -> int:
    return _fitted_long((seen.origin[2] - down_m) * 1e3)


@kernel
def _put_place(seen: Any, north_m: float, east_m: float, out: NDArray[np.int32]) -> None:
    """Latitude and longitude in 1e-7 deg."""
    north_deg, east_deg = north_m * DEGREES_PER_M, east_m * seen.east_degrees_per_m
    out[0] = _fitted_long((seen.origin[0] + north_deg) * 1e7)
    out[1] = _fitted_long((seen.origin[1] + east_deg) * 1e7)


@kernel
def _put_floats(values: Array, out: NDArray[np.float32]) -> None:
    for i in range(values.shape[0]):
        out[i] = values[i]


@kernel
def put_attitude(plant: Any, payload: Any) -> None:
    w, x, y, z = plant.report[6], plant.report[7], plant.report[8], plant.report[9]
    payload.floats[1] = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    payload.floats[2] = math.asin(min(1.0, max(-1.0, 2.0 * (w * y - z * x))))
    payload.floats[3] = _yaw(plant)
    _put_floats(plant.report[10:13], payload.floats[4:7])


@kernel
def put_attitude_quaternion(plant: Any, payload: Any) -> None:
    _put_floats(plant.report[6:13], payload.floats[1:8])
    for i in range(8, 12):
        payload.words[i] = 0


@kernel
def put_local_position(plant: Any, payload: Any) -> None:
    _put_floats(plant.report[0:6], payload.floats[1:7])


@kernel
def put_odometry(plant: Any, seen: Any, payload: Any) -> None:
    _put_floats(plant.report[0:3], payload.floats[2:5])
    _put_floats(plant.report[6:10], payload.floats[5:9])
    _put_floats(plant.report[3:6], payload.floats[9:12])
    _put_floats(plant.report[10:13], payload.floats[12:15])
    for i in range(15, 57):
        payload.words[i] = _NAN_WORD
    payload.octets[228] = 1  # MAV_FRAME_LOCAL_NED, velocities too
    payload.octets[229] = 1
    payload.octets[230] = seen.resets
    payload.octets[231] = 8  # MAV_ESTIMATOR_TYPE_AUTOPILOT
    payload.octets[232] = 0


@kernel
def put_global_position(plant: Any, seen: Any, payload: Any) -> None:
    _put_place(seen, plant.report[0], plant.report[1], payload.integers[1:3])
    payload.integers[3] = _altitude_mm(seen, plant.report[2])
    payload.integers[4] = _fitted_long((seen.home_down_m - plant.report[2]) * 1e3)
    for i in range(3):
        payload.shorts[10 + i] = _fitted_short(plant.report[3 + i] * 100)
    payload.shorts[13] = _centidegrees(_yaw(plant))


@kernel
def put_imu(plant: Any, seen: Any, payload: Any) -> None:
    w, x, y, z = plant.body[0], plant.body[1], plant.body[2], plant.body[3]
    north, east, down = plant.rotor[3], plant.rotor[4], plant.rotor[5] - GRAVITY_MPS2
    a, b, c = y * down - z * east, z * north - x * down, x * east - y * north
    a, b, c = a - w * north, b - w * east, c - w * down
    payload.floats[2] = north + 2.0 * (y * c - z * b)
    payload.floats[3] = east + 2.0 * (z * a - x * c)
    payload.floats[4] = down + 2.0 * (x * b - y * a)
    _put_floats(plant.report[10:13], payload.floats[5:8])
    payload.floats[8], payload.floats[9], payload.floats[10] = 0.21, 0.0, 0.43
    height = seen.origin[2] - plant.body[12]
    payload.floats[11] = 1013.25 * (1.0 - 2.25577e-5 * height) ** 5.25588
    payload.floats[12] = 0.0
    payload.floats[13] = height
    payload.floats[14] = 15.0
    payload.octets[60] = 0xFF
    payload.octets[61] = 0x1B
    payload.octets[62] = 0


@kernel
def put_altitude(plant: Any, seen: Any, payload: Any) -> None:
    down = plant.report[2]
    amsl = _altitude_mm(seen, down) / 1e3
    payload.floats[2] = amsl
    payload.floats[3] = amsl
    payload.floats[4] = -down
    payload.floats[5] = seen.home_down_m - down
    payload.words[6] = _NAN_WORD
    payload.words[7] = _NAN_WORD


@kernel
def put_hud(plant: Any, seen: Any, payload: Any) -> None:
    payload.floats[0] = 0.0
    payload.floats[1] = math.hypot(plant.report[3], plant.report[4])
    payload.floats[2] = _altitude_mm(seen, plant.report[2]) / 1e3
    payload.floats[3] = -plant.report[5]
    payload.shorts[8] = _centidegrees(_yaw(plant)) // 100
    payload.shorts[9] = _fitted(seen.throttle * 100, _ZERO, _USHORT_MAX)


@kernel
def put_attitude_target(seen: Any, payload: Any) -> None:
    _put_floats(seen.attitude[0:4], payload.floats[1:5])
    _put_floats(seen.rates_radps[0:3], payload.floats[5:8])
    payload.floats[8] = seen.thrust
    payload.octets[36] = 0


@kernel
def put_position_target(seen: Any, payload: Any) -> None:
    _put_floats(seen.motion[0:11], payload.floats[1:12])
    payload.shorts[24] = 0
    payload.octets[50] = 1


@kernel
def put_extended_state(seen: Any, payload: Any) -> None:
    payload.octets[0] = 0
    payload.octets[1] = seen.landed_state


@kernel
def put_timesync(time_us: int, payload: Any) -> None:
    payload.words[0] = payload.words[1] = 0
    payload.words[2] = time_us * 1000 & 0xFFFFFFFF
    payload.words[3] = time_us * 1000 >> 32


@kernel
def put_gps(plant: Any, seen: Any, payload: Any) -> None:
    for i in range(2, 13):
        payload.words[i] = 0
    if not seen.has_fix:
        payload.words[5] = payload.words[6] = 0xFFFFFFFF
        payload.octets[28] = 1
        return
    receive_fix(plant)
    _put_place(seen, plant.fix[0], plant.fix[1], payload.integers[2:4])
    height = _altitude_mm(seen, plant.fix[2])
    north, east = plant.fix[3], plant.fix[4]
    payload.integers[4] = height
    payload.shorts[10], payload.shorts[11] = 70, 110
    payload.shorts[12] = _fitted(math.hypot(north, east) * 100, _ZERO, _USHORT_MAX)
    payload.shorts[13] = _centidegrees(math.atan2(east, north))
    payload.octets[28], payload.octets[29] = 3, 10
    for i in range(4):  # from here on no field lies at a multiple of its size
        payload.octets[30 + i] = height >> 8 * i & 0xFF
    payload.octets[34], payload.octets[35] = 900 & 0xFF, 900 >> 8
    payload.octets[38], payload.octets[39] = 1780 & 0xFF, 1780 >> 8
    payload.octets[42], payload.octets[43] = 400 & 0xFF, 400 >> 8


@kernel
def put_status(plant: Any, seen: Any, payload: Any) -> None:
    cells, capacity, at_boot, resistance = (
        seen.battery[0],
        seen.battery[1],
        seen.battery[2],
        seen.battery[3],
    )
    left = at_boot - plant.rotor[CHARGE] / capacity
    remaining = max(left, 0.0)
    current = seen.battery[4] * (plant.rotor[THRUST] / seen.battery[5]) ** 1.5
    voltage = max(cells * (3.5 + 0.7 * left) - resistance * current, 0.0)
    for i in range(3):
        payload.words[i] = seen.sensors[i]
    for i in range(3, 11):
        payload.words[i] = 0
    payload.shorts[6] = 80
    payload.shorts[7] = _fitted(voltage * 1e3, _ZERO, _USHORT_MAX)
    payload.shorts[8] = _fitted_short(current * 100)
    payload.octets[30] = _fitted(remaining * 100, -_BYTE_MAX - 1, _BYTE_MAX) & 0xFF
    payload.octets[39] = 1


@kernel
def put_truth(plant: Any, seen: Any, payload: Any) -> None:
    body = plant.body
    _put_floats(body[0:7], payload.floats[2:9])
    _put_place(seen, body[10], body[11], payload.integers[9:11])
    payload.integers[11] = _altitude_mm(seen, body[12])
    for i in range(3):
        payload.shorts[24 + i] = _fitted_short(body[7 + i] * 100)
        payload.shorts[29 + i] = _fitted_short(plant.rotor[3 + i] / GRAVITY_MPS2 * 1e3)
    airspeed = _fitted(math.hypot(body[7], body[8]) * 100, _ZERO, _USHORT_MAX)
    payload.shorts[27] = payload.shorts[28] = airspeed
