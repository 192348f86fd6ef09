"""Identification while flying: what is identified when, a piece of work after each control tick.

After the climb small steps of tilt, course and thrust show the responses; they are repeated while
the tilt response stays uncertain. During the reference the drag is identified, and the tilt is
compared with its prediction. The results go into the `VehicleEstimate`. Time is vehicle time.
"""

from __future__ import annotations

import math
from collections.abc import Generator
from dataclasses import dataclass

from pydantic import Field

from offboard.documents.parameters import Parameters
from offboard.flight.phases import MOVING, Phase
from offboard.identification.adoption import log_record
from offboard.identification.attitude_fit import unexplained
from offboard.identification.excitation import LENGTH_S, excited
from offboard.identification.learned import Learned
from offboard.identification.trace import Recorder, Trace
from offboard.identification.uncertainty import Estimate
from offboard.identification.vehicle_estimate import OUT_OF_BOUNDS, VehicleEstimate
from offboard.identification.vehicle_fit import (
    identify_drag,
    identify_hover,
    identify_in_pieces,
    identify_tilt,
)
from offboard.model.command import Command
from offboard.model.frames import course_from_quaternion, thrust_direction_from_quaternion
from offboard.model.vehicle import Vehicle

LIFTED_OFF_S = 0.5  # after this the ground has no effect on the thrust
MOST_ROUNDS = 3  # of steps
# Drag: when it is identified first, how often, and from how much flight.
DRAG_FIRST_S, DRAG_EVERY_S, DRAG_OVER_S = 3.0, 0.5, 25.0
HOVER_EVERY_S, HOVER_OVER_S = 1.0, 6.0  # hover thrust: how often, and from how much flight
# Tilt: identified again while its delay is in doubt or its sd is greater than this.
WELL_KNOWN_S, TILT_EVERY_S, TILT_OVER_S = 0.004, 2.0, 12.0
DRAG_NEWS_PS = 0.03  # a smaller change of drag is not adopted
# Prediction: how often and over how much flight it is compared with the tilt, and after how many
# contradictions in a row the estimate is in doubt.
COMPARE_EVERY_S, COMPARE_OVER_S, COMPARE_TIMES = 0.5, 2.0, 2
LINK_DIGITS = 2  # of seconds: a smaller change of the link changes no bandwidth

Work = Generator[None, None, None]


class IdentifySettings(Parameters):
    """Identification in flight. A constant further from the vehicle file than `factor` either
    way, or outside the absolute ranges of `BOUNDS`, is not adopted."""

    online: bool = True
    excite: bool = True  # False: no steps, identify from climb and reference alone
    tilt_step_deg: float = Field(default=2.0, ge=0.2, le=6)
    thrust_step: float = Field(default=0.05, ge=0, le=0.2)
    # Possible error of the delay until it is identified: the bandwidth is limited accordingly
    unknown_delay_s: float = Field(default=0.28, ge=0.0, le=0.6)
    # Possible error of the vehicle file's delay (online: false); supports a bandwidth of 5 rad/s
    file_delay_s: float = Field(default=0.13, ge=0.0, le=0.6)
    box_m: float = Field(default=0.6, ge=0.1, le=5)  # further from the start the steps end
    factor: float = Field(default=4.0, ge=1, le=20)
    blend_s: float = Field(default=1.0, ge=0, le=10)

    @property
    def initial_delay_error_s(self) -> float:
        """Possible error of the vehicle file's delay."""
        return self.unknown_delay_s if self.online else self.file_delay_s


@dataclass(frozen=True, slots=True)
class Adoption:
    """What to fly with from the next tick on.

    `vehicle` goes to controller and observer, `bandwidth_limit_radps` to the controller;
    `sentences` are for log and user, `record` for the log (empty: nothing new).
    """

    vehicle: Vehicle
    bandwidth_limit_radps: float
    gains: bool  # whether to compute the gains anew: at the end of a blend, or at a lower limit
    sentences: tuple[str, ...] = ()
    record: tuple[float, ...] = ()


