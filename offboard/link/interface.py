"""Link: the byte channel to the vehicle, as the loop sees it. `connection.open_link` opens one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable
from dataclasses import dataclass

NAMED_MAX = 8  # addresses that are counted one by one
OTHERS = "other addresses"


@dataclass(frozen=True, slots=True)
class Chunk:
    """Received bytes: a datagram, or any portion of a stream.

    `arrived_s` is on the clock of `clock.monotonic_s`: the kernel's stamp of a datagram; for a
    stream the end of the waiting for it, or if it was not awaited the last time when nothing had
    arrived.
    """

    data: bytes
    peer: Hashable
    arrived_s: float


def peer_name(peer: Hashable) -> str:
    """An address as the user writes it, 127.0.0.1:14540 or [::1]:14540."""
    if not isinstance(peer, tuple):
        return str(peer)
    host, port = peer[:2]
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


class LinkReport:
    """What a link tells: what other addresses than the vehicle's send, counted, and breaks.
    `overheard`: some of these datagrams, until the loop has taken them."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()
        self._news: list[str] = []
        self.overheard: list[bytes] = []

    @property
    def ignored(self) -> int:
        """Datagrams and connections of others."""
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
        """Something else that the user should know of the link."""
        self._news.append(sentence)

    def news(self) -> list[str]:
        """Sentences since the last call, on the 1st, 10th, 100th ... datagram of a sender."""
        news, self._news = self._news, []
        return news


class Link:
    """Non-blocking byte channel. `is_stream`: received chunks may end within a frame.
    `capacity_bytes_ps` of each direction; None: unknown. `opened` changes when the descriptors
    do."""

    is_stream = False
    opened = 0
    capacity_bytes_ps: float | None = None

    def __init__(self) -> None:
        self.report = LinkReport()

    def wait(self, timeout_s: float) -> None:
        """Wait at most `timeout_s` until something has arrived. Reads nothing."""

    def receive(self) -> list[Chunk]:
        """What has arrived, oldest first and bounded. Never waits."""
        raise NotImplementedError

    def send(self, data: bytes, peer: Hashable | None) -> None:
        """Send one frame to `peer` (UDP) or to the other end. Never waits: a frame that does not
        fit into the buffer is dropped (UDP) or queued (streams)."""
        raise NotImplementedError

    def follow(self, peer: Hashable) -> None:
        """The vehicle sends from `peer`: from now on other senders cannot displace it."""

    def descriptors(self) -> tuple[int, ...]:
        """The open file descriptors, with which another process can continue the link."""
        return ()

    @property
    def listens(self) -> bool:
        """Whether the first of these listens for others than the vehicle."""
        return False

    def close(self) -> None:
        """Close all of them."""
