"""Identification while flying: what the flight shows of its vehicle is looked at, piece by piece.

After the climb small steps show how tilt, course and thrust answer; they are repeated while the
delay stays uncertain. From then on the flight itself shows the drag, and whether the tilt still
answers as believed. The result is the `VehicleEstimate`. After each tick one piece of work of some
milliseconds is done. Knows values and vehicle time, no link and no clock.
"""

from __future__ import annotations

import math
from collections.abc import Generator
from dataclasses import dataclass

from pydantic import Field

from offboard.documents.parameters import Parameters
from offboard.flight.phases import Phase
from offboard.identification.adoption import record_of
from offboard.identification.excitation import LENGTH_S, excited
from offboard.identification.response_fit import Estimate, unexplained
from offboard.identification.stages import identify_drag, identify_tilt, stages
from offboard.identification.trace import Recorder
from offboard.identification.vehicle_estimate import VehicleEstimate
from offboard.model.command import Command
from offboard.model.frames import course_from_quaternion, thrust_direction_from_quaternion
from offboard.model.vehicle import Vehicle

RECORD_NAME, RECORD_ID = "identified", 2  # of the DEBUG_FLOAT_ARRAY in the log
LIFTED_OFF_S = 0.5  # the ground's effect on the thrust ends
MOST_ROUNDS = 3  # of steps
DRAG_FIRST_S, DRAG_EVERY_S, DRAG_OVER_S = 3.0, 0.5, 25.0
# The tilt is looked at again while its delay is not known to this, or doubted.
WELL_KNOWN_S, TILT_EVERY_S, TILT_OVER_S = 0.004, 2.0, 12.0
DRAG_NEWS_PS = 0.03  # a smaller change is not worth a word
# The last seconds are predicted so often; what contradicts twice in a row counts.
WATCH_EVERY_S, WATCH_OVER_S, WATCH_TWICE = 0.5, 2.0, 2
MOVING = (Phase.JOIN, Phase.TRACK)


class IdentifySettings(Parameters):
    """Identification in flight. A constant further from the vehicle file than `factor` either
    way, or outside the absolute ranges of `BOUNDS`, is not taken over."""

    online: bool = True
    excite: bool = True  # False: learn from climb and flight as they are
    tilt_step_deg: float = Field(default=2.0, ge=0.2, le=6)
    thrust_step: float = Field(default=0.05, ge=0, le=0.2)
    # What the delay may be wrong by until it is identified: the bandwidth is lowered to bear it
    unknown_delay_s: float = Field(default=0.28, ge=0.0, le=0.6)
    # The same of a vehicle file that is flown as it is (online: false): 5 rad/s bears so much
    file_delay_s: float = Field(default=0.13, ge=0.0, le=0.6)
    box_m: float = Field(default=0.6, ge=0.1, le=5)  # from the start; further out the steps end
    factor: float = Field(default=4.0, ge=1, le=20)
    blend_s: float = Field(default=1.0, ge=0, le=10)

    @property
    def doubt_s(self) -> float:
        """What the vehicle file's delay may be wrong by."""
        return self.unknown_delay_s if self.online else self.file_delay_s


@dataclass(frozen=True, slots=True)
class Adoption:
    """What the companion shall fly with from now on. `bandwidth_limit_radps` is what the delay
    supports; `sentences` for the log and the user, `record` for the log (empty: nothing new)."""

    vehicle: Vehicle
    bandwidth_limit_radps: float
    gains: bool  # whether the law should solve for its gains anew: the last step of a blend
    sentences: tuple[str, ...] = ()
    record: tuple[float, ...] = ()


