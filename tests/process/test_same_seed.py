"""`fly --sitl` with one seed sends and receives the same frames on any machine, busy or not."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator, Sequence
from dataclasses import fields
from pathlib import Path
from threading import Timer

import pytest

from offboard.analysis import tlog
from offboard.flight.flight import Flight
from offboard.flight.phases import Phase
from offboard.flight.record import COMPONENT_ID, RECORD_COMPONENT_ID, RECORD_ID, TickRecord
from offboard.run import flight
from offboard.run.configuration import load
from offboard.run.sitl import SimulatorProcess

VEHICLE_COMPONENT_ID = 1
WALL_TIMES = ("solve_time_s", "answer_s")  # fields of TickRecord that the machine decides
SHORT = ("reference.duration_s=1", "reference.height_m=1", "identify.excite=false")
COLUMNS = [at for at, field in enumerate(fields(TickRecord)) if field.name in WALL_TIMES]


class LateSimulator(SimulatorProcess):
    """Starts each vehicle `late_s` after the launch."""

    late_s = 0.0

    def launch(self, options: Sequence[str]) -> None:
        os.killpg(self.pid, signal.SIGSTOP)
        super().launch(options)
        Timer(self.late_s, os.killpg, (self.pid, signal.SIGCONT)).start()


@pytest.fixture(scope="module")
def simulator() -> Iterator[LateSimulator]:
    with LateSimulator() as simulator:
        yield simulator


def fly(
    directory: Path,
    simulator: LateSimulator,
    *,
    simulator_late_s: float = 0.0,
    controller_late_s: float = 0.0,
    stall_s: float = 0.0,
) -> dict[int, list[bytes]]:
    """One short flight: its frames by component, without wall times."""
    stalls = [stall_s]

    def progress(companion: Flight) -> None:
        if companion.phase is Phase.TRACK and stalls:
            time.sleep(stalls.pop())

    simulator.late_s = simulator_late_s
    config = load(
        "flight", choices={"reference": "hover", "vehicle": "px4_sih"}, assignments=SHORT, seed=7
    )
    outcome = flight.fly(
        config,
        directory,
        flight.Simulated(),
        simulator=simulator,
        progress=progress,
        tell=lambda sentence: time.sleep(controller_late_s),
    )
    assert outcome.exit_code == 0, outcome.sentence
    frames: dict[int, list[bytes]] = {}
    for entry in tlog.read(tlog.find(directory)):
        frames.setdefault(entry.component_id, []).append(without_wall_times(entry))
    return frames


def without_wall_times(entry: tlog.LoggedMessage) -> bytes:
    """The frame; of a tick's record, which is never sent, the fields that no clock decides."""
    if entry.name != "DEBUG_FLOAT_ARRAY" or entry.message.array_id != RECORD_ID:
        return entry.frame.raw
    kept = [value for at, value in enumerate(entry.message.data) if at not in COLUMNS]
    return repr((entry.frame.sequence, entry.message.time_usec, kept)).encode()


@pytest.fixture(scope="module")
def undisturbed(
    simulator: LateSimulator, tmp_path_factory: pytest.TempPathFactory
) -> dict[int, list[bytes]]:
    return fly(tmp_path_factory.mktemp("undisturbed") / "flight", simulator)


@pytest.mark.parametrize(
    "disturbance",
    [
        # the simulator repeats its first barrier, and one in flight
        {"simulator_late_s": 0.1, "controller_late_s": 1.0, "stall_s": 1.2},
        pytest.param({"simulator_late_s": 2.0}, marks=pytest.mark.slow),
    ],
    ids=str,
)
def test_every_frame_is_the_same(
    disturbance: dict[str, float],
    undisturbed: dict[int, list[bytes]],
    simulator: LateSimulator,
    tmp_path: Path,
) -> None:
    frames = fly(tmp_path / "flight", simulator, **disturbance)
    assert set(frames) == {VEHICLE_COMPONENT_ID, COMPONENT_ID, RECORD_COMPONENT_ID}
    assert len(frames[COMPONENT_ID]) > 500
    for component, expected in undisturbed.items():
        assert frames[component] == expected
