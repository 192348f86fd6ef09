"""Link behaviour of ArduCopter."""

from __future__ import annotations

from simulator.firmware.base import LinkRules
from simulator.firmware.values import ReadParameter


def is_ground_station(_: int, system: int, parameter: ReadParameter) -> bool:
    """By system id, whatever the MAV_TYPE."""
    return system == parameter("SYSID_MYGCS")


def obeys_system(sender: int, own: int, parameter: ReadParameter) -> bool:
    """All systems; with SYSID_ENFORCE the ground station and its own components only."""
    return not parameter("SYSID_ENFORCE") or sender in (own, parameter("SYSID_MYGCS"))


LINK = LinkRules(
    is_ground_station=is_ground_station,
    ground_station_stays_s=0.0,
    obeys_system=obeys_system,
    target_component_checked=False,
    text_suffix="",
    text_to_ground_stations_only=False,
    parameters_bytewise=False,
    parameters_hashed=False,
    # RADIO_STATUS, RADIO; on USB, which is not simulated, all
    accepted_unsigned=frozenset({109, 166}),
    stamps_follow_clock=True,  # GPS
    parameters_numbered=False,
)
