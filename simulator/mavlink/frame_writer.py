"""Frames of the messages that are nearly all of the traffic, written by compiled code.

Header, stamp, payload (`simulator.mavlink.payloads`) and checksum, in the bytes that
`simulator.mavlink.codec` gives to the same. Knows no rates and no links.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.model.kernel import kernel
from simulator.mavlink.payloads import (
    put_altitude,
    put_attitude,
    put_attitude_quaternion,
    put_attitude_target,
    put_extended_state,
    put_global_position,
    put_gps,
    put_hud,
    put_imu,
    put_local_position,
    put_odometry,
    put_position_target,
    put_status,
    put_timesync,
    put_truth,
)

# Message, its id, CRC extra and length; what stamp it begins with
_NONE, _MILLISECONDS, _MICROSECONDS = range(3)
_TABLE = (
    ("ATTITUDE", 30, 39, 28, _MILLISECONDS),
    ("ATTITUDE_QUATERNION", 31, 246, 48, _MILLISECONDS),
    ("LOCAL_POSITION_NED", 32, 185, 28, _MILLISECONDS),
    ("ODOMETRY", 331, 91, 233, _MICROSECONDS),
    ("GLOBAL_POSITION_INT", 33, 104, 28, _MILLISECONDS),
    ("HIGHRES_IMU", 105, 93, 63, _MICROSECONDS),
    ("ALTITUDE", 141, 47, 32, _MICROSECONDS),
    ("VFR_HUD", 74, 20, 20, _NONE),
    ("ATTITUDE_TARGET", 83, 22, 37, _MILLISECONDS),
    ("POSITION_TARGET_LOCAL_NED", 85, 140, 51, _MILLISECONDS),
    ("GPS_RAW_INT", 24, 24, 52, _MICROSECONDS),
    ("SYS_STATUS", 1, 124, 43, _NONE),
    ("EXTENDED_SYS_STATE", 245, 130, 2, _NONE),
    ("HIL_STATE_QUATERNION", 115, 4, 64, _MICROSECONDS),
    ("TIMESYNC", 111, 34, 16, _NONE),
)
KINDS = tuple(row[0] for row in _TABLE)
_IDS, _EXTRAS, _SIZES, _STAMPS = (
    np.array(column, np.int64) for column in list(zip(*_TABLE, strict=True))[1:]
)
FRAME_MAX = 12 + max(row[3] for row in _TABLE)  # header, checksum


def _checksum_tables() -> NDArray[np.int64]:
    """X.25, reflected polynomial 0x1021: what a byte does to the checksum 0 .. 3 bytes later."""
    table = np.arange(256)
    for _ in range(8):
        table = np.where(table & 1, table >> 1 ^ 0x8408, table >> 1)
    tables = [table]
    for _ in range(3):
        tables.append(tables[-1] >> 8 ^ table[tables[-1] & 0xFF])
    return np.array(tables)


_CHECKSUM = _checksum_tables()


@kernel
def _put_fast(kind: int, plant: Any, seen: Any, payload: Any) -> None:
    """The messages of a pilot's instruments, sent many times a second."""
    if kind == 0:
        put_attitude(plant, payload)
    elif kind == 1:
        put_attitude_quaternion(plant, payload)
    elif kind == 2:
        put_local_position(plant, payload)
    elif kind == 3:
        put_odometry(plant, seen, payload)
    elif kind == 4:
        put_global_position(plant, seen, payload)
    else:
        put_imu(plant, seen, payload)


@kernel
def _put_slow(kind: int, plant: Any, seen: Any, time_us: int, payload: Any) -> None:
    if kind == 6:
        put_altitude(plant, seen, payload)
    elif kind == 7:
        put_hud(plant, seen, payload)
    elif kind == 8:
        put_attitude_target(seen, payload)
    elif kind == 9:
        put_position_target(seen, payload)
    elif kind == 10:
        put_gps(plant, seen, payload)
    elif kind == 11:
        put_status(plant, seen, payload)
    elif kind == 12:
        put_extended_state(seen, payload)
    elif kind == 13:
        put_truth(plant, seen, payload)
    else:
        put_timesync(time_us, payload)


@kernel
def write_frame(
    kind: int,
    plant: Any,
    seen: Any,
    time_us: int,
    sequence: int,
    payload: Any,
    out: Any,
    at: int,
) -> int:
    """Write the frame of message KINDS[kind] into `out` from `at`; the place behind it.

    `plant`, `seen` and `payload`: records. Component id 1, the autopilot's.
    """
    if _STAMPS[kind] == _MICROSECONDS:
        payload.words[0], payload.words[1] = time_us & 0xFFFFFFFF, time_us >> 32
    elif _STAMPS[kind] == _MILLISECONDS:
        payload.words[0] = time_us // 1000 & 0xFFFFFFFF
    if kind < 6:
        _put_fast(kind, plant, seen, payload)
    else:
        _put_slow(kind, plant, seen, time_us, payload)
    size = _SIZES[kind]
    while size > 1 and payload.octets[size - 1] == 0:
        size -= 1
    out[at] = 0xFD
    out[at + 1] = size
    out[at + 2] = out[at + 3] = 0
    out[at + 4] = sequence
    out[at + 5] = seen.system
    out[at + 6] = 1
    out[at + 7] = _IDS[kind] & 0xFF
    out[at + 8] = _IDS[kind] >> 8
    out[at + 9] = 0
    end = at + 10 + size
    for i in range(size):
        out[at + 10 + i] = payload.octets[i]
    crc = _checksum(out, at + 1, end, _EXTRAS[kind])
    out[end] = crc & 0xFF
    out[end + 1] = crc >> 8
    behind: int = end + 2
    return behind


@kernel
def _checksum(octets: Any, begin: int, end: int, extra: int) -> int:
    """CRC-16/MCRF4XX of these octets and the message's extra one, four at a time."""
    crc: Any = np.int64(0xFFFF)
    at = begin
    while at + 4 <= end:
        crc = (
            _CHECKSUM[3, (crc ^ octets[at]) & 0xFF]
            ^ _CHECKSUM[2, (crc >> 8 ^ octets[at + 1]) & 0xFF]
            ^ _CHECKSUM[1, octets[at + 2]]
            ^ _CHECKSUM[0, octets[at + 3]]
        )
        at += 4
    for i in range(at, end):
        crc = crc >> 8 ^ _CHECKSUM[0, (crc ^ octets[i]) & 0xFF]
    whole: int = crc >> 8 ^ _CHECKSUM[0, (crc ^ extra) & 0xFF]
    return whole
