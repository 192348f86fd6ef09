"""Sockets of a link, faults of its datagrams, and their division into MAVLink frames."""
