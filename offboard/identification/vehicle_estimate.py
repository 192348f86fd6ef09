"""The constants of one vehicle and the uncertainty of its delays, updated by fits and by the link.

The estimate begins with the vehicle file, or with the constants that an earlier flight has
identified. A fit is adopted if it is within bounds and either more certain than the value in use or
confirmed to differ from it; a drag also if it is nearly as certain. If telemetry contradicts the
constants in use, the delay becomes uncertain at once, until a fit explains the flight. `vehicle`
and `uncertainty` are the result. This module knows no control law. Times are vehicle time.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from offboard.identification.attitude_fit import ResponseFit, Unexplained
from offboard.identification.uncertainty import Estimate
from offboard.identification.vehicle_fit import (
    LINK_S,
    THRUST_DELAY_SD_S,
    THRUST_LAG_SD_S,
    Identified,
    summary,
    with_link_delay,
    within_bounds,
)
from offboard.model.vehicle import DelayUncertainty, Vehicle

# Uncertainties of delays. Vehicle file before identification; includes that the response may be
# slower than the file's:
UNKNOWN_DELAY_S = 0.4
FILE_DELAY_S = 0.13  # vehicle file that is flown without identification
DOUBTED_DELAY_S = 0.28  # tilt, fitted or flown before, that telemetry contradicts
SDS = 3.0  # identified delay, in standard deviations
THRUST_SD_S = math.hypot(THRUST_DELAY_SD_S, THRUST_LAG_SD_S)  # of delay plus lag, before a fit
DIRECT_LINK_S = 0.004  # delay of a fast link: age of telemetry
LINK_DIGITS = 2  # delays of the link are rounded to 10 ms: smaller changes are ignored
# After so many contradictions the delay stays uncertain until nothing contradicts for CALM_S
MOST_CONTRADICTIONS, CALM_S = 2, 20.0
# A new tilt fit replaces the old one if its delay's sd, or in doubt the tilt that it leaves
# unexplained, is less than this share of the old one's
BETTER = 0.7
VAGUE = 2.0  # uncertainty of an sd, as a factor
LINK_CHANGE_S = 0.1  # a larger change of the link delay explains a tilt that is not as predicted
LEAST_JUMP_S, JUMP_SDS = 0.015, 4.0  # delays that differ by more contradict each other
FACTOR = 4.0  # greatest ratio, either way, of an identified constant to the vehicle file's
DECISIVE = ("tilt", "hover_thrust")  # if one of these is out of bounds, the flight ends
LINKED = ("yaw", "thrust_delay_s")  # changed with the tilt's delay if not identified themselves


@dataclass(frozen=True, slots=True)
class IdentifiedVehicle:
    """The constants identified by a flight, for the next flight of the same vehicle. The delays of
    `vehicle` contain the link delay in that flight, `link_s` (telemetry and setpoint together; 0
    if it was not measured). `delay_sd_s` is the standard deviation of the tilt's delay,
    `thrust_sd_s` that of the thrust's delay plus lag, infinite if no fit was adopted."""

    vehicle: Vehicle
    delay_sd_s: float
    link_s: float
    thrust_sd_s: float = math.inf


