"""The service through a day of events, in lockstep, judged by an independent observer of the wire.

OFFBOARD_DAY_S=28800 makes the day eight hours instead of the default seconds.
"""

from __future__ import annotations

import gc
import os
import resource
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from service_wire import Wire
from serving import ARM, PAUSE_CONTINUE, SET_MODE, START, serve

from offboard.flight.phases import TRACKING

DAY_S = float(os.environ.get("OFFBOARD_DAY_S", "120"))  # of both autopilots together
EVENT_S = 8.0  # about the mean of an event, with what it needs before
PER_EXAMPLE = 8 if DAY_S < 1000 else 300
EXAMPLES = max(2, round(DAY_S / 2 / EVENT_S / PER_EXAMPLE) + 1)  # the first is a trivial one
EVENTS = ("engage", "engage", "engage", "switch", "switch", "land", "up", "up", "reboot",
          "down lost", "up lost", "freeze", "second sender", "arm", "engage on ground", "start",
          "pause", "continue", "hand back", "restart")  # fmt: skip
Event = tuple[str, float]
DAYS = st.lists(
    st.tuples(st.sampled_from(EVENTS), st.floats(0.2, 8.0)),
    min_size=PER_EXAMPLE,
    max_size=PER_EXAMPLE,
)


class Day:
    """One vehicle, one service, and what happens to them."""

    def __init__(self, on: str) -> None:
        self.pair = serve(on=on)
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
            "arm": lambda for_s: self.pair.ground(ARM, 1),
            "engage on ground": lambda for_s: self.pair.switch("engage"),
            "start": lambda for_s: self.pair.command(START),
            "pause": lambda for_s: self.pair.command(PAUSE_CONTINUE, 0),
            "continue": lambda for_s: self.pair.command(PAUSE_CONTINUE, 1),
            "hand back": lambda for_s: self.pair.command(SET_MODE, 1, 4, 3),
            "restart": self._restart,
        }

    def live(self, event: Event) -> None:
        name, for_s = event
        self._acts[name](for_s)
        self.pair.run(for_s)
        self._forget()

    def _forget(self) -> None:
        """What the pair keeps for other tests."""
        for kept in (self.pair.sent, self.pair.logged, self.pair.phases):
            kept.clear()

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
        if not self.pair.instance.autopilot.commander.armed:
            self.pair.instance.reboot(1.0)

    def _without(self, direction: str, for_s: float) -> None:
        setattr(self.pair, direction, True)
        self.pair.run(for_s)
        setattr(self.pair, direction, False)

    def _second_sender(self, for_s: float) -> None:
        for _ in range(int(2 * for_s)):
            self.pair.other_setpoint()
            self.pair.run(0.5)

    def _restart(self, _: float) -> None:
        self.pair.restart()
        self.wire.wrap()


@pytest.mark.parametrize("on", ["px4", "ardupilot"])
@pytest.mark.timeout(0)
def test_no_unsafe_state_in_a_day(on: str) -> None:
    early: list[tuple[int, int]] = []

    @settings(
        max_examples=EXAMPLES,
        deadline=None,
        database=None,
        derandomize="OFFBOARD_DAY_S" not in os.environ,
        suppress_health_check=list(HealthCheck),
    )
    @given(DAYS)
    def live(events: list[Event]) -> None:
        day = Day(on)
        for index, event in enumerate(events):
            day.live(event)
            assert day.wire.unsafe == [], events[: index + 1]
            if not early and index >= len(events) // 2:
                early.append(used())
        memory_kb, descriptors = used()
        print(
            f"\n{on}: {day.pair.time_s:.0f} s, {len(events)} events, {len(day.pair.logs.begun)} "
            f"flights, {day.wire.setpoints} setpoints, {day.wire.engaged_setpoints} engaged, least "
            f"thrust {day.wire.least_share:.2f} of hover, memory {early[0][0]} -> {memory_kb} kB, "
            f"descriptors {early[0][1]} -> {descriptors}"
        )
        assert memory_kb < early[0][0] + 20_000
        assert descriptors == early[0][1]

    live()


def used() -> tuple[int, int]:
    """Resident memory (kB) and number of open descriptors of this process."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() // 1024, len(os.listdir("/proc/self/fd"))
