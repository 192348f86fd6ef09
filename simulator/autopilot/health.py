"""Whether the vehicle is fit to arm: how far its start has come, and what the checks ask for.

Knows firmware, parameters and what is watched; what is refused for it is for the rules.
"""

from __future__ import annotations

from simulator.autopilot.mission import Mission
from simulator.autopilot.parameters import ParameterTable
from simulator.autopilot.setpoints import SetpointStream
from simulator.autopilot.watch import Watch
from simulator.firmware.base import Firmware
from simulator.firmware.values import Behaviour, Mode


class Health:
    """Of one vehicle from boot on; `scale` stretches the times of its start."""

    def __init__(
        self,
        firmware: Firmware,
        parameters: ParameterTable,
        mission: Mission,
        stream: SetpointStream,
        watch: Watch,
        scale: float,
    ) -> None:
        self._firmware, self._parameters, self._mission = firmware, parameters, mission
        self._stream, self._watch = stream, watch
        self.scale = scale
        self.reached: frozenset[str] = frozenset()  # events of the start
        self._ahead = sorted((at_s * scale, event) for event, at_s in firmware.health.boot.items())

    def reach(self, now_s: float) -> str | None:
        """The next event of the start that has come, if one has."""
        if not (self._ahead and now_s >= self._ahead[0][0]):
            return None
        _, event = self._ahead.pop(0)
        self.reached |= {event}
        return event

    def has_fix(self, now_s: float) -> bool:
        """GPS reports a position, unless a fault takes it away."""
        return now_s >= self._firmware.health.sensors.first_fix_s * self.scale

    def passes(self, mode: Mode, now_s: float, *, latched: bool) -> bool:
        """The pre-arm checks pass, for the mode that was chosen; `latched`: something is wrong
        until a reboot."""
        firmware = self._firmware
        after_s = firmware.health.passes_without_position_after_s
        if mode.needs_position:
            after_s = firmware.health.passes_after_s
        waits = firmware.setpoints.mode_needs_stream and mode.behaviour is Behaviour.SETPOINT
        booted = now_s >= after_s * self.scale and not latched
        if firmware.health.fails_where_unarmable and not mode.arms:
            return False
        if self._watch.ground_station_lost and self._parameters.role("ground_station_needed") > 0:
            return False
        if mode.behaviour is Behaviour.MISSION:
            return booted and self._mission.flyable
        return booted and (self._stream.alive(now_s) or not waits)

    def can_run(self, mode: Mode, now_s: float) -> bool:
        """Whether a vehicle in the air may be put into this mode."""
        if mode.behaviour is Behaviour.SETPOINT:
            return self._stream.alive(now_s)
        if mode.behaviour is Behaviour.MISSION:
            return self._mission.flyable
        return not mode.needs_sticks

    def position_missing(self, mode: Mode) -> bool:
        """The mode needs a position, and there was none yet."""
        return mode.needs_position and "position" not in self.reached
