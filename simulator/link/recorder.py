"""Telemetry log (.tlog) of a link: every frame with its time. Knows framing and no message.

A record is a big-endian uint64 of Unix microseconds, low two bits zero, then the frame unchanged.
"""

from __future__ import annotations

import struct
from pathlib import Path

from simulator.link.impairment import frames

_STAMP = struct.Struct(">Q")
_NO_FRAME, _SETUP_SIGNING = -1, 256  # which holds the key


class Recorder:
    """Writes a new file without buffering, so that a killed process loses nothing."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("xb", buffering=0)

    def write(self, unix_us: int, datagrams: list[bytes]) -> None:
        """Append the MAVLink 2 frames of datagrams, sent or received. A full disk is ignored."""
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
