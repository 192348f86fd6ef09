"""Identification while flying: what the flight shows of its vehicle is taken over, within bounds.

After the climb small steps show how tilt, course and thrust answer; from then on the flight itself
shows the drag. What is found is checked against the vehicle file, blended in over a second and
announced; what is not found, or out of bounds, stays as the vehicle file has it. Knows values and
vehicle time, no link and no clock.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from pydantic import Field

from offboard.control.base import Command
from offboard.control.delay_margin import supported_bandwidth
from offboard.control.identification import Identified, identify, identify_drag
from offboard.control.response_fit import Estimate
from offboard.control.trace import Recorder
from offboard.flight.excitation import LENGTH_S, excited
from offboard.flight.phases import Phase
from offboard.flight.takeover import bounded, mixed, record_of, told, with_link
from offboard.model.frames import course_from_quaternion, thrust_direction_from_quaternion
from offboard.model.vehicle import Parameters, Vehicle

RECORD_NAME, RECORD_ID = "identified", 2  # of the DEBUG_FLOAT_ARRAY in the log
LIFTED_OFF_S = 0.5  # the ground's effect on the thrust ends
DRAG_FIRST_S, DRAG_EVERY_S, DRAG_OVER_S = 3.0, 0.5, 25.0
# The tilt is looked at again while its delay is not known to this, and taken if this much better.
WELL_KNOWN_S, TILT_EVERY_S, BETTER = 0.004, 2.0, 0.7
DRAG_NEWS_PS = 0.03  # a smaller change is not worth a word
MOVING = (Phase.JOIN, Phase.TRACK)


class IdentifySettings(Parameters):
    """Identification in flight. A constant further from the vehicle file than `factor` either
    way, or outside the absolute ranges of `BOUNDS`, is not taken over."""

    online: bool = True
    excite: bool = True  # False: learn from climb and flight as they are
    tilt_step_deg: float = Field(default=2.0, ge=0.2, le=6)
    thrust_step: float = Field(default=0.05, ge=0, le=0.2)
    # Until the delay is known: 3 rad/s bears 0.25 s more than believed, 5 rad/s 0.13 s
    cautious_bandwidth_radps: float = Field(default=3.0, ge=0.5, le=20)
    box_m: float = Field(default=0.6, ge=0.1, le=5)  # from the start; further out the steps end
    factor: float = Field(default=4.0, ge=1, le=20)
    blend_s: float = Field(default=1.0, ge=0, le=10)


@dataclass(frozen=True, slots=True)
class Adoption:
    """What the companion shall fly with from now on. `bandwidth_limit_radps` is what the delay
    supports; `sentences` for the log and the user, `record` for the log (empty: nothing new)."""

    vehicle: Vehicle
    bandwidth_limit_radps: float
    gains: bool  # whether the law should solve for its gains anew: the last step of a blend
    sentences: tuple[str, ...] = ()
    record: tuple[float, ...] = ()


class Learner:
    """One flight's identification. `vehicle` is the vehicle file's."""

    def __init__(
        self,
        vehicle: Vehicle,
        settings: IdentifySettings,
        *,
        period_s: float,
        bandwidth_radps: float,
    ) -> None:
        self._file = vehicle
        self._settings = settings
        self._period_s = period_s
        self._bandwidth_radps = bandwidth_radps
        self._recorder = Recorder()
        self.reset()

    def reset(self) -> None:
        """Forget everything of the previous flight."""
        self._recorder.clear()
        self._from = self._to = self._now = self._file
        self._blend_began_s = -math.inf
        self._refused_drag_ps = math.inf
        self._climb_s = self._excite_s = self._moving_s = math.nan
        self._looked_s = self._tilt_looked_s = -math.inf
        self._delay_sd_s = math.inf
        self._identified = False
        self._gave_up = False
        self._left_box = False
        self._limit_radps = math.inf

    # ------------------------------------------------------------------ what happened

    def on_attitude(self, time_s: float, q: tuple[float, float, float, float]) -> None:
        if not math.isnan(self._climb_s):
            north, east, _ = thrust_direction_from_quaternion(q)
            course = float(course_from_quaternion(q))
            self._recorder.on_attitude(time_s, (float(north), float(east)), course)

    def on_position(
        self,
        time_s: float,
        position_ned_m: tuple[float, float, float],
        velocity_ned_mps: tuple[float, float, float],
    ) -> None:
        if not math.isnan(self._climb_s):
            self._recorder.on_position(time_s, position_ned_m, velocity_ned_mps)

    def on_command(self, time_s: float, command: Command) -> None:
        """A command sent, as scaled by the vehicle now adopted."""
        north, east, _ = command.thrust_direction_ned
        share = command.thrust_mps2 / self._now.thrust_max_mps2
        self._recorder.on_command(time_s, (north, east), share, command.course_rad)

    def on_phase(self, phase: Phase, time_s: float) -> None:
        if phase is Phase.CLIMB:
            self._climb_s = time_s
        elif phase is Phase.EXCITE:
            self._excite_s = time_s
        elif phase is Phase.JOIN:
            self._moving_s = time_s

    # ------------------------------------------------------------------ what to do

    @property
    def wants_excitation(self) -> bool:
        return self._settings.online and self._settings.excite

    @property
    def cautious_bandwidth_radps(self) -> float:
        """What the law may use until the delay is known."""
        return self._settings.cautious_bandwidth_radps

    def excited(self, command: Command, time_s: float, error_m: float) -> Command:
        """In the phase EXCITE: the command with its step, unless the vehicle left the box."""
        self._left_box = self._left_box or error_m > self._settings.box_m
        if self._left_box:
            return command
        tilt_rad = math.radians(self._settings.tilt_step_deg)
        return excited(command, time_s - self._excite_s, tilt_rad, self._settings.thrust_step)

    def finished(self, time_s: float) -> bool:
        """Whether the steps are over and what they showed is taken over."""
        if self._gave_up:
            return True
        return self._identified and time_s >= self._blend_began_s + self._settings.blend_s

    def give_up(self) -> None:
        """Learn nothing more in this flight."""
        self._gave_up = True

    def learn(self, phase: Phase, time_s: float) -> Adoption | None:
        """After a tick's command was sent: what to fly with from the next tick on."""
        if self._gave_up or not self._settings.online:
            return None
        sentences: list[str] = []
        record: tuple[float, ...] = ()
        if not self._identified and self._steps_are_over(phase, time_s):
            self._identified = True
            trace = self._recorder.trace(self._climb_s + LIFTED_OFF_S, time_s)
            found = identify(trace, self._file)
            sentences += self._take(found, time_s)
            sentences += self._conclude(found)
            record = record_of(found)
        elif phase in MOVING and self._drag_is_due(time_s):
            found = self._look_again(time_s)
            if found.supported:
                sentences += self._take(found, time_s)
                record = record_of(found)
            if found.tilt is not None:
                sentences += self._conclude(found)
        if self._to == self._now and not sentences and not record:
            return None
        return self._step(time_s, tuple(sentences), record)

    def _steps_are_over(self, phase: Phase, time_s: float) -> bool:
        if phase is Phase.EXCITE:
            return self._left_box or time_s >= self._excite_s + LENGTH_S
        return phase in MOVING and not self.wants_excitation

    def _drag_is_due(self, time_s: float) -> bool:
        return (
            time_s >= self._moving_s + DRAG_FIRST_S
            and time_s >= self._looked_s + DRAG_EVERY_S - 1e-6
        )

    def _look_again(self, time_s: float) -> Identified:
        """What the motion shows that is news: the drag, and the tilt where it is not known well."""
        self._looked_s = time_s
        begin_s = max(self._moving_s, time_s - DRAG_OVER_S)
        found = identify_drag(self._recorder.trace(begin_s, time_s), self._to)
        if not self._is_news(found.drag_ps):
            found = replace(found, drag_ps=None)
        if self._delay_sd_s > WELL_KNOWN_S and time_s >= self._tilt_looked_s + TILT_EVERY_S:
            self._tilt_looked_s = time_s
            begin_s = max(self._climb_s + LIFTED_OFF_S, time_s - DRAG_OVER_S)
            again = identify(self._recorder.trace(begin_s, time_s), self._file)
            if again.tilt is not None and again.tilt.delay_s.sd < BETTER * self._delay_sd_s:
                found = replace(found, tilt=again.tilt)
        return found

    def _is_news(self, drag: Estimate | None) -> bool:
        if drag is None:
            return False
        known = (self._to.drag_per_mass_ps, self._refused_drag_ps)
        return all(abs(drag.value - each) > max(DRAG_NEWS_PS, drag.sd) for each in known)

    # ------------------------------------------------------------------ taking over

    def _take(self, found: Identified, time_s: float) -> list[str]:
        """Set the target of the blend; what was taken, refused or out of bounds, in sentences."""
        within, sentences = bounded(found, self._file, self._settings.factor)
        target = with_link(within, within.applied_to(self._to), self._file)
        if target != self._to:
            self._from, self._to, self._blend_began_s = self._now, target, time_s
            sentences.insert(0, told(within))
        if within.drag_ps is None and found.drag_ps is not None:
            self._refused_drag_ps = found.drag_ps.value
        return sentences

    def _conclude(self, found: Identified) -> list[str]:
        """The bandwidth that the delay bears: the cautious one while it is not known."""
        tilt = found.tilt
        if tilt is None or tilt.delay_s.value != self._to.tilt.delay_s:
            self._limit_radps = self._settings.cautious_bandwidth_radps
            why = found.refusals.get("tilt", "it is out of bounds")
            return [f"tilt as believed, bandwidth {self._limit_radps:.1f} rad/s: {why}"]
        self._delay_sd_s = tilt.delay_s.sd
        limit = supported_bandwidth(
            self._to, self._bandwidth_radps, self._period_s, self._delay_sd_s
        )
        self._limit_radps = limit
        if limit >= self._bandwidth_radps:
            return []
        return [
            f"bandwidth lowered from {self._bandwidth_radps:.1f} to {limit:.1f} rad/s: a delay of "
            f"{1e3 * self._to.tilt.delay_s:.0f} ms supports no more",
        ]

    def _step(
        self, time_s: float, sentences: tuple[str, ...], record: tuple[float, ...]
    ) -> Adoption:
        share = 1.0
        if self._settings.blend_s > 0.0:
            passed_s = time_s - self._blend_began_s + self._period_s
            share = min(passed_s / self._settings.blend_s, 1.0)
        self._now = self._to if share > 1.0 - 1e-6 else mixed(self._from, self._to, share)
        return Adoption(self._now, self._limit_radps, self._now == self._to, sentences, record)
