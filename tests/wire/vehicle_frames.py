"""Frames of an autopilot, encoded by pymavlink as an independent encoder."""

from __future__ import annotations

import lzma
import struct
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from offboard.mavlink.session import Session, SessionSettings

RECORDINGS = Path(__file__).parent / "recordings"
PX4_RECORDING = RECORDINGS / "px4-1.16.1-offboard.tlog"
ARDUCOPTER_RECORDING = RECORDINGS / "arducopter-4.6.3-guided.tlog"
PX4, ARDUPILOT = mavlink.MAV_AUTOPILOT_PX4, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA
PEER = ("127.0.0.1", 14580)
OFFBOARD = 0x00060000


class Sender:
    """One component on the network, with its own sequence numbers. With a `key` pymavlink signs
    its frames, from time stamp `stamp` on."""

    def __init__(
        self, system_id: int = 1, component_id: int = 1, key: bytes = b"", stamp: int = 0
    ) -> None:
        self.ids = system_id, component_id
        self.codec = mavlink.MAVLink(None, srcSystem=system_id, srcComponent=component_id)
        self.codec.robust_parsing = True
        self.codec.signing.secret_key = key or None
        self.codec.signing.sign_outgoing = bool(key)
        self.codec.signing.timestamp = stamp

    def frame(self, message: Any, mavlink1: bool = False) -> bytes:
        packed: bytes = message.pack(self.codec, force_mavlink1=mavlink1)
        self.codec.seq = (self.codec.seq + 1) % 256
        return packed

    def heartbeat(
        self, autopilot: int = PX4, custom_mode: int = OFFBOARD, vehicle_type: int = 2
    ) -> bytes:
        return self.frame(
            mavlink.MAVLink_heartbeat_message(vehicle_type, autopilot, 1, custom_mode, 3, 3)
        )

    def position(self, time_boot_ms: int, *state: float) -> bytes:
        values = state or (1.0, 2.0, -3.0, 0.1, 0.2, -0.3)
        return self.frame(mavlink.MAVLink_local_position_ned_message(time_boot_ms, *values))

    def attitude(self, time_boot_ms: int, *state: float) -> bytes:
        values = state or (1.0, 0.0, 0.0, 0.0, 0.01, 0.02, 0.03)
        return self.frame(mavlink.MAVLink_attitude_quaternion_message(time_boot_ms, *values))

    def ack(self, command: int, result: int, system_id: int = 1, component_id: int = 191) -> bytes:
        return self.frame(
            mavlink.MAVLink_command_ack_message(command, result, 0, 0, system_id, component_id)
        )

    def text(self, data: bytes, text_id: int = 0, chunk: int = 0) -> bytes:
        return self.frame(mavlink.MAVLink_statustext_message(2, data, text_id, chunk))


def framed(message_id: int, payload: bytes, *, version_1: bool = False) -> bytes:
    """A frame of system 1, component 1 with any payload and a valid checksum."""
    ids = struct.pack("<BBBH", 7, 1, 1, message_id & 0xFFFF)
    body = bytes((len(payload), 0, 0)) + ids + bytes((message_id >> 16,)) + payload
    if version_1:
        body = bytes((len(payload),)) + ids[:4] + payload
    crc = mavlink.x25crc(body)
    crc.accumulate(bytes((mavlink.mavlink_map[message_id].crc_extra,)))
    return (b"\xfe" if version_1 else b"\xfd") + body + struct.pack("<H", crc.crc)


def pinned(vehicle: Sender, autopilot: int = PX4, **settings: Any) -> Session:
    """Return a session that has received the first HEARTBEAT of `vehicle`."""
    session = Session(SessionSettings(**settings))
    reception = session.receive(vehicle.heartbeat(autopilot), PEER, 0.0)
    assert len(reception.events) == 2
    session.poll(0.0)
    return session


def understood(frame: bytes) -> Any:
    """Return one of our frames decoded by pymavlink, as an autopilot would decode it."""
    return mavlink.MAVLink(None).decode(bytearray(frame))


def recorded(path: Path) -> list[tuple[float, bytes, Any]]:
    """Entries of a .tlog or .tlog.xz: host seconds since the first, frame, message by pymavlink."""
    data, frames, at = path.read_bytes(), [], 0
    if path.suffix == ".xz":
        data = lzma.decompress(data)
    parser = mavlink.MAVLink(None)
    parser.robust_parsing = True
    first_us = struct.unpack_from(">Q", data)[0]
    while at < len(data):
        (stamp_us,) = struct.unpack_from(">Q", data, at)
        frame = data[at + 8 : at + 20 + data[at + 9]]
        frames.append(((stamp_us - first_us) * 1e-6, frame, parser.parse_char(frame)))
        at += 8 + len(frame)
    return frames
