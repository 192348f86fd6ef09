"""The service through a day of events, in lockstep, judged by an independent observer of the wire.

One vehicle, one service and one record for the whole day; Hypothesis draws the events. The default
is 45 s of each autopilot. OFFBOARD_DAY_S=28800 makes it eight hours, OFFBOARD_DAY_SEED another day.
"""

from __future__ import annotations

import gc
import json
import os
import resource
import shutil
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import NamedTuple

import hypothesis
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from service_wire import Wire
from serving import ARM, PAUSE_CONTINUE, SET_MODE, START, prepared, serve

from offboard.analysis.score import keep_score, score_flight
from offboard.flight.phases import TRACKING, WAITING
from offboard.service.record import ENGAGED, ROLLING_NAMES, UNSCORED, Recorder

DAY_S = float(os.environ.get("OFFBOARD_DAY_S", "45"))  # of each autopilot
SEED = int(os.environ.get("OFFBOARD_DAY_SEED", "1"))
ROLLING_BYTES = 2_000_000
HOUR_S = 3600.0
# In this order they are the first example, and all of the default day
EVENTS = ("engage on ground", "engage", "freeze", "up lost", "other computer", "engage", "kill",
          "engage", "second sender", "switch", "stop", "engage", "down lost", "hand back", "land",
          "arm", "up", "start", "pause", "continue", "switch", "reboot", "configure")  # fmt: skip
REFERENCES = ("hover", "lemniscate")
Event = tuple[str, float]
DURATIONS_S = st.integers(5, 40).map(lambda fifths: fifths / 5.0)
DAYS = st.tuples(  # every event, in any order; Hypothesis would repeat few of them
    st.permutations(EVENTS), st.lists(DURATIONS_S, min_size=len(EVENTS), max_size=len(EVENTS))
).map(lambda drawn: list(zip(*drawn, strict=True)))


class Used(NamedTuple):
    """By this process."""

    memory_kb: int
    descriptors: int
    threads: int


def used() -> Used:
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    memory_kb = pages * resource.getpagesize() // 1024
    return Used(memory_kb, len(os.listdir("/proc/self/fd")), threading.active_count())


