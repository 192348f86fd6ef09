"""Sockets of the simulator's links, and waiting for datagrams. Bytes only; no MAVLink.

udpout:HOST:PORT sends to that address from the start, udpin:HOST:PORT sends to every address from
which it has received, and tcpin:HOST:PORT accepts connections, as ArduPilot's SITL does. A TCP
stream may divide a frame anywhere; `receive` returns whole MAVLink frames, as in a datagram.
"""

from __future__ import annotations

import select
import selectors
import socket
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field

from offboard.documents.errors import UserError, abridged
from simulator.link.framing import whole_frames

PEERS_MAX = 16
DATAGRAM_MAX = 65535
Address = tuple[str, int]
CLIENTS_MAX = 16
READ_BYTES = 65536
UNSENT_MAX = 1 << 20  # bytes; a client with more unsent bytes does not read and is disconnected
# Difference between the ports of two instances, as in PX4's and ArduPilot's SITL
_PORTS_APART = {"udpout": 1, "udpin": 1, "tcpin": 10}


class LinkError(UserError):
    """An address that cannot be used; the message is one sentence."""


class UdpLink:
    """A UDP socket and its peers. A datagram is lost if it cannot be sent."""

    def __init__(
        self,
        sock: socket.socket,
        target: Address | None,
        peers: dict[Address, None] | None = None,
    ) -> None:
        self._socket = sock
        self._target = target
        self.peers = peers if peers is not None else {} if target is None else {target: None}

    def fileno(self) -> int:
        return self._socket.fileno()

    @property
    def address(self) -> Address:
        """The local address."""
        host, port = self._socket.getsockname()
        return str(host), int(port)

    @property
    def port(self) -> int:
        """The local port."""
        return self.address[1]

    def send(self, datagrams: Iterable[bytes]) -> None:
        """Send each datagram to every peer."""
        for datagram in datagrams:
            for peer in self.peers:
                try:
                    self._socket.sendto(datagram, peer)
                except OSError:  # port closed, host unreachable or buffer full
                    continue

    def receive(self) -> bytes | None:
        """Return the next datagram, or None."""
        while True:
            try:
                datagram, sender = self._socket.recvfrom(DATAGRAM_MAX)
            except ConnectionError:
                continue  # ICMP error for a datagram sent earlier
            except OSError:
                return None
            if sender not in self.peers:
                self._add_peer(sender)
            return datagram

    def _add_peer(self, sender: Address) -> None:
        if len(self.peers) >= PEERS_MAX:
            oldest = next(peer for peer in self.peers if peer != self._target)
            del self.peers[oldest]
        self.peers[sender] = None

    def close(self) -> None:
        self._socket.close()


@dataclass(slots=True)
class Client:
    """A TCP connection, with received bytes of an incomplete frame and bytes not sent yet."""

    socket: socket.socket
    arrived: bytearray = field(default_factory=bytearray)
    unsent: bytearray = field(default_factory=bytearray)


class TcpLink:
    """A listening TCP socket and its clients. A client that does not read is disconnected."""

    def __init__(self, listener: socket.socket) -> None:
        self._listener = listener
        self._clients: list[Client] = []
        self._selector = selectors.DefaultSelector()
        self._selector.register(listener, selectors.EVENT_READ)
        self._frames: deque[bytes] = deque()

    def fileno(self) -> int:
        """File descriptor for select; it covers the listener and all clients."""
        return self._selector.fileno()

    @property
    def port(self) -> int:
        """The local port."""
        return int(self._listener.getsockname()[1])

    def send(self, datagrams: Iterable[bytes]) -> None:
        """Send all datagrams to every client."""
        together = b"".join(datagrams)
        for client in tuple(self._clients):
            client.unsent += together
            if client.unsent:
                self._flush(client)

    def _flush(self, client: Client) -> None:
        try:
            del client.unsent[: client.socket.send(client.unsent)]
        except BlockingIOError:
            pass
        except OSError:
            self._disconnect(client)
        if len(client.unsent) > UNSENT_MAX:
            self._disconnect(client)

    def receive(self) -> bytes | None:
        """Return the whole frames that one client has sent, or None."""
        if not self._frames:
            for key, _ in self._selector.select(0):
                if key.fileobj is self._listener:
                    self._accept()
                else:
                    self._read_client(key.data)
        return self._frames.popleft() if self._frames else None

    def _accept(self) -> None:
        try:
            sock, _ = self._listener.accept()
        except OSError:
            return
        if len(self._clients) >= CLIENTS_MAX:
            self._disconnect(self._clients[0])
        sock.setblocking(False)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        client = Client(sock)
        self._clients.append(client)
        self._selector.register(sock, selectors.EVENT_READ, client)

    def _read_client(self, client: Client) -> None:
        try:
            piece = client.socket.recv(READ_BYTES)
        except BlockingIOError:
            return
        except OSError:
            piece = b""
        if not piece:
            self._disconnect(client)
            return
        client.arrived += piece
        whole = whole_frames(client.arrived)
        if whole:
            self._frames.append(bytes(client.arrived[:whole]))
            del client.arrived[:whole]

    def _disconnect(self, client: Client) -> None:
        if client in self._clients:
            self._clients.remove(client)
            self._selector.unregister(client.socket)
            client.socket.close()

    def close(self) -> None:
        for client in tuple(self._clients):
            self._disconnect(client)
        self._selector.close()
        self._listener.close()


