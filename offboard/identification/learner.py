"""Identification in flight: the steps that excite the responses, and one piece of work after each
setpoint.

The flight passes telemetry, commands and the stage that it has entered to the `Learner`. After each
setpoint was sent, `learn` does one piece of work of 10 to 20 ms at most:

- First it identifies all constants, from the climb and the steps that are flown for this purpose.
  The steps are repeated if they do not determine the tilt's response.
- In motion it identifies drag, tilt response, delay and lag of the thrust, and hover thrust, and
  adopts those that are more certain or differ from those in use.
- It compares the tilt of the last seconds with its prediction; see `vehicle_estimate`.

New results are returned as a `VehicleUpdate`. Times are vehicle time.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Generator, Mapping
from dataclasses import dataclass, field, replace
from enum import Enum, auto

import numpy as np
from pydantic import Field

from offboard.documents.parameters import Parameters
from offboard.identification.attitude_fit import FLY_STEPS, TILT, fit_axis, unexplained
from offboard.identification.trace import (
    ATTITUDE_WIDTH,
    COMMAND_WIDTH,
    POSITION_WIDTH,
    Rows,
    Trace,
    clean,
)
from offboard.identification.uncertainty import Estimate
from offboard.identification.vehicle_estimate import (
    FILE_DELAY_S,
    UNKNOWN_DELAY_S,
    IdentifiedVehicle,
    VehicleEstimate,
    in_ms,
)
from offboard.identification.vehicle_fit import (
    Identified,
    identify_drag,
    identify_in_pieces,
    identify_thrust,
)
from offboard.model.command import Command
from offboard.model.frames import (
    heading_from_quaternion,
    thrust_direction_from_quaternion,
    wrap_pi,
)
from offboard.model.vehicle import DelayUncertainty, Vehicle

# A step is + - - + in four equal parts, so that the vehicle ends where it began. Each is given as
# (start, length of one of the four parts), s
NORTH_S = ((0.0, 0.3), (2.4, 0.2))
EAST_S = ((1.2, 0.3), (3.2, 0.2))
THRUST_S = ((0.2, 0.3), (2.2, 0.3))
HEADING_S = ((0.0, 1.0),)
LENGTH_S = 4.0
TILT_RAD = math.radians(2.0)
THRUST_SHARE = 0.05
# Steps are flown at most so many times, until the sd of the tilt's delay is at most CERTAIN_S
MOST_ROUNDS = 3
CERTAIN_S = 0.01

LIFTED_OFF_S = 0.5  # after this the ground has no effect on the thrust
SETTLE_S = 1.0  # the observer needs this time after an adoption
# Drag: first fit after the start of the motion, interval, length of flight that is fitted, and
# smallest change (1/s) that is adopted
DRAG_FIRST_S, DRAG_EVERY_S, DRAG_OVER_S, DRAG_NEWS_PS = 3.0, 0.5, 25.0, 0.03
# Hover thrust of the observer: interval, length of flight that is averaged, and smallest change, as
# a share and in sds, that is adopted: gusts of 1 m/s change the hover thrust by 6 %
HOVER_EVERY_S, HOVER_OVER_S, HOVER_NEWS, HOVER_SDS = 1.0, 6.0, 0.06, 3.0
HOVER_RELATED_S = 2.0  # time over which its errors are autocorrelated
# Tilt: fitted again while its delay is in doubt or has a greater sd than WELL_KNOWN_S; interval and
# length of flight
WELL_KNOWN_S, TILT_EVERY_S, TILT_OVER_S = 0.004, 2.0, 12.0
# Thrust: first fit after the start of the motion, interval; from TILT_OVER_S of flight
THRUST_FIRST_S, THRUST_EVERY_S = 6.0, 2.0
# Comparison of tilt and prediction: interval and length of flight. Two contradictions in a row put
# the vehicle in doubt
COMPARE_EVERY_S, COMPARE_OVER_S = 0.5, 2.0

Work = Generator[None, None, None]


class IdentifySettings(Parameters):
    """Settings of the identification in flight."""

    online: bool = True
    excite: bool = True  # False: no steps, identify from climb and reference alone
    box_m: float = Field(default=0.6, ge=0.1, le=5)  # steps end at this distance from their start


class Stage(Enum):
    """Stage of the flight, as far as the identification distinguishes it."""

    OTHER = auto()
    CLIMB = auto()  # the vehicle lifts off or was taken over; data are collected from here on
    STEPS = auto()
    MOTION = auto()  # the vehicle follows the reference


@dataclass(frozen=True, slots=True)
class VehicleUpdate:
    """The constants to fly with from the next tick on.

    `vehicle` is for controller and observer, `uncertainty` for the controller; `cause` is the
    reason for this uncertainty. `sentences` are for log and user, `record` for the log (empty if
    nothing is new).
    """

    vehicle: Vehicle
    uncertainty: DelayUncertainty
    cause: str = ""
    sentences: tuple[str, ...] = ()
    record: Mapping[str, Estimate | None] = field(default_factory=dict)


class Learner(VehicleEstimate):
    """The estimate of one vehicle, improved during one flight. It needs all telemetry and commands
    (`on_...`); `learn` is called once per tick.

    Args:
        vehicle: constants of the vehicle file.
        settings: see `IdentifySettings`.
        known: the constants that an earlier flight has identified; then no steps are flown.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        settings: IdentifySettings,
        *,
        known: IdentifiedVehicle | None = None,
    ) -> None:
        known = known if settings.online else None
        super().__init__(
            vehicle,
            delay_error_s=UNKNOWN_DELAY_S if settings.online else FILE_DELAY_S,
            known=known,
        )
        self.identified = self.delay.known
        self._settings = settings
        # The last update returned, and whether the last call of `learn` returned it
        self._told = VehicleUpdate(self.vehicle, self.uncertainty)
        self._has_told = False
        if not self.identified:
            self.cause = "the vehicle's delay is not identified yet"
        if not settings.online:
            self.cause = (
                f"without identification the vehicle file's delay may be wrong by "
                f"{1e3 * FILE_DELAY_S:.0f} ms"
            )
        self._commands, self._attitudes = Rows(COMMAND_WIDTH), Rows(ATTITUDE_WIDTH)
        self._positions = Rows(POSITION_WIDTH)
        self._stage = Stage.OTHER
        self._time_s = 0.0
        self._climb_s = self._steps_s = self.motion_s = math.inf  # when each began
        self._rounds = 1
        self._left_box = self._gave_up = False
        self._work: Work | None = None
        self._due_s: dict[str, float] = {}  # when each piece of work is due again
        self._doubted_from_s = -math.inf
        self._hover: deque[tuple[float, float]] = deque()

    # ------------------------------------------------------------------ events

    def on_attitude(self, time_s: float, q: tuple[float, float, float, float]) -> None:
        """Store an attitude received (ATTITUDE_QUATERNION: body to NED, w first)."""
        if time_s >= self._climb_s:
            north, east, _ = thrust_direction_from_quaternion(q)
            self._attitudes.add(time_s, north, east, float(heading_from_quaternion(q)))

    def on_position(
        self,
        time_s: float,
        position_ned_m: tuple[float, float, float],
        velocity_ned_mps: tuple[float, float, float],
    ) -> None:
        """Store a position received (LOCAL_POSITION_NED)."""
        if time_s >= self._climb_s:
            self._positions.add(time_s, *position_ned_m, *velocity_ned_mps)

    def on_command(self, time_s: float, command: Command, thrust: float) -> None:
        """Store a command sent; `thrust` is its thrust as a fraction of full throttle."""
        north, east, _ = command.thrust_direction_ned
        self._commands.add(time_s, north, east, thrust, command.heading_rad)

    def on_stage(self, stage: Stage, time_s: float) -> None:
        """Note that the flight has entered `stage`."""
        self._stage = stage
        if stage is Stage.CLIMB:
            self._climb_s, self.motion_s = time_s, math.inf  # a repeated reference has its own
        elif stage is Stage.STEPS:
            self._steps_s = time_s
        elif stage is Stage.MOTION:
            self.motion_s = min(self.motion_s, time_s)

    # ------------------------------------------------------------------ what the flight reads

    @property
    def wants_excitation(self) -> bool:
        """Whether the flight should go through the steps."""
        return self._settings.online and self._settings.excite and not self.identified

    def excited(self, command: Command, time_s: float, error_m: float) -> Command:
        """Return `command` with the step of this time added, unless the vehicle has left the box:
        unless its distance `error_m` from the reference has exceeded `box_m`."""
        self._left_box = self._left_box or error_m > self._settings.box_m
        return command if self._left_box else excited(command, time_s - self._steps_s)

    def finished(self, time_s: float) -> bool:
        """Whether the steps are over and the observer has settled with the new constants."""
        settled = time_s >= self.adopted_s + SETTLE_S
        return self._gave_up or (self.identified and settled)

    def give_up(self) -> None:
        """Identify nothing more in this flight."""
        self._gave_up = True

    # ------------------------------------------------------------------ work, in pieces

    def learn(self, time_s: float, hover_thrust: float) -> VehicleUpdate | None:
        """Return the constants to fly with from the next tick on. If nothing is new, do one piece
        of work and return None. `hover_thrust` is the observer's estimate.

        While the link delay changes with each tick, every other call does a piece of work.
        """
        told = VehicleUpdate(self.vehicle, self.uncertainty, self.cause)
        if not self._has_told and (self.sentences or self.record or told != self._told):
            self._has_told, self._told = True, told
            update = replace(told, sentences=tuple(self.sentences), record=self.record)
            self.sentences, self.record = [], {}
            return update
        self._has_told = False
        if self._gave_up:
            return None
        self._time_s = time_s
        if self.identified and self._stage is Stage.MOTION and not self.in_doubt:
            self._hover.append((time_s, hover_thrust))
        if self._settings.online and self._work is None:
            self._work = self._due()
        if self._work is not None and next(self._work, self) is self:
            self._work = None
        return None

    def _due(self) -> Work | None:
        """Return the work to begin now if it has several pieces; do work of one piece at once."""
        if not self.identified:
            flown = self._stage is Stage.MOTION and not self._settings.excite
            if self._stage is Stage.STEPS:
                at_once = self._left_box and self._rounds == 1
                flown = at_once or self._time_s >= self._steps_s + LENGTH_S
            return self._identify_all() if flown else None
        if self._stage is not Stage.MOTION:
            return None
        certain = self.delay.sd <= WELL_KNOWN_S
        if not self.in_doubt and self._is_due("compare", COMPARE_EVERY_S):
            self._compare_with_prediction()
            return None
        if (self.in_doubt or not certain) and self._is_due("tilt", TILT_EVERY_S):
            return self._identify_tilt()
        if self.in_doubt:
            return None
        moved_s = self._time_s - self.motion_s
        if moved_s >= DRAG_FIRST_S and self._is_due("drag", DRAG_EVERY_S):
            self._identify_drag()
        elif moved_s >= THRUST_FIRST_S and self._is_due("thrust", THRUST_EVERY_S):
            self._identify_thrust()
        elif self._is_due("hover", HOVER_EVERY_S):
            self._review_hover()
        return None

    def _is_due(self, work: str, every_s: float) -> bool:
        if self._time_s < self._due_s.get(work, -math.inf) - 1e-6:
            return False
        self._due_s[work] = self._time_s + every_s
        return True

    def _flown_since(self, begin_s: float) -> Trace:
        known = clean(self._commands.kept, self._attitudes.kept, self._positions.kept)
        return known.between(begin_s, self._time_s)

    def _identify_all(self) -> Work:
        """Identify everything from climb and steps. Repeat the steps if they do not determine the
        tilt's response."""
        trace = self._flown_since(self._climb_s + LIFTED_OFF_S)
        found = yield from identify_in_pieces(trace, self.file)
        refusal = found.refusals.get("tilt")
        if found.tilt and found.tilt.delay_s.sd > CERTAIN_S:
            refusal = f"its delay is uncertain: {in_ms(found.tilt.delay_s)}"
        if refusal and self._settings.excite:  # no advice is needed: steps are flown
            refusal = refusal.removesuffix(FLY_STEPS)
        may_repeat = self._stage is Stage.STEPS and self._rounds < MOST_ROUNDS
        if refusal is not None and may_repeat:
            self._rounds += 1
            self._steps_s = self._time_s
            again = "waiting for more flight" if self._left_box else "repeating the steps"
            self.sentences.append(f"{again}, tilt not identified: {refusal}")
            return
        self.identified = True
        self.adopt(found, self._time_s)
        self.explain(refusal or "it is out of bounds")
        if not self.delay.known:
            self.sentences.append(self.cause)
            self.cause = ""

    def _identify_drag(self) -> None:
        trace = self._flown_since(max(self.motion_s, self._time_s - DRAG_OVER_S))
        self.review_drag(identify_drag(trace, self.vehicle), DRAG_NEWS_PS, self._time_s)

    def _identify_thrust(self) -> None:
        trace = self._flown_since(max(self.motion_s, self._time_s - TILT_OVER_S))
        found = identify_thrust(trace, self.vehicle, self.delay, self.file)
        self.review_thrust(found, self._time_s)

    def _identify_tilt(self) -> Work:
        """Identify the tilt from the last seconds, without the lift-off and the flight before a
        contradiction, and adopt the fit if it is better."""
        over_s = self._time_s - TILT_OVER_S
        trace = self._flown_since(max(self._climb_s + LIFTED_OFF_S, over_s, self._doubted_from_s))
        tilt = yield from fit_axis(TILT, trace, {})
        found = Identified(trace.seconds, tilt=tilt)
        self.review_tilt(found, unexplained(trace, self.vehicle.tilt), self._time_s)

    def _compare_with_prediction(self) -> None:
        """Compare the tilt of the last seconds with the prediction by the constants in use."""
        begin_s = self._time_s - COMPARE_OVER_S
        trace = self._flown_since(begin_s)
        now = unexplained(trace, self.vehicle.tilt)
        if self._again("tilt", now.contradicts and not self.link_changed):
            self._doubted_from_s = begin_s
            self.on_contradiction(now, unexplained(trace, self.previous.tilt), self._time_s)

    def _review_hover(self) -> None:
        """Adopt the mean of the observer's hover thrust if it differs from the one in use twice in
        a row, because mass or battery has changed. A value out of bounds is ignored."""
        while self._hover[0][0] < self._time_s - HOVER_OVER_S:
            self._hover.popleft()
        if self._hover[0][0] > self._time_s - HOVER_OVER_S + HOVER_EVERY_S:
            return
        shares, known = np.array(self._hover)[:, 1], self.vehicle.hover_thrust
        sd = float(np.std(shares)) / math.sqrt(HOVER_OVER_S / HOVER_RELATED_S)
        hover = Estimate(float(np.mean(shares)), sd)
        found = Identified(HOVER_OVER_S, hover_thrust=hover)
        differs = abs(hover.value - known) > max(HOVER_NEWS * known, HOVER_SDS * sd)
        if self._again("hover", differs and not self.within_bounds(found)[1]):
            self.adopt(found, self._time_s)