class OnlineIdentification:
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
        self._recorder = Recorder()
        self._estimate = VehicleEstimate(
            vehicle,
            factor=settings.factor,
            blend_s=settings.blend_s,
            unknown_delay_s=settings.doubt_s,
            period_s=period_s,
            bandwidth_radps=bandwidth_radps,
        )
        self.reset()

    def reset(self) -> None:
        """Forget everything of the previous flight."""
        self._recorder.clear()
        self._estimate.reset()
        self._time_s = 0.0
        self._climb_s = self._excite_s = self._moving_s = math.nan
        self._rounds = 1
        self._drag_looked_s = self._tilt_looked_s = self._watched_s = -math.inf
        self._doubted_from_s = -math.inf
        self._contradictions = 0  # in a row
        self._identified = False
        self._gave_up = False
        self._left_box = False
        self._work: Generator[None, None, None] | None = None
        self._sentences: list[str] = []
        self._record: tuple[float, ...] = ()

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
        share = command.thrust_mps2 / self._estimate.now.thrust_max_mps2
        self._recorder.on_command(time_s, (north, east), share, command.course_rad)

    def on_link_delay(self, late: Estimate | None) -> None:
        """How late the link is, measured before lift-off; None: the vehicle did not tell."""
        if late is not None:
            self._sentences += self._estimate.expect_link(late)

    def on_phase(self, phase: Phase, time_s: float) -> None:
        if not self._settings.online:
            if phase is Phase.CLIMB:
                self._sentences += self._estimate.unsure()
        elif phase is Phase.CLIMB:
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
        return self._estimate.cautious_radps

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
        return self._identified and self._estimate.taken_over(time_s)

    @property
    def contradiction(self) -> str:
        """What telemetry says against the vehicle file, so that the flight must end; or empty."""
        return self._estimate.contradiction

    def give_up(self) -> None:
        """Learn nothing more in this flight."""
        self._gave_up = True

    def learn(self, phase: Phase, time_s: float) -> Adoption | None:
        """After a tick's command was sent: what to fly with from the next tick on."""
        if self._gave_up:
            return None
        self._time_s = time_s
        if self._work is None:
            self._work = self._due(phase, time_s)
        if self._work is not None and next(self._work, self) is self:
            self._work = None
        sentences, self._sentences = tuple(self._sentences), []
        record, self._record = self._record, ()
        estimate = self._estimate
        if estimate.settled and not sentences and not record:
            return None
        estimate.step(time_s)
        return Adoption(estimate.now, estimate.limit_radps, estimate.settled, sentences, record)

    # ------------------------------------------------------------------ work, in pieces

    def _due(self, phase: Phase, time_s: float) -> Generator[None, None, None] | None:
        """The work that is to be begun now."""
        if not self._settings.online:
            return None
        if not self._identified:
            return self._look_at_steps(phase) if self._steps_are_over(phase, time_s) else None
        if phase not in MOVING:
            return None
        if self._is_due(self._watched_s, WATCH_EVERY_S) and not self._estimate.doubted:
            return self._watch()
        sure = self._estimate.delay is not None and self._estimate.delay.sd <= WELL_KNOWN_S
        if self._is_due(self._tilt_looked_s, TILT_EVERY_S) and (self._estimate.doubted or not sure):
            return self._look_at_tilt()
        shown = time_s >= self._moving_s + DRAG_FIRST_S and not self._estimate.doubted
        if shown and self._is_due(self._drag_looked_s, DRAG_EVERY_S):
            return self._look_at_drag()
        return None

    def _is_due(self, last_s: float, every_s: float) -> bool:
        return self._time_s >= last_s + every_s - 1e-6

    def _steps_are_over(self, phase: Phase, time_s: float) -> bool:
        if phase is Phase.EXCITE:
            return self._left_box or time_s >= self._excite_s + LENGTH_S
        return phase in MOVING and not self.wants_excitation

    def _look_at_steps(self, phase: Phase) -> Generator[None, None, None]:
        """Everything; once more the steps, where they did not show the tilt well enough."""
        trace = self._recorder.trace(self._climb_s + LIFTED_OFF_S, self._time_s)
        found = yield from stages(trace, self._file)
        yield
        refusal = found.refusals.get("tilt")
        again = phase is Phase.EXCITE and self._rounds < MOST_ROUNDS and not self._left_box
        if refusal is not None and again:
            self._rounds += 1
            self._excite_s = self._time_s
            self._sentences.append(f"the steps again: {refusal}")
            return
        self._identified = True
        self._sentences += self._estimate.take(found, self._time_s)
        self._record = record_of(found)
        yield
        self._sentences += self._estimate.conclude(refusal or "it is out of bounds")

    def _look_at_drag(self) -> Generator[None, None, None]:
        self._drag_looked_s = self._time_s
        begin_s = max(self._moving_s, self._time_s - DRAG_OVER_S)
        trace = self._recorder.trace(begin_s, self._time_s)
        found = identify_drag(trace, self._estimate.target)
        if self._estimate.is_news(found.drag_ps, DRAG_NEWS_PS):
            self._sentences += self._estimate.take(found, self._time_s)
            self._record = record_of(found)
        yield

    def _look_at_tilt(self) -> Generator[None, None, None]:
        """Whether the flight itself shows the tilt better, or other than believed."""
        self._tilt_looked_s = self._time_s
        begin_s = max(
            self._climb_s + LIFTED_OFF_S, self._time_s - TILT_OVER_S, self._doubted_from_s
        )
        trace = self._recorder.trace(begin_s, self._time_s)
        found = identify_tilt(trace)
        yield
        before = self._estimate.delay
        now = unexplained(trace, self._estimate.target.tilt)
        self._sentences += self._estimate.look_again(found, now, self._time_s)
        if self._estimate.delay is not before:
            self._record = record_of(found)
        yield

    def _watch(self) -> Generator[None, None, None]:
        """Whether the tilt answers as believed."""
        self._watched_s = self._time_s
        trace = self._recorder.trace(self._time_s - WATCH_OVER_S, self._time_s)
        now = unexplained(trace, self._estimate.target.tilt)
        self._contradictions = self._contradictions + 1 if now.contradicts else 0
        if self._contradictions >= WATCH_TWICE:
            self._contradictions = 0
            before = unexplained(trace, self._estimate.before.tilt)
            self._doubted_from_s = self._time_s - WATCH_OVER_S
            self._sentences += self._estimate.contradict(now, before, self._time_s)
        yield
