"""MAVLink frames in bytes: where they begin and end, and a log of them (.tlog). Knows no message.

A record of the log is a big-endian uint64, Unix time in microseconds with the low two bits zero,
and then the frame.
"""

from __future__ import annotations

import struct
from pathlib import Path

MAGIC_V1, MAGIC_V2 = 0xFE, 0xFD
SIGNED = 0x01  # incompatibility flag: a signature follows
SIGNATURE_LENGTH = 13
_STAMP = struct.Struct(">Q")
_NO_FRAME, _SETUP_SIGNING = -1, 256  # ids that are not recorded: SETUP_SIGNING contains the key


def frame_length(data: bytes | bytearray, at: int) -> int:
    """Return the length of the frame that begins at `at`, even if `data` ends before; 0 if no frame
    begins there, and -1 if the length is not yet known."""
    if data[at] not in (MAGIC_V1, MAGIC_V2):
        return 0
    if len(data) - at < 3:
        return -1
    if data[at] == MAGIC_V1:
        return 8 + data[at + 1]
    return 12 + data[at + 1] + (SIGNATURE_LENGTH if data[at + 2] & SIGNED else 0)


def frames(datagram: bytes) -> list[tuple[int, bytes]]:
    """Return (message id, frame) of each MAVLink 2 frame; from the first other byte on, the rest is
    one piece with id -1."""
    found: list[tuple[int, bytes]] = []
    at = 0
    while at < len(datagram):
        if datagram[at] != MAGIC_V2 or len(datagram) - at < 12:
            found.append((_NO_FRAME, datagram[at:]))
            break
        size = frame_length(datagram, at)
        message_id = int.from_bytes(datagram[at + 7 : at + 10], "little")
        found.append((message_id, datagram[at : at + size]))
        at += size
    return found


def whole_frames(data: bytes | bytearray) -> int:
    """Return the number of bytes before the first incomplete frame; other bytes count too."""
    at = 0
    while at < len(data):
        length = frame_length(data, at)
        if length < 0 or at + length > len(data):
            return at
        at += length or 1
    return at


class Recorder:
    """Writes a new .tlog without buffering, so that nothing is lost if the process is killed."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("xb", buffering=0)

    def write(self, unix_us: int, datagrams: list[bytes]) -> None:
        """Append the MAVLink 2 frames of sent or received datagrams. Write errors are ignored."""
        stamp = _STAMP.pack(unix_us & ~3)
        records = [
            stamp + frame
            for datagram in datagrams
            for message_id, frame in frames(datagram)
            if message_id not in (_NO_FRAME, _SETUP_SIGNING)
        ]
        if not records:
            return
        try:
            self._file.write(b"".join(records))
        except OSError:
            return
