"""Sockets of a link, and faults between its two ends."""
