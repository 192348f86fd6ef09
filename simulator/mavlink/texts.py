"""STATUSTEXTs of one link: cut into chunks, and held back until a ground station is there.

Knows when a ground station was last heard on this link; the texts come from the autopilot.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from simulator.firmware.values import StatusText
from simulator.mavlink.outbox import Outbox

HELD_US = 5_000_000
LENGTH = 50  # STATUSTEXT.text


@dataclass(slots=True)
class Texts:
    """Texts of one link. `connected`: anything was received on it."""

    outbox: Outbox
    connected: bool = False
    _ground_station_us: float = -math.inf  # its last heartbeat
    _held: list[tuple[int, StatusText]] = field(default_factory=list)
    _number: int = 0

    def restart(self) -> None:
        """Reset as after boot; texts already sent are not repeated."""
        self._ground_station_us, self._held, self._number = -math.inf, [], 0

    def send(self, text: StatusText) -> None:
        """Queue a text, or hold it back until a ground station is there (PX4)."""
        link = self.outbox.view.autopilot.firmware.link
        if link.text_to_ground_stations_only and not self._has_ground_station:
            self._held.append((self._now_us, text))
            return
        if not self.connected:
            return
        encoded = (text.text + link.text_suffix).encode("ascii", "replace")
        for chunk, at in enumerate(range(0, len(encoded), LENGTH)):
            piece = encoded[at : at + LENGTH]
            self.outbox.send("STATUSTEXT", int(text.severity), piece, self._number, chunk)
        self._number = (self._number + 1) & 0xFFFF

    def note_ground_station(self) -> None:
        """A ground station sent a heartbeat: send the texts held back for at most HELD_US."""
        self._ground_station_us = self._now_us
        held, self._held = self._held, []
        for at_us, text in held:
            if self._now_us - at_us < HELD_US:
                self.send(text)

    @property
    def _has_ground_station(self) -> bool:
        stays_us = self.outbox.view.autopilot.firmware.link.ground_station_stays_s * 1e6
        return self._now_us - self._ground_station_us <= stays_us

    @property
    def _now_us(self) -> int:
        return self.outbox.view.autopilot.state.time_us
