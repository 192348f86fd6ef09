"""The learner: what one vehicle is, and how sure of its delays, while it flies.

It begins with the vehicle file, or with what an earlier flight has identified. The flight gives it
telemetry and commands (`recorder`), and after each setpoint has left calls `step`, which does one
piece of work of 10 to 20 ms at most:

- the first identification: everything, from the climb and the steps that are flown for it;
- in motion: drag, tilt response and hover thrust, adopted where they are better known or another;
- the tilt of the last seconds is compared with its prediction. A contradiction makes the delay
  uncertain at once, until a new fit explains the flight.

`vehicle` and `uncertainty` are the result. What they mean for a control law is not known here.
Times are vehicle time.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Generator
from dataclasses import dataclass, replace
from enum import Enum, auto
from typing import Any

import numpy as np

from offboard.identification.attitude_fit import ResponseFit, Unexplained, unexplained
from offboard.identification.trace import Recorder, Trace
from offboard.identification.uncertainty import Estimate
from offboard.identification.vehicle_fit import (
    LINK_S,
    Identified,
    identify_drag,
    identify_in_pieces,
    identify_tilt,
    log_record,
    summary,
    with_link_delay,
    within_bounds,
)
from offboard.model.vehicle import DelayUncertainty, Vehicle

LIFTED_OFF_S = 0.5  # after this the ground has no effect on the thrust
SETTLE_S = 1.0  # after an adoption the observer settles
# What a delay may be wrong by: of a vehicle file in general; of one that is flown as it is
UNKNOWN_DELAY_S, FILE_DELAY_S = 0.28, 0.13
SDS = 3.0  # standard deviations that an identified delay may be wrong by
DIRECT_LINK_S = 0.004  # link delay without a slow link: age of telemetry
# Drag: when it is identified first, how often, from how much flight; a smaller change (1/s) is none
DRAG_FIRST_S, DRAG_EVERY_S, DRAG_OVER_S, DRAG_NEWS_PS = 3.0, 0.5, 25.0, 0.03
# Hover thrust, by the observer: how often it is looked at, and its mean over how long. One that
# differs by less, as a share and in sds, is not adopted: gusts of 1 m/s move it by 6 %
HOVER_EVERY_S, HOVER_OVER_S, HOVER_NEWS, HOVER_SDS = 1.0, 6.0, 0.06, 3.0
HOVER_RELATED_S = 2.0  # time over which its errors are autocorrelated
# Tilt: identified again while its delay is in doubt or its sd is greater than this
WELL_KNOWN_S, TILT_EVERY_S, TILT_OVER_S = 0.004, 2.0, 12.0
# Prediction: how often and over how much flight it is compared with the tilt, and after how many
# contradictions in a row the vehicle is in doubt
COMPARE_EVERY_S, COMPARE_OVER_S, COMPARE_TIMES = 0.5, 2.0, 2
# After so many the delay stays uncertain until the vehicle has explained the flight for CALM_S
MOST_CONTRADICTIONS, CALM_S = 2, 20.0
# A new tilt fit replaces the old one if its delay's sd, or in doubt the tilt that it leaves
# unexplained, is less than this share of the old one's
BETTER = 0.7
LEAST_JUMP_S, JUMP_SDS = 0.015, 4.0  # delays that differ by more contradict each other
# Delay and lag of the thrust that are less certain than this are not adopted, unless those in use
# are wrong by more: the height is unstable with 60 ms too much as well as with 90 ms too little
THRUST_SD_S = 0.02
FACTOR = 4.0  # greatest ratio, either way, of an identified constant to the vehicle file's
DECISIVE = ("tilt", "hover_thrust")  # out of bounds, these end the flight
LINKED = ("yaw", "thrust_delay_s")  # changed with the tilt's delay where not identified themselves

Work = Generator[None, None, None]


class Stage(Enum):
    """What the flight allows to be identified."""

    NOTHING = auto()
    EVERYTHING = auto()  # the steps were flown, or none will be
    IN_MOTION = auto()


@dataclass(frozen=True, slots=True)
class IdentifiedVehicle:
    """What a flight has identified, for the next one of the same vehicle. The delays of `vehicle`
    contain the link's delay of then, `link_s` (telemetry and setpoint together; 0 if it was not
    measured). `delay` is the delay of the tilt and its standard deviation, s."""

    vehicle: Vehicle
    delay: Estimate
    link_s: float


class Learner:
    """One vehicle during one flight.

    Args:
        file: constants of the vehicle file.
        delay_error_s: what its delays may be wrong by.
        known: what an earlier flight has identified.

    `vehicle` are the constants to fly with. `delay` is that of the tilt once identified.
    `sentences` for the user and `record` for the log are what is new; who reads them empties them.
    `cause` is why the uncertainty of the delay is what it is; empty where a sentence says it.
    `contradiction` says why the vehicle file must not be flown with, or is empty. `repeats_steps`:
    the steps are needed once more; who flies them sets it back. `adopted_s`: time of the newest
    adoption.
    """

    def __init__(
        self, file: Vehicle, *, delay_error_s: float, known: IdentifiedVehicle | None = None
    ) -> None:
        self._file = file
        self.vehicle = known.vehicle if known else file
        self._unknown_s = delay_error_s
        self._recalled = known
        self.delay: Estimate | None = known.delay if known else None
        self.identified = known is not None
        self.recorder = Recorder()
        self.sentences: list[str] = []
        self.record: tuple[float, ...] = ()
        self.cause = ""
        self.contradiction = ""
        self.repeats_steps = False
        self.adopted_s = -math.inf
        self._thrust: Estimate | None = None  # delay and lag of the thrust, once identified
        self._link_s = 0.0  # the link's delay before the flight
        self._link = (0.0, 0.0)  # added since take-off, and changed lately
        self._doubt_s = 0.0  # what the delay may be wrong by because telemetry contradicts it
        self._contradictions = 0  # and those in a row of the comparison
        self._in_a_row = 0
        self._calm_from_s = self._doubted_from_s = -math.inf  # since the last contradiction
        self._other_delay: Estimate | None = None  # seen once, contradicts the one in use
        self._replaced: dict[str, Any] = {}  # tilt constants before the last adoption
        self._rejected_drag_ps = math.inf
        self._other_hover = False  # seen once, differs from the one in use
        self._hover: deque[tuple[float, float]] = deque()
        self._climb_s = self._moving_s = math.inf
        self._due_s: dict[str, float] = {}  # when each piece of work is due again
        self._time_s = 0.0
        self._work: Work | None = None

    # ------------------------------------------------------------------ what is known

    @property
    def uncertainty(self) -> DelayUncertainty:
        """What is not known of the delays of `vehicle`."""
        added_s, changed_s = self._link
        known_s = SDS * self.delay.sd if self.delay else self._unknown_s
        thrust_s = SDS * self._thrust.sd if self._thrust else 0.0
        tilt_s = max(known_s, self._doubt_s, changed_s)
        return DelayUncertainty(tilt_s=tilt_s, thrust_s=thrust_s, link_s=added_s)

    @property
    def in_doubt(self) -> bool:
        """Whether telemetry contradicts the delay, and no fit has explained it yet."""
        return self._doubt_s > 0.0

    @property
    def contradicted(self) -> bool:
        """Whether this flight has contradicted the constants in use."""
        return self.in_doubt or self._contradictions > 0 or bool(self.contradiction)

    @property
    def result(self) -> IdentifiedVehicle | None:
        """What the next flight may begin with; None if nothing was identified, or in doubt."""
        if self.delay is None or self.contradicted or not self.identified:
            return None
        return IdentifiedVehicle(self.vehicle, self.delay, self._link_s)

    # ------------------------------------------------------------------ before and at take-off

    def on_link_delay(self, link: Estimate) -> None:
        """The link's delay, measured before lift-off: it is in every delay of the vehicle. What
        remains unknown is the vehicle's own delay and the link's scatter."""
        self._link_s = link.value
        if self.delay is not None and self._recalled is not None:
            self._on_other_link(self._recalled, self.delay, link)
            return
        added_s = link.value - DIRECT_LINK_S
        if added_s >= LINK_S:
            self.vehicle = self.vehicle.later_by(added_s)
            self.sentences.append(f"link delay {_in_ms(link)}, telemetry and setpoint together")
        self._unknown_s += JUMP_SDS * link.sd

    def _on_other_link(self, recalled: IdentifiedVehicle, delay: Estimate, link: Estimate) -> None:
        """Adapt what was recalled to the link's delay of now."""
        changed_s = link.value - max(recalled.link_s, DIRECT_LINK_S)
        changed_s = max(changed_s, -self.vehicle.tilt.delay_s, -self.vehicle.yaw.delay_s)
        if abs(changed_s) < LINK_S:
            return
        self.vehicle = self.vehicle.later_by(changed_s)
        self.delay = Estimate(delay.value + changed_s, math.hypot(delay.sd, link.sd))
        self.sentences.append(
            f"the link delays by {1e3 * changed_s:+.0f} ms since the vehicle was identified"
        )

    def on_link_growth(self, added_s: float, changed_s: float) -> None:
        """The link has added `added_s` to its delay since take-off, which the times of commands
        contain, and has changed by `changed_s` lately: the delay is not known better."""
        if self._link == (added_s, changed_s):
            return
        self._link = added_s, changed_s
        change_ms = round(1e3 * added_s)
        of_link = f"has grown by {change_ms} ms" if change_ms > 0 else "is that of take-off"
        of_tilt = f"is {_in_ms(self.delay)}" if self.delay else "is not identified yet"
        self.cause = f"the link's delay {of_link}, the tilt's {of_tilt}"

    def set_hover_thrust(self, hover_thrust: float) -> None:
        """The hover thrust that the vehicle showed before the take-over."""
        self.vehicle = self.vehicle.model_copy(update={"hover_thrust": hover_thrust})

    def on_climb(self, time_s: float) -> None:
        """The vehicle leaves the ground, or was taken over: what it does from now on counts."""
        self._climb_s = time_s

    def on_motion(self, time_s: float) -> None:
        """The vehicle begins to follow the reference."""
        self._moving_s = time_s

    @property
    def records(self) -> bool:
        """Whether telemetry counts yet."""
        return math.isfinite(self._climb_s)

    # ------------------------------------------------------------------ work, in pieces

    def step(
        self, time_s: float, stage: Stage, hover_thrust: float, *, may_repeat: bool = False
    ) -> None:
        """Do one piece of work. `hover_thrust`: the observer's estimate of now. `may_repeat`: the
        steps can be flown again (`repeats_steps`)."""
        self._time_s = time_s
        if stage is Stage.IN_MOTION and not self.in_doubt:
            self._hover.append((time_s, hover_thrust))
        if self._work is None:
            self._work = self._due(stage, may_repeat)
        if self._work is not None and next(self._work, self) is self:
            self._work = None

    def _due(self, stage: Stage, may_repeat: bool) -> Work | None:
        """The work to begin now."""
        if stage is Stage.EVERYTHING and not self.identified:
            return self._identify_all(may_repeat=may_repeat)
        if stage is not Stage.IN_MOTION or not self.identified:
            return None
        certain = self.delay is not None and self.delay.sd <= WELL_KNOWN_S
        if not self.in_doubt and self._is_due("compare", COMPARE_EVERY_S):
            return self._compare_with_prediction()
        if (self.in_doubt or not certain) and self._is_due("tilt", TILT_EVERY_S):
            return self._identify_tilt()
        if self.in_doubt:
            return None
        if self._time_s >= self._moving_s + DRAG_FIRST_S and self._is_due("drag", DRAG_EVERY_S):
            return self._identify_drag()
        if self._is_due("hover", HOVER_EVERY_S):
            self._review_hover()
        return None

    def _is_due(self, work: str, every_s: float) -> bool:
        if self._time_s < self._due_s.get(work, -math.inf) - 1e-6:
            return False
        self._due_s[work] = self._time_s + every_s
        return True

    def _flown(self, over_s: float) -> Trace:
        """The last `over_s`, without the lift-off and what came before a contradiction."""
        begin_s = max(self._climb_s + LIFTED_OFF_S, self._time_s - over_s, self._doubted_from_s)
        return self.recorder.trace(begin_s, self._time_s)

    def _identify_all(self, *, may_repeat: bool) -> Work:
        """Identify everything from climb and steps, which are repeated if they do not show the
        tilt's response."""
        trace = self.recorder.trace(self._climb_s + LIFTED_OFF_S, self._time_s)
        found = yield from identify_in_pieces(trace, self._file)
        refusal = found.refusals.get("tilt")
        if refusal is not None and may_repeat:
            self.repeats_steps = True
            self.sentences.append(f"repeating the steps, tilt not identified: {refusal}")
            return
        self.identified = True
        self.adopt(found)
        self.record = log_record(found)
        self._explain(refusal or "it is out of bounds")

    def _identify_drag(self) -> Work:
        begin_s = max(self._moving_s, self._time_s - DRAG_OVER_S)
        trace = self.recorder.trace(begin_s, self._time_s)
        found = identify_drag(trace, self.vehicle)
        drag = found.drag_ps
        known = (self.vehicle.drag_per_mass_ps, self._rejected_drag_ps)
        if drag and all(abs(drag.value - each) > max(DRAG_NEWS_PS, drag.sd) for each in known):
            self.adopt(found)
            self.record = log_record(found)
        yield

    def _identify_tilt(self) -> Work:
        """Identify the tilt from the last seconds, and adopt it if it is better."""
        trace = self._flown(TILT_OVER_S)
        found = yield from identify_tilt(trace)
        before = self.delay
        self.review_tilt(found, unexplained(trace, self.vehicle.tilt), self._time_s)
        if self.delay is not before:
            self.record = log_record(found)

    def _compare_with_prediction(self) -> Work:
        """Compare the tilt of the last seconds with what the constants predict."""
        trace = self.recorder.trace(self._time_s - COMPARE_OVER_S, self._time_s)
        now = unexplained(trace, self.vehicle.tilt)
        self._in_a_row = self._in_a_row + 1 if now.contradicts else 0
        if self._in_a_row >= COMPARE_TIMES:
            self._in_a_row = 0
            before = unexplained(trace, self._previous.tilt)
            self._doubted_from_s = self._time_s - COMPARE_OVER_S
            self.on_contradiction(now, before, self._time_s)
        yield

    def _review_hover(self) -> None:
        """Adopt the observer's hover thrust if its mean is another than the one in use, twice: the
        mass or the battery has changed. One beyond the bounds is ignored."""
        while self._hover[0][0] < self._time_s - HOVER_OVER_S:
            self._hover.popleft()
        if self._hover[0][0] > self._time_s - HOVER_OVER_S + HOVER_EVERY_S:
            return
        shares, known = np.array(self._hover)[:, 1], self.vehicle.hover_thrust
        sd = float(np.std(shares)) / math.sqrt(HOVER_OVER_S / HOVER_RELATED_S)
        hover = Estimate(float(np.mean(shares)), sd)
        seen_before, self._other_hover = self._other_hover, False
        found = Identified(HOVER_OVER_S, hover_thrust=hover)
        if abs(hover.value - known) <= max(HOVER_NEWS * known, HOVER_SDS * sd):
            return
        if within_bounds(found, self._file, FACTOR)[1]:
            return
        self._other_hover = not seen_before
        if seen_before:
            self.adopt(found)
            self.record = log_record(found)

    # ------------------------------------------------------------------ adoption

    @property
    def _previous(self) -> Vehicle:
        """The vehicle with the tilt constants before the last adoption."""
        return self.vehicle.model_copy(update=self._replaced)

    def adopt(self, found: Identified) -> None:
        """Use what is within bounds from now on."""
        within, sentences = within_bounds(found, self._file, FACTOR)
        for name in DECISIVE:
            if getattr(found, name) is not None and getattr(within, name) is None:
                self.contradiction = "; ".join(sentences)
        effect = within.thrust_effect_s
        in_use = Estimate(self.vehicle.thrust_delay_s + self.vehicle.thrust_lag_s, 0.0)
        if effect and effect.sd > THRUST_SD_S and not _apart(effect, in_use):
            within = replace(within, thrust_lag_s=None, thrust_delay_s=None, thrust_effect_s=None)
        applied = within.applied_to(self.vehicle)
        vehicle = with_link_delay(within, applied, self._file)
        if within.tilt is not None:
            moved = [name for name in LINKED if getattr(vehicle, name) != getattr(applied, name)]
            self._replaced = {name: getattr(self.vehicle, name) for name in ("tilt", *moved)}
            self.delay = within.tilt.delay_s
            self._other_delay = None
        if within.thrust_delay_s is not None:
            self._thrust = within.thrust_effect_s
        if vehicle != self.vehicle:
            self.vehicle, self.adopted_s = vehicle, self._time_s
            sentences.insert(0, summary(within))
        if within.drag_ps is None and found.drag_ps is not None:
            self._rejected_drag_ps = found.drag_ps.value
        self.sentences += sentences

    def review_tilt(self, found: Identified, now: Unexplained, time_s: float) -> None:
        """Compare a later fit of the tilt with the constants in use, and adopt it if it is better.
        `now` is what these leave unexplained in the same stretch of flight."""
        tilt = found.tilt
        if now.contradicts:
            self._calm_from_s = time_s
        elif time_s >= self._calm_from_s + CALM_S:
            self._contradictions = 0
        if tilt is None or within_bounds(found, self._file, FACTOR)[1]:
            return
        if self.delay is None:
            better = True
        elif _apart(tilt.delay_s, self.delay):
            if not self._confirmed(tilt, now):
                self._doubt(tilt.delay_s, self.delay)
                return
            better = True
        else:
            clearer = self.in_doubt and tilt.residual_rms < BETTER * now.rms
            better = clearer or tilt.delay_s.sd < BETTER * self.delay.sd
        if better:
            self.adopt(found)
        left = replace(now, rms=tilt.residual_rms) if better else now
        explained = not left.contradicts if self.in_doubt else better
        if explained and self._contradictions < MOST_CONTRADICTIONS:
            self._doubt_s = 0.0
            self._explain()

    def _explain(self, refusal: str = "") -> None:
        """The delay is as well known as it can be now; `refusal`: why it was not identified."""
        if self.delay is None:
            self.cause = f"tilt response not identified, {refusal}"
            return
        thrust = f", of the thrust with its lag {_in_ms(self._thrust)}" if self._thrust else ""
        self.cause = f"identified delay, {_in_ms(self.delay)}{thrust}"

    def _confirmed(self, tilt: ResponseFit, now: Unexplained) -> bool:
        """Whether something besides this fit shows that the delay is another: a fit before it, or
        a contradiction that it explains."""
        if self._other_delay is not None:
            return not _apart(tilt.delay_s, self._other_delay)
        once = 0 < self._contradictions < MOST_CONTRADICTIONS
        explains = tilt.residual_rms < BETTER * now.rms
        left = replace(now, rms=tilt.residual_rms)
        return self.in_doubt and once and explains and not left.contradicts

    def _doubt(self, seen: Estimate, known: Estimate) -> None:
        self._other_delay, self.cause = seen, ""
        self._doubt_s = max(self._doubt_s, abs(seen.value - known.value) + seen.sd)
        self.sentences.append(
            f"tilt delay {_in_ms(seen)} contradicts the identified {_in_ms(known)}"
        )

    def on_contradiction(self, now: Unexplained, before: Unexplained, time_s: float) -> None:
        """The tilt does not respond as predicted: its delay may be anything. `now` and `before` are
        what the constants in use and the ones before them leave unexplained; the latter are used
        again if they explain more."""
        self._doubt_s, self.cause = max(self._doubt_s, self._unknown_s), ""
        self._contradictions += 1
        self._calm_from_s = time_s
        vehicle = "identified vehicle" if self.vehicle != self._file else "vehicle file"
        sentence = (
            f"the {vehicle} contradicts telemetry: {1e3 * now.rms:.0f} mrad of tilt unexplained "
            f"(limit {1e3 * now.limit:.0f}, commanded {1e3 * now.commanded_rms:.0f})"
        )
        if before.rms < BETTER * now.rms:
            self.delay = None
            self.vehicle = self._previous
            sentence += f"; the previous estimate, with {1e3 * before.rms:.0f} mrad, is used again"
        if self._contradictions >= MOST_CONTRADICTIONS:
            sentence += f"; its delay is unknown until nothing contradicts for {CALM_S:.0f} s"
        self.sentences.append(sentence)


def _apart(one: Estimate, other: Estimate) -> bool:
    """Whether two delays contradict each other."""
    allowed_s = max(LEAST_JUMP_S, JUMP_SDS * math.hypot(one.sd, other.sd))
    return abs(one.value - other.value) > allowed_s


def _in_ms(delay: Estimate) -> str:
    return f"{1e3 * delay.value:.0f} +- {1e3 * delay.sd:.0f} ms"
