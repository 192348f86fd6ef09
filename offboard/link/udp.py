"""UDP links. Once the vehicle is known, a second socket on the same local port is connected to it,
and only receives.

Linux lets two sockets share a port with SO_REUSEADDR, macOS with SO_REUSEPORT. The option is
cleared afterwards, so that no other program can share the port.
"""

from __future__ import annotations

import select
import socket
import struct
import sys
from collections import Counter
from collections.abc import Hashable
from contextlib import suppress

from offboard.link import clock
from offboard.link.interface import Chunk, Link
from offboard.mavlink.framing import TIMESYNC, frame_size
from offboard.mavlink.senders import OTHER_VEHICLE_S, PEER_SILENT_S, same_host

DATAGRAM_SIZE = 65535
BUFFER_BYTES = 1 << 20
BATCH_MAX = 512  # datagrams that one call of `receive` reads from a socket
LOOK_MAX, LOOK_EVERY_S = 64, 0.02  # datagrams of other senders that are read, and how often
BESIDE_S = 60.0  # a port heard beside the vehicle's cannot become the vehicle's for this time
_LINUX = sys.platform == "linux"
_SHARE_PORT = socket.SO_REUSEADDR if _LINUX else socket.SO_REUSEPORT
# Options that the socket module does not name: SO_TIMESTAMPNS on Linux, SO_TIMESTAMP on macOS
_STAMP_OPTION = 35 if _LINUX else 0x0400
_STAMP_KIND = 35 if _LINUX else 0x02
_STAMP = struct.Struct("@ll" if _LINUX else "@li")
_STAMP_UNIT_S = 1e-9 if _LINUX else 1e-6
_ANCILLARY_BYTES = socket.CMSG_SPACE(_STAMP.size)


def udp_socket(family: int = socket.AF_INET) -> socket.socket:
    """Create a non-blocking UDP socket with arrival time stamps."""
    sock = socket.socket(family, socket.SOCK_DGRAM)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
    with suppress(OSError):  # without stamps, the earliest possible arrival is used
        sock.setsockopt(socket.SOL_SOCKET, _STAMP_OPTION, 1)
    sock.setblocking(False)
    return sock


class _Inbox:
    """Reads datagrams from one socket."""

    def __init__(self, sock: socket.socket) -> None:
        self.socket = sock
        self._buffer = bytearray(DATAGRAM_SIZE)
        self._empty_s = clock.monotonic_s()  # datagrams that wait arrived after this

    def drain(self, most: int) -> list[Chunk]:
        """Read at most `most` waiting datagrams, in the order of their arrival."""
        read: list[tuple[bytes, Hashable, float]] = []
        offset_s = clock.monotonic_less_unix_s()
        for _ in range(most):
            now_s = clock.monotonic_s()
            try:
                size, ancillary, _, peer = self.socket.recvmsg_into(
                    [self._buffer], _ANCILLARY_BYTES
                )
            except ConnectionError:
                continue  # ICMP: the peer's port was closed when an earlier datagram reached it
            except OSError:  # no datagram is left, or the network interface is down
                self._empty_s = now_s
                break
            arrived_s = max(self._empty_s, _stamp_s(ancillary) + offset_s)
            read.append((bytes(self._buffer[:size]), peer, arrived_s))
        # if the computer's clock was set meanwhile, arrivals are still limited to the time between
        # `_empty_s` and now, and keep their order
        latest_s = clock.monotonic_s()
        chunks: list[Chunk] = []
        for data, peer, arrived_s in reversed(read):
            latest_s = min(arrived_s, latest_s)
            chunks.append(Chunk(data, peer, latest_s))
        return chunks[::-1]


def _stamp_s(ancillary: list[tuple[int, int, bytes]]) -> float:
    """Unix time of the arrival in seconds; 0 if there is no stamp."""
    for _, kind, data in ancillary:
        if kind == _STAMP_KIND and len(data) >= _STAMP.size:
            seconds, fraction = _STAMP.unpack_from(data)
            return float(seconds + fraction * _STAMP_UNIT_S)
    return 0.0


