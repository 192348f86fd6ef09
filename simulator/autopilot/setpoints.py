"""The stream of setpoint messages: conversion to local NED, refusals, and its age.

The firmware reads the messages. Knows no modes and no flight.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from simulator.autopilot.firmware import Firmware
from simulator.autopilot.parameters import ParameterTable
from simulator.autopilot.state import StateEstimate
from simulator.autopilot.values import AttitudeSetpoint, MotionSetpoint, StatusText
from simulator.geodesy import TERRAIN_FRAMES, down_m, to_metres

ATTITUDE = "SET_ATTITUDE_TARGET"
LOCAL, GLOBAL = "SET_POSITION_TARGET_LOCAL_NED", "SET_POSITION_TARGET_GLOBAL_INT"
_POSITION_IGNORED, _LOCAL_NED = 0b111, 1  # type_mask; MAV_FRAME


@dataclass(slots=True)
class SetpointStream:
    """Setpoints of a client; `newest_s`: vehicle time of the last that was accepted."""

    firmware: Firmware
    parameters: ParameterTable
    newest_s: float = -math.inf

    def alive(self, now_s: float) -> bool:
        """The stream is not lost; the firmware notices a loss some time after its time-out."""
        role = self.parameters.role
        age_s = now_s - self.newest_s - role("stream_reaction_s")
        return age_s <= role("stream_timeout_s")

    def read(
        self, message: str, values: Mapping[str, Any], estimate: StateEstimate, home_down_m: float
    ) -> tuple[AttitudeSetpoint | MotionSetpoint | None, StatusText | None]:
        """Setpoint of a message, or a text about its refusal.

        Args:
            message: ATTITUDE, LOCAL or GLOBAL.
            values: its fields, which may be relative to the vehicle.
            estimate: of the vehicle's state.
            home_down_m: down coordinate (NED) of home, to which heights may be relative.
        """
        firmware = self.firmware
        if message == ATTITUDE:
            return firmware.attitude_setpoint(values, self.parameters.__getitem__), None
        frame = values["coordinate_frame"]
        if message == LOCAL:
            local = firmware.in_local_frame(values, estimate)
        elif _has_position(values) and frame not in firmware.global_frames:
            return None, firmware.setpoint_rejection(message, frame)
        else:
            local = self._in_metres(values, home_down_m)
        setpoint = firmware.motion_setpoint(local)
        if setpoint is not None:
            return setpoint, None
        frame = local["coordinate_frame"]
        return None, firmware.setpoint_rejection(message, None if frame == _LOCAL_NED else frame)

    def _in_metres(self, values: Mapping[str, Any], home_down_m: float) -> Mapping[str, Any]:
        """Fields of GLOBAL as those of LOCAL in MAV_FRAME 1; a position is whole or ignored."""
        origin, frame, mask = self.firmware.origin, values["coordinate_frame"], values["type_mask"]
        x, y = to_metres(origin, values["lat_int"] * 1e-7, values["lon_int"] * 1e-7)
        z = down_m(values["alt"], frame, origin, home_down_m)
        if frame in TERRAIN_FRAMES:
            z = -values["alt"]
        mask |= 0 if _has_position(values) else _POSITION_IGNORED
        place = {"coordinate_frame": _LOCAL_NED, "x": x, "y": y, "z": z, "type_mask": mask}
        return {**values, **place}


def _has_position(values: Mapping[str, Any]) -> bool:
    return not values["type_mask"] & _POSITION_IGNORED