class Day:
    """One vehicle, one service, and what happens to them."""

    def __init__(self, on: str, directory: Path) -> None:
        self.directory = directory
        self.begun = self.scored = self.killed = 0
        self.used: list[Used] = []
        self.pair = serve(on=on, record=self._recorder())
        self.wire = Wire(self.pair)
        self._acts: dict[str, Callable[[float], None]] = {
            "engage": self._engage,
            "switch": lambda for_s: self.pair.switch("pilot"),
            "land": self._land,
            "up": self._up,
            "reboot": self._reboot,
            "down lost": lambda for_s: self._without("lost_down", for_s),
            "up lost": lambda for_s: self._without("lost_up", for_s),
            "freeze": lambda for_s: self.pair.pause(0.4 * for_s),
            "second sender": self._second_sender,
            "other computer": self._other_computer,
            "arm": lambda for_s: self.pair.ground(ARM, 1),
            "engage on ground": lambda for_s: self.pair.switch("engage"),
            "start": lambda for_s: self.pair.command(START),
            "pause": lambda for_s: self.pair.command(PAUSE_CONTINUE, 0),
            "continue": lambda for_s: self.pair.command(PAUSE_CONTINUE, 1),
            "hand back": lambda for_s: self.pair.command(SET_MODE, 1, 4, 3),
            "stop": self._stop,
            "kill": self._kill,
            "configure": self._configure,
        }

    def _recorder(self) -> Recorder:
        """Flights are scored in this process, which is what differs from the daemon."""
        self._dead = dead = threading.Event()

        def score(flight: Path, _: threading.Event) -> None:
            if not dead.is_set():
                keep_score(flight, *score_flight(flight))

        def stamp() -> str:
            self.begun += 1
            return f"flight-{self.begun}"

        recorder = Recorder(
            self.directory, stamp=stamp, score=score, rolling_bytes=ROLLING_BYTES, settled_s=0.0
        )
        recorder.score_earlier()
        return recorder

    # ------------------------------------------------------------------ events

    def live(self, event: Event) -> None:
        name, for_s = event
        self._acts[name](for_s)
        self.pair.run(for_s)

    @property
    def _aloft(self) -> bool:
        return bool(-self.pair.place[2] > 0.5)

    def _engage(self, for_s: float) -> None:
        """The pilot switches from a mode of his own, as one who looks does."""
        if not self._aloft:
            self._up(for_s)
        if self.pair.phase not in TRACKING:
            self.pair.switch("pilot")
            self.pair.run(1.5)
            self.pair.switch("engage")
        self.pair.run(3.0 * for_s)

    def _up(self, _: float) -> None:
        commander = self.pair.instance.autopilot.commander
        if self._aloft or commander.armed:
            return
        try:
            self.pair.fly_up(3.0)
        except AssertionError:  # a vehicle that does not arm now
            self.pair.switch("pilot")

    def _land(self, _: float) -> None:
        self.pair.switch("land")
        commander = self.pair.instance.autopilot.commander
        end_s = self.pair.time_s + 40.0
        while commander.armed and self.pair.time_s < end_s:
            self.pair.advance()

    def _reboot(self, _: float) -> None:
        """With another battery."""
        if not self.pair.instance.autopilot.commander.armed:
            self.pair.instance.autopilot.plant.set_battery(1.0)
            self.pair.instance.reboot(1.0)

    def _without(self, direction: str, for_s: float) -> None:
        setattr(self.pair, direction, True)
        self.pair.run(for_s)
        setattr(self.pair, direction, False)

    def _second_sender(self, for_s: float) -> None:
        for _ in range(int(2 * for_s)):
            self.pair.other_setpoint()
            self.pair.run(0.5)

    def _other_computer(self, _: float) -> None:
        """It flies the vehicle, on a link that the service does not hear, as the service begins."""
        pair = self.pair
        if not self._aloft:
            return
        pair.switch("pilot")
        pair.run(1.5)
        pair.lost_down = pair.lost_up = True
        pair.flown_by_other(0.5)
        pair.switch("engage")
        pair.flown_by_other(0.5)
        self._kill(0.0)
        pair.lost_down = pair.lost_up = False
        pair.flown_by_other(4.0)
        pair.switch("pilot")

    def _configure(self, _: float) -> None:
        """The configuration is changed while it runs; what was identified is lost."""
        self.pair.memory.known.clear()
        vehicle = {"px4": "px4_sih", "ardupilot": "arducopter"}[self.pair.firmware]
        reference = REFERENCES[self.begun % 2]
        self.pair.source.prepared = prepared(reference=reference, vehicle=vehicle)

    def _stop(self, _: float) -> None:
        """SIGTERM, and started again by the service manager."""
        self.pair.service.request_stop()
        end_s = self.pair.time_s + 10.0
        while not self.pair.service.has_ended() and self.pair.time_s < end_s:
            self.pair.advance()
        self._restart()

    def _kill(self, _: float) -> None:
        """SIGKILL, and started again by the service manager."""
        self._dead.set()
        self.killed += self.pair.phase not in WAITING
        self._restart()

    def _restart(self) -> None:
        self.close()
        self.pair.logs = self._recorder()
        self.pair.restart()
        self.wire.wrap()

    # ------------------------------------------------------------------ judged

    def close(self) -> None:
        """The process ends: everything is closed, and what it has flown is scored."""
        assert self.pair.logs.problem == ""
        if not self._dead.is_set():
            self.pair.service.close()
        self.pair.logs.close()
        self._take_scores()
        rolled = [(self.directory / name).stat().st_size for name in ROLLING_NAMES]
        assert max(rolled) <= ROLLING_BYTES
        self.used.append(used())

    def _take_scores(self) -> None:
        """Flights that are over and scored; those of a killed process are left to the next one."""
        for flight in self.directory.glob("flight-*"):
            if (flight / "score.json").exists() and not (flight / ENGAGED).exists():
                assert (flight / "flight.yaml").exists()
                assert json.loads((flight / "score.json").read_text())["phases"]
                shutil.rmtree(flight)
                self.scored += 1

    def end(self) -> None:
        """The last process has all the time that it needs to score what is left."""
        self.close()
        last = self._recorder()
        last.settle()
        end_s = time.monotonic() + 60.0
        while any(self.directory.glob(f"*/{UNSCORED}")) and time.monotonic() < end_s:
            time.sleep(0.02)
        last.close()
        self._take_scores()


@pytest.mark.parametrize("on", ["px4", "ardupilot"])
@pytest.mark.slow
@pytest.mark.timeout(0)
def test_no_unsafe_state_in_a_day(on: str, tmp_path: Path) -> None:
    day = Day(on, tmp_path)
    lived: deque[tuple[float, Event]] = deque(maxlen=20)

    @hypothesis.seed(SEED)
    @settings(
        max_examples=max(10, round(DAY_S / 50.0)),
        phases=[hypothesis.Phase.generate],
        deadline=None,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(DAYS)
    def live(events: list[Event]) -> None:
        for event in events:
            if day.pair.time_s > DAY_S:
                return
            lived.append((day.pair.time_s, event))
            day.live(event)
            assert day.wire.unsafe == [], list(lived)

    live()
    day.end()
    assert day.pair.time_s > DAY_S
    first, last = day.used[0], day.used[-1]
    print(f"{on}: {day.begun} flights, {day.killed} killed in flight, {first}, {last}")
    assert day.scored == day.begun > DAY_S / 200.0
    assert (last.descriptors, last.threads) == (first.descriptors, first.threads)
    if DAY_S > 2.0 * HOUR_S:  # it does not grow after the first part of the day
        memory_kb, part = [each.memory_kb for each in day.used], len(day.used) // 10
        assert median(memory_kb[-part:]) < median(memory_kb[part : 2 * part]) + 10_000
