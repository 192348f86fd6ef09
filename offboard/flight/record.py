"""Control ticks: the log's record of one (state, command, cost and times, as floats), and whether
this computer keeps up with them.

The fields of `TickRecord` are the layout of DEBUG_FLOAT_ARRAY.data (name "pso") in the .tlog; the
analysis reads the log with the same class. The array_id is the number of fields, so that the log
of an older version, which lacks the last ones, stays readable.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass, fields

import numpy as np
from numpy.typing import NDArray

from offboard.control.base import Certificate, Decision
from offboard.flight.phases import Phase
from offboard.mavlink.outgoing import ReferenceRecord
from offboard.model.command import Command, PositionCommand, PredictedState
from offboard.reference.base import FlatSample

COMPONENT_ID = 191  # MAV_COMP_ID_ONBOARD_COMPUTER: the sender of frames
# MAV_COMP_ID_ONBOARD_COMPUTER2: the sender of records, which are only logged. Its own sequence
# numbers leave no gap in those of the frames that the vehicle counts.
RECORD_COMPONENT_ID = 192
RECORD_NAME = "pso"
NAN = float("nan")
CERTIFIED = len(fields(Certificate))
Array = NDArray[np.float64]
IDENTIFIED_NAME, IDENTIFIED_ID = "identified", 2  # of the other DEBUG_FLOAT_ARRAY in the log


@dataclass(frozen=True, slots=True)
class TickRecord:
    """All floats, SI, NED, vehicle time; NaN for what the control law does not have.

    Thrust, direction and heading are those of the setpoint that was sent. The certificate, from
    `cost` to `at_bound` and `seed_cost`, is of this setpoint too: NaN where it is not the one that
    the control law certified, because excitation or the limits changed it or it was not sent.
    """

    phase: float  # of flight.phases.PHASE_CODES
    thrust_mps2: float
    thrust_direction_north: float
    thrust_direction_east: float
    thrust_direction_down: float
    heading_rad: float
    cost: float
    optimal_cost: float
    gap: float
    spread: float
    iterations: float
    cut_short: float
    at_bound: float
    solve_time_s: float
    answer_s: float  # host time from the arrival of the telemetry until the setpoint was sent
    missed_ticks: float  # ticks skipped since the previous record
    predicted_north_m: float
    predicted_east_m: float
    predicted_down_m: float
    predicted_velocity_north_mps: float
    predicted_velocity_east_mps: float
    predicted_velocity_down_mps: float
    disturbance_north_mps2: float
    disturbance_east_mps2: float
    disturbance_down_mps2: float
    hover_thrust: float
    track_time_s: float  # time since the start of the track; NaN before it
    seed_cost: float = NAN  # cost of the best plan that the search started from
    age_s: float = NAN  # of the telemetry when the setpoint was sent, vehicle time
    refused: float = 0.0  # flags of `setpoint.Refusal`; 0 for a setpoint that was sent
    other_datagrams: float = 0.0  # datagrams of other senders since the previous record
    pause_s: float = 0.0  # longest pause of this process since the previous tick; 0 below a period

    def data(self) -> tuple[float, ...]:
        """The values in the order of DEBUG_FLOAT_ARRAY.data."""
        return tuple(getattr(self, each.name) for each in fields(self))


FIELDS = tuple(field.name for field in fields(TickRecord))
RECORD_ID = len(FIELDS)


@dataclass(frozen=True, slots=True)
class Tick:
    """One control tick."""

    time_s: float = 0.0  # vehicle time
    arrived_s: float = 0.0  # host time of the arrival of the telemetry that caused it
    missed: int = 0  # ticks skipped since the previous one
    other_datagrams: int = 0  # datagrams of other senders since the previous one
    pause_s: float = 0.0  # of this process, since the previous one


@dataclass(slots=True)
class Decided:
    """A decision, the predicted state it was made for, and what became of it."""

    tick: Tick
    phase: Phase
    state: PredictedState
    decision: Decision
    solve_time_s: float
    sent: Command | PositionCommand | None = None
    age_s: float = 0.0  # of its telemetry, when it was checked
    refused: int = 0  # flags of `setpoint.Refusal`
    failure: str = ""  # why it was refused

    def record(self, *, answer_s: float, hover_thrust: float, track_time_s: float) -> TickRecord:
        """The record of the tick. The certificate counts if the setpoint was sent as decided."""
        sent, state, tick = self.sent, self.state, self.tick
        # with a position setpoint, the autopilot chooses thrust and direction
        attitude = sent if isinstance(sent, Command) else None
        certified = sent == self.decision.command
        figures = astuple(self.decision.certificate) if certified else (NAN,) * CERTIFIED
        *certificate, seed_cost = map(float, figures)
        values = (
            float(self.phase.code),
            attitude.thrust_mps2 if attitude else NAN,
            *(attitude.thrust_direction_ned if attitude else (NAN, NAN, NAN)),
            sent.heading_rad if sent else NAN,
            *certificate,
            self.solve_time_s,
            answer_s,
            float(tick.missed),
            *_triple(state.position_ned_m),
            *_triple(state.velocity_ned_mps),
            *_triple(state.disturbance_ned_mps2),
            hover_thrust,
            track_time_s,
            seed_cost,
            self.age_s,
            float(self.refused),
            float(tick.other_datagrams),
            tick.pause_s,
        )
        return TickRecord(*values)


def reference_record(time_s: float, sample: FlatSample) -> ReferenceRecord:
    """The reference at a tick, for the log."""
    return ReferenceRecord(
        time_s=time_s,
        position_ned_m=_triple(sample.position_ned_m),
        velocity_ned_mps=_triple(sample.velocity_ned_mps),
        acceleration_ned_mps2=_triple(sample.acceleration_ned_mps2),
        heading_rad=float(sample.heading_rad),
        heading_rate_radps=float(sample.heading_rate_radps),
    )


def _triple(values: Array) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])


# ---------------------------------------------------------------------- ticks that were skipped

SHARE = 0.05  # of the ticks skipped, from which a computer is too busy
PAUSE_S = 0.3  # or one pause; after it, what was known before is not known any more


def too_busy(skipped: float, ticks: float, pause_s: float) -> str:
    """A sentence if this computer was too busy to fly; else empty.

    `skipped` of `ticks` control ticks fell into pauses of this process; `pause_s` is the longest.
    """
    if not (pause_s > PAUSE_S or skipped > SHARE * ticks):
        return ""
    return (
        f"this computer was too busy: {skipped:.0f} of {ticks:.0f} ticks were skipped, pauses up "
        f"to {pause_s:.2f} s"
    )


class Busyness:
    """Counts in the air. `period_s`: of control; a shorter gap between two turns skips no tick."""

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._gap_s = 0.0  # longest between two turns, since the previous tick
        self.skipped = self.ticks = 0
        self.pause_s = 0.0

    def on_turn(self, gap_s: float) -> None:
        """A turn begins `gap_s` after the one before it, host time."""
        self._gap_s = max(self._gap_s, gap_s)

    def on_tick(self, missed: int, *, flying: bool) -> float:
        """A tick, `missed` ticks after the previous one. Returns the pause that it came after, 0
        without one."""
        pause_s, self._gap_s = self._gap_s, 0.0
        if pause_s <= self._period_s:
            pause_s = 0.0
        if flying:
            self.ticks += 1 + missed
            self.skipped += missed if pause_s else 0
            self.pause_s = max(self.pause_s, pause_s)
        return pause_s

    @property
    def sentence(self) -> str:
        return too_busy(self.skipped, self.ticks, self.pause_s)