Link = UdpLink | TcpLink


def free_ports(count: int) -> list[int]:
    """Return UDP ports on 127.0.0.1 that are free now."""
    sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(count)]
    try:
        for sock in sockets:
            sock.bind(("127.0.0.1", 0))
        return [int(sock.getsockname()[1]) for sock in sockets]
    finally:
        for sock in sockets:
            sock.close()


def wait(links: Iterable[Link], timeout_s: float) -> list[Link]:
    """Wait until a link has a datagram to receive, at most `timeout_s`; return all that have."""
    return select.select(links, [], [], max(0.0, timeout_s))[0]


def open_link(url: str, preferred_port: int) -> Link:
    """Open a link.

    Args:
        url: `udpout:HOST:PORT`, `udpin:HOST:PORT` or `tcpin:HOST:PORT`.
        preferred_port: local port of `udpout`; if it is in use, any free port is taken.

    Raises:
        LinkError: the address is malformed, unknown or in use.
    """
    kind, host, port = _split(url)
    address = _resolve(url, host, port)
    by_stream = kind == "tcpin"
    sock = socket.socket(socket.AF_INET, socket.SOCK_STREAM if by_stream else socket.SOCK_DGRAM)
    sock.setblocking(False)
    try:
        if by_stream:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            sock.bind(address)
            sock.listen()
            return TcpLink(sock)
        if kind == "udpin":
            sock.bind(address)
            return UdpLink(sock, None)
        local = "127.0.0.1" if address[0].startswith("127.") else ""
        try:
            sock.bind((local, preferred_port))
        except OSError:
            sock.bind((local, 0))
    except OSError as error:
        sock.close()
        raise LinkError(f"{url} cannot be opened: {error.strerror or error}") from None
    return UdpLink(sock, address)


def open_beside(link: Link) -> Link:
    """Open a link with another local port and the same peers, for a sender that is not the vehicle.

    Raises:
        LinkError: `link` is a TCP link, whose connections allow no other sender.
    """
    if not isinstance(link, UdpLink):
        raise LinkError("fault stranger needs a UDP link: nobody else can send on a TCP connection")
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.setblocking(False)
    sock.bind((link.address[0], 0))
    return UdpLink(sock, None, link.peers)


def shifted(url: str, by: int) -> str:
    """Return the URL of this link for the instance whose number is greater by `by`. Raises
    LinkError."""
    kind, host, port = _split(url)
    return f"{kind}:{host}:{port + by * _PORTS_APART[kind]}"


def _split(url: str) -> tuple[str, str, int]:
    parts = url.split(":")
    usable = len(parts) == 3 and parts[0] in _PORTS_APART and parts[1] != ""
    number = parts[-1].isascii() and parts[-1].isdigit() and len(parts[-1]) <= 5
    if not (usable and number and 0 < int(parts[2]) < 65536):
        raise LinkError(
            f"{abridged(url)} is not a link: give udpout:, udpin: or tcpin:HOST:PORT, "
            "port 1 .. 65535"
        )
    return parts[0], parts[1], int(parts[2])


def _resolve(url: str, host: str, port: int) -> Address:
    try:
        found = socket.getaddrinfo(host, port, socket.AF_INET, socket.SOCK_DGRAM)
    except (OSError, UnicodeError):
        raise LinkError(
            f"{abridged(url)} cannot be opened: no address known for {abridged(host)}"
        ) from None
    address = found[0][4]
    return (str(address[0]), int(address[1]))
