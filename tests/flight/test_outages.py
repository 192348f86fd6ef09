"""Outages of the link in track: the vehicle is not left while the process lives.

Nothing passes in either direction for a time. PX4's own failsafe comes meanwhile, after 1.0 s.
"""

from __future__ import annotations

from collections.abc import Callable

import pytest
from faults import CURRENT_MODE, HEARTBEAT, POSITION, cut, late, lost, without
from pair import Pair, hover, in_phase, on_arducopter
from watch import aborted, begun_s, flown, said, sent_after

from offboard.flight.phases import Phase
from offboard.mavlink.events import Heartbeat

LONG = ("reference.height_m=3.0", "reference.duration_s=6.0")
FALLBACKS = {"px4": 0.0, "px4, which holds": 5.0}  # COM_OBL_RC_ACT: POSCTL, LOITER


def make(vehicle: str, when: Callable[[Pair], object]) -> Pair:
    """A flight to which `when` happens one second into the track."""
    at = [(in_phase(Phase.TRACK, 1.0), when)]
    if vehicle == "arducopter":
        return on_arducopter(*LONG, reference="hover", aloft=True, at=at)
    pair = hover(*LONG, aloft=True, at=at)
    pair.instance.autopilot.parameters.set("COM_OBL_RC_ACT", FALLBACKS[vehicle])
    return pair


@pytest.mark.parametrize(
    ("vehicle", "outage_s"),
    [("arducopter", 0.8), ("px4", 1.6), ("px4, which holds", 4.0), ("arducopter", 10.0)],
)
def test_after_an_outage_the_vehicle_is_landed(vehicle: str, outage_s: float) -> None:
    """Up to 0.8 s it is flown on. Before, it was left in the air from 2.6 s on."""
    pair = make(vehicle, cut(outage_s))
    if outage_s < 1.0:
        flown(pair)
    else:
        aborted(pair, r"no telemetry for 1.0 s \(limits.silence_s is 1\)$")  # no pilot is named
    assert not pair.armed
    assert pair.instance.autopilot.state.truth.position_ned_m[2] > -0.1
    assert said(pair, "waiting for the link, then landing is asked again") is (outage_s > 2.0)


def test_a_message_that_has_just_begun_to_arrive_is_not_called_slow() -> None:
    """Its rate is that of two seconds. A booting ArduCopter sends no position for 40 s."""
    pair, rest = hover(), without(POSITION)
    begins_s = pair.time_s + 12.0
    pair.down = lambda time_s, frames: frames if time_s >= begins_s else rest(time_s, frames)
    flown(pair)
    waiting = [each for each in pair.companion.announced if each.startswith("waiting: ")]
    assert waiting == [
        "waiting: no LOCAL_POSITION_NED arrives", "waiting: the delay of the link is being measured"
    ]  # fmt: skip


def test_a_gap_of_telemetry_on_a_late_link_is_no_loss_of_setpoints() -> None:
    """0.36 s there and back. While nothing is heard nothing is asked, and no answer is missing."""
    down = late(0.18)

    def gap(pair: Pair) -> None:
        heard = lost(pair, 0.98)
        pair.down = lambda time_s, datagrams: down(time_s, heard(time_s, datagrams))

    at = [(in_phase(Phase.TRACK, 1.0), gap)]
    slow = "controller.bandwidth_radps=1.5"
    pair = on_arducopter(*LONG, slow, reference="hover", aloft=True, at=at)
    pair.down, pair.up = down, late(0.18)
    flown(pair, error_m=2.0)


def test_a_pilot_who_takes_over_in_an_outage_keeps_it() -> None:
    """Also in the mode of PX4's own failsafe, which HEARTBEAT does not show then."""
    pair, mode = make("px4", cut(4.0)), "POSCTL"
    commander = pair.instance.autopilot.commander
    pair.at.append((in_phase(Phase.LAND, 1.5), lambda _: commander.switch(mode)))
    aborted(pair, f".*for {mode}")
    assert commander.mode.name == mode
    assert sent_after(pair, pair.phases[-1][0]) == []
    assert pair.companion.phase is Phase.YIELDED