# ---------------------------------------------------------------------- steps


def excited(command: Command, time_s: float) -> Command:
    """Return `command` with the steps added, at `time_s` since their start: TILT_RAD in tilt, twice
    that in heading, THRUST_SHARE of itself in thrust. A command that would be tilted by more than
    64 degrees is returned unchanged."""
    north, east, _ = command.thrust_direction_ned
    north += math.sin(TILT_RAD) * _step_sign(time_s, NORTH_S)
    east += math.sin(TILT_RAD) * _step_sign(time_s, EAST_S)
    lateral = math.hypot(north, east)
    if lateral >= 0.9:
        return command
    thrust = command.thrust_mps2 * (1.0 + THRUST_SHARE * _step_sign(time_s, THRUST_S))
    heading = command.heading_rad + 2.0 * TILT_RAD * _step_sign(time_s, HEADING_S)
    return Command(
        thrust, (north, east, math.sqrt(1.0 - lateral * lateral)), float(wrap_pi(heading))
    )


def _step_sign(time_s: float, steps: tuple[tuple[float, float], ...]) -> float:
    """Return +1, -1, -1, +1 in the four parts of each step, else 0."""
    for begin_s, part_s in steps:
        part = math.floor((time_s - begin_s) / part_s + 1e-6)
        if 0 <= part < 4:
            return 1.0 if part in (0, 3) else -1.0
    return 0.0
