"""A MAVLink offboard controller: telemetry in, attitude and thrust setpoints out."""

from offboard.model.compilation import prepare_cache

prepare_cache()  # before any module of this package has numba compile something
