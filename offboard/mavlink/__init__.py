"""The MAVLink boundary, sans-I/O: bytes in, events out; values in, bytes out."""
