"""Snapshots of a flight beside the messages that crossed the wire."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest
from pair import hover
from uneventful import heartbeat, uneventful

from offboard.flight.display import Snapshot
from offboard.flight.phases import ExitCode, Phase


def test_snapshots_agree_with_the_wire() -> None:
    pair = hover()
    seen: list[tuple[float, Snapshot]] = []

    def look(flying: object) -> bool:
        if pair.steps % 25 == 0:  # every 0.1 s
            seen.append((float(pair.instance.autopilot.plant.height_m), pair.companion.snapshot()))
        return False

    pair.at.append((look, lambda _: None))
    assert pair.fly().exit_code == ExitCode.FLOWN

    first = seen[0][1]
    assert (first.authority, first.reference_ned_m) == ("free", None)
    assert math.isnan(first.position_error_m)
    tracked = [each for each in seen if each[1].phase == "track"]
    assert len(tracked) == pytest.approx(30, abs=2)
    for true_height_m, shown in tracked:
        assert shown.position_ned_m is not None
        assert shown.reference_ned_m is not None
        assert -shown.position_ned_m[2] == pytest.approx(true_height_m, abs=0.3)
        assert shown.position_error_m == pytest.approx(
            math.dist(shown.position_ned_m, shown.reference_ned_m), abs=1e-9
        )
        assert (shown.mode, shown.armed, shown.authority) == ("OFFBOARD", True, "ours")
        assert shown.failsafe == "fly"
    assert [tracked[0][1].track_time_s, tracked[-1][1].track_time_s] == pytest.approx(
        [0.0, 3.0], abs=0.2
    )
    last = pair.companion.snapshot()
    assert (last.phase, last.armed) == ("disarmed", False)
    followed = {each[1].phase for each in seen if each[1].reference_ned_m is not None}
    assert followed == {"climb", "track", "hover"}
    assert last.texts[-1] == pair.companion.announced[-1]


def test_the_mode_of_a_pilot_is_shown_with_who_has_authority() -> None:
    state: Any = uneventful(Phase.TRACK)
    state.session.counters = SimpleNamespace(forged=0)
    heartbeat(state, armed=True, mode="AUTO.LOITER")
    assert (Snapshot(state).authority, Snapshot(state).mode) == ("lost", "AUTO.LOITER")
