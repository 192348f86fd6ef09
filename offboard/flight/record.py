"""The log's record of one control tick: state, command, cost and times, as floats.

The fields of `TickRecord` are the layout of DEBUG_FLOAT_ARRAY.data (name "pso", array_id 1) in the
.tlog; the analysis reads the log with the same class.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from offboard.control.base import Decision
from offboard.mavlink.outgoing import ReferenceRecord
from offboard.model.command import Command
from offboard.model.predicted_state import PredictedState
from offboard.reference.base import FlatSample

COMPONENT_ID = 191  # MAV_COMP_ID_ONBOARD_COMPUTER: the sender of frames
# MAV_COMP_ID_ONBOARD_COMPUTER2: the sender of records, which are only logged. Its own sequence
# numbers leave no gap in those of the frames that the vehicle counts.
RECORD_COMPONENT_ID = 192
RECORD_NAME = "pso"
NAN = float("nan")
RECORD_ID = 1


@dataclass(frozen=True, slots=True)
class TickRecord:
    """All floats, SI, NED, vehicle time; NaN for what the control law does not have."""

    phase: float  # of flight.phases.PHASE_CODES
    thrust_mps2: float
    thrust_direction_north: float
    thrust_direction_east: float
    thrust_direction_down: float
    course_rad: float
    cost: float
    optimal_cost: float
    gap: float
    spread: float
    iterations: float
    cut_short: float
    at_bound: float
    solve_time_s: float
    lateness_s: float  # wall time from the arrival of the telemetry to this record
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

    def data(self) -> tuple[float, ...]:
        """The values in the order of DEBUG_FLOAT_ARRAY.data."""
        return tuple(getattr(self, each.name) for each in fields(self))

    @classmethod
    def of(
        cls,
        *,
        phase: int,
        decision: Decision,
        state: PredictedState,
        solve_time_s: float,
        lateness_s: float,
        missed_ticks: int,
        hover_thrust: float,
        track_time_s: float,
    ) -> TickRecord:
        """The record of `decision`, made for the predicted `state`."""
        command, certificate = decision.command, decision.certificate
        # with a position setpoint, the autopilot chooses thrust and direction
        direction = command.thrust_direction_ned if isinstance(command, Command) else (NAN,) * 3
        return cls(
            float(phase),
            command.thrust_mps2 if isinstance(command, Command) else NAN,
            *direction,
            command.course_rad,
            certificate.cost,
            certificate.optimal_cost,
            certificate.gap,
            certificate.spread,
            float(certificate.iterations),
            float(certificate.cut_short),
            float(certificate.at_bound),
            solve_time_s,
            lateness_s,
            float(missed_ticks),
            *_triple(state.position_ned_m),
            *_triple(state.velocity_ned_mps),
            *_triple(state.disturbance_ned_mps2),
            hover_thrust,
            track_time_s,
            certificate.seed_cost,
        )

    @classmethod
    def from_data(cls, data: tuple[float, ...]) -> TickRecord:
        """The record in DEBUG_FLOAT_ARRAY.data. Raises ValueError if the array is too short."""
        names = fields(cls)
        if len(data) < len(names):
            raise ValueError(f"a tick record has {len(names)} floats, this one {len(data)}")
        return cls(*data[: len(names)])


def reference_record(time_s: float, sample: FlatSample) -> ReferenceRecord:
    """The reference at a tick, for the log."""
    return ReferenceRecord(
        time_s=time_s,
        position_ned_m=_triple(sample.position_ned_m),
        velocity_ned_mps=_triple(sample.velocity_ned_mps),
        acceleration_ned_mps2=_triple(sample.acceleration_ned_mps2),
        course_rad=float(sample.course_rad),
        course_rate_radps=float(sample.course_rate_radps),
    )


def _triple(values: NDArray[np.float64]) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])
