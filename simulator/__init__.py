"""A software-in-the-loop vehicle that behaves like an autopilot at its MAVLink boundary."""

from offboard.model.compilation import prepare_before_numba

prepare_before_numba()
