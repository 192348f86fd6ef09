"""A spherical Earth: conversion between latitude, longitude, height and metres from an origin; and
gravity. Knows no vehicle."""

from __future__ import annotations

import math

GRAVITY_MPS2 = 9.80665
EARTH_RADIUS_M = 6_371_000.0
DEGREES_PER_M = math.degrees(1.0 / EARTH_RADIUS_M)  # degrees of latitude per metre
Origin = tuple[float, float, float]  # latitude, longitude deg, AMSL m
RELATIVE_FRAMES = frozenset((3, 6))  # MAV_FRAMEs with the height above home
TERRAIN_FRAMES = frozenset((10, 11))  # MAV_FRAMEs with the height above the terrain


def to_metres(origin: Origin, latitude_deg: float, longitude_deg: float) -> tuple[float, float]:
    """North and east, m, of a point near the origin. The angles may exceed 180 degrees; NaN
    gives NaN."""
    latitude, longitude, _ = origin
    north_m = math.radians(wrapped_deg(latitude_deg - latitude)) * EARTH_RADIUS_M
    shrink = math.cos(math.radians(latitude))
    east_m = math.radians(wrapped_deg(longitude_deg - longitude)) * EARTH_RADIUS_M * shrink
    return north_m, east_m


def wrapped_deg(angle_deg: float) -> float:
    """The same angle between -180 and 180; NaN if it is not finite."""
    return math.remainder(angle_deg, 360.0) if math.isfinite(angle_deg) else math.nan


def to_degrees(origin: Origin, north_m: float, east_m: float) -> tuple[float, float]:
    """Latitude and longitude of a point near the origin."""
    latitude, longitude, _ = origin
    east_deg = east_m * (DEGREES_PER_M / math.cos(math.radians(latitude)))
    return latitude + north_m * DEGREES_PER_M, wrapped_deg(longitude + east_deg)


def down_m(height_m: float, frame: int, origin: Origin, home_down_m: float) -> float:
    """NED position, down, of a height in this MAV_FRAME: above home in RELATIVE_FRAMES, otherwise
    above mean sea level."""
    return (home_down_m if frame in RELATIVE_FRAMES else origin[2]) - height_m