def test_landing_is_not_asked_again_of_a_vehicle_that_is_not_heard() -> None:
    """What it sends is lost for 4 s, and a pilot takes it after the first request."""

    def deafen(pair: Pair) -> None:
        pair.down = lost(pair, 4.0)

    pair = make("arducopter", deafen)
    commander = pair.instance.autopilot.commander
    pair.at.append((in_phase(Phase.LAND, 0.6), lambda _: commander.switch("LOITER")))
    aborted(pair, ".*left GUIDED for LOITER")
    assert len(pair.landings) == 1
    assert commander.mode.name == "LOITER"


@pytest.mark.parametrize(
    ("vehicle", "pilot"),
    [("px4, which holds", ""), ("arducopter", "BRAKE")],
)
def test_without_reports_of_the_mode_it_listens_and_lands_it_later(
    vehicle: str, pilot: str
) -> None:
    """HEARTBEAT and CURRENT_MODE are lost for 9 s: nothing is sent 2.5 s later. If a pilot has
    taken it meanwhile, nothing is sent after that either."""
    began_s: list[float] = []

    def lose(pair: Pair) -> None:
        began_s.append(pair.time_s)
        pair.down = lost(pair, 9.0, HEARTBEAT, CURRENT_MODE)

    pair = make(vehicle, lose)
    commander = pair.instance.autopilot.commander
    if pilot:
        pair.at.append((in_phase(Phase.LAND, 1.0), lambda _: commander.switch(pilot)))
    aborted(pair, "no report of the mode for 2.")
    assert sent_after(pair, began_s[0] + 2.6) == sent_after(pair, began_s[0] + 8.99)
    assert commander.armed is bool(pilot)
    assert bool(pair.landings) is not bool(pilot)
    assert pair.companion.phase is (Phase.YIELDED if pilot else Phase.DISARMED)


def test_a_vehicle_that_does_not_receive_setpoints_is_held() -> None:
    """ArduCopter, which shows nothing: what was commanded meanwhile would have dropped it as it
    received it again."""
    lost_up: list[float] = []

    def loses(pair: Pair) -> None:
        pair.up = lost(pair, 3.0)
        lost_up.append(pair.time_s)

    pair = make("arducopter", loses)
    watch = aborted(
        pair, "15 requests of TIMESYNC are not answered: does it receive setpoints",
        failsafes=["uplink"], fall_mps=1.6,
    )  # fmt: skip
    assert begun_s(pair, Phase.HOLD) - lost_up[0] < 1.8
    assert watch.top_m < 3.5


def test_a_heartbeat_that_is_missing_is_requested() -> None:
    """Two are lost and no CURRENT_MODE arrives: the third, 3 s after the first, is too late."""

    def after_the_next(pair: Pair) -> None:
        pair.down = without(CURRENT_MODE)
        pair.at.append((heard, lose))

    def heard(pair: Pair) -> bool:
        return pair.companion.vehicle.age_s(Heartbeat) == 0.0

    def lose(pair: Pair) -> None:
        ends_s = pair.time_s + 2.2
        quiet, rest = without(CURRENT_MODE, HEARTBEAT), without(CURRENT_MODE)
        pair.down = lambda time_s, sent: (quiet if time_s < ends_s else rest)(time_s, sent)

    pair = make("px4", after_the_next)
    flown(pair)


def test_where_heartbeat_alone_shows_the_mode_a_short_switch_is_seen() -> None:
    """PX4 1.14 has no CURRENT_MODE, and one HEARTBEAT a second: a pilot leaves after one, and has
    returned before the next."""

    def leave(pair: Pair) -> None:
        pair.instance.autopilot.commander.switch("POSCTL")
        pair.at.append(
            (in_phase(Phase.TRACK, pair.time_s - begun_s(pair, Phase.TRACK) + 0.6), back)
        )

    def back(pair: Pair) -> None:
        pair.instance.autopilot.commander.switch("OFFBOARD")

    def just_after_a_beat(pair: Pair) -> bool:
        heartbeat_s = pair.companion.vehicle.age_s(Heartbeat)
        return pair.companion.phase is Phase.TRACK and heartbeat_s < 0.1

    pair = hover(*LONG, aloft=True, at=[(just_after_a_beat, leave)])
    pair.down = without(CURRENT_MODE)
    aborted(pair, "the vehicle left OFFBOARD for POSCTL")
    assert pair.companion.phase is Phase.YIELDED
