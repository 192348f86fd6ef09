"""Checks of the planned flight against the vehicle, and of this computer."""

from __future__ import annotations

import math
from collections.abc import Iterable

from offboard.control.delay_margin import LEAST_MARGIN_S, SDS, needed_margin, supported_bandwidth
from offboard.doctor.findings import Finding, blocks, ok, wait, warn
from offboard.doctor.observation import Observation
from offboard.identification.adoption import with_added_delay
from offboard.identification.uncertainty import Estimate
from offboard.run.configuration import UNKNOWN_VEHICLE, FlightConfig

HOVER_FACTOR = 1.3
LEAST_FREE_BYTES = 500_000_000  # four hours of log
OVERSHOOT_S, CLOCK_STEP_S = 0.02, 0.05
MARGIN = 0.5  # of the deadline


def configuration(seen: Observation) -> Iterable[Finding]:
    """The planned flight against this vehicle: hover thrust, tilt, reference, bandwidth."""
    config = seen.config
    if config is None:
        return
    if seen.config_problem:
        yield blocks(seen.config_problem, "change the reference or the vehicle file")
    yield from _hover(seen, config)
    yield from _tilt(seen, config)
    if seen.link.delay:
        yield from _bandwidth(seen.link.delay, config)
    yield ok(f"{config.reference.title} by {config.controller.law}, vehicle {config.vehicle.name}")


def _hover(seen: Observation, config: FlightConfig) -> Iterable[Finding]:
    dialect, assumed = seen.dialect, config.vehicle.hover_thrust
    if dialect is None or config.vehicle.name == UNKNOWN_VEHICLE:
        return
    told = seen.vehicle.parameters.get(dialect.hover_parameter)
    if told and not 1.0 / HOVER_FACTOR < assumed / told < HOVER_FACTOR:
        yield warn(
            f"vehicle {config.vehicle.name} has hover_thrust {assumed:.3g}, the autopilot has "
            f"{dialect.hover_parameter} {told:.3g}",
            f"use the file of this vehicle, --vehicle {UNKNOWN_VEHICLE} to have it identified, or "
            f"param set {dialect.hover_parameter} {assumed:.3g}",
        )


def _tilt(seen: Observation, config: FlightConfig) -> Iterable[Finding]:
    dialect, needed = seen.dialect, seen.tilt_rad
    if dialect is None or needed is None:
        return
    name, unit = dialect.tilt_parameter
    value = seen.vehicle.parameters.get(name)
    if value is not None and needed > value * unit:
        enough = math.ceil(math.degrees(needed) + 1.0) * math.radians(1.0) / unit
        yield warn(
            f"the reference tilts by {math.degrees(needed):.0f} deg, the autopilot's own modes by "
            f"at most {math.degrees(value * unit):.0f} deg ({name})",
            f"fly slower, or param set {name} {enough:g}",
        )


def _bandwidth(delay: Estimate, config: FlightConfig) -> Iterable[Finding]:
    wanted = getattr(config.controller, "bandwidth_radps", None)
    if wanted is None:
        return
    vehicle = with_added_delay(config.vehicle, delay.value)
    margin_s = needed_margin(vehicle, delay.sd)
    possible = supported_bandwidth(
        vehicle,
        wanted,
        config.period_s,
        tilt_margin_s=margin_s,
        thrust_margin_s=max(LEAST_MARGIN_S, SDS * delay.sd),
    )
    if possible < wanted:
        yield warn(
            f"with a delay of {1e3 * delay.value:.0f} +- {1e3 * delay.sd:.0f} ms the link bears a "
            f"bandwidth of {possible:g} rad/s, {wanted:g} is configured",
            f"the flight lowers it by itself; or --set controller.bandwidth_radps={possible:g}",
        )


def disk(seen: Observation) -> Iterable[Finding]:
    """Free space for the log of a flight."""
    free, place = seen.computer.free_bytes, seen.computer.directory
    if free is None:
        return
    figures = f"{free / 1e9:.1f} GB free in {place}"
    if free < LEAST_FREE_BYTES:
        yield warn(f"{figures}; a flight lands when its log cannot be written", "free some space")
    else:
        yield ok(figures)


def compiled(seen: Observation) -> Iterable[Finding]:
    """Whether the compiled functions are ready."""
    missing = seen.computer.not_compiled
    if missing is None:
        return
    if missing:
        yield warn(
            f"{missing} functions are not compiled yet: the first flight begins late",
            "run `offboard fly --sitl` once",
        )
    else:
        yield ok("all functions are compiled")


def computer(seen: Observation) -> Iterable[Finding]:
    """Whether this computer decides and wakes up in time."""
    measured = seen.computer
    if measured.not_measured_s is not None:
        yield wait(
            f"reference and controller were not examined within {measured.not_measured_s:.0f} s",
            "close other programs and check again, or `offboard check` the configuration",
        )
    if measured.rehearsal:
        yield blocks(measured.rehearsal, "choose another controller, or a longer deadline_s")
    if measured.clock_step_s > CLOCK_STEP_S:
        yield warn(
            f"this computer's clock was set by {measured.clock_step_s:.2f} s while it listened",
            "let the clock settle (chrony, ntp); logs have wrong times",
        )
    figures = []
    if measured.decision_s is not None and measured.deadline_s:
        figures.append(
            f"a decision takes {1e3 * measured.decision_s:.1f} ms of "
            f"{1e3 * measured.deadline_s:.0f} ms"
        )
        if measured.decision_s > MARGIN * measured.deadline_s and not measured.rehearsal:
            yield warn(figures[0], "close other programs, or plan fewer steps")
    if measured.overshoot_s is not None:
        figures.append(f"wakes up at most {1e3 * measured.overshoot_s:.1f} ms late")
        if measured.overshoot_s > OVERSHOOT_S:
            hint = "close other programs; use the performance governor of the processor"
            yield warn(f"this computer wakes up {1e3 * measured.overshoot_s:.0f} ms late", hint)
    if figures:
        yield ok(", ".join(figures))