class OnlineIdentification:
    """Identification during one flight.

    Args:
        vehicle: constants of the vehicle file.
        settings: see `IdentifySettings`.
        period_s: control period.
        bandwidth_radps: bandwidth of the controller as configured.
        learned: what an earlier flight has identified; then no steps are flown.

    It is told what arrives and what is sent (`on_...`), and `learn` is called once per tick.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        settings: IdentifySettings,
        *,
        period_s: float,
        bandwidth_radps: float,
        learned: Learned | None = None,
    ) -> None:
        self._file = vehicle
        self._settings = settings
        self._recalled = learned if settings.online else None
        self._recorder = Recorder()
        self._estimate = VehicleEstimate(
            vehicle,
            factor=settings.factor,
            blend_s=settings.blend_s,
            unknown_delay_s=settings.initial_delay_error_s,
            period_s=period_s,
            bandwidth_radps=bandwidth_radps,
        )
        self.reset()

    def reset(self) -> None:
        """Forget the previous flight."""
        self._recorder.clear()
        self._estimate.reset()
        if self._recalled:
            self._estimate.recall(self._recalled)
        self._link_s = 0.0  # the link's delay when the climb began
        self._time_s = 0.0
        self._climb_s = self._excite_s = self._moving_s = math.nan
        self._rounds = 1
        self._drag_at_s = self._tilt_at_s = self._compared_at_s = self._hover_at_s = -math.inf
        self._in_doubt_from_s = -math.inf
        self._contradictions = 0  # in a row
        self._identified = self._recalled is not None
        self._gave_up = False
        self._left_box = False
        self._limit_radps = self._estimate.limit_radps  # as adopted
        self._link = (0.0, 0.0)  # growth and change
        self._link_is_new = False  # not yet taken into account
        self._followed_link = False  # the newest work has taken it into account
        self._work: Work | None = None
        self._sentences: list[str] = []
        self._record: tuple[float, ...] = ()

    # ------------------------------------------------------------------ events

    def on_attitude(self, time_s: float, q: tuple[float, float, float, float]) -> None:
        """An attitude received (ATTITUDE_QUATERNION: body to NED, w first)."""
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
        """A position received (LOCAL_POSITION_NED)."""
        if not math.isnan(self._climb_s):
            self._recorder.on_position(time_s, position_ned_m, velocity_ned_mps)

    def on_command(self, time_s: float, command: Command) -> None:
        """A command sent; its thrust was scaled with the current estimate."""
        north, east, _ = command.thrust_direction_ned
        share = command.thrust_mps2 / self._estimate.now.thrust_max_mps2
        self._recorder.on_command(time_s, (north, east), share, command.course_rad)

    def on_link_delay(self, link: Estimate | None) -> None:
        """The link's delay, measured before lift-off; None if the vehicle did not answer."""
        if link is None:
            return
        self._link_s = link.value
        if self._recalled:
            self._sentences += self._estimate.apply_link_change(self._recalled, link)
        else:
            self._sentences += self._estimate.apply_link_delay(link)

    def on_hover_thrust(self, hover_thrust: float) -> None:
        """The hover thrust that the vehicle showed before the take-over."""
        self._estimate.apply_hover_thrust(hover_thrust)

    def on_link_growth(self, added_s: float, changed_s: float) -> None:
        """The link has added `added_s` to its delay since take-off, and changed by `changed_s`
        lately; see `LinkGrowth`. The times of commands contain the former."""
        link = round(added_s, LINK_DIGITS), round(changed_s, LINK_DIGITS)
        if link != self._link:
            self._link, self._link_is_new = link, True

    def on_phase(self, phase: Phase, time_s: float) -> None:
        """The flight has entered `phase`."""
        if not self._settings.online:
            if phase is Phase.CLIMB:
                self._sentences += self._estimate.without_identification()
        elif phase is Phase.CLIMB:
            self._climb_s = time_s
        elif phase is Phase.EXCITE:
            self._excite_s = time_s
        elif phase is Phase.JOIN:
            self._moving_s = time_s

    # ------------------------------------------------------------------ what to do

    @property
    def wants_excitation(self) -> bool:
        """Whether the flight should go through the phase EXCITE."""
        return self._settings.online and self._settings.excite and not self._identified

    @property
    def learned(self) -> Learned | None:
        """What the next flight of this vehicle may begin with; None if nothing is known."""
        return self._estimate.learned(self._link_s) if self._identified else None

    @property
    def contradicted(self) -> bool:
        """Whether telemetry has contradicted the constants in use."""
        return self._estimate.contradicted

    @property
    def cautious_bandwidth_radps(self) -> float:
        """Bandwidth limit until the delay is identified."""
        return self._estimate.cautious_radps

    @property
    def bandwidth_limit_radps(self) -> float:
        """The bandwidth limit that was adopted last."""
        return self._limit_radps

    def excited(self, command: Command, time_s: float, error_m: float) -> Command:
        """In the phase EXCITE: `command` with its step, until the vehicle leaves the box."""
        self._left_box = self._left_box or error_m > self._settings.box_m
        if self._left_box:
            return command
        tilt_rad = math.radians(self._settings.tilt_step_deg)
        return excited(command, time_s - self._excite_s, tilt_rad, self._settings.thrust_step)

    def finished(self, time_s: float) -> bool:
        """Whether the steps are over and what they showed is adopted."""
        if self._gave_up:
            return True
        return self._identified and self._estimate.blended(time_s)

    @property
    def contradiction(self) -> str:
        """Why telemetry contradicts the vehicle file, so that the flight must end; or empty."""
        return self._estimate.contradiction

    def give_up(self) -> None:
        """Identify nothing more in this flight."""
        self._gave_up = True

    def learn(self, phase: Phase, time_s: float) -> Adoption | None:
        """Do one piece of work after a tick's command was sent. Returns what to fly with from the
        next tick on, or None if nothing changes."""
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
        limit_radps = estimate.limit_radps
        lowered = limit_radps < self._limit_radps
        news = sentences or record or limit_radps != self._limit_radps
        if estimate.settled and not news:
            return None
        self._limit_radps = limit_radps
        estimate.step(time_s)
        gains = estimate.settled or lowered
        return Adoption(estimate.now, limit_radps, gains, sentences, record)

    # ------------------------------------------------------------------ work, in pieces

    def _due(self, phase: Phase, time_s: float) -> Work | None:
        """The work to begin now. A link that changes all the time gets every other turn."""
        work = self._identifying(phase, time_s)
        if self._link_is_new and (work is None or not self._followed_link):
            work = self._follow_link(*self._link)
            self._followed_link = True
        else:
            self._followed_link = False
        return work

    def _identifying(self, phase: Phase, time_s: float) -> Work | None:
        """The identification that is due."""
        if not self._settings.online:
            return None
        if not self._identified:
            return self._identify_all(phase) if self._steps_are_over(phase, time_s) else None
        if phase not in MOVING:
            return None
        estimate = self._estimate
        if self._is_due(self._compared_at_s, COMPARE_EVERY_S) and not estimate.in_doubt:
            return self._compare_with_prediction()
        certain = estimate.delay is not None and estimate.delay.sd <= WELL_KNOWN_S
        if self._is_due(self._tilt_at_s, TILT_EVERY_S) and (estimate.in_doubt or not certain):
            return self._identify_tilt()
        moved = time_s >= self._moving_s + DRAG_FIRST_S and not estimate.in_doubt
        if moved and self._is_due(self._drag_at_s, DRAG_EVERY_S):
            return self._identify_drag()
        if not estimate.in_doubt and self._is_due(self._hover_at_s, HOVER_EVERY_S):
            return self._identify_hover()
        return None

    def _is_due(self, last_s: float, every_s: float) -> bool:
        return self._time_s >= last_s + every_s - 1e-6

    def _steps_are_over(self, phase: Phase, time_s: float) -> bool:
        if phase is Phase.EXCITE:
            return self._left_box or time_s >= self._excite_s + LENGTH_S
        return phase in MOVING and not self.wants_excitation

    def _follow_link(self, added_s: float, changed_s: float) -> Work:
        """Adapt the bandwidth to the link as it is now."""
        self._link_is_new = False
        self._sentences += self._estimate.on_link(added_s, changed_s)
        yield

    def _identify_all(self, phase: Phase) -> Work:
        """Identify everything from climb and steps; repeat the steps if the tilt is uncertain."""
        trace = self._recorder.trace(self._climb_s + LIFTED_OFF_S, self._time_s)
        found = yield from identify_in_pieces(trace, self._file)
        refusal = found.refusals.get("tilt")
        again = phase is Phase.EXCITE and self._rounds < MOST_ROUNDS and not self._left_box
        if refusal is not None and again:
            self._rounds += 1
            self._excite_s = self._time_s
            self._sentences.append(f"repeating the steps, tilt not identified: {refusal}")
            return
        self._identified = True
        self._sentences += self._estimate.adopt(found, self._time_s)
        self._record = log_record(found)
        yield
        self._sentences += self._estimate.update_bandwidth(refusal or OUT_OF_BOUNDS)

    def _identify_drag(self) -> Work:
        self._drag_at_s = self._time_s
        begin_s = max(self._moving_s, self._time_s - DRAG_OVER_S)
        trace = self._recorder.trace(begin_s, self._time_s)
        found = identify_drag(trace, self._estimate.target)
        if self._estimate.is_new_drag(found.drag_ps, DRAG_NEWS_PS):
            self._sentences += self._estimate.adopt(found, self._time_s)
            self._record = log_record(found)
        yield

    def _identify_hover(self) -> Work:
        """Follow the hover thrust, which a load or an empty battery changes."""
        self._hover_at_s = self._time_s
        found = identify_hover(self._flown(HOVER_OVER_S), self._estimate.target)
        sentences = self._estimate.review_hover(found, self._time_s)
        if sentences:
            self._sentences += sentences
            self._record = log_record(found)
        yield

    def _flown(self, over_s: float) -> Trace:
        """The last `over_s`, without the lift-off and what came before a contradiction."""
        begin_s = max(self._climb_s + LIFTED_OFF_S, self._time_s - over_s, self._in_doubt_from_s)
        return self._recorder.trace(begin_s, self._time_s)

    def _identify_tilt(self) -> Work:
        """Identify the tilt from the last seconds, and adopt it if it is better."""
        self._tilt_at_s = self._time_s
        trace = self._flown(TILT_OVER_S)
        found = yield from identify_tilt(trace)
        before = self._estimate.delay
        now = unexplained(trace, self._estimate.target.tilt)
        self._sentences += self._estimate.review_tilt(found, now, self._time_s)
        if self._estimate.delay is not before:
            self._record = log_record(found)
        yield

    def _compare_with_prediction(self) -> Work:
        """Compare the tilt of the last seconds with what the estimate predicts."""
        self._compared_at_s = self._time_s
        trace = self._recorder.trace(self._time_s - COMPARE_OVER_S, self._time_s)
        now = unexplained(trace, self._estimate.target.tilt)
        self._contradictions = self._contradictions + 1 if now.contradicts else 0
        if self._contradictions >= COMPARE_TIMES:
            self._contradictions = 0
            before = unexplained(trace, self._estimate.previous.tilt)
            self._in_doubt_from_s = self._time_s - COMPARE_OVER_S
            self._sentences += self._estimate.on_contradiction(now, before, self._time_s)
        yield
