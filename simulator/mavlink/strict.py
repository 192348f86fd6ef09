"""Reports of messages that an autopilot ignores or misreads without an answer (`--strict`).

Looks at messages only; the vehicle behaves as without it. Knows no link and no mode.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from simulator.autopilot.parameters import ParameterTable
from simulator.firmware.values import StatusText, warning
from simulator.mavlink.codec import Message

AUTOPILOT = 1  # MAV_COMP_ID
REPEAT_S = 1.0
_RATES_IGNORED, _THRUST_IGNORED, _ATTITUDE_IGNORED = 0b11, 64, 128  # type_mask
_NORM_TOLERANCE = 0.01
_MOTION = (("x", "y", "z"), ("vx", "vy", "vz"), ("afx", "afy", "afz"))


@dataclass(slots=True)
class Strict:
    """Checks of received messages. `counts`: number of messages by complaint."""

    system: int
    parameters: ParameterTable
    counts: Counter[str] = field(default_factory=Counter)
    _reported_s: dict[str, float] = field(default_factory=dict)

    def complaint(self, message: Message, now_s: float) -> StatusText | None:
        """Text about a message; None if it is fine, or was reported less than REPEAT_S ago."""
        check = CHECKS.get(message.name)
        if check is None or message.values.get("target_system", 0) not in (0, self.system):
            return None
        component = message.values.get("target_component", 0)
        fault = check(self, message.values)
        if component not in (0, AUTOPILOT):
            fault = f"to component {component} is ignored"
        if not fault:
            return None
        sentence = f"Strict: {message.name} {fault}"
        self.counts[sentence] += 1
        if now_s - self._reported_s.get(sentence, -math.inf) < REPEAT_S:
            return None
        self._reported_s[sentence] = now_s
        return warning(sentence)

    def _attitude(self, values: dict[str, Any]) -> str:
        mask, thrust = values["type_mask"], values["thrust"]
        by_attitude, by_rates = not mask & _ATTITUDE_IGNORED, not mask & _RATES_IGNORED
        if not (by_attitude or by_rates):
            return f"with mask {mask} is no setpoint"
        if mask & _THRUST_IGNORED:
            return "without thrust is zero thrust"
        if not math.isfinite(thrust):
            return "thrust is not a number: zero thrust"
        if not 0.0 <= thrust <= 1.0:
            return "thrust is outside 0 .. 1"
        norm = math.sqrt(sum(part * part for part in values["q"]))
        if by_attitude and not abs(norm - 1.0) <= _NORM_TOLERANCE:
            return "quaternion is not of unit length"
        rates = (values["body_roll_rate"], values["body_pitch_rate"], values["body_yaw_rate"])
        if by_rates and not all(map(math.isfinite, rates)):
            return "rates are not numbers"
        return ""

    def _motion(self, values: dict[str, Any]) -> str:
        mask = values["type_mask"]
        for group, names in enumerate(_MOTION):
            for place, name in enumerate(names):
                demanded = not mask >> (3 * group + place) & 1
                if demanded and name in values and not math.isfinite(values[name]):
                    return f"{name} is not a number"
        return ""

    def _parameter(self, values: dict[str, Any]) -> str:
        known = values["param_id"] in self.parameters or values.get("param_index", -1) >= 0
        return "" if known else f"of unknown {_printable(values['param_id'])}"

    def _parameter_set(self, values: dict[str, Any]) -> str:
        name = values["param_id"]
        if name not in self.parameters:
            return f"of unknown {_printable(name)}"
        if not self.parameters.in_range(name, values["param_value"]):
            return f"of {name} is out of range"
        return ""


def _printable(name: str) -> str:
    return "".join(letter for letter in name if letter.isprintable()) or "name"


CHECKS: dict[str, Callable[[Strict, dict[str, Any]], str]] = {
    "SET_ATTITUDE_TARGET": Strict._attitude,
    "SET_POSITION_TARGET_LOCAL_NED": Strict._motion,
    "SET_POSITION_TARGET_GLOBAL_INT": Strict._motion,
    "PARAM_REQUEST_READ": Strict._parameter,
    "PARAM_SET": Strict._parameter_set,
}
