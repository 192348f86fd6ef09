"""A MAVLink offboard controller: telemetry in, attitude and thrust setpoints out."""

from offboard.model.compilation import prepare_before_numba

prepare_before_numba()
