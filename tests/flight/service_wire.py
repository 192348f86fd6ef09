"""An independent observer of the service: what leaves, against the vehicle's true state.

It reads the bytes that the service sends and the simulated vehicle itself, and nothing of the
service. What must never happen is kept in `unsafe`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pair import decode
from serving import ARM, LAND, SET_MODE, TAKEOFF, Serving

from offboard.flight.companion import Output
from offboard.flight.link import Chunk

REACTION_S = 0.15  # a report of the mode at 10 Hz, and a turn
REPORTED_S = 1.1  # PX4's HEARTBEAT, where CURRENT_MODE is lost
SETPOINTS = {82, 84, 86}
ENGAGE = {"px4": "OFFBOARD", "ardupilot": "GUIDED"}
HOLD = {"px4": "AUTO.LOITER", "ardupilot": "BRAKE"}
LANDS = {"px4": "AUTO.LAND", "ardupilot": "LAND"}
HOLD_PARAMETERS = {"px4": (4, 3), "ardupilot": (17, 0)}
HOVER = {"px4": 0.489, "ardupilot": 0.366}
ALOFT_M = 0.3


@dataclass
class Wire:
    """Watches `pair` from now on. `arms`: the service may arm."""

    pair: Serving
    arms: bool = False
    unsafe: list[str] = field(default_factory=list)
    setpoints: int = 0
    engaged_setpoints: int = 0
    least_share: float = math.inf  # of hover thrust, in the air and in the mode of setpoints
    gone_s: float = -math.inf  # since when the vehicle has shown another mode than ours
    asked: set[str] = field(default_factory=set)  # modes that the service asked for
    mode: str = ""

    def __post_init__(self) -> None:
        self.wrap()

    def wrap(self) -> None:
        """Watch the present service; again after its restart."""
        service = self.pair.companion
        turn = service.turn

        def watched(chunks: list[Chunk], now_s: float) -> Output:
            self.look()
            output = turn(chunks, now_s)
            for frame in output.send:
                self.judge(frame)
            return output

        service.turn = watched  # type: ignore[method-assign]

    def look(self) -> None:
        """At the vehicle's mode."""
        mode = self.pair.mode
        if mode == self.mode:
            return
        if mode == ENGAGE[self.pair.firmware]:
            self.asked.clear()
        elif mode not in self.asked:
            self.gone_s = self.pair.time_s
        self.mode = mode

    def judge(self, frame: bytes) -> None:
        number = int.from_bytes(frame[7:10], "little")
        if number in SETPOINTS:
            self._judge_setpoint(decode(frame))
        elif number in (75, 76):
            self._judge_command(decode(frame))

    def _gone(self) -> bool:
        """The vehicle has another mode than ours for longer than a report takes to arrive."""
        away = self.mode != ENGAGE[self.pair.firmware] and self.mode not in self.asked
        return away and self.pair.heard_mode_s > self.gone_s + REACTION_S

    def _judge_setpoint(self, message: Any) -> None:
        pair, on = self.pair, self.pair.firmware
        self.setpoints += 1
        values = (*message.q, message.thrust)
        if not all(map(math.isfinite, values)) or abs(math.hypot(*message.q) - 1.0) > 4e-4:
            self._note(f"setpoint {message}")
        engaged = self.mode == ENGAGE[on]
        commander = pair.instance.autopilot.commander
        aloft = -pair.place[2] > ALOFT_M and commander.armed
        share = message.thrust / HOVER[on]
        if aloft and share < 0.32:
            self._note(f"thrust {message.thrust:.3f} in the air, {self.mode}")
        if engaged and aloft:
            self.engaged_setpoints += 1
            self.least_share = min(self.least_share, share)
        if self._gone() and on == "ardupilot":
            self._note(f"setpoint in {self.mode}")
        elif self._gone() and aloft:
            attitude = np.array(pair.instance.autopilot.state.truth.attitude)
            angle = 2.0 * math.acos(min(1.0, abs(float(attitude @ np.array(message.q)))))
            if angle > 0.35:
                self._note(f"setpoint {math.degrees(angle):.0f} deg away in {self.mode}")

    def _judge_command(self, message: Any) -> None:
        on, command = self.pair.firmware, message.command
        if (
            command in (ARM, TAKEOFF)
            and not self.arms
            and not (command == ARM and not message.param1)
        ):
            self._note(f"command {command} ({message.param1:g})")
        if command not in (SET_MODE, LAND):
            return
        hold = command == SET_MODE and (message.param2, message.param3) == HOLD_PARAMETERS[on]
        if command == SET_MODE and not hold and not self.arms:
            self._note(f"mode {message.param2:g} {message.param3:g} requested")
        begins = self.arms and command == SET_MODE and not hold
        if self._gone() and not begins:
            self._note(f"command {command} in {self.mode}")
        self.asked.add(LANDS[on] if command == LAND else HOLD[on])

    def _note(self, what: str) -> None:
        self.unsafe.append(f"{self.pair.time_s:.2f} s {self.pair.phase.value}: {what}")
