"""The record of a tick: it says what was sent."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from laws import at
from uneventful import uneventful

from offboard.control.base import Certificate, Decision
from offboard.flight.decision import tick_record
from offboard.flight.outbox import Refusal
from offboard.flight.phases import Phase
from offboard.flight.record import Decided, TickRecord
from offboard.model.command import Command

COMMAND = Command(9.0, (0.6, 0.0, 0.8), 0.3)
DECISION = Decision(COMMAND, Certificate(2.0, 1.5, 0.25, 0.1, 40, True, True, 3.0))
CERTIFIED = ("cost", "optimal_cost", "gap", "spread", "iterations", "cut_short", "at_bound",
             "seed_cost")  # fmt: skip


def record(sent: Command | None, **more: Refusal) -> TickRecord:
    state = at((0.0, 0.0, 0.0), 0.0)
    decided = Decided(Phase.TRACK, state, DECISION, 0.001, sent, **more)
    return tick_record(uneventful(), decided, 0.002)


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
