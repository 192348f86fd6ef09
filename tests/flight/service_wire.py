"""An independent observer of the service: checks what it sends against what vehicle and pilot do.

It decodes the bytes on the three links (vehicle to service, service to vehicle, ground station to
vehicle) with pymavlink, reads the state of the simulated vehicle, and uses no code of the service.
It stores in `unsafe` whatever must never happen.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from pair import ATTITUDE_TARGET, COMMAND_LONG, decode, frame_id, frames_of
from serving import ARM, HOVER, LAND, MODES, SET_MODE, START, TAKEOFF, Serving

from offboard.link.interface import Chunk

HEARTBEAT, CURRENT_MODE = 0, 436
COMMANDS, SETPOINTS = {75, COMMAND_LONG}, {ATTITUDE_TARGET, 84, 86}
# HEARTBEAT, PARAM_REQUEST_READ, COMMAND_ACK, TIMESYNC, STATUSTEXT
HARMLESS = {HEARTBEAT, 20, 77, 111, 253}
QUESTIONS = {511, 512}  # MAV_CMD_SET_MESSAGE_INTERVAL, _REQUEST_MESSAGE
US, VEHICLE = (1, 191), (1, 1)  # system and component id
CRITICAL = 5  # MAV_STATE; greater values are worse
ENGAGE = {"px4": "OFFBOARD", "ardupilot": "GUIDED"}
HOLD = {"px4": "AUTO.LOITER", "ardupilot": "BRAKE"}
LANDS = {"px4": "AUTO.LAND", "ardupilot": "LAND"}
HOLD_PARAMETERS = {"px4": (4, 3), "ardupilot": (17, 0)}
POSCTL = 3, 0  # as HOLD_PARAMETERS
ALOFT_M = 0.3
REPORTED_S = 0.5  # time until the service knows of a landing: EXTENDED_SYS_STATE comes at 5 Hz
ANSWERED_S = 0.3  # longest time from a command of the pilot to the vehicle's change of mode
KNOWN_S = 2.6  # greatest age of the newest report of the mode for setpoints and commands
TOUCHED_S = 1.5  # time for which a vehicle that touches the ground, as in a jump, counts as off it
OTHER_S = 4.9  # time for which another sender counts as present; 5 s in the service
LIKE_NOW_RAD = 0.2  # greatest angle between the vehicle's attitude and a setpoint in another mode
TILT_RAD = math.radians(46.0)  # greatest tilt of a setpoint
LEAST_SHARE, FALLING_MPS = 0.32, 3.5  # least thrust / hover thrust in the air; greatest sink rate
UNFLOWN_S = 2.5  # longest time in the air without setpoint or command of the service


class Report(NamedTuple):
    """A report of the mode that the vehicle has sent, and the truth at that time."""

    time_s: float
    mode: str
    engaged: bool  # whether a pilot had switched to the mode in the air
    failsafe: bool


@dataclass
class Wire:
    """Watches `pair` from now on. `arms`: whether the service may arm."""

    pair: Serving
    arms: bool = False
    unsafe: list[str] = field(default_factory=list)
    mode: str = ""  # mode of the vehicle
    before: str = ""  # its mode before the newest switch to the mode of setpoints
    changed_s: float = -math.inf  # when the vehicle changed to this mode
    engaged: bool = False  # whether the pilot engaged, and the vehicle is still in the mode
    left: bool = False  # whether a service that flew the vehicle was ended in that mode
    asked: set[str] = field(default_factory=set)  # modes that the service has requested
    known: Report | None = None  # the newest report that the service has received

    def __post_init__(self) -> None:
        self._wish_s = self._other_s = self._off_ground_s = -math.inf
        self._sent: deque[Report] = deque()  # reports on their way to the service
        self._followed = False  # whether the service has sent setpoints since the pilot engaged
        self._served_s = self._apart_s = self._flying_s = self.pair.time_s
        self._deliver = self.pair.down
        self.pair.down = self._delivered
        self._feed = self.pair.instance.feed_ground
        self.pair.instance.feed_ground = self._asked  # type: ignore[method-assign]
        self.pair.restarted = self.wrap
        self.wrap()

    def wrap(self) -> None:
        """Watch the present service. Called again after its restart, which ends an engagement."""
        service = self.pair.companion
        turn = service.turn
        self.left = self.engaged and self._followed
        self.engaged, self.known = False, None
        self._other_s = -math.inf  # the service cannot know what was sent before it began
        self._sent.clear()
        self.asked.clear()

        def watched(chunks: list[Chunk], now_s: float) -> tuple[bytes, ...]:
            for chunk in chunks:
                self._take(chunk.data)
            frames = turn(chunks, now_s)
            for frame in frames:
                self._judge(frame)
            return frames

        service.turn = watched  # type: ignore[method-assign]

    # ------------------------------------------------------------------ to the vehicle and from it

    def _asked(self, frame: bytes) -> None:
        """Note a command of the pilot to the vehicle."""
        if frame_id(frame) == COMMAND_LONG:
            message = decode(frame)
            asked = (message.command, message.param1, message.param2, message.param3)
            if asked == (SET_MODE, *MODES[self.pair.firmware]["engage"]):
                self._wish_s = self.pair.time_s
        self._feed(frame)

    def _delivered(self, time_s: float, datagrams: list[bytes]) -> list[bytes]:
        """Look at the vehicle, and note the reports of its mode that will reach the service."""
        self._look(time_s)
        arriving = self._deliver(time_s, datagrams)
        for frame in (frame for datagram in arriving for frame in frames_of(datagram)):
            number = frame_id(frame)
            if number in (HEARTBEAT, CURRENT_MODE) and (frame[5], frame[6]) == VEHICLE:
                failsafe = self.known is not None and self.known.failsafe
                if self._sent:
                    failsafe = self._sent[-1].failsafe
                if number == HEARTBEAT:
                    failsafe = decode(frame).system_status >= CRITICAL
                self._sent.append(Report(time_s, self.mode, self.engaged, failsafe))
        return arriving

    def _look(self, time_s: float) -> None:
        """Look at the state of the simulated vehicle."""
        mode, ours = self.pair.mode, ENGAGE[self.pair.firmware]
        if mode != self.mode:
            self.left = self._followed = False
            if mode == ours:
                self.asked.clear()
                self.before = self.mode
                # beside another sender the pilot switches to the mode for that sender
                alone = time_s - self._other_s > OTHER_S
                self.engaged = alone and time_s - self._wish_s < ANSWERED_S and self._off_ground
            else:
                self.engaged = False
                if mode not in self.asked:
                    self.asked.clear()
            self.mode, self.changed_s = mode, time_s
        unheard, autopilot = self.pair.lost_down or self.pair.paused, self.pair.instance.autopilot
        idle = not autopilot.commander.armed and autopilot.position_controller.landed
        if unheard or not idle:  # the service may not know that the vehicle is on the ground
            self._flying_s = time_s
        if not autopilot.plant.on_ground:
            self._off_ground_s = time_s
        joined = not (self.pair.lost_up or self.pair.lost_down or self.pair.paused)
        if not joined or time_s - self._other_s < OTHER_S or not (self.engaged and self._aloft):
            self._apart_s = time_s
        elif time_s - max(self._apart_s, self._served_s, self.changed_s) > UNFLOWN_S:
            self._note(f"nobody flies it in {mode}")
            self._apart_s = time_s
        down_mps = self.pair.instance.autopilot.state.truth.velocity_ned_mps[2]
        if self.engaged and self._aloft and down_mps > FALLING_MPS:
            self._note(f"falls at {down_mps:.1f} m/s")

    @property
    def _off_ground(self) -> bool:
        return self.pair.time_s - self._off_ground_s < TOUCHED_S

    @property
    def _aloft(self) -> bool:
        return bool(-self.pair.place[2] > ALOFT_M) and self.pair.armed

    def _take(self, datagram: bytes) -> None:
        """Note what arrives at the service."""
        for frame in frames_of(datagram):
            number, sender = frame_id(frame), (frame[5], frame[6])
            if sender == VEHICLE and number in (HEARTBEAT, CURRENT_MODE):
                if self._sent:
                    self.known = self._sent.popleft()
            elif sender != VEHICLE and number in SETPOINTS:
                self._other_s = self.pair.time_s
            elif sender != VEHICLE and number == COMMAND_LONG and decode(frame).command == START:
                starts = self.mode == ENGAGE[self.pair.firmware] and self._off_ground
                self.engaged |= starts
                if starts and self.known:
                    self.known = self.known._replace(engaged=True)

    # ------------------------------------------------------------------ from the service

    def _judge(self, frame: bytes) -> None:
        number = frame_id(frame)
        if number in SETPOINTS | COMMANDS:
            if (frame[5], frame[6]) != US:
                self._note(f"message {number} of {frame[5]}/{frame[6]}")
            if number in SETPOINTS:
                self._judge_setpoint(decode(frame))
            else:
                self._judge_command(decode(frame))
        elif number not in HARMLESS:
            self._note(f"message {number}")

    def _judge_setpoint(self, message: Any) -> None:
        on, known = self.pair.firmware, self.known
        self._served_s = self.pair.time_s
        self._judge_numbers(message)
        if self._is_unknown(known):
            self._note("setpoint without a recent report of the mode")
        elif known.mode == ENGAGE[on]:  # type: ignore[union-attr]
            self._judge_engaged(message, known)  # type: ignore[arg-type]
        elif on == "ardupilot":
            self._note(f"setpoint in {self.mode}")
        elif self._aloft:
            self._judge_stream(message, known)  # type: ignore[arg-type]
        elif message.thrust > 0.0 and self.pair.time_s - self._flying_s > REPORTED_S:
            self._note(f"thrust {message.thrust:.3f} on the ground")

    def _judge_numbers(self, message: Any) -> None:
        values = (*message.q, message.thrust)
        valid = all(map(math.isfinite, values)) and 0.0 <= message.thrust <= 1.0
        if not valid or abs(math.hypot(*message.q) - 1.0) > 4e-4 or message.type_mask != 7:
            self._note(f"setpoint {message}")
        _, x, y, _ = message.q
        if 2.0 * math.asin(min(1.0, math.hypot(x, y))) > TILT_RAD:
            self._note(f"setpoint tilted {message.q}")
        if self._aloft and message.thrust / HOVER[self.pair.firmware] < LEAST_SHARE:
            self._note(f"thrust {message.thrust:.3f} in the air, {self.mode}")

    def _judge_engaged(self, message: Any, known: Report) -> None:
        self._followed = True
        if not known.engaged and (self._aloft or message.thrust > 0.0) and not self.arms:
            self._note(f"setpoint in {known.mode}, to which no pilot has switched in the air")

    def _judge_stream(self, message: Any, known: Report) -> None:
        """Judge a setpoint to a PX4 vehicle that flies in another mode. PX4 wants such setpoints
        before OFFBOARD; they must be close to its present attitude."""
        if known.failsafe:
            self._note(f"setpoint in {known.mode}, a failsafe")
        if self.pair.time_s - self._other_s < OTHER_S:
            self._note(f"setpoint in {known.mode} beside those of another program")
        attitude = np.array(self.pair.instance.autopilot.state.truth.attitude)
        angle = 2.0 * math.acos(min(1.0, abs(float(attitude @ np.array(message.q)))))
        if angle > LIKE_NOW_RAD:
            self._note(f"setpoint {math.degrees(angle):.0f} deg away in {known.mode}")

    def _judge_command(self, message: Any) -> None:
        on, command = self.pair.firmware, message.command
        asked = command == SET_MODE and (message.param2, message.param3)
        holds = asked == HOLD_PARAMETERS[on]
        # back to the pilot's mode after a request to hold
        returns = asked == POSCTL and self.before == "POSCTL" and HOLD[on] in self.asked
        disarms = command == ARM and not message.param1 and not self._off_ground
        if command in QUESTIONS or (
            self.arms and command in (ARM, TAKEOFF, SET_MODE) and not holds
        ):
            return
        if not (holds or returns or disarms or command == LAND):
            self._note(f"command {command} ({message.param1:g}, {message.param2:g})")
            return
        self._served_s = self.pair.time_s
        if self._is_unknown(self.known):
            self._note(f"command {command} without a recent report of the mode")
        elif command == LAND and self._starved:
            pass  # the vehicle's own failsafe for missing setpoints flies it, and no pilot
        elif self.known.mode not in self.asked | {ENGAGE[on]}:  # type: ignore[union-attr]
            self._note(f"command {command} in {self.mode}")
        elif self.known.mode == ENGAGE[on]:  # type: ignore[union-attr]
            ours = self.known.engaged or self.left or self.arms  # type: ignore[union-attr]
            if not (ours or disarms):
                self._note(f"command {command} in {self.mode}, in which it is another's")
        if not disarms:
            self.asked.add(self.before if returns else HOLD[on] if holds else LANDS[on])

    @property
    def _starved(self) -> bool:
        commander = self.pair.instance.autopilot.commander
        return commander.failsafe and commander._cause == "stream lost"

    def _is_unknown(self, known: Report | None) -> bool:
        return known is None or self.pair.time_s - known.time_s > KNOWN_S

    def _note(self, what: str) -> None:
        self.unsafe.append(f"{self.pair.time_s:.2f} s {self.pair.phase.value}: {what}")
