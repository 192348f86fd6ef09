"""Send queue of one link: messages are framed, numbered and joined to datagrams.

Knows the view that fills messages, the link's sequence numbers and STATUSTEXTs, and when a ground
station was last heard on this link; knows no client and no rate.
"""

from __future__ import annotations

import math
from collections import Counter, deque

from simulator.autopilot.values import StatusText
from simulator.mavlink.codec import Encoder, Keyring
from simulator.mavlink.view import View

MAV_COMP_ID_AUTOPILOT = 1
DATAGRAM_MAX = 1400
HELD_US = 5_000_000  # age up to which a STATUSTEXT waits for a ground station
FORWARDED_KEPT = 64  # newest forwarded frames; a received one that is among them has come back
TEXT_LENGTH = 50  # STATUSTEXT.text


class Outbox:
    """Send queue. STATUSTEXTs are divided into chunks; in PX4 they wait for a ground station.

    `keyring` is the vehicle's; `link` is the link id in signatures; `connected`: whether any
    message was received on the link.
    """

    def __init__(self, view: View, keyring: Keyring, link: int) -> None:
        self.view, self.connected = view, False
        self._frames: list[bytes] = []
        self.forwarded: deque[bytes] = deque(maxlen=FORWARDED_KEPT)
        self._suppressed: Counter[str] = Counter()
        self._keyring, self._link = keyring, link
        self.restart()

    def restart(self) -> None:
        """Reset as after boot: frames are numbered from 0. Texts already sent are not repeated."""
        self._encoder = Encoder(self.view.system, MAV_COMP_ID_AUTOPILOT, self._keyring, self._link)
        self._ground_station_us = -math.inf  # time of its last heartbeat
        self._held: list[tuple[int, StatusText]] = []
        self._text_number = 0

    def send(self, name: str, *values: object) -> None:
        """Queue one message; `values` are in the field order of the XML."""
        self._frames.append(self._encoder.frame(name, values))

    def send_now(self, name: str) -> None:
        """Queue a message with its present content from the view, unless a fault stops it."""
        if name not in self.view.silent or self._passes(name):
            self._frames.append(self._encoder.frame(name, self.view.fields(name)))

    def forward(self, frame: bytes) -> None:
        """Queue a frame of another sender."""
        self.forwarded.append(frame)
        self._frames.append(frame)

    def _passes(self, name: str) -> bool:
        """Whether a message that a fault stops is sent this time."""
        every = self.view.silent[name]
        self._suppressed[name] += 1
        return every > 0 and self._suppressed[name] % every == 0

    def drain(self) -> list[bytes]:
        """Empty the queue and return it as datagrams of whole frames, each of at most DATAGRAM_MAX
        bytes."""
        datagrams: list[bytes] = []
        waiting: list[bytes] = []
        size = 0
        for frame in self._frames:
            if size + len(frame) > DATAGRAM_MAX:
                datagrams.append(b"".join(waiting))
                waiting, size = [], 0
            waiting.append(frame)
            size += len(frame)
        self._frames.clear()
        return [*datagrams, b"".join(waiting)] if waiting else datagrams

    # -- texts ---------------------------------------------------------------------------------

    def send_text(self, text: StatusText) -> None:
        """Queue a text, or hold it back until a ground station is connected (PX4)."""
        firmware = self.view.autopilot.firmware
        if firmware.text_to_ground_stations_only and not self._has_ground_station:
            self._held.append((self._now_us, text))
            return
        if not self.connected:
            return
        encoded = (text.text + firmware.text_suffix).encode("ascii", "replace")
        for chunk, at in enumerate(range(0, len(encoded), TEXT_LENGTH)):
            piece = encoded[at : at + TEXT_LENGTH]
            self.send("STATUSTEXT", int(text.severity), piece, self._text_number, chunk)
        self._text_number = (self._text_number + 1) & 0xFFFF

    def note_ground_station(self) -> None:
        """Note a heartbeat of a ground station; send the texts held back for at most HELD_US."""
        self._ground_station_us = self._now_us
        held, self._held = self._held, []
        for at_us, text in held:
            if self._now_us - at_us < HELD_US:
                self.send_text(text)

    @property
    def _has_ground_station(self) -> bool:
        stays_us = self.view.autopilot.parameters.role("ground_station_stays_s") * 1e6
        return self._now_us - self._ground_station_us <= stays_us

    @property
    def _now_us(self) -> int:
        return self.view.autopilot.state.time_us
