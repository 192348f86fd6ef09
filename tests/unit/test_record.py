"""The record of a tick: it says what was sent, and logs of older versions stay readable."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from offboard.control.base import Certificate, Decision
from offboard.flight.phases import Phase
from offboard.flight.record import Decided, Tick, TickRecord
from offboard.flight.setpoint import Refusal
from offboard.model.command import Command, PredictedState

TICK = Tick(5.0)
COMMAND = Command(9.0, (0.6, 0.0, 0.8), 0.3)
DECISION = Decision(COMMAND, Certificate(2.0, 1.5, 0.25, 0.1, 40, True, True, 3.0))
CERTIFIED = ("cost", "optimal_cost", "gap", "spread", "iterations", "cut_short", "at_bound",
             "seed_cost")  # fmt: skip
STATE = PredictedState(
    time_s=5.0,
    position_ned_m=np.zeros(3),
    velocity_ned_mps=np.zeros(3),
    thrust_direction_ned=np.array([0.0, 0.0, 1.0]),
    thrust_direction_rate_ned_ps=np.zeros(3),
    heading_rad=0.0,
    heading_rate_radps=0.0,
    thrust_mps2=9.81,
    disturbance_ned_mps2=np.zeros(3),
    rates_frd_radps=np.zeros(3),
)


def record(sent: Command | None, tick: Tick = TICK, **more: float) -> TickRecord:
    decided = Decided(tick, Phase.TRACK, STATE, DECISION, 0.001, sent, **more)
    return decided.record(answer_s=0.002, hover_thrust=0.5, track_time_s=1.0)


def certificate(of: TickRecord) -> list[float]:
    return [getattr(of, name) for name in CERTIFIED]


def test_the_certificate_is_of_what_was_sent() -> None:
    as_decided = record(COMMAND)
    assert certificate(as_decided) == [2.0, 1.5, 0.25, 0.1, 40.0, 1.0, 1.0, 3.0]
    limited = record(replace(COMMAND, thrust_mps2=8.0))
    assert limited.thrust_mps2 == 8.0
    assert np.isnan(certificate(limited)).all()
    withheld = record(None, refused=Refusal.STALE | Refusal.LATE)
    assert np.isnan([*certificate(withheld), withheld.thrust_mps2, withheld.heading_rad]).all()
    assert withheld.refused == 3.0