class VehicleEstimate:
    """The estimate of one vehicle during one flight.

    Args:
        file: constants of the vehicle file.
        delay_error_s: uncertainty of its delays.
        known: the constants that an earlier flight has identified.

    `vehicle` has the constants to fly with. `sentences` for the user and `record` for the log
    collect news; their reader empties them. `cause` is the reason for the present uncertainty of
    the delay, empty if a sentence says it. `contradiction` is the reason why the vehicle file must
    not be flown, or empty. `adopted_s` is the time of the newest adoption.
    """

    def __init__(
        self, file: Vehicle, *, delay_error_s: float, known: IdentifiedVehicle | None = None
    ) -> None:
        known = known or IdentifiedVehicle(file, delay_sd_s=math.inf, link_s=0.0)
        self.file, self.vehicle = file, known.vehicle
        self.sentences: list[str] = []
        self.record: dict[str, Estimate | None] = {}
        self.cause = self.contradiction = ""
        self.adopted_s = -math.inf
        self._unknown_s = delay_error_s
        # Standard deviations of the values in use, infinite until they are identified: the tilt's
        # delay, the thrust's delay plus lag, and the drag (that of its most certain fit)
        self._delay_sd_s, self._thrust_sd_s = known.delay_sd_s, known.thrust_sd_s
        self._drag_sd_ps = math.inf
        self._link_s = known.link_s  # link delay that `vehicle` contains
        self._link = (0.0, 0.0)  # increase of the link delay since takeoff, and recent change
        self._doubt_s = 0.0  # uncertainty of the delay because telemetry contradicts it
        self._contradictions = 0
        self._calm_from_s = -math.inf  # the time of the last contradiction
        self._other_delay: Estimate | None = None  # fitted once, contradicts the one in use
        self._differed: set[str] = set()  # constants whose newest fit differs from the one in use
        self._replaced: dict[str, Any] = {}  # tilt constants before the last adoption
        self._rejected_drag_ps = math.inf

    @property
    def uncertainty(self) -> DelayUncertainty:
        """The uncertainty of the delays of `vehicle`."""
        added_s, changed_s = self._link
        known_s = SDS * self._delay_sd_s if self.delay.known else self._unknown_s
        thrust_s = SDS * THRUST_SD_S if self.delay.known else self._unknown_s
        if self._thrust.known:
            thrust_s = min(thrust_s, SDS * self._thrust_sd_s)
        tilt_s = max(known_s, self._doubt_s, changed_s)
        return DelayUncertainty(tilt_s=tilt_s, thrust_s=thrust_s, link_s=added_s)

    @property
    def delay(self) -> Estimate:
        """The delay of the tilt."""
        return Estimate(self.vehicle.tilt.delay_s, self._delay_sd_s)

    @property
    def _thrust(self) -> Estimate:
        """The sum of delay and lag of the thrust."""
        effect_s = self.vehicle.thrust_delay_s + self.vehicle.thrust_lag_s
        return Estimate(effect_s, self._thrust_sd_s)

    @property
    def in_doubt(self) -> bool:
        """Whether telemetry contradicts the delay, and no fit has explained it yet."""
        return self._doubt_s > 0.0

    @property
    def link_changed(self) -> bool:
        """Whether the link delay has just changed: times of earlier commands are then wrong."""
        return self._link[1] > LINK_CHANGE_S

    @property
    def contradicted(self) -> bool:
        """Whether this flight has contradicted the constants in use."""
        return self.in_doubt or self._contradictions > 0 or bool(self.contradiction)

    @property
    def result(self) -> IdentifiedVehicle | None:
        """The constants with which the next flight may begin; None if they are not identified or
        were contradicted."""
        if not self.delay.known or self.contradicted:
            return None
        return IdentifiedVehicle(self.vehicle, self._delay_sd_s, self._link_s, self._thrust_sd_s)

    @property
    def previous(self) -> Vehicle:
        """The vehicle with the tilt constants before the last adoption."""
        return self.vehicle.model_copy(update=self._replaced)

    # ------------------------------------------------------------------ link and take-over

    def on_link_delay(self, link: Estimate | None) -> None:
        """Add the link delay, measured before lift-off, or its change since an earlier flight, to
        every delay of the vehicle. The vehicle's own delay and the scatter of the link delay
        remain unknown. `link` is None if the vehicle did not answer."""
        if link is None:
            return
        if self.delay.known:
            self._on_other_link(link)
            return
        self._link_s = link.value
        added_s = link.value - DIRECT_LINK_S
        if added_s >= LINK_S:
            self.vehicle = self.vehicle.later_by(added_s)
            self.sentences.append(f"link delay {in_ms(link)}, telemetry and setpoint together")
        self._unknown_s += JUMP_SDS * link.sd

    def _on_other_link(self, link: Estimate) -> None:
        """Change delays identified in an earlier flight by the change of the link delay."""
        link_s = max(self._link_s, DIRECT_LINK_S)
        changed_s = link.value - link_s
        changed_s = max(changed_s, -self.vehicle.tilt.delay_s, -self.vehicle.yaw.delay_s)
        if abs(changed_s) < LINK_S:
            return
        self.vehicle, self._link_s = self.vehicle.later_by(changed_s), link_s + changed_s
        self._delay_sd_s = math.hypot(self._delay_sd_s, link.sd)
        self.sentences.append(
            f"the link's delay has changed by {1e3 * changed_s:+.0f} ms since the vehicle was "
            "identified"
        )

    def on_link_growth(self, added_s: float, changed_s: float) -> None:
        """Use the growth `added_s` of the link delay since takeoff, which the times of commands
        contain, and its recent change `changed_s`, by which the delay is uncertain at least."""
        link = round(added_s, LINK_DIGITS), round(changed_s, LINK_DIGITS)
        if self._link == link:
            return
        self._link = link
        grown_ms, lately_ms = (round(1e3 * each) for each in link)
        of_link = (
            f"has changed by {lately_ms} ms lately" if lately_ms else "is the same as at takeoff"
        )
        if grown_ms > 0:
            of_link = f"has grown by {grown_ms} ms"
        of_tilt = f"is {in_ms(self.delay)}" if self.delay.known else "is not identified yet"
        self.cause = f"the link's delay {of_link}, the tilt's {of_tilt}"

    def on_shown(self, constants: Mapping[str, Any]) -> None:
        """Use `constants` that the vehicle reports, by name."""
        self.vehicle = self.vehicle.model_copy(update=constants)

    # ------------------------------------------------------------------ fits

    def within_bounds(self, found: Identified) -> tuple[Identified, list[str]]:
        """Return what may be adopted, and a sentence about each constant that may not."""
        return within_bounds(found, self.file, FACTOR)

    def adopt(self, found: Identified, time_s: float) -> None:
        """Use the constants of `found` that are within bounds from now on."""
        within, sentences = self.within_bounds(found)
        if any(getattr(found, name) and not getattr(within, name) for name in DECISIVE):
            self.contradiction = "; ".join(sentences)
        hover, used = within.hover_thrust, self.vehicle.hover_thrust
        if hover and abs(hover.value - used) <= SDS * hover.sd:  # the one in use may be better
            within = replace(within, hover_thrust=None)
        applied = within.applied_to(self.vehicle)
        if within.thrust_delay_s and within.thrust_effect_s:
            self._thrust_sd_s = within.thrust_effect_s.sd
            self._replaced.pop("thrust_delay_s", None)
        vehicle = with_link_delay(within, applied, self.file, thrust_known=self._thrust.known)
        if within.tilt is not None:
            moved = [name for name in LINKED if getattr(vehicle, name) != getattr(applied, name)]
            self._replaced = {name: getattr(self.vehicle, name) for name in ("tilt", *moved)}
            self._delay_sd_s = within.tilt.delay_s.sd
            self._other_delay = None
        if vehicle != self.vehicle:
            self.vehicle, self.adopted_s = vehicle, time_s
            sentences.insert(0, summary(within))
        if within.drag_ps is not None:
            self._drag_sd_ps = within.drag_ps.sd
        if within.drag_ps is None and found.drag_ps is not None:
            self._rejected_drag_ps = found.drag_ps.value
        self.sentences += sentences
        self.record = found.estimates

    def review_drag(self, found: Identified, least_ps: float, time_s: float) -> None:
        """Adopt a drag (1/s) that differs by more than its sd and `least_ps` from the drag in use,
        and from the last one that was out of bounds. A drag that is clearly less certain than the
        one in use is adopted only if it contradicts that, and the fit before did, too."""
        new = found.drag_ps
        if new is None:
            return
        used_ps, sd_ps = self.vehicle.drag_per_mass_ps, self._drag_sd_ps
        vague = new.sd > VAGUE * sd_ps
        contradicts = abs(new.value - used_ps) > SDS * math.hypot(new.sd, sd_ps)
        again = self._again("drag", contradicts and vague)
        differs, is_other = (
            abs(new.value - each) > max(least_ps, new.sd)
            for each in (used_ps, self._rejected_drag_ps)
        )
        if not differs:
            self._drag_sd_ps = min(sd_ps, new.sd)
        elif is_other and (again or not vague):
            self.adopt(found, time_s)

    def _again(self, constant: str, differs: bool) -> bool:
        """Whether this fit of a constant `differs` from the value in use, and the last one did."""
        again = differs and constant in self._differed
        if differs and not again:
            self._differed.add(constant)
        else:
            self._differed.discard(constant)
        return again

    def review_thrust(self, found: Identified, time_s: float) -> None:
        """Adopt a later fit of the thrust if it is clearly more certain, or if it is the second in
        a row that differs from the values in use. Later fits are better than the first one, because
        during the steps the estimated height drifts, and feedback hides a part of the response."""
        new, known = found.thrust_effect_s, self._thrust
        if new is None or self.within_bounds(found)[1]:
            return
        better = new.sd < BETTER * known.sd
        differs = _apart(new, known, SDS)
        if self._again("thrust", differs and not better) or better:
            self.adopt(found, time_s)
            if self.delay.known:
                self.explain()

    def review_tilt(self, found: Identified, now: Unexplained, time_s: float) -> None:
        """Compare a later fit of the tilt with the constants in use, and adopt it if it is better.
        `now` is the tilt that the latter leave unexplained in the same stretch of flight."""
        tilt = found.tilt
        if now.contradicts:
            self._calm_from_s = time_s
        elif time_s >= self._calm_from_s + CALM_S:
            self._contradictions = 0
        if tilt is None or self.within_bounds(found)[1]:
            return
        if _apart(tilt.delay_s, self.delay, JUMP_SDS):
            better = self._confirmed(tilt, now)
            if not better:
                self._doubt(tilt.delay_s, self.delay)
                return
        else:
            clearer = self.in_doubt and tilt.left.rms < BETTER * now.rms
            better = clearer or tilt.delay_s.sd < BETTER * self.delay.sd
        if better:
            self.adopt(found, time_s)
        left = tilt.left if better else now
        explained = not left.contradicts if self.in_doubt else better
        if explained and self._contradictions < MOST_CONTRADICTIONS:
            self._doubt_s = 0.0
            self.explain()

    def explain(self, refusal: str = "") -> None:
        """Set `cause` to the identified delay, or to `refusal`, why it is not identified."""
        if not self.delay.known:
            self.cause = f"tilt response not identified, {refusal}"
            return
        thrust = f"and its lag {in_ms(self._thrust)}" if self._thrust.known else "not identified"
        self.cause = f"identified delay of the tilt {in_ms(self.delay)}, of the thrust {thrust}"

    def _confirmed(self, tilt: ResponseFit, now: Unexplained) -> bool:
        """Whether something else than this fit shows a changed delay: an earlier fit that agrees,
        or a contradiction that this fit explains."""
        if self._other_delay is not None:
            return not _apart(tilt.delay_s, self._other_delay, JUMP_SDS)
        once = 0 < self._contradictions < MOST_CONTRADICTIONS
        explains = tilt.left.rms < BETTER * now.rms
        return self.in_doubt and once and explains and not tilt.left.contradicts

    def _doubt(self, seen: Estimate, known: Estimate) -> None:
        self._other_delay, self.cause = seen, ""
        self._doubt_s = max(self._doubt_s, abs(seen.value - known.value) + seen.sd)
        self.sentences.append(f"tilt delay {in_ms(seen)} contradicts the identified {in_ms(known)}")

    def on_contradiction(self, now: Unexplained, before: Unexplained, time_s: float) -> None:
        """Doubt the delay of the tilt, because the tilt does not respond as predicted. `now` and
        `before` are the tilt left unexplained by the constants in use and by those before them;
        the latter are used again if they explain more."""
        self._doubt_s, self.cause = max(self._doubt_s, DOUBTED_DELAY_S), ""
        self._contradictions += 1
        self._calm_from_s = time_s
        vehicle = "identified vehicle" if self.vehicle != self.file else "vehicle file"
        sentence = (
            f"telemetry contradicts the {vehicle}: {1e3 * now.rms:.0f} mrad of tilt unexplained "
            f"(limit {1e3 * now.limit:.0f}, commanded {1e3 * now.commanded_rms:.0f})"
        )
        if before.rms < BETTER * now.rms:
            self._delay_sd_s = math.inf
            self.vehicle = self.previous
            sentence += f"; the previous estimate, with {1e3 * before.rms:.0f} mrad, is used again"
        if self._contradictions >= MOST_CONTRADICTIONS:
            sentence += f"; its delay is unknown until nothing contradicts for {CALM_S:.0f} s"
        self.sentences.append(sentence)


def _apart(one: Estimate, other: Estimate, sds: float) -> bool:
    """Whether two delays differ by more than `sds` standard deviations and LEAST_JUMP_S."""
    allowed_s = max(LEAST_JUMP_S, sds * math.hypot(one.sd, other.sd))
    return abs(one.value - other.value) > allowed_s


def in_ms(delay: Estimate) -> str:
    return f"{1e3 * delay.value:.0f} +- {1e3 * delay.sd:.0f} ms"
