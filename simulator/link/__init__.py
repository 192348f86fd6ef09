"""Sockets, and the faults of the way between them."""
