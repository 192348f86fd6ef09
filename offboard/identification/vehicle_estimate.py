"""The vehicle constants in use during a flight, and the bandwidth that their delay supports.

They begin as the vehicle file's. Identified constants within bounds replace them, blended in over
a second. Telemetry may contradict them later: the delay has changed, or the tilt does not respond
as predicted. Then the bandwidth is lowered at once, until a fit explains the flight again.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from offboard.control.delay_margin import (
    LEAST_MARGIN_S,
    SDS,
    needed_margin,
    supported_bandwidth,
)
from offboard.identification.adoption import (
    LINK_S,
    interpolated,
    summary,
    with_added_delay,
    with_link_delay,
    within_bounds,
)
from offboard.identification.attitude_fit import ResponseFit, Unexplained
from offboard.identification.learned import Learned
from offboard.identification.uncertainty import Estimate
from offboard.identification.vehicle_fit import Identified
from offboard.model.vehicle import Vehicle

# A new tilt fit replaces the old one if its delay's sd, or in doubt the tilt that it leaves
# unexplained, is less than this share of the old one's.
BETTER = 0.7
DIRECT_LINK_S = 0.004  # link delay without a slow link: age of telemetry
LEAST_JUMP_S, JUMP_SDS = 0.015, 4.0  # delays that differ by more contradict each other
DECISIVE = ("tilt", "hover_thrust")  # out of bounds, these end the flight
# After so many contradictions the bandwidth stays low until the estimate in use has explained the
# flight for CALM_S.
MOST_CONTRADICTIONS, CALM_S = 2, 20.0
# Delay and lag of the thrust that are less certain than this would cost too much bandwidth, unless
# those in use are wrong by more
THRUST_SD_S = 0.02
LINKED = ("yaw", "thrust_delay_s")  # changed with the tilt's delay where not identified themselves
# A later hover thrust that differs by less, as a share and in sds, is not adopted: gusts of 1 m/s
# move it by 6 %
HOVER_NEWS, HOVER_SDS = 0.06, 3.0
NOTICEABLE_RADPS = 1.0  # a smaller change for a later link is not announced
OUT_OF_BOUNDS = "it is out of bounds"


class VehicleEstimate:
    """The current estimate of one vehicle, `now`, and the bandwidth limit that goes with it.

    Args:
        vehicle: constants of the vehicle file, used until others are identified.
        factor: greatest ratio, either way, of an identified constant to the vehicle file's.
        blend_s: time over which identified constants replace those in use; 0: at once.
        unknown_delay_s: what the vehicle file's delay may be wrong by.
        period_s: control period.
        bandwidth_radps: bandwidth of the controller as configured.

    Methods that adopt or reject something return sentences for the user.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        *,
        factor: float,
        blend_s: float,
        unknown_delay_s: float,
        period_s: float,
        bandwidth_radps: float,
    ) -> None:
        self._file = self._from = self.target = self.now = vehicle
        self._factor = factor
        self._blend_s = blend_s
        self._period_s = period_s
        self._bandwidth_radps = bandwidth_radps
        self._unknown_delay_s = unknown_delay_s
        self.reset()

    def reset(self) -> None:
        """Back to the vehicle file."""
        self._replaced: dict[str, Any] = {}  # tilt constants before the last adoption
        self._blend_began_s = -math.inf
        self._rejected_drag_ps = math.inf
        self._other_delay: Estimate | None = None  # seen once, contradicts the one in use
        self._other_hover = False  # seen once, differs from the one in use
        self._contradictions = 0
        self._calm_from_s = -math.inf  # since the last contradiction
        self.delay: Estimate | None = None  # of the tilt, once identified
        self._thrust: Estimate | None = None  # delay and lag of the thrust, once identified
        self.in_doubt = False
        self._unknown_s = self._unknown_delay_s
        self._link_radps = math.inf  # limit because the link became later
        self._lowered_radps = 0.0  # by which this was lower than the vehicle's, as announced
        self._begin_with(self._file, self._unknown_s)
        self.contradiction = ""  # why this vehicle file must not be flown with

    # ------------------------------------------------------------------ blending

    @property
    def settled(self) -> bool:
        """Whether the constants in use are the last ones adopted."""
        return self.now == self.target

    def blended(self, time_s: float) -> bool:
        """Whether `time_s` is after the end of the last blend."""
        return time_s >= self._blend_began_s + self._blend_s

    def step(self, time_s: float) -> None:
        """Blend by one control period."""
        share = 1.0
        if self._blend_s > 0.0:
            passed_s = time_s - self._blend_began_s + self._period_s
            share = min(passed_s / self._blend_s, 1.0)
        settled = share > 1.0 - 1e-6
        self.now = self.target if settled else interpolated(self._from, self.target, share)

    def _blend_to(self, target: Vehicle, time_s: float) -> None:
        self._from, self.target, self._blend_began_s = self.now, target, time_s

    @property
    def previous(self) -> Vehicle:
        """The estimate with the tilt constants before the last adoption."""
        return self.target.model_copy(update=self._replaced)

    def _begin_with(self, vehicle: Vehicle, tilt_margin_s: float) -> None:
        """Use `vehicle` at once, with the bandwidth that this margin of its delay allows."""
        self._from = self.target = self.now = vehicle
        self._vehicle_radps = self.cautious_radps = self._supported(tilt_margin_s)

    # ------------------------------------------------------------------ identified constants

    def apply_link_delay(self, link: Estimate) -> list[str]:
        """Add the link's delay, measured before the flight, to every delay of the vehicle. What
        remains unknown is the vehicle's own delay and the link's scatter."""
        added_s = link.value - DIRECT_LINK_S
        vehicle, sentences = self.target, []
        if added_s >= LINK_S:
            vehicle = with_added_delay(self.target, added_s)
            sentences = [f"link delay {_in_ms(link)}, telemetry and setpoint together"]
        self._unknown_s = self._unknown_delay_s + JUMP_SDS * link.sd
        self._begin_with(vehicle, self._unknown_s)
        return sentences

    def recall(self, learned: Learned) -> None:
        """Begin with what an earlier flight has identified."""
        self.delay = learned.delay
        self._begin_with(learned.vehicle, needed_margin(learned.vehicle, learned.delay.sd))

    def apply_link_change(self, learned: Learned, link: Estimate) -> list[str]:
        """Adapt what was recalled to the link's delay of now."""
        changed_s = link.value - max(learned.link_s, DIRECT_LINK_S)
        changed_s = max(changed_s, -self.target.tilt.delay_s, -self.target.yaw.delay_s)
        if abs(changed_s) < LINK_S:
            return []
        vehicle, sd_s = (
            with_added_delay(self.target, changed_s),
            math.hypot(learned.delay.sd, link.sd),
        )
        self.delay = Estimate(learned.delay.value + changed_s, sd_s)
        self._begin_with(vehicle, needed_margin(vehicle, sd_s))
        return [f"the link delays by {1e3 * changed_s:+.0f} ms since the vehicle was identified"]

    def learned(self, link_s: float) -> Learned | None:
        """What the next flight may begin with; None if nothing was identified, or in doubt."""
        if self.delay is None or self.contradicted:
            return None
        return Learned(self.target, self.delay, link_s)

    @property
    def contradicted(self) -> bool:
        """Whether this flight has contradicted the constants in use."""
        return self.in_doubt or self._contradictions > 0 or bool(self.contradiction)

    def apply_hover_thrust(self, hover_thrust: float) -> None:
        """Begin with another hover thrust than the vehicle file's."""
        update = {"hover_thrust": hover_thrust}
        self.target = self.now = self._from = self.target.model_copy(update=update)

    def adopt(self, found: Identified, time_s: float) -> list[str]:
        """Begin to blend in what is within bounds."""
        within, sentences = within_bounds(found, self._file, self._factor)
        for name in DECISIVE:
            if getattr(found, name) is not None and getattr(within, name) is None:
                self.contradiction = "; ".join(sentences)
        effect = within.thrust_effect_s
        in_use = Estimate(self.target.thrust_delay_s + self.target.thrust_lag_s, 0.0)
        if effect and effect.sd > THRUST_SD_S and not _apart(effect, in_use):
            within = replace(within, thrust_lag_s=None, thrust_delay_s=None, thrust_effect_s=None)
        applied = within.applied_to(self.target)
        target = with_link_delay(within, applied, self._file)
        if within.tilt is not None:
            moved = [name for name in LINKED if getattr(target, name) != getattr(applied, name)]
            self._replaced = {name: getattr(self.target, name) for name in ("tilt", *moved)}
            self.delay = within.tilt.delay_s
            self._other_delay = None
        if within.thrust_delay_s is not None:
            self._thrust = within.thrust_effect_s
        if target != self.target:
            self._blend_to(target, time_s)
            sentences.insert(0, summary(within))
        if within.drag_ps is None and found.drag_ps is not None:
            self._rejected_drag_ps = found.drag_ps.value
        return sentences

    def is_new_drag(self, drag: Estimate | None, least_ps: float) -> bool:
        """Whether `drag` differs by more than `least_ps` and its sd from the one in use and from
        the one rejected last."""
        if drag is None:
            return False
        known = (self.target.drag_per_mass_ps, self._rejected_drag_ps)
        return all(abs(drag.value - each) > max(least_ps, drag.sd) for each in known)

    def review_hover(self, found: Identified, time_s: float) -> list[str]:
        """Adopt a later hover thrust if it and the one before it differ from the one in use by more
        than HOVER_NEWS and HOVER_SDS: the mass or the battery has changed. `time_s`: vehicle time.
        One beyond the bounds of adoption is ignored."""
        hover, known = found.hover_thrust, self.target.hover_thrust
        seen_before, self._other_hover = self._other_hover, False
        if hover is None or within_bounds(found, self._file, self._factor)[1]:
            return []
        if abs(hover.value - known) <= max(HOVER_NEWS * known, HOVER_SDS * hover.sd):
            return []
        self._other_hover = not seen_before
        return self.adopt(found, time_s) if seen_before else []

    def review_tilt(self, found: Identified, now: Unexplained, time_s: float) -> list[str]:
        """Compare a later fit of the tilt with the estimate, and adopt it if it is better. `now`
        is what the estimate leaves unexplained in the same stretch of flight."""
        tilt = found.tilt
        self._forget_contradictions(now, time_s)
        if tilt is None or within_bounds(found, self._file, self._factor)[1]:
            return []
        if self.delay is None:
            better = True
        elif _apart(tilt.delay_s, self.delay):
            if not self._confirmed(tilt, now):
                return self._on_other_delay(self.delay, tilt.delay_s)
            better = True
        else:
            clearer = self.in_doubt and tilt.residual_rms < BETTER * now.rms
            better = clearer or tilt.delay_s.sd < BETTER * self.delay.sd
        sentences = self.adopt(found, time_s) if better else []
        left = _left(tilt, now) if better else now
        certain = not left.contradicts if self.in_doubt else better
        return sentences + (self.update_bandwidth() if certain else [])

    # ------------------------------------------------------------------ contradictions

    def _confirmed(self, tilt: ResponseFit, now: Unexplained) -> bool:
        """Whether something besides this fit shows that the delay is another: a fit before it, or
        a contradiction that it explains."""
        if self._other_delay is not None:
            return not _apart(tilt.delay_s, self._other_delay)
        once = 0 < self._contradictions < MOST_CONTRADICTIONS
        explains = tilt.residual_rms < BETTER * now.rms
        return self.in_doubt and once and explains and not _left(tilt, now).contradicts

    def _on_other_delay(self, known: Estimate, seen: Estimate) -> list[str]:
        self._other_delay, self.in_doubt = seen, True
        self._limit(self._supported(abs(seen.value - known.value) + seen.sd))
        return [
            f"tilt delay {_in_ms(seen)} contradicts the identified {_in_ms(known)}; "
            f"{self._bandwidth_text}"
        ]

    def on_contradiction(self, now: Unexplained, before: Unexplained, time_s: float) -> list[str]:
        """Lower the bandwidth because the tilt does not respond as predicted. `now` and `before`
        are what the estimate and the previous one leave unexplained; the previous one is used again
        if it explains more."""
        self.in_doubt = True
        self._contradictions += 1
        self._calm_from_s = time_s
        vehicle = "identified vehicle" if self.target != self._file else "vehicle file"
        sentence = (
            f"the {vehicle} contradicts telemetry: {1e3 * now.rms:.0f} mrad of tilt unexplained "
            f"(limit {1e3 * now.limit:.0f}, commanded {1e3 * now.commanded_rms:.0f})"
        )
        if before.rms < BETTER * now.rms:
            self.delay = None
            self._blend_to(self.previous, time_s)
            sentence += f"; the previous estimate, with {1e3 * before.rms:.0f} mrad, is used again"
        self._limit(self.cautious_radps)
        sentence += f"; {self._bandwidth_text}"
        if self._contradictions >= MOST_CONTRADICTIONS:
            sentence += f" until nothing contradicts for {CALM_S:.0f} s"
        return [sentence]

    def _forget_contradictions(self, now: Unexplained, time_s: float) -> None:
        """After CALM_S in which the estimate in use explains the flight."""
        if now.contradicts:
            self._calm_from_s = time_s
        elif time_s >= self._calm_from_s + CALM_S:
            self._contradictions = 0

    # ------------------------------------------------------------------ bandwidth

    @property
    def limit_radps(self) -> float:
        """The bandwidth that vehicle and link support, as they are known now."""
        return min(self._vehicle_radps, self._link_radps)

    def on_link(self, added_s: float, changed_s: float) -> list[str]:
        """Limit the bandwidth to what a link supports that has added `added_s` to its delay since
        take-off, which prediction compensates, and that changed by `changed_s` lately."""
        self._link_radps = math.inf
        if added_s or changed_s:
            vehicle = with_added_delay(self.target, added_s)
            needed_s = needed_margin(vehicle, self.delay.sd) if self.delay else self._unknown_s
            self._link_radps = self._supported(max(needed_s, changed_s), vehicle)
        lowered_radps = max(min(self._vehicle_radps, self._bandwidth_radps) - self._link_radps, 0.0)
        news = abs(lowered_radps - self._lowered_radps) >= NOTICEABLE_RADPS
        if not (news or (self._lowered_radps and not lowered_radps)):
            return []
        self._lowered_radps = lowered_radps
        change_ms = round(1e3 * added_s)
        delay = f"has grown by {change_ms} ms" if change_ms > 0 else "is no longer than at take-off"
        known = f"identified is {_in_ms(self.delay)}" if self.delay else "none is identified yet"
        return [f"the link's delay {delay}, {known}; {self._bandwidth_text}"]

    def without_identification(self) -> list[str]:
        """What the bandwidth is limited to with the vehicle file as it is."""
        if self.limit_radps >= self._bandwidth_radps:
            return []
        return [
            f"{self._bandwidth_text}: without identification the vehicle file's delay may be wrong "
            f"by {1e3 * self._unknown_delay_s:.0f} ms"
        ]

    def update_bandwidth(self, refusal: str = OUT_OF_BOUNDS) -> list[str]:
        """Set the limit that the delay supports as it is known now; `refusal` is the reason why
        the tilt was not identified, if it was not."""
        if self.delay is None:
            self._vehicle_radps = self.cautious_radps
            return [f"{self._bandwidth_text}: tilt response not identified, {refusal}"]
        before = self._in_use_radps
        supported = self._supported(needed_margin(self.target, self.delay.sd))
        self.in_doubt = self._contradictions >= MOST_CONTRADICTIONS
        self._vehicle_radps = min(supported, self._vehicle_radps) if self.in_doubt else supported
        if self._in_use_radps == before:
            return []
        cause = " by the" if self.limit_radps < self._bandwidth_radps else ":"
        thrust = f", of the thrust with its lag {_in_ms(self._thrust)}" if self._thrust else ""
        return [f"{self._bandwidth_text}{cause} identified delay, {_in_ms(self.delay)}{thrust}"]

    def _supported(self, tilt_margin_s: float, vehicle: Vehicle | None = None) -> float:
        vehicle = vehicle or self.target
        thrust_sd_s = self._thrust.sd if self._thrust else 0.0
        return supported_bandwidth(
            vehicle,
            self._bandwidth_radps,
            self._period_s,
            tilt_margin_s=tilt_margin_s,
            thrust_margin_s=max(LEAST_MARGIN_S, SDS * thrust_sd_s),
        )

    def _limit(self, limit_radps: float) -> None:
        self._vehicle_radps = min(self._vehicle_radps, limit_radps)

    @property
    def _in_use_radps(self) -> float:
        return min(self.limit_radps, self._bandwidth_radps)

    @property
    def _bandwidth_text(self) -> str:
        if self.limit_radps >= self._bandwidth_radps:
            return f"bandwidth {self._bandwidth_radps:.1f} rad/s as configured"
        return (
            f"bandwidth limited to {self.limit_radps:.1f} rad/s "
            f"(configured {self._bandwidth_radps:.1f})"
        )


def _left(tilt: ResponseFit, now: Unexplained) -> Unexplained:
    """What this fit leaves unexplained of the same stretch of flight."""
    return replace(now, rms=tilt.residual_rms)


def _apart(one: Estimate, other: Estimate) -> bool:
    """Whether two delays contradict each other."""
    allowed_s = max(LEAST_JUMP_S, JUMP_SDS * math.hypot(one.sd, other.sd))
    return abs(one.value - other.value) > allowed_s


def _in_ms(delay: Estimate) -> str:
    return f"{1e3 * delay.value:.0f} +- {1e3 * delay.sd:.0f} ms"
