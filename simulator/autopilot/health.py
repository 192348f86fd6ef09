"""Start of the autopilot and its pre-arm checks.

Knows the firmware's times and what the monitors found; its state table decides what is refused.
"""

from __future__ import annotations

from collections.abc import Iterator

from simulator.autopilot.guidance import Guidance
from simulator.autopilot.monitors import Monitors
from simulator.autopilot.setpoints import SetpointStream
from simulator.firmware.values import Behaviour, Mode


class Health:
    """Health of one vehicle from boot on; `boot_scale` multiplies the times of its start."""

    def __init__(
        self, guidance: Guidance, stream: SetpointStream, monitors: Monitors, boot_scale: float
    ) -> None:
        self._firmware, self._mission = guidance.firmware, guidance.mission
        self._parameters, self._stream, self._monitors = guidance.parameters, stream, monitors
        self.boot_scale = boot_scale
        self.reached: frozenset[str] = frozenset()  # boot events so far
        times_s = self._firmware.health.boot.items()
        self._ahead = sorted((at_s * boot_scale, event) for event, at_s in times_s)

    def boot_events(self, now_s: float) -> Iterator[str]:
        """Boot events since the last call."""
        while self._ahead and now_s >= self._ahead[0][0]:
            _, event = self._ahead.pop(0)
            self.reached |= {event}
            yield event

    @property
    def position_lost(self) -> bool:
        """The position estimate is lost since a fault took the fix away."""
        return self._monitors.position_lost

    def has_fix(self, now_s: float) -> bool:
        """GPS has its first fix; a fault may take it away."""
        return now_s >= self._firmware.health.sensors.first_fix_s * self.boot_scale

    def passes(self, mode: Mode, now_s: float, *, latched: bool) -> bool:
        """The pre-arm checks pass for this mode. `latched`: a failure that only a reboot clears."""
        firmware = self._firmware
        after_s = firmware.health.passes_without_position_after_s
        if mode.needs_position:
            if self.position_lost:
                return False
            after_s = firmware.health.passes_after_s
        if latched or now_s < after_s * self.boot_scale:
            return False
        if firmware.health.fails_where_unarmable and not mode.arms:
            return False
        needed = self._parameters.role("ground_station_needed") > 0
        if needed and self._monitors.ground_station_lost:
            return False
        if mode.behaviour is Behaviour.MISSION:
            return self._mission.flyable
        needs_stream = mode.behaviour is Behaviour.SETPOINT and firmware.setpoints.mode_needs_stream
        return not needs_stream or self._stream.alive(now_s)

    def can_run(self, mode: Mode, now_s: float) -> bool:
        """A vehicle in the air may enter this mode."""
        if mode.behaviour is Behaviour.SETPOINT:
            return self._stream.alive(now_s)
        if mode.behaviour is Behaviour.MISSION:
            return self._mission.flyable
        return not mode.needs_sticks
