"""A software-in-the-loop vehicle that behaves like an autopilot at its MAVLink boundary."""

from offboard.model.compilation import prepare_cache

prepare_cache()  # before any module of this package has numba compile something
