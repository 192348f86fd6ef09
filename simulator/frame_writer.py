"""The six messages that are four fifths of the traffic, written by compiled code.

Each is laid out here byte for byte, apart from `simulator.telemetry`, which says the same slowly
and readably: a test holds every byte of the one against the other. Knows no rates and no links.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from simulator.geodesy import EARTH_RADIUS_M
from simulator.position_loop import GRAVITY_MPS2
from simulator.sensors import REPORT_WIDTH

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]

KINDS = (
    "ATTITUDE",
    "ATTITUDE_QUATERNION",
    "LOCAL_POSITION_NED",
    "ODOMETRY",
    "GLOBAL_POSITION_INT",
    "HIGHRES_IMU",
)
FRAME_MAX = 12 + 233  # header, checksum, ODOMETRY
PAYLOAD_MAX = 256

# What the writer reads of the vehicle: its estimate (`simulator.sensors`), the true attitude,
# height and acceleration, and what is fixed: origin, degrees east per metre, home.
TRUE_ATTITUDE = REPORT_WIDTH  # and the next three
TRUE_DOWN = REPORT_WIDTH + 4
TRUE_ACCELERATION = REPORT_WIDTH + 5  # and the next two
ORIGIN = slice(REPORT_WIDTH + 8, REPORT_WIDTH + 11)
EAST_DEGREES_PER_M = REPORT_WIDTH + 11
HOME_DOWN = REPORT_WIDTH + 12
SEEN_WIDTH = REPORT_WIDTH + 13

_IDS = np.array([30, 31, 32, 331, 33, 105], dtype=np.int64)
_EXTRAS = np.array([39, 246, 185, 91, 104, 93], dtype=np.int64)
_SIZES = np.array([28, 48, 28, 233, 28, 63], dtype=np.int64)
_DEGREES_PER_M = math.degrees(1.0 / EARTH_RADIUS_M)
_NAN_WORD = np.uint32(0x7FC00000)
_ONE_DEGREE = 180.0 / math.pi
_LIMIT_16, _LIMIT_32 = np.int64(1 << 15), np.int64(1 << 31)


def _checksum_table() -> NDArray[np.uint16]:
    """X.25: reflected polynomial 0x1021, a byte at a time."""
    table = np.arange(256, dtype=np.uint16)
    for _ in range(8):
        table = np.where(table & 1, table >> 1 ^ 0x8408, table >> 1).astype(np.uint16)
    return table


_CHECKSUM = _checksum_table()


@numba.njit(cache=True)
def _fitted(value: float, limit: np.int64) -> int:
    """Nearest integer that a signed field of -limit .. limit - 1 holds; 0 if not finite."""
    if value - value != 0.0:
        return 0
    if value >= limit:
        return int(limit) - 1
    return max(-int(limit), int(np.rint(value)))


@numba.njit(cache=True)
def _yaw(seen: Array) -> float:
    w, x, y, z = seen[6], seen[7], seen[8], seen[9]
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


@numba.njit(cache=True)
def _put_floats(seen: Array, out: NDArray[np.float32]) -> None:
    for i in range(seen.shape[0]):
        out[i] = np.float32(seen[i])


@numba.njit(cache=True)
def _put_attitude(seen: Array, floats: NDArray[np.float32]) -> None:
    w, x, y, z = seen[6], seen[7], seen[8], seen[9]
    floats[1] = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    floats[2] = math.asin(min(1.0, max(-1.0, 2.0 * (w * y - z * x))))
    floats[3] = _yaw(seen)
    _put_floats(seen[10:13], floats[4:7])


@numba.njit(cache=True)
def _put_odometry(
    seen: Array, resets: int, floats: NDArray[np.float32], words: NDArray[np.uint32], octets: Bytes
) -> None:
    _put_floats(seen[0:3], floats[2:5])
    _put_floats(seen[6:10], floats[5:9])
    _put_floats(seen[3:6], floats[9:12])
    _put_floats(seen[10:13], floats[12:15])
    for i in range(15, 57):
        words[i] = _NAN_WORD
    octets[228] = 1  # MAV_FRAME_LOCAL_NED, velocities too
    octets[229] = 1
    octets[230] = resets
    octets[231] = 8  # MAV_ESTIMATOR_TYPE_AUTOPILOT
    octets[232] = 0


@numba.njit(cache=True)
def _put_global_position(
    seen: Array, integers: NDArray[np.int32], shorts: NDArray[np.int16]
) -> None:
    latitude, longitude, altitude = seen[21], seen[22], seen[23]
    integers[1] = _fitted((latitude + seen[0] * _DEGREES_PER_M) * 1e7, _LIMIT_32)
    integers[2] = _fitted((longitude + seen[1] * seen[24]) * 1e7, _LIMIT_32)
    integers[3] = _fitted((altitude - seen[2]) * 1e3, _LIMIT_32)
    integers[4] = _fitted((seen[25] - seen[2]) * 1e3, _LIMIT_32)
    for i in range(3):
        shorts[10 + i] = _fitted(seen[3 + i] * 100, _LIMIT_16)
    heading = int(np.rint(_yaw(seen) * _ONE_DEGREE * 100)) % 36000
    shorts[13] = np.int16(heading if heading < 32768 else heading - 65536)


@numba.njit(cache=True)
def _put_imu(seen: Array, floats: NDArray[np.float32], octets: Bytes) -> None:
    w, x, y, z = seen[13], seen[14], seen[15], seen[16]
    north, east, down = seen[18], seen[19], seen[20] - GRAVITY_MPS2
    a, b, c = y * down - z * east, z * north - x * down, x * east - y * north
    a, b, c = a - w * north, b - w * east, c - w * down
    floats[2] = north + 2.0 * (y * c - z * b)
    floats[3] = east + 2.0 * (z * a - x * c)
    floats[4] = down + 2.0 * (x * b - y * a)
    _put_floats(seen[10:13], floats[5:8])
    floats[8], floats[9], floats[10] = 0.21, 0.0, 0.43
    height = seen[23] - seen[17]
    floats[11] = 1013.25 * (1.0 - 2.25577e-5 * height) ** 5.25588
    floats[12] = 0.0
    floats[13] = height
    floats[14] = 15.0
    octets[60] = 0xFF
    octets[61] = 0x1B
    octets[62] = 0


@numba.njit(cache=True)
def write_frame(
    kind: int,
    seen: Array,
    time_us: int,
    resets: int,
    system: int,
    sequence: int,
    payload: Bytes,
    out: Bytes,
    at: int,
) -> int:
    """Write the frame of message KINDS[kind] into `out` from `at`; the place behind it.

    `seen` (SEEN_WIDTH,), `payload` (PAYLOAD_MAX,) scratch; autopilot's component id 1.
    """
    words, floats = payload.view(np.uint32), payload.view(np.float32)
    if kind == 3 or kind == 5:
        words[0], words[1] = time_us & 0xFFFFFFFF, time_us >> 32
    else:
        words[0] = time_us // 1000 & 0xFFFFFFFF
    if kind == 0:
        _put_attitude(seen, floats)
    elif kind == 1:
        _put_floats(seen[6:13], floats[1:8])
        for i in range(8, 12):
            words[i] = 0
    elif kind == 2:
        _put_floats(seen[0:6], floats[1:7])
    elif kind == 3:
        _put_odometry(seen, resets, floats, words, payload)
    elif kind == 4:
        _put_global_position(seen, payload.view(np.int32), payload.view(np.int16))
    else:
        _put_imu(seen, floats, payload)
    size = _SIZES[kind]
    while size > 1 and payload[size - 1] == 0:
        size -= 1
    out[at] = 0xFD
    out[at + 1] = size
    out[at + 2] = out[at + 3] = 0
    out[at + 4] = sequence
    out[at + 5] = system
    out[at + 6] = 1
    out[at + 7] = _IDS[kind] & 0xFF
    out[at + 8] = _IDS[kind] >> 8
    out[at + 9] = 0
    for i in range(size):
        out[at + 10 + i] = payload[i]
    end = at + 10 + size
    crc = np.uint32(0xFFFF)
    for i in range(at + 1, end):
        crc = crc >> np.uint32(8) ^ np.uint32(_CHECKSUM[(crc ^ out[i]) & np.uint32(0xFF)])
    extra = np.uint32(_EXTRAS[kind])
    crc = crc >> np.uint32(8) ^ np.uint32(_CHECKSUM[(crc ^ extra) & np.uint32(0xFF)])
    out[end] = crc & np.uint32(0xFF)
    out[end + 1] = crc >> np.uint32(8)
    behind: int = end + 2
    return behind
