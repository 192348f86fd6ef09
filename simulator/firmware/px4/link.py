"""Link behaviour of PX4."""

from __future__ import annotations

from simulator.firmware.base import LinkRules
from simulator.firmware.values import ReadParameter

_MAV_TYPE_GCS = 6


def is_ground_station(kind: int, _: int, __: ReadParameter) -> bool:
    """By MAV_TYPE, whatever the system id."""
    return kind == _MAV_TYPE_GCS


def obeys_system(_: int, __: int, ___: ReadParameter) -> bool:
    """All systems."""
    return True


LINK = LinkRules(
    is_ground_station=is_ground_station,
    ground_station_stays_s=2.5,
    obeys_system=obeys_system,
    target_component_checked=True,
    text_suffix="\t",
    text_to_ground_stations_only=True,
    parameters_bytewise=True,
    parameters_hashed=True,
    # of 1.17, as 1.16 has no signing: HEARTBEAT, RADIO_STATUS, ADSB_VEHICLE, COLLISION
    accepted_unsigned=frozenset({0, 109, 246, 247}),
    stamps_follow_clock=False,
    parameters_numbered=True,
)
