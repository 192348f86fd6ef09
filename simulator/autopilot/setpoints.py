"""The stream of setpoints: what a message asks to be flown, and whether they still come.

What each firmware makes of one is its own; here places become local NED, complaints are found and
the age is kept. Knows neither modes nor the pilot that flies them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from simulator.autopilot.nav import Nav
from simulator.autopilot.parameters import ParameterTable
from simulator.firmware.base import Firmware
from simulator.firmware.values import AttitudeSetpoint, MotionSetpoint, StatusText
from simulator.geodesy import TERRAIN_FRAMES, down_m, to_metres

ATTITUDE = "SET_ATTITUDE_TARGET"
LOCAL, GLOBAL = "SET_POSITION_TARGET_LOCAL_NED", "SET_POSITION_TARGET_GLOBAL_INT"
_POSITION_IGNORED, _LOCAL_NED = 0b111, 1  # type_mask; MAV_FRAME


@dataclass(slots=True)
class SetpointStream:
    """The setpoints that somebody sends; `newest_s`: vehicle time of the last that was taken."""

    firmware: Firmware
    parameters: ParameterTable
    newest_s: float = -math.inf

    def alive(self, now_s: float) -> bool:
        """Not lost: the firmware notices a little later than its time-out."""
        age_s = now_s - self.newest_s - self.firmware.setpoints.reaction_s
        return age_s <= self.parameters.role("stream_timeout_s")

    def attitude(self, values: Mapping[str, Any]) -> AttitudeSetpoint | MotionSetpoint | None:
        """By the fields of ATTITUDE; None: nothing to be flown."""
        return self.firmware.setpoints.attitude(values, self.parameters.__getitem__)

    def motion(
        self, message: str, values: Mapping[str, Any], nav: Nav, home_down_m: float
    ) -> tuple[MotionSetpoint | None, StatusText | None]:
        """By the fields of LOCAL or GLOBAL, and what is said about them. They may be relative to
        the vehicle, and heights to home (NED, m)."""
        rules, frame = self.firmware.setpoints, values["coordinate_frame"]
        if message == LOCAL:
            local = rules.in_local_frame(values, nav.position_ned_m, nav.attitude)
        elif _is_place(values) and frame not in rules.global_frames:
            return None, rules.rejection(message, frame)
        else:
            local = self._in_metres(values, home_down_m)
        setpoint = rules.motion(local)
        if setpoint is not None:
            return setpoint, None
        frame = local["coordinate_frame"]
        known = None if frame == _LOCAL_NED else frame
        return None, rules.rejection(message, known)

    def _in_metres(self, values: Mapping[str, Any], home_down_m: float) -> Mapping[str, Any]:
        """Fields of GLOBAL as those of LOCAL in MAV_FRAME 1; a position is whole or ignored."""
        origin, frame, mask = self.firmware.origin, values["coordinate_frame"], values["type_mask"]
        x, y = to_metres(origin, values["lat_int"] * 1e-7, values["lon_int"] * 1e-7)
        home_down_m *= -1.0 if self.firmware.setpoints.home_mirrored else 1.0
        z = down_m(values["alt"], frame, origin, home_down_m)
        if frame in TERRAIN_FRAMES:
            z = -values["alt"]
        mask |= 0 if _is_place(values) else _POSITION_IGNORED
        place = {"coordinate_frame": _LOCAL_NED, "x": x, "y": y, "z": z, "type_mask": mask}
        return {**values, **place}


def _is_place(values: Mapping[str, Any]) -> bool:
    return not values["type_mask"] & _POSITION_IGNORED
