"""Connections: opens the link at an address.

udpin:HOST:PORT    listen on a port, send to the address of the vehicle that the session found
udpout:HOST:PORT   send to this address, and receive from no other
tcp:HOST:PORT      connect to a listening autopilot (ArduPilot SITL)
tcpin:HOST:PORT    listen for one client
serial:DEVICE:BAUD

An IPv6 address is in brackets, for example udpin:[::1]:14540.
"""

from __future__ import annotations

import re
import socket
from errno import EADDRINUSE
from typing import Any

from offboard.documents.errors import Unavailable, UserError, shown
from offboard.link.interface import Link
from offboard.link.stream import ListeningLink, RedialingLink, connect, open_port
from offboard.link.udp import LockstepLink, UdpLink, udp_socket

FORMS = "udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT, tcpin:HOST:PORT or serial:DEVICE:BAUD"
PORT_MAX, BAUD_MAX = 65535, 100_000_000
BITS_OF_A_BYTE = 10  # on a serial line: start bit, eight data bits, stop bit
_ADDRESS = re.compile(r"(udpin|udpout|tcp|tcpin|serial):(.+):([0-9]{1,9})", re.ASCII)


def open_lockstep_link() -> LockstepLink:
    """Open a link on a free port of this computer, for a simulator in lockstep. Raises
    Unavailable if nothing can be sent to that port."""
    sock = udp_socket()
    try:
        sock.bind(("127.0.0.1", 0))
        with udp_socket() as probe:  # sends nothing, and fails without a loopback interface
            probe.connect(sock.getsockname())
    except OSError as error:
        sock.close()
        raise Unavailable(
            f"the bundled simulator needs UDP on 127.0.0.1 ({error.strerror or error}): is the "
            "loopback interface up?"
        ) from None
    return LockstepLink(sock)


def parsed(address: str) -> tuple[str, str, int]:
    """Split an address into kind, host or device, and port or baud rate. Raises UserError."""
    matched = _ADDRESS.fullmatch(address)
    if matched is None:
        raise UserError(f"connection {shown(address)} is not understood; use {FORMS}")
    kind, host, number = matched[1], matched[2], int(matched[3])
    if kind == "serial":
        if not 0 < number <= BAUD_MAX:
            raise UserError(f"connection {shown(address)}: {number} baud is no rate of a port")
        return kind, host, number
    if not 1 <= number <= PORT_MAX:
        raise UserError(f"connection {shown(address)}: port {number} is not within 1 .. {PORT_MAX}")
    if ":" in host and not (host.startswith("[") and host.endswith("]")):
        raise UserError(
            f"connection {shown(address)} is not understood; an IPv6 address stands in brackets, "
            f"as in {kind}:[::1]:{number}"
        )
    return kind, host.strip("[]"), number


def open_link(address: str) -> Link:
    """Open the link at `address`, for example "udpin:127.0.0.1:14540" (see the module). Raises
    UserError for a wrong address, and Unavailable if a later attempt may succeed."""
    kind, host, number = parsed(address)
    if kind == "serial":
        return RedialingLink(lambda: open_port(host, number), "serial", number / BITS_OF_A_BYTE)
    try:
        return _network_link(kind, host, number)
    except UnicodeError as error:  # a label of the host name is too long
        raise UserError(f"connection {shown(address)} cannot be opened: {error}") from None
    except OSError as error:
        raise Unavailable(
            f"connection {shown(address)} cannot be opened: {error.strerror or error}"
            + ("; another program uses the port" if error.errno == EADDRINUSE else "")
        ) from None


def _network_link(kind: str, host: str, port: int) -> Link:
    """Open a UDP or TCP link. Raises OSError or UnicodeError."""
    if kind == "tcp":
        return RedialingLink(lambda: connect(host, port), "tcp")
    family, place = _resolved(host, port)
    sock = socket.socket(family, socket.SOCK_STREAM) if kind == "tcpin" else udp_socket(family)
    try:
        if kind == "udpout":
            sock.bind(("", 0))
            with udp_socket(family) as probe:  # sends nothing
                probe.connect(place)  # fails without a route, and replaces 0.0.0.0 by this computer
                return UdpLink(sock, peer=probe.getpeername())
        if kind == "udpin":
            sock.bind(place)
            return UdpLink(sock)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.bind(place)
        sock.listen()
        return ListeningLink(sock, "tcp")
    except OSError:
        sock.close()
        raise


def _resolved(host: str, port: int) -> tuple[int, tuple[Any, ...]]:
    """Address family and socket address of a host; IPv4 if it has both. Raises OSError."""
    try:  # where `localhost` is only ::1, glibc returns 127.0.0.1 only to a request for IPv4
        found = socket.getaddrinfo(host, port, socket.AF_INET, socket.SOCK_DGRAM)
    except socket.gaierror:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
    family, _, _, _, place = found[0]
    return family, tuple(place)
