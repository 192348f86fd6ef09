"""What is believed of the vehicle in flight, and the bandwidth that this bears.

It begins with the vehicle file, takes over what identification found within bounds, blended over
a second, and doubts what contradicts it: a delay that jumps, a tilt that does not answer as
predicted. Doubt lowers the bandwidth at once; only a look that explains the flight raises it again.
Knows values and vehicle time, no flight and no trace.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from offboard.control.delay_margin import needed_margin, supported_bandwidth
from offboard.identification.adoption import LINK_S, bounded, later, mixed, told, with_link
from offboard.identification.response_fit import Estimate, Unexplained
from offboard.identification.stages import Identified
from offboard.model.vehicle import Vehicle

BETTER = 0.7  # another look at the tilt is taken if its delay is this much surer; in doubt, it or
# what was believed before, if it leaves this much less unexplained
DIRECT_LINK_S = 0.004  # of the vehicle file's delay: telemetry's age where nothing is in between
LEAST_JUMP_S, JUMP_SDS = 0.015, 4.0  # delays further apart contradict each other
DECISIVE = ("tilt", "hover_thrust")  # far from the vehicle file's, the flight ends
MOST_DOUBTS = 2  # so often contradicted, doubt and low bandwidth stay for good
LINKED = ("yaw", "thrust_delay_s")  # moved by the tilt's delay, where they were not identified


class VehicleEstimate:
    """`vehicle` is the vehicle file's, `unknown_delay_s` what its delay may be wrong by until it
    is identified; see `IdentifySettings` for `factor` and `blend_s`."""

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
        self._file = vehicle
        self._factor = factor
        self._blend_s = blend_s
        self._period_s = period_s
        self._bandwidth_radps = bandwidth_radps
        self._unknown_delay_s = unknown_delay_s
        self.reset()

    def reset(self) -> None:
        """Forget everything of the previous flight."""
        self._from = self.target = self.now = self._file
        self._before: dict[str, Any] = {}  # what the tilt taken over last has replaced
        self._blend_began_s = -math.inf
        self._refused_drag_ps = math.inf
        self._doubt: Estimate | None = None
        self._doubts = 0
        self.delay: Estimate | None = None  # of the tilt, once identified
        self.doubted = False
        self.limit_radps = self.cautious_radps = self._borne(self._unknown_delay_s)
        self.contradiction = ""  # why this vehicle file must not be flown with

    # ------------------------------------------------------------------ on the way

    @property
    def settled(self) -> bool:
        return self.now == self.target

    def taken_over(self, time_s: float) -> bool:
        return time_s >= self._blend_began_s + self._blend_s

    def step(self, time_s: float) -> None:
        """One period further on the way to the target."""
        share = 1.0
        if self._blend_s > 0.0:
            passed_s = time_s - self._blend_began_s + self._period_s
            share = min(passed_s / self._blend_s, 1.0)
        self.now = self.target if share > 1.0 - 1e-6 else mixed(self._from, self.target, share)

    def is_news(self, drag: Estimate | None, least_ps: float) -> bool:
        """Whether a drag differs from the one believed, and from the one refused last."""
        if drag is None:
            return False
        known = (self.target.drag_per_mass_ps, self._refused_drag_ps)
        return all(abs(drag.value - each) > max(least_ps, drag.sd) for each in known)

    # ------------------------------------------------------------------ what was found

    def expect_link(self, late: Estimate) -> list[str]:
        """The link's delay is known before the flight: what remains unknown is the vehicle's own,
        and the link's scatter."""
        added_s = late.value - DIRECT_LINK_S
        sentences = []
        if added_s >= LINK_S:
            self.target = self.now = self._from = later(self._file, added_s)
            sentences = [f"the link is {_told(late)} late, telemetry and setpoint together"]
        unknown_s = self._unknown_delay_s + JUMP_SDS * late.sd
        self.limit_radps = self.cautious_radps = self._borne(unknown_s)
        return sentences

    def take(self, found: Identified, time_s: float) -> list[str]:
        """Set out for what was found; what was taken, refused or out of bounds, in sentences."""
        within, sentences = bounded(found, self._file, self._factor)
        for name in DECISIVE:
            if getattr(found, name) is not None and getattr(within, name) is None:
                self.contradiction = "; ".join(sentences)
        applied = within.applied_to(self.target)
        target = with_link(within, applied, self._file)
        if within.tilt is not None:
            moved = [name for name in LINKED if getattr(target, name) != getattr(applied, name)]
            self._before = {name: getattr(self.target, name) for name in ("tilt", *moved)}
            self.delay = within.tilt.delay_s
            self._doubt = None
        if target != self.target:
            self._set_out(target, time_s)
            sentences.insert(0, told(within))
        if within.drag_ps is None and found.drag_ps is not None:
            self._refused_drag_ps = found.drag_ps.value
        return sentences

    def unsure(self) -> list[str]:
        """What flying the vehicle file as it is costs."""
        if self.limit_radps >= self._bandwidth_radps:
            return []
        return [
            f"bandwidth lowered from {self._bandwidth_radps:.1f} to {self.limit_radps:.1f} rad/s: "
            "the delay is the vehicle file's, not identified"
        ]

    def conclude(self, refusal: str = "it is out of bounds") -> list[str]:
        """The bandwidth that the delay bears as it is known now; `refusal`: why it is not."""
        if self.delay is None:
            self.limit_radps = self.cautious_radps
            return [f"tilt as believed, bandwidth {self.limit_radps:.1f} rad/s: {refusal}"]
        before = min(self.limit_radps, self._bandwidth_radps)
        borne = self._borne(needed_margin(self.target, self.delay.sd))
        trusted = self._doubts < MOST_DOUBTS
        self.limit_radps = borne if trusted else min(borne, self.limit_radps)
        now = min(self.limit_radps, self._bandwidth_radps)
        self.doubted = not trusted
        if now == before:
            return []
        return [
            f"bandwidth {now:.1f} of {self._bandwidth_radps:.1f} rad/s: what a delay of "
            f"{_told(self.delay)} bears"
        ]

    def look_again(self, found: Identified, now: Unexplained, time_s: float) -> list[str]:
        """A later look at the tilt: better, the same, or a contradiction. `now`: what the belief
        leaves of the same stretch."""
        tilt = found.tilt
        if tilt is None or bounded(found, self._file, self._factor)[1]:
            return []
        if self.delay is None:
            better = True
        elif _apart(tilt.delay_s, self.delay):
            if self._doubt is None or _apart(tilt.delay_s, self._doubt):
                return self._doubt_delay(self.delay, tilt.delay_s)
            better = True
        else:
            clearer = self.doubted and tilt.residual_rms < BETTER * now.scale
            better = clearer or tilt.delay_s.sd < BETTER * self.delay.sd
        sentences = self.take(found, time_s) if better else []
        left = replace(now, scale=tilt.residual_rms) if better else now
        certain = not left.contradicts if self.doubted else better
        return sentences + (self.conclude() if certain else [])

    def _doubt_delay(self, known: Estimate, seen: Estimate) -> list[str]:
        self._doubt, self.doubted = seen, True
        limit_radps = self._borne(abs(seen.value - known.value) + seen.sd)
        said = f"tilt delay {_told(seen)} contradicts the {_told(known)} identified"
        return [f"{said}: {self._lowered(limit_radps)}"]

    def contradict(self, now: Unexplained, before: Unexplained, time_s: float) -> list[str]:
        """The tilt does not answer as predicted; `before`: what the belief before leaves."""
        self.doubted = True
        self._doubts += 1
        identified = self.target != self._file
        said = "the identified vehicle" if identified else "the vehicle file"
        said += f" contradicts telemetry: {now.told}"
        if before.scale < BETTER * now.scale:
            self.delay = None
            self._set_out(self.before, time_s)
            said += f", {before.told} by the one before, which is flown again"
        said += f"; {self._lowered(self.cautious_radps)}"
        return [said + (" for good" if self._doubts >= MOST_DOUBTS else "")]

    def _set_out(self, target: Vehicle, time_s: float) -> None:
        self._from, self.target, self._blend_began_s = self.now, target, time_s

    def _borne(self, needed_s: float) -> float:
        return supported_bandwidth(self.target, self._bandwidth_radps, self._period_s, needed_s)

    def _lowered(self, limit_radps: float) -> str:
        self.limit_radps = min(self.limit_radps, limit_radps)
        return f"bandwidth lowered to {min(self.limit_radps, self._bandwidth_radps):.1f} rad/s"

    @property
    def before(self) -> Vehicle:
        """With the tilt that was believed before the last was taken over."""
        return self.target.model_copy(update=self._before)


def _apart(one: Estimate, other: Estimate) -> bool:
    allowed_s = max(LEAST_JUMP_S, JUMP_SDS * math.hypot(one.sd, other.sd))
    return abs(one.value - other.value) > allowed_s


def _told(delay: Estimate) -> str:
    return f"{1e3 * delay.value:.0f} +- {1e3 * delay.sd:.0f} ms"
