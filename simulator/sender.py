"""A MAVLink sender beside the vehicle: its frames, and when they are due."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from simulator.firmware.base import Firmware
from simulator.mavlink.codec import Encoder, message_of
from simulator.mavlink.outbox import MAV_COMP_ID_AUTOPILOT
from simulator.steps import STEP_S

_QUADROTOR, _ONBOARD_CONTROLLER, _NO_AUTOPILOT = 2, 18, 8  # MAV_TYPE, MAV_AUTOPILOT
_STANDBY, _ACTIVE, _MAVLINK = 3, 4, 3  # MAV_STATE; protocol version
_ATTITUDE_AND_THRUST = 7  # type_mask


@dataclass(slots=True)
class Sender:
    """Another sender with its MAVLink ids. `step` counts the steps in which it sends, from 0."""

    system: int
    component: int
    step: int = -1
    _encoder: Encoder = field(init=False)

    def __post_init__(self) -> None:
        self._encoder = Encoder(self.system, self.component)

    def due(self, rate_hz: float) -> range:
        """As many numbers as messages of this rate are due in this step; the first is at once."""
        before, now = (math.floor(n * rate_hz * STEP_S + 1e-9) for n in (self.step - 1, self.step))
        return range(now - before)

    def companion_heartbeat(self, custom_mode: int) -> bytes:
        """HEARTBEAT of a companion computer."""
        values = (_ONBOARD_CONTROLLER, _NO_AUTOPILOT, 0, custom_mode, _ACTIVE, _MAVLINK)
        return self._frame("HEARTBEAT", *values)

    def autopilot_heartbeat(self, firmware: Firmware) -> bytes:
        """HEARTBEAT of an autopilot with this firmware, disarmed and in its first mode."""
        mode = firmware.modes[firmware.boot_mode]
        state = (mode.base_mode, mode.custom_mode, _STANDBY, _MAVLINK)
        return self._frame("HEARTBEAT", _QUADROTOR, firmware.mav_autopilot, *state)

    def level_setpoint(self, target: int, thrust: float) -> bytes:
        """SET_ATTITUDE_TARGET of a level attitude that heads north."""
        head = (0, target, MAV_COMP_ID_AUTOPILOT, _ATTITUDE_AND_THRUST)
        values = (*head, (1.0, 0.0, 0.0, 0.0), 0.0, 0.0, 0.0, thrust)
        return self._frame("SET_ATTITUDE_TARGET", *values)

    def command(self, target: int, number: int, params: tuple[float, ...]) -> bytes:
        """COMMAND_LONG; parameters that are not given are 0."""
        filled = (*params, *(0.0,) * (7 - len(params)))
        return self._frame("COMMAND_LONG", target, MAV_COMP_ID_AUTOPILOT, number, 0, *filled)

    def _frame(self, name: str, *values: object) -> bytes:
        return self._encoder.frame(message_of(name, values))
