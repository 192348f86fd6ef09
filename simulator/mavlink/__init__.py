"""Bytes of MAVLink in, bytes out: what is asked of the autopilot and what it reports."""
