"""Send queue of one link: messages framed, numbered and joined to datagrams.

Knows the view that fills messages and the link's sequence numbers; knows no client and no rate.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

from simulator.mavlink.codec import SIGNED, frame, layout
from simulator.mavlink.signing import SIGNATURE_LENGTH, Keyring
from simulator.mavlink.view import View

MAV_COMP_ID_AUTOPILOT = 1
DATAGRAM_MAX = 1400


@dataclass(slots=True)
class Outbox:
    """Send queue. `sequence`: number of the next frame, 0 .. 255. With a key of `keyring` frames
    are signed; `link` is the number of the link in the signature."""

    view: View
    keyring: Keyring
    link: int
    sequence: int = 0
    _frames: list[bytes] = field(default_factory=list)
    _suppressed: Counter[str] = field(default_factory=Counter)

    def send(self, name: str, *values: object) -> None:
        """Queue one message; `values` in the field order of the XML."""
        self._frame(name, layout(name).pack(values))

    def send_now(self, name: str) -> None:
        """Queue a message with its contents of now, filled by the view, unless a fault stops it."""
        if name not in self.view.silent or self._passes(name):
            self._frame(name, self.view.payload(name))

    def forward(self, frame: bytes) -> None:
        """Queue a frame of another sender."""
        self._frames.append(frame)

    def _passes(self, name: str) -> bool:
        """Whether a message that a fault stops is one of those that are still sent."""
        every = self.view.silent[name]
        self._suppressed[name] += 1
        return every > 0 and self._suppressed[name] % every == 0

    def _frame(self, name: str, payload: bytes) -> None:
        numbers = (self.sequence, self.view.system, MAV_COMP_ID_AUTOPILOT)
        if self.keyring.on:
            flagged = frame(*numbers, layout(name), payload, flags=SIGNED)
            self._frames.append(self.keyring.seal(flagged, self.link))
        else:
            self._frames.append(frame(*numbers, layout(name), payload))
        self.sequence = (self.sequence + 1) & 0xFF

    def drain(self) -> list[bytes]:
        """Remove everything queued, as datagrams of whole frames."""
        if not self._frames:
            return []
        together = self._frames[0] if len(self._frames) == 1 else b"".join(self._frames)
        self._frames.clear()
        return [together] if len(together) <= DATAGRAM_MAX else _datagrams(together)


def _datagrams(frames: bytes) -> list[bytes]:
    """Frames, cut between frames into datagrams of at most DATAGRAM_MAX bytes."""
    datagrams: list[bytes] = []
    begin = at = 0
    while at < len(frames):
        signature = SIGNATURE_LENGTH if frames[at + 2] & SIGNED else 0
        length = 12 + frames[at + 1] + signature
        if at + length - begin > DATAGRAM_MAX:
            datagrams.append(frames[begin:at])
            begin = at
        at += length
    return [*datagrams, frames[begin:]]
