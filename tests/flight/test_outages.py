"""Outages of the link in track: the vehicle is not left while the process lives.

Nothing passes in either direction for a time. PX4's own failsafe comes meanwhile, after 1.0 s.
"""

from __future__ import annotations

from collections.abc import Callable

import pytest
from faults import HEARTBEAT, without
from pair import Bytes, Pair, hover, in_phase, on_arducopter
from watch import LAND, said, sent_after

from offboard.flight.phases import ExitCode, Phase

LONG = ("reference.height_m=3.0", "reference.duration_s=15.0")
POSCTL, LOITER = 0.0, 5.0  # COM_OBL_RC_ACT
CURRENT_MODE = 436


def px4(fallback: float) -> Callable[..., Pair]:
    def make(**options: object) -> Pair:
        pair = hover(*LONG, aloft=True, **options)
        pair.instance.autopilot.parameters.set("COM_OBL_RC_ACT", fallback)
        return pair

    return make


def arducopter(**options: object) -> Pair:
    return on_arducopter(*LONG, reference="hover", aloft=True, **options)


VEHICLES = {"px4": px4(POSCTL), "px4, which holds": px4(LOITER), "arducopter": arducopter}


def cut(pair: Pair, for_s: float, *, message: int | None = None) -> None:
    """From now on: the link, or only these messages of the vehicle."""
    ends_s = pair.time_s + for_s

    def lost(time_s: float, datagrams: Bytes) -> Bytes:
        return [] if time_s < ends_s else datagrams

    def thinned(time_s: float, datagrams: Bytes) -> Bytes:
        assert message is not None
        return without(message, CURRENT_MODE)(time_s, datagrams) if time_s < ends_s else datagrams

    if message is None:
        pair.down = pair.up = lost
    else:
        pair.down = thinned


def cut_in_track(make: Callable[..., Pair], for_s: float, **options: object) -> Pair:
    return make(at=[(in_phase(Phase.TRACK, 1.0), lambda pair: cut(pair, for_s))], **options)


@pytest.mark.parametrize("outage_s", [0.8, 1.6, 4.0, 10.0])
@pytest.mark.parametrize("vehicle", VEHICLES)
def test_after_an_outage_the_vehicle_is_landed(vehicle: str, outage_s: float) -> None:
    """Up to 0.8 s it is flown on. Before, it was left in the air from 2.6 s on."""
    pair = cut_in_track(VEHICLES[vehicle], outage_s)
    outcome = pair.fly()
    autopilot = pair.instance.autopilot
    assert not autopilot.commander.armed
    assert not autopilot.state.truth.position_ned_m[2] < -0.1
    assert outcome.exit_code == (ExitCode.FLOWN if outage_s < 1.0 else ExitCode.ABORTED)
    assert said(pair, "waiting for the link, then landing is asked again") is (outage_s > 2.0)
    if outage_s > 1.0:
        assert outcome.sentence == "no telemetry for 1.0 s"  # no pilot is named


@pytest.mark.parametrize("vehicle", ["px4", "arducopter"])
def test_a_pilot_who_takes_over_in_an_outage_keeps_it(vehicle: str) -> None:
    """Also in the mode of PX4's own failsafe, which HEARTBEAT does not show then."""
    pair = cut_in_track(VEHICLES[vehicle], 4.0)
    mode = "POSCTL" if vehicle == "px4" else "BRAKE"
    commander = pair.instance.autopilot.commander
    pair.at.append((in_phase(Phase.LAND, 1.5), lambda _: commander.switch(mode)))
    outcome = pair.fly()
    assert outcome.exit_code == ExitCode.ABORTED
    assert f"for {mode}" in outcome.sentence
    assert commander.mode.name == mode
    back_s = pair.phases[-1][0]
    assert sent_after(pair, back_s) == []
    assert pair.companion.phase is Phase.YIELDED


def test_landing_is_not_asked_again_of_a_vehicle_that_is_not_heard() -> None:
    """What it sends is lost for 4 s, and a pilot takes it after the first request."""
    asked = in_phase(Phase.LAND, 0.6)
    pair = arducopter(at=[(in_phase(Phase.TRACK, 1.0), lambda flying: deaf(flying, 4.0))])
    commander = pair.instance.autopilot.commander
    pair.at.append((asked, lambda _: commander.switch("LOITER")))
    assert "left GUIDED for LOITER" in pair.fly().sentence
    assert len(pair.commands(LAND)) == 1
    assert commander.mode.name == "LOITER"


def deaf(pair: Pair, for_s: float) -> None:
    """From now on nothing of the vehicle arrives."""
    ends_s = pair.time_s + for_s
    pair.down = lambda time_s, datagrams: [] if time_s < ends_s else datagrams


@pytest.mark.parametrize("pilot", [False, True])
@pytest.mark.parametrize("vehicle", ["px4, which holds", "arducopter"])
def test_without_reports_of_the_mode_it_listens_and_lands_it_later(
    vehicle: str, pilot: bool
) -> None:
    """HEARTBEAT and CURRENT_MODE are lost for 9 s: nothing is sent 2.5 s later. If a pilot has
    taken it meanwhile, nothing is sent after that either."""
    began: list[float] = []

    def lose(pair: Pair) -> None:
        began.append(pair.time_s)
        cut(pair, 9.0, message=HEARTBEAT)

    pair = VEHICLES[vehicle](at=[(in_phase(Phase.TRACK, 1.0), lose)])
    commander = pair.instance.autopilot.commander
    mode = "POSCTL" if "px4" in vehicle else "BRAKE"
    if pilot:
        pair.at.append((in_phase(Phase.LAND, 1.0), lambda _: commander.switch(mode)))
    outcome = pair.fly()
    (began_s,) = began
    assert outcome.exit_code == ExitCode.ABORTED
    assert outcome.sentence.startswith("no report of the mode for 2.")
    assert sent_after(pair, began_s + 2.6) == sent_after(pair, began_s + 8.99)
    assert commander.armed is pilot
    assert bool(pair.commands(LAND)) is not pilot
    assert pair.companion.phase is (Phase.YIELDED if pilot else Phase.DISARMED)
