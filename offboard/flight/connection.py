"""Connections: the link that an address names.

udpin:HOST:PORT    listen on a port, send to the address of the vehicle that the session found
udpout:HOST:PORT   send to this address, and hear no other
tcp:HOST:PORT      connect to a listening autopilot (ArduPilot SITL)
serial:DEVICE:BAUD
"""

from __future__ import annotations

import re
import socket
from errno import EADDRINUSE

from offboard.documents.errors import shown
from offboard.flight.link import Link, LinkError
from offboard.flight.stream_link import serial_link, tcp_link
from offboard.flight.udp_link import LockstepLink, UdpLink, udp_socket

FORMS = "udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or serial:DEVICE:BAUD"
PORT_MAX, BAUD_MAX = 65535, 100_000_000
_ADDRESS = re.compile(r"(udpin|udpout|tcp|serial):(.+):([0-9]{1,9})", re.ASCII)


def open_lockstep_link() -> LockstepLink:
    """Open a link on a free port of this computer, for a simulator in lockstep."""
    sock = udp_socket()
    sock.bind(("127.0.0.1", 0))
    return LockstepLink(sock)


def open_link(address: str) -> Link:
    """Open the link at `address`, for example "udpin:127.0.0.1:14540" (see the module).

    Raises LinkError, which says what to change.
    """
    matched = _ADDRESS.fullmatch(address)
    if matched is None:
        raise LinkError(f"connection {shown(address)} is not understood; use {FORMS}")
    kind, host, number = matched[1], matched[2], int(matched[3])
    if kind == "serial":
        if not 0 < number <= BAUD_MAX:
            raise LinkError(f"connection {shown(address)}: {number} baud is no rate of a port")
        return serial_link(host, number)
    least = 0 if kind == "udpin" else 1  # 0: any free port
    if not least <= number <= PORT_MAX:
        raise LinkError(
            f"connection {shown(address)}: port {number} is not within {least} .. {PORT_MAX}"
        )
    try:
        return tcp_link(host, number) if kind == "tcp" else _udp_link(kind, host, number)
    except (OSError, UnicodeError) as error:  # of a host name that is too long
        reason = getattr(error, "strerror", None) or error
        taken = getattr(error, "errno", None) == EADDRINUSE
        raise LinkError(
            f"connection {shown(address)} cannot be opened: {reason}"
            + ("; another program uses the port" if taken else "")
        ) from None


def _udp_link(kind: str, host: str, port: int) -> UdpLink:
    place = (socket.gethostbyname(host), port)
    sock = udp_socket()
    try:
        if kind == "udpout":
            sock.connect(place)
            return UdpLink(None, sock)
        sock.bind(place)
    except OSError:
        sock.close()
        raise
    return UdpLink(sock, None)
