"""The service through a day of events, in lockstep, judged by an independent observer of the wire.

One vehicle and one service for the whole day, with drawn events. The default is 45 s of each
autopilot. OFFBOARD_DAY_S=28800 makes it eight hours, OFFBOARD_DAY_SEED another day.
"""

from __future__ import annotations

import os
import random
import resource
from collections import deque
from collections.abc import Callable
from itertools import chain, repeat
from pathlib import Path
from statistics import median

import pytest
from service_wire import Wire
from serving import ARM, PAUSE_CONTINUE, SET_MODE, START, Serving, prepared, serve

from offboard.flight.phases import TRACKING

DAY_S = float(os.environ.get("OFFBOARD_DAY_S", "45"))  # of each autopilot
SEED = int(os.environ.get("OFFBOARD_DAY_SEED", "1"))
HOUR_S = 3600.0


def engage(pair: Serving, for_s: float) -> None:
    """The pilot switches from a mode of his own, as one who looks does."""
    up(pair)
    if pair.phase not in TRACKING:
        pair.switch("pilot")
        pair.run(1.5)
        pair.switch("engage")
    pair.run(3.0 * for_s)


def aloft(pair: Serving) -> bool:
    return bool(-pair.place[2] > 0.5)


def up(pair: Serving, _: float = 0.0) -> None:
    if aloft(pair) or pair.armed:
        return
    try:
        pair.fly_up(3.0)
    except AssertionError:  # a vehicle that does not arm now
        pair.switch("pilot")


def land(pair: Serving, _: float) -> None:
    pair.switch("land")
    end_s = pair.time_s + 40.0
    while pair.armed and pair.time_s < end_s:
        pair.advance()


def reboot(pair: Serving, _: float) -> None:
    """With another battery."""
    if not pair.armed:
        pair.instance.autopilot.plant.set_battery(1.0)
        pair.instance.reboot(1.0)


def lose(direction: str) -> Callable[[Serving, float], None]:
    def lost(pair: Serving, for_s: float) -> None:
        setattr(pair, direction, True)
        pair.run(for_s)
        setattr(pair, direction, False)

    return lost


def second_sender(pair: Serving, for_s: float) -> None:
    for _ in range(int(2 * for_s)):
        pair.other_setpoint()
        pair.run(0.5)


def other_computer(pair: Serving, _: float) -> None:
    """It flies the vehicle, on a link that the service does not hear, as the service begins."""
    if not aloft(pair):
        return
    pair.switch("pilot")
    pair.run(1.5)
    pair.lost_down = pair.lost_up = True
    pair.flown_by_other(0.5)
    pair.switch("engage")
    pair.flown_by_other(0.5)
    pair.restart()
    pair.lost_down = pair.lost_up = False
    pair.flown_by_other(4.0)
    pair.switch("pilot")


def configure(pair: Serving, _: float) -> None:
    """The configuration is changed while it runs; what was identified is lost."""
    pair.memory.known.clear()
    vehicle = {"px4": "px4_sih", "ardupilot": "arducopter"}[pair.firmware]
    reference = ("hover", "lemniscate")[len(pair.logs.begun) % 2]
    pair.source.prepared = prepared(reference=reference, vehicle=vehicle)


def stop(pair: Serving, _: float) -> None:
    """SIGTERM, and started again by the service manager."""
    pair.service.request_stop()
    end_s = pair.time_s + 10.0
    while not pair.service.has_ended() and pair.time_s < end_s:
        pair.advance()
    pair.service.close()
    pair.restart()


EVENTS: dict[str, Callable[[Serving, float], object]] = {
    "engage on ground": lambda pair, _: pair.switch("engage"),
    "engage": engage,
    "freeze": lambda pair, for_s: pair.pause(0.4 * for_s),
    "up lost": lose("lost_up"),
    "other computer": other_computer,
    "kill": lambda pair, _: pair.restart(),
    "second sender": second_sender,
    "switch": lambda pair, _: pair.switch("pilot"),
    "stop": stop,
    "down lost": lose("lost_down"),
    "hand back": lambda pair, _: pair.command(SET_MODE, 1, 4, 3),
    "land": land,
    "arm": lambda pair, _: pair.ground(ARM, 1),
    "up": up,
    "start": lambda pair, _: pair.command(START),
    "pause": lambda pair, _: pair.command(PAUSE_CONTINUE, 0),
    "continue": lambda pair, _: pair.command(PAUSE_CONTINUE, 1),
    "reboot": reboot,
    "configure": configure,
}


@pytest.mark.parametrize("on", ["px4", "ardupilot"])
@pytest.mark.slow
@pytest.mark.timeout(0)
def test_no_unsafe_state_in_a_day(on: str) -> None:
    """Nor does its memory grow after the first part of the day."""
    pair, chance = serve(on=on), random.Random(SEED)
    wire = Wire(pair)
    lived: deque[tuple[float, str]] = deque(maxlen=20)
    # every event once, in an order in which each matters, then any, engaged again and again
    drawn = (chance.choice(["engage", *EVENTS]) for _ in repeat(None))
    used: list[int] = []  # pages
    for name in chain(EVENTS, drawn):
        lived.append((pair.time_s, name))
        for_s = chance.uniform(1.0, 8.0)
        EVENTS[name](pair, for_s)
        pair.run(for_s)
        assert wire.unsafe == [], list(lived)
        for kept in (pair.sent, pair.logged, pair.phases):
            kept.clear()
        used.append(int(Path("/proc/self/statm").read_text().split()[1]))
        if pair.time_s > DAY_S and len(used) >= len(EVENTS):
            break
    assert len(pair.logs.begun) > DAY_S / 200.0
    if DAY_S > 2.0 * HOUR_S:
        part = len(used) // 10
        grown = median(used[-part:]) - median(used[part : 2 * part])
        assert grown * resource.getpagesize() < 10e6
