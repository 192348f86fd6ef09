"""A recorded session with a real PX4, repeated: the same bytes at the same vehicle times.

Every answer is compared row by row; what may differ is listed here with its reason.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from sim_bench import Bench
from sim_talk import Talk, ask_again

from simulator.vehicle.sensors import EstimatorName

RECORDING = Path(__file__).parent / "recordings" / "px4-1.16.1-offboard.tlog"
# PX4 announces its log file, the simulator writes none; the simulator hears that the recording ends
NOT_OURS = ("[logger]", "Connection to ground station lost")


@pytest.fixture(scope="module")
def talks() -> tuple[Talk, Talk]:
    """The real one's talk and the simulator's."""
    real, ours = Talk(NOT_OURS), Talk(NOT_OURS)
    bench = Bench(EstimatorName.PX4_LIKE, seed=3, heartbeat_type=None, system=7)
    # the recording ends after its last question
    ask_again(RECORDING, bench, real, ours, run_on_s=20.0)
    return real, ours


def test_every_ack_is_the_same_in_order(talks: tuple[Talk, Talk]) -> None:
    real, ours = talks
    assert [row[:2] for row in ours.acks] == [row[:2] for row in real.acks]
    assert len(real.acks) == 14
    late = [abs(a[2] - b[2]) for a, b in zip(ours.acks, real.acks, strict=True)]
    assert max(late) < 0.06  # vehicle time is known to some ms, the speed of SITL wavers


def test_every_text_is_the_same_in_order(talks: tuple[Talk, Talk]) -> None:
    """Their times too, but for what hangs on the takeoff and on how far the estimates wander
    near the ground: over eight seeds the landing is felt between 5 s before and 6 s after."""
    real, ours = talks
    assert [row[:2] for row in ours.texts] == [row[:2] for row in real.texts]
    assert len(real.texts) == 9
    for (_, text, our_s), (_, _, real_s) in zip(ours.texts, real.texts, strict=True):
        limit_s = {"Takeoff": 0.5, "Landing d": 3.0, "Disarmed ": 3.0}
        known = next((limit_s[start] for start in limit_s if text.startswith(start)), 0.06)
        assert abs(our_s - real_s) < known, text


def test_every_parameter_is_the_same(talks: tuple[Talk, Talk]) -> None:
    real, ours = talks
    asked = [row for row in real.parameters if row[0] in {name for name, _, _ in ours.parameters}]
    assert ours.parameters == asked[-7:]  # before: PX4's unasked list of changes
    assert len(ours.parameters) == 7


def test_heartbeats_go_through_the_same_states(talks: tuple[Talk, Talk]) -> None:
    real, ours = talks
    assert ours.states == real.states
    assert len(real.states) == 11


def test_landed_states_are_the_same(talks: tuple[Talk, Talk]) -> None:
    real, ours = talks
    assert ours.landed == real.landed == [1, 2, 4, 1]