class UdpLink(Link):
    """A UDP link. The socket `listening` receives from every sender, and sends; `vehicle`, if
    given, is connected to the vehicle. Without it, `peer`, if given, is all that is heard."""

    listens = True

    def __init__(
        self,
        listening: socket.socket,
        vehicle: socket.socket | None = None,
        peer: Hashable | None = None,
    ) -> None:
        super().__init__()
        self._listening = _Inbox(listening)
        self._vehicle = _Inbox(vehicle) if vehicle else None
        self._peer: Hashable = vehicle.getpeername() if vehicle else peer
        self._heard_s = clock.monotonic_s()  # when a datagram of the vehicle was last read
        # `_beside`: ports that have sent while the vehicle did, and host times until which they are
        # other senders; `_newer`: ports heard since its last datagram
        self._beside: dict[Hashable, float] = {}
        self._newer: set[Hashable] = set()
        self._look_s = 0.0  # host time at which other senders are read next

    # --- in ---

    def wait(self, timeout_s: float) -> None:
        # datagrams of other senders must not end the wait before it is time to read them
        looks = self._vehicle is None or clock.monotonic_s() >= self._look_s
        awaited = (self._vehicle, self._listening if looks else None)
        select.select([i.socket for i in awaited if i], [], [], max(0.0, timeout_s))

    def receive(self) -> list[Chunk]:
        if self._vehicle is None:
            heard = self._listening.drain(BATCH_MAX)
            return [chunk for chunk in heard if self._peer in (None, chunk.peer)]
        chunks = self._vehicle.drain(BATCH_MAX)
        if len(chunks) < BATCH_MAX:
            chunks += self._look(bool(chunks))
        else:  # the vehicle's socket may hold more, older than what others have sent
            self._heard_s = clock.monotonic_s()
        return sorted(chunks, key=lambda chunk: chunk.arrived_s)

    def _look(self, heard: bool) -> list[Chunk]:
        """Read the listening socket. `heard`: whether the vehicle's own socket had datagrams.

        Datagrams of other senders are counted, and returned only if they may come from a new port
        of the vehicle. Those of the vehicle, too: it sent them before its socket was connected, or
        to a broadcast address.
        """
        now_s = clock.monotonic_s()
        found = self._listening.drain(LOOK_MAX) if now_s >= self._look_s else []
        ours = [chunk for chunk in found if chunk.peer == self._peer]
        others = [chunk for chunk in found if chunk.peer != self._peer]
        silent_s = now_s - self._heard_s
        if others:
            self._look_s = now_s + LOOK_EVERY_S
        moved = silent_s > OTHER_VEHICLE_S
        near = {chunk.peer for chunk in others if moved or same_host(chunk.peer, self._peer)}
        if heard or ours:
            self._heard_s = now_s
            if self._newer:
                known = {port: end_s for port, end_s in self._beside.items() if end_s > now_s}
                self._beside = known | dict.fromkeys(self._newer, now_s + BESIDE_S)
                self._newer.clear()
        elif silent_s > PEER_SILENT_S:
            near = {port for port in near if self._beside.get(port, now_s) <= now_s}
            ours = [chunk for chunk in others if chunk.peer in near]
            others = [chunk for chunk in others if chunk.peer not in near]
        self._newer |= near
        for sender, number in Counter(chunk.peer for chunk in others).items():
            self.report.count(sender, number)
        if others:
            self.report.overheard = [chunk.data for chunk in others]
        return ours

    # --- out ---

    def send(self, data: bytes, peer: Hashable | None) -> None:
        place = self._peer or peer
        if isinstance(place, tuple):
            with suppress(OSError):  # the flight notices a broken link as silence
                self._listening.socket.sendto(data, place)

    # --- the vehicle ---

    def follow(self, peer: Hashable) -> None:
        if peer == self._peer or not isinstance(peer, tuple):
            return
        before, self._vehicle = self._vehicle, None
        if before:  # the supervisor still has it, with the port
            before.socket.setsockopt(socket.SOL_SOCKET, _SHARE_PORT, 1)
            before.socket.close()
        with suppress(OSError):  # else no other sender is heard
            self._vehicle = _Inbox(_second_socket(self._listening.socket, peer))
        self._peer = peer
        self._newer.clear()
        self.opened += 1
        self._heard_s = clock.monotonic_s()

    def descriptors(self) -> tuple[int, ...]:
        return tuple(i.socket.fileno() for i in (self._listening, self._vehicle) if i)

    def close(self) -> None:
        for inbox in (self._listening, self._vehicle):
            if inbox:
                inbox.socket.close()


def _second_socket(listening: socket.socket, peer: tuple[str | int, ...]) -> socket.socket:
    """Create a socket on the port of `listening` that is connected to `peer`. Raises OSError."""
    sock = udp_socket(listening.family)
    both = (listening, sock)
    try:
        for one in both:
            one.setsockopt(socket.SOL_SOCKET, _SHARE_PORT, 1)
        sock.bind(listening.getsockname())
        sock.connect(peer)
    except OSError:
        sock.close()
        raise
    finally:
        for one in both:
            if one.fileno() >= 0:
                one.setsockopt(socket.SOL_SOCKET, _SHARE_PORT, 0)
    return sock


class LockstepLink(UdpLink):
    """UDP to a simulator in lockstep. `receive` returns all datagrams up to a barrier together, and
    each only once.

    A barrier is a TIMESYNC request at the end of a datagram. The simulator waits for the reply and
    meanwhile repeats all datagrams since the previous barrier.
    """

    def __init__(self, sock: socket.socket) -> None:
        super().__init__(sock)
        self.port: int = sock.getsockname()[1]
        self._block: list[Chunk] = []  # datagrams since the newest barrier
        self._barrier = b""
        self._simulator: Hashable | None = None  # the sender of the barriers

    def follow(self, peer: Hashable) -> None:
        """Do nothing: only our simulator sends here, and a second socket would change the order of
        its datagrams."""

    def receive(self) -> list[Chunk]:
        complete: list[Chunk] = []
        for chunk in super().receive():
            self._block.append(chunk)
            if _is_barrier(chunk.data):
                if chunk.data != self._barrier:
                    complete += self._block
                self._barrier, self._block = chunk.data, []
                self._simulator = chunk.peer
        return complete

    def send(self, data: bytes, peer: Hashable | None) -> None:
        """Send to the simulator, also before its vehicle is found: with a simulated link delay its
        first HEARTBEAT arrives only after several barriers were answered."""
        super().send(data, self._simulator if peer is None else peer)


def _is_barrier(datagram: bytes) -> bool:
    """Whether the last frame of `datagram` is a TIMESYNC request, which has tc1 = 0."""
    at = last = 0
    while at < len(datagram):
        last, at = at, at + frame_size(datagram, at)
    frame = datagram[last:]
    return int.from_bytes(frame[7:10], "little") == TIMESYNC and not any(frame[10:18])
