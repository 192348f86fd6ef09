"""Link: the byte channel to the vehicle, as the loop sees it. `connection.open_link` opens one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable
from dataclasses import dataclass

NAMED_MAX = 8  # addresses that are counted separately; the rest are OTHERS
OTHERS = "other addresses"


@dataclass(frozen=True, slots=True)
class Chunk:
    """Received bytes: a datagram, or any portion of a stream.

    `arrived_s` is host time (`clock.monotonic_s`). For a datagram it is the kernel's time stamp.
    For a stream it is the moment when `wait` returned because of the bytes; if they arrived
    while nothing waited, it is the last moment at which none had arrived.
    """

    data: bytes
    peer: Hashable
    arrived_s: float


def peer_name(peer: Hashable) -> str:
    """An address as the user writes it: 127.0.0.1:14540 or [::1]:14540."""
    if not isinstance(peer, tuple):
        return str(peer)
    host, port = peer[:2]
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


class LinkReport:
    """Reports of a link: counts of datagrams that addresses other than the vehicle's have sent, and
    breaks of the link. `overheard` has some of these datagrams until the loop takes them."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()
        self._news: list[str] = []
        self.overheard: list[bytes] = []

    @property
    def ignored(self) -> int:
        """Number of ignored datagrams and connections."""
        return self._counts.total()

    def count(self, peer: Hashable, number: int, noun: str = "datagram") -> None:
        """Add `number` ignored datagrams, or connections, from `peer`."""
        sender = peer_name(peer)
        if sender not in self._counts and len(self._counts) >= NAMED_MAX:
            sender = OTHERS
        before = self._counts[sender]
        self._counts[sender] += number
        if len(str(before + number)) > len(str(before)) or not before:
            count = f"{before + number:,} {noun}{'s' if before + number > 1 else ''}"
            verb = "were" if before + number > 1 else "was"
            self._news.append(f"{count} from {sender}, which is not the vehicle, {verb} ignored")

    def tell(self, sentence: str) -> None:
        """Add another sentence for the user about the link."""
        self._news.append(sentence)

    def news(self) -> list[str]:
        """New sentences since the last call. Ignored datagrams of a sender are reported on the 1st,
        10th, 100th ... datagram."""
        news, self._news = self._news, []
        return news


class Link:
    """Non-blocking byte channel. `is_stream`: whether a received chunk may end within a frame.
    `capacity_bytes_ps`: capacity of each direction in bytes per second; None: unknown. `opened`: a
    counter that changes whenever the descriptors change. `listens`: whether the first of
    `descriptors` is a listening socket, which also hears others."""

    is_stream = listens = False
    opened = 0
    capacity_bytes_ps: float | None = None

    def __init__(self) -> None:
        self.report = LinkReport()

    def wait(self, timeout_s: float) -> None:
        """Wait at most `timeout_s` until something has arrived. Reads nothing."""

    def receive(self) -> list[Chunk]:
        """The chunks that have arrived, oldest first and limited in number. Never waits."""
        raise NotImplementedError

    def send(self, data: bytes, peer: Hashable | None) -> None:
        """Send one frame to `peer` (UDP) or to the other end (streams). Never waits: a frame that
        does not fit into the buffer is dropped (UDP) or queued (streams)."""
        raise NotImplementedError

    def follow(self, peer: Hashable) -> None:
        """Use `peer` as the vehicle's address. Other senders cannot displace its bytes any more."""

    def descriptors(self) -> tuple[int, ...]:
        """The open file descriptors. With them another process can continue the link."""
        return ()

    def close(self) -> None:
        """Close all descriptors."""
