"""The texts of one link: STATUSTEXT in chunks, and those that wait for a ground station.

Knows when a ground station was last heard here; what is said is for others to decide.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from simulator.firmware.values import StatusText
from simulator.mavlink.outbox import Outbox

KEPT_US = 5_000_000
LENGTH = 50  # STATUSTEXT.text


@dataclass(slots=True)
class Texts:
    """`heard`: there is somebody on the link at all."""

    outbox: Outbox
    heard: bool = False
    _ground_station_us: float = -math.inf  # last heard
    _kept: list[tuple[int, StatusText]] = field(default_factory=list)
    _number: int = 0

    def restart(self) -> None:
        """As after boot: what was said is said."""
        self._ground_station_us, self._kept, self._number = -math.inf, [], 0

    def say(self, said: StatusText) -> None:
        """Queue a text, if this link gets any."""
        firmware = self.outbox.view.autopilot.firmware
        if firmware.link.text_to_ground_stations_only and not self._ground_station_is_there:
            self._kept.append((self._now_us, said))
            return
        if not self.heard:
            return
        text = (said.text + firmware.link.text_suffix).encode("ascii", "replace")
        for chunk, at in enumerate(range(0, len(text), LENGTH)):
            piece = text[at : at + LENGTH]
            self.outbox.send("STATUSTEXT", int(said.severity), piece, self._number, chunk)
        self._number = (self._number + 1) & 0xFFFF

    def hear_ground_station(self) -> None:
        """Texts wait for one, but not for long."""
        self._ground_station_us = self._now_us
        kept, self._kept = self._kept, []
        for at_us, said in kept:
            if self._now_us - at_us < KEPT_US:
                self.say(said)

    @property
    def _ground_station_is_there(self) -> bool:
        stays_us = self.outbox.view.autopilot.firmware.link.ground_station_stays_s * 1e6
        return self._now_us - self._ground_station_us <= stays_us

    @property
    def _now_us(self) -> int:
        return self.outbox.view.autopilot.senses.time_us
