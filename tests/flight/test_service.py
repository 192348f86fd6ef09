"""The service with both simulated autopilots in lockstep: engaged, handed back, engaged again."""

from __future__ import annotations

import os
import random
import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from itertools import chain, repeat
from typing import Any

import faults
import numpy as np
import pytest
from pair import STEP_S, another_vehicle, decode, frame_id, frames_of
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from service_wire import HOLD, Wire
from serving import (
    ARM,
    HOVER,
    PAUSE_CONTINUE,
    SET_MODE,
    START,
    Serving,
    prepared,
    serve,
)
from watch import announced, begun_s, said, sent_after

from offboard.flight.authority import PilotSwitch
from offboard.flight.phases import TRACKING, Limits, Phase
from offboard.identification.vehicle_estimate import IdentifiedVehicle
from simulator import config as simulated

BOTH = pytest.mark.parametrize("on", ["px4", "ardupilot"])
REPOSITION, LOITER = 192, 5  # a MAV_CMD; a mode of ArduCopter
ACCEPTED, TEMPORARILY_REJECTED, DENIED, UNSUPPORTED = range(4)  # MAV_RESULT


class Served:
    """Creates services, each of which an independent observer (`service_wire.Wire`) watches."""

    def __init__(self) -> None:
        self.wires: list[Wire] = []

    def __call__(self, on: str = "px4", **options: Any) -> Serving:
        pair = serve(on=on, **options)
        self.wires.append(Wire(pair, arms=options.get("arms", False)))
        return pair

    def aloft(self, on: str = "px4", **options: Any) -> Serving:
        """Return a service that waits, with a vehicle that its pilot holds in the air."""
        pair = self(on, aloft=True, **options)
        pair.until(lambda: pair.phase is Phase.STANDBY)
        pair.run(2.0)
        return pair

    def engaged(self, on: str = "px4", **options: Any) -> Serving:
        """Return a service that the pilot has just engaged."""
        pair = self.aloft(on, **options)
        pair.engage()
        return pair


@pytest.fixture
def served() -> Iterator[Served]:
    """Create services. At the end of the test nothing unsafe may have happened."""
    served = Served()
    yield served
    assert [wire.unsafe for wire in served.wires] == [[] for _ in served.wires]


def thrusts(pair: Serving, since_s: float) -> list[float]:
    return [setpoint.thrust for at_s, _, setpoint in pair.setpoints if at_s > since_s]


def commanded(pair: Serving, since_s: float) -> list[str]:
    return [sent for sent in sent_after(pair, since_s) if sent.startswith("COMMAND_LONG")]


@BOTH
def test_service_is_engaged_handed_back_and_engaged_again(served: Served, on: str) -> None:
    """In the first flight the service's process is paused for half a second; the sentence after the
    flight counts the skipped ticks of 0.1 s. On a stop request the service hands back first."""
    pair = served.aloft(on)
    pair.run(2.0)
    standby = thrusts(pair, pair.time_s - 1.0)
    if on == "px4":  # in standby, setpoints repeat what the vehicle flies
        assert len(standby) >= 9
        assert max(abs(u / HOVER[on] - 1.0) for u in standby) < 0.05
    else:
        assert standby == []
    for flight in (1, 2):
        at_m, began_s, far_m = pair.place, pair.time_s, 0.0
        pair.switch("engage")
        while pair.phase is not Phase.HOVER:
            pair.advance()
            far_m = max(far_m, float(np.linalg.norm(pair.place - at_m)))
            assert pair.time_s < began_s + 40.0
        first = thrusts(pair, began_s)[:10]
        assert max(abs(u / HOVER[on] - 1.0) for u in first) < 0.1
        assert far_m < 0.1
        steps = any(phase is Phase.EXCITE for at_s, phase in pair.phases if at_s > began_s)
        assert steps is (flight == 1)
        if flight == 1:
            pair.pause(0.52)
            pair.run(1.0)
        left_s = pair.time_s
        pair.switch("pilot")
        pair.run(2.0)
        assert pair.phase is Phase.STANDBY
        assert commanded(pair, left_s) == []
        if flight == 1:
            ticks = round((left_s - began_s) / 0.1)
            score = pair.score()
            assert (score.completed, score.ended_by) == (1.0, "reference over")
    (busy,) = (text for text in announced(pair) if "too busy" in text)
    counted = rf"this computer was too busy: [45] of ({ticks}|{ticks + 1}) ticks were "
    assert re.fullmatch(rf"{counted}skipped, pauses up to 0\.5[0-9] s", busy)
    assert len(pair.logs.begun) == len(pair.logs.ended) == 2
    known = r"this vehicle was identified before: tilt delay \d+ ms; no identification steps"
    assert any(re.fullmatch(known, text) for text in announced(pair))  # without hover thrust
    pair.engage()
    pair.run(1.0)
    pair.service.request_stop()
    pair.until(pair.service.has_ended, 3.0)
    pair.run(0.5)
    assert pair.mode == HOLD[on]
    assert pair.service.current.outcome is not None
    assert pair.service.current.outcome.exit_code == 0


def test_pilot_may_take_over_during_hand_back(served: Served) -> None:
    """The service is being stopped, and the vehicle has not shown its hold mode yet."""
    pair = served.engaged()
    pair.service.request_stop()
    pair.until(lambda: pair.phase is Phase.HAND_BACK, 0.5)
    pair.instance.autopilot.commander.switch("POSCTL")
    pair.until(pair.service.has_ended, 3.0)
    outcome = pair.service.current.outcome
    assert outcome is not None
    assert (outcome.exit_code, pair.service.current.taken) == (0, True)


def fly_north(pair: Serving, speed_mps: float) -> None:
    """Let the pilot fly north until the speed is 97 % of `speed_mps`; ArduCopter by the sticks."""

    def push(pitch_us: int) -> None:
        sticks = (1500, pitch_us, 1500, 1500, *(65535,) * 4)
        message = mavlink.MAVLink_rc_channels_override_message(1, 1, *sticks)
        codec = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
        pair.instance.feed_ground(message.pack(codec))

    if pair.firmware == "px4":
        latitude, longitude, _ = pair.instance.autopilot.firmware.origin
        pair.ground(REPOSITION, speed_mps, 1, 0, np.nan, latitude + 6e-4, longitude, np.nan)
    else:
        push(1500)
        pair.ground(SET_MODE, 1, LOITER)
    while pair.instance.autopilot.state.truth.velocity_ned_mps[0] < 0.97 * speed_mps:
        if pair.firmware == "ardupilot":
            push(1500 - round(100 * speed_mps))
        pair.run(0.2)


@BOTH
def test_immediate_second_engagement_stays_near_hover_thrust(served: Served, on: str) -> None:
    """Regression: before its first position the second flight assumed the vehicle at the origin,
    and demanded full thrust."""
    pair = served.engaged(on)
    since_s = pair.time_s
    pair.switch("pilot")
    pair.run(0.1)
    pair.switch("engage")
    pair.until(lambda: pair.service.engagements == 2)
    pair.run(1.0)
    shares = np.array(thrusts(pair, since_s)) / HOVER[on]
    assert len(shares) > 8
    assert 0.7 < shares.min() < shares.max() < 1.4


@BOTH
def test_engagement_in_motion_keeps_the_vertical_thrust(served: Served, on: str) -> None:
    """The vertical thrust stays that of hover although the vehicle is tilted, and the reference
    begins at the vehicle's position."""
    pair = served.aloft(on)
    fly_north(pair, 3.8)
    began_s = pair.time_s
    pair.switch("engage")
    tilt_cosines, off_m = dict[float, float](), list[float]()
    while pair.phase in (Phase.STANDBY, Phase.CLIMB):
        pair.advance()
        if pair.phase is not Phase.CLIMB:
            continue
        state = pair.state
        tilt_cosines[pair.time_s] = pair.instance.autopilot.state.estimate.tilt_cosine
        place = np.array(state.vehicle.position.position_ned_m)
        off_m.append(float(np.linalg.norm(place - state.plan.sample(state.time_s).position_ned_m)))
        assert pair.time_s < began_s + 10.0
    lifts = [  # ArduCopter itself divides the thrust by the cosine
        setpoint.thrust / HOVER[on] * (tilt_cosines[at_s] if on == "px4" else 1.0)
        for at_s, _, setpoint in pair.setpoints
        if at_s in tilt_cosines
    ]
    assert len(lifts) > 8
    assert max(abs(lift - 1.0) for lift in lifts) < 0.03
    assert max(off_m) < 0.1


def test_contradicted_stored_vehicle_is_discarded(served: Served) -> None:
    """The stored constants are those of a vehicle whose tilt responds three times as late."""
    true = simulated.vehicle("px4_sih")
    late = {"delay_s": 0.2, "natural_frequency_radps": 6.0}
    wrong = true.model_copy(update={"tilt": true.tilt.model_copy(update=late)})
    known = IdentifiedVehicle(wrong, 0.002, 0.008)
    pair = served.engaged(reference="lemniscate", known=known)
    pair.run(14.0)
    pair.switch("pilot")
    pair.run(1.0)
    assert pair.remembered is None
    assert said(pair, "contradicted, and discarded")


def test_drag_identified_in_motion_is_stored(served: Served) -> None:
    """Also if the vehicle was identified before: here its drag is 2.5 times the stored value."""
    true = simulated.vehicle("px4_sih")
    known = true.model_copy(update={"drag_translation_npmps": (0.4 * true.mass_kg,) * 3})
    before = IdentifiedVehicle(known, 0.002, 0.008)
    pair = served.engaged(reference="lemniscate", known=before)
    pair.until(lambda: pair.phase is Phase.HOVER, 40.0)
    assert pair.remembered == before
    pair.switch("pilot")
    pair.run(1.0)
    assert pair.remembered.vehicle.drag_per_mass_ps == pytest.approx(true.drag_per_mass_ps, rel=0.1)


def test_autopilot_limits_replace_those_of_a_stored_vehicle(served: Served) -> None:
    """The stored vehicle has a lower limit of the angular acceleration than the autopilot now."""
    copter = simulated.vehicle("arducopter")
    slow = copter.model_copy(update={"angular_acceleration_limit_radps2": (2.3, 2.3, 2.2)})
    known = IdentifiedVehicle(slow, 0.002, 0.008)
    pair = served.engaged("ardupilot", known=known)
    pair.run(1.0)
    assert said(pair, "this vehicle was identified before")
    assert pair.service.current.model.angular_acceleration_limit_radps2[0] > 19.0


# --- who may engage, and when ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("on", "left"), [("px4", "px4-1-1"), ("px4", "px4-1-ff"), ("ardupilot", "")]
)
def test_restarted_service_holds_only_its_engaged_vehicle(
    served: Served, on: str, left: str
) -> None:
    """Afterwards it waits for the pilot. In the other two cases a flight with another vehicle was
    cut short, or another companion computer flies the vehicle on a link that we do not hear."""
    pair = served.engaged(on)
    if on == "px4":  # delay its own failsafe
        pair.instance.autopilot.parameters.set("COM_OF_LOSS_T", 5.0)
    assert pair.logs.left == f"{on}-1-1"
    pair.logs.left = left
    pair.restart()
    began_s = pair.time_s
    pair.run(4.0)
    if left == "px4-1-1":
        assert pair.mode == "AUTO.LOITER"
    else:
        assert pair.mode in ("OFFBOARD", "GUIDED")
        assert sent_after(pair, began_s) == []
        assert said(pair, "in the air, and this service has not engaged it: it is left alone")
        assert len(pair.logs.begun) == 1
        pair.switch("pilot")
        pair.run(2.0)
        assert pair.logs.left == left
    assert pair.phase is Phase.STANDBY
    pair.engage()


def test_anchor_origin_needs_a_known_takeoff_point(served: Served) -> None:
    """A service that starts in the air with --anchor origin engages only after the next landing."""
    pair = served("ardupilot", anchor="origin")
    pair.fly_up()
    pair.engage()
    assert pair.state.plan.origin_ned_m == pytest.approx((0.0, 0.0, 0.0), abs=0.1)
    pair.switch("pilot")
    pair.run(1.0)
    pair.restart()
    pair.run(6.0)
    engaged_s = pair.time_s
    pair.switch("engage")
    pair.until(lambda: pair.mode == "GUIDED", 0.5)
    pair.until(lambda: pair.mode == "BRAKE", 1.0)
    assert thrusts(pair, engaged_s) == []
    assert len(commanded(pair, engaged_s)) == 1
    assert said(pair, "not engaged: its takeoff point is not known")


def test_the_volume_begins_at_the_take_off_point_wherever_the_pilot_engages(served: Served) -> None:
    """limits.radius_m of a room must not move along with each engagement."""
    pair = served()
    pair.fly_up()
    latitude, longitude, _ = pair.instance.autopilot.firmware.origin
    pair.ground(REPOSITION, 2, 1, 0, np.nan, latitude + 4e-5, longitude, np.nan)
    pair.run(8.0)
    assert pair.place[0] > 4.0
    pair.service.current.limits = Limits(radius_m=3.0)  # of this flight alone
    pair.switch("engage")
    pair.run(3.0)
    assert said(pair, "not engaged: 3 m above and 5 m from the takeoff point (limits.ceiling_m")
    assert pair.state.vehicle.mode == "AUTO.LOITER"
    pair.engage()
    assert pair.state.from_takeoff_m == pytest.approx(pair.place * (1, 1, -1), abs=0.1)


@pytest.mark.parametrize("holds", [True, False])
def test_service_started_in_the_air_refuses_a_vehicle_above_the_ceiling(
    served: Served, holds: bool
) -> None:
    """The takeoff point was not seen; heights are above the local origin. A vehicle that cannot
    hold, as without a global position, goes back to the mode that its pilot flew by sticks."""
    pair = served.aloft(rules=() if holds else (faults.CANNOT_HOLD,))
    pair.instance.autopilot.parameters.set("COM_RC_LOSS_T", 35.0)
    sticks = mavlink.MAVLink_manual_control_message(1, 0, 0, 500, 0, 0)
    pair.instance.feed_ground(sticks.pack(mavlink.MAVLink(None, srcSystem=255)))
    pair.run(0.1)
    pair.ground(SET_MODE, 1, 3)
    pair.until(lambda: pair.state.vehicle.mode == "POSCTL", 2.0)
    pair.service.current.limits = Limits(ceiling_m=2.5)
    pair.switch("engage")
    pair.until(lambda: pair.phase is Phase.HAND_BACK, 1.0)
    pair.until(lambda: pair.phase is Phase.STANDBY, 3.0)
    assert said(pair, "not engaged: 3 m above and 0 m from the takeoff point (limits.ceiling_m")
    assert pair.state.vehicle.mode == ("AUTO.LOITER" if holds else "POSCTL")


def test_lost_supervisor_prevents_only_new_flights(served: Served) -> None:
    pair = served.engaged()
    pair.service.current.guard(False)
    pair.run(1.0)
    assert pair.phase in TRACKING
    pair.switch("pilot")
    pair.run(2.0)
    pair.switch("engage")
    pair.until(lambda: said(pair, "not engaged: the supervisor, which lands it if this"), 1.0)
    pair.until(lambda: pair.mode == "AUTO.LOITER", 1.0)


def test_service_leaves_another_controller_alone(served: Served) -> None:
    """While its setpoints are on the link, the service sends no setpoint and no command."""
    pair = served.aloft()
    pair.other_setpoint()
    pair.run(0.3)
    heard_s = pair.time_s
    # in place of the other program's setpoints, which do not reach the simulated vehicle
    pair.instance.autopilot.parameters.set("COM_OF_LOSS_T", 60.0)
    pair.switch("engage")
    for _ in range(4):
        pair.other_setpoint()
        pair.run(0.3)
    pair.run(6.0)  # the other program is silent, but the pilot has not switched for the service
    assert pair.mode == "OFFBOARD"
    assert sent_after(pair, heard_s) == []
    assert pair.phase is Phase.STANDBY
    assert said(pair, "not engaged: OFFBOARD, but another program sends setpoints")


def test_engagement_while_landing_or_grounded_is_refused(
    served: Served,
) -> None:
    """Regression: ArduCopter stayed in GUIDED without setpoints, and the pilot was not told. In
    BRAKE its land detector does not detect the ground; a start by command is rejected then, too."""
    pair = served.engaged("ardupilot", then="land")
    pair.until(lambda: pair.phase is Phase.LAND, 30.0)
    pair.run(1.0)
    pair.switch("engage")
    pair.run(4.0)
    assert (pair.phase, pair.mode) == (Phase.STANDBY, "BRAKE")
    assert said(pair, "switch again")
    pair.switch("pilot")
    pair.run(1.5)
    pair.engage()
    pair.switch("land")
    pair.until(lambda: -pair.place[2] < 0.01)
    pair.switch("pilot")
    pair.run(2.0)
    assert pair.state.vehicle.landed == "in_air"
    switched_s = pair.time_s
    pair.switch("engage")
    pair.run(1.0)
    assert (pair.phase, pair.mode) == (Phase.STANDBY, "GUIDED")
    assert said(pair, "not engaged: GUIDED, but the vehicle may stand on the ground")
    pair.command(START)
    pair.run(1.0)
    assert (pair.phase, pair.acks) == (Phase.STANDBY, [(START, TEMPORARILY_REJECTED)])
    assert said(pair, "but it may stand on the ground")
    assert sent_after(pair, switched_s) == []


def test_service_without_arms_option_stays_on_the_ground(served: Served) -> None:
    """Another vehicle is heard once, which prevents standby for 10 s. A start is rejected, and a
    vehicle that is armed in OFFBOARD does not lift off. On the ground, a flight that was cut short
    counts as ended: whoever engages the vehicle later is another controller."""
    pair = served()
    pair.run(0.5)
    pair.forwarded.append(another_vehicle(9))
    pair.run(9.8)
    assert pair.phase is Phase.HEALTH
    assert said(pair, "several vehicles are heard, systems 1 and 9. Fix: choose one")
    pair.command(START)
    pair.run(0.1)
    assert said(pair, "but it is on the ground, and may not be armed without --arms")
    pair.until(lambda: pair.phase is Phase.STANDBY, 1.0)
    pair.command(START)
    pair.run(3.0)
    assert pair.acks == [(START, TEMPORARILY_REJECTED)] * 2
    assert said(pair, "but it is on the ground, and may not be armed without --arms")
    assert commanded(pair, 0.0) == []
    pair.restart()
    pair.logs.left = "px4-1-1"
    pair.until(lambda: pair.logs.left == "", 5.0)
    pair.until(lambda: pair.phase is Phase.STANDBY)
    pair.switch("engage")
    commander = pair.instance.autopilot.commander
    pair.until(lambda: pair.try_arm(commander), 20.0)
    armed_s = pair.time_s
    pair.run(6.0)
    assert pair.phase is Phase.STANDBY
    assert set(thrusts(pair, armed_s)) == {0.0}
    assert -pair.place[2] < 0.05
    pair.service.request_stop()
    pair.until(pair.service.has_ended, 1.0)
    assert said(pair, "ended: stop requested by the operator")


def test_start_command_with_arms_option_takes_off(served: Served) -> None:
    """Regression: after a start that was stopped while arming, each later start stood down at once,
    because the answer to the first arming command was taken for its own."""
    pair = served(arms=True, then="land")
    pair.until(lambda: pair.phase is Phase.STANDBY)
    pair.run(10.0)
    pair.command(START)
    pair.until(lambda: pair.armings == [1.0], 5.0)
    pair.run(0.1)
    pair.command(SET_MODE, 1.0)
    pair.until(lambda: len(pair.logs.ended) == 1, 10.0)
    assert not pair.armed
    pair.run(3.0)
    pair.command(START)
    pair.until(lambda: pair.phase is Phase.TRACK, 60.0)
    pair.until(lambda: len(pair.logs.ended) == 2, 60.0)
    assert pair.acks == [(START, ACCEPTED), (SET_MODE, ACCEPTED), (START, ACCEPTED)]
    assert pair.phase is Phase.STANDBY
    assert not pair.armed


# --- what happens in between ----------------------------------------------------------------------


def test_service_flies_again_after_a_vehicle_reboot(served: Served) -> None:
    pair = served.engaged()
    pair.switch("land")
    pair.until(lambda: not pair.armed, 40.0)
    before_s = pair.state.time_s
    pair.instance.reboot(1.0)
    pair.until(lambda: said(pair, "the vehicle restarted"), 10.0)
    pair.fly_up()
    pair.until(lambda: pair.state.time_s > before_s + 0.1)  # the same vehicle time comes again
    assert pair.state.hover.thrust(pair.state.time_s) == pytest.approx(HOVER["px4"], rel=0.05)
    pair.switch("engage")
    pair.until(lambda: pair.phase is Phase.HOVER, 40.0)


def test_reason_of_a_wait_is_named_once(served: Served) -> None:
    """First the vehicle has a new system id, after a reboot; then it has the old one again, and its
    estimator does not run yet."""
    pair = served()
    pair.until(lambda: pair.phase is Phase.STANDBY, 20.0)
    pair.down = lambda time_s, datagrams: [another_vehicle(9)]
    pair.run(40.0)
    pair.down = faults.without(faults.ATTITUDE, faults.POSITION)
    pair.run(40.0)
    assert [each for each in pair.state.announced if each.startswith("waiting: no ")] == [
        "waiting: no HEARTBEAT arrives from system 1, but from 9; see --system",
        "waiting: no LOCAL_POSITION_NED and no ATTITUDE_QUATERNION arrives",
    ]


@BOTH
def test_vehicle_is_landed_after_a_link_outage(served: Served, on: str) -> None:
    """ArduCopter, not heard for 4 s, has stayed in GUIDED without setpoints. PX4 would return from
    its failsafe to OFFBOARD when setpoints arrive again, although no pilot has switched; so none is
    sent."""
    pair = served.engaged(on)
    pair.run(1.0)
    pair.lost_up, pair.lost_down = True, on == "ardupilot"
    pair.run(4.0 if pair.lost_down else 1.5)
    pair.lost_up = pair.lost_down = False
    pair.until(lambda: pair.mode in ("LAND", "AUTO.LAND"), 3.0)
    assert len(pair.logs.begun) == 1  # the same flight
    if on == "px4":
        pair.until(lambda: not pair.armed, 30.0)
        pair.until(lambda: pair.phase is Phase.STANDBY, 5.0)


def test_mavlink_commands_pause_continue_start_and_hand_back(served: Served) -> None:
    """A command that is repeated, as by a ground station that missed the answer, is accepted again.
    A pause is rejected while the vehicle is handed back."""
    pair = served.engaged("ardupilot", reference="lemniscate")
    pair.until(lambda: pair.phase is Phase.TRACK, 30.0)
    expected: list[tuple[int, int]] = []

    def ask(command: int, *params: float, result: int = ACCEPTED, times: int = 1) -> None:
        for _ in range(times):
            pair.command(command, *params)
        expected.extend([(command, result)] * times)
        pair.run(0.2)
        assert pair.acks == expected

    ask(PAUSE_CONTINUE, 1.0, result=TEMPORARILY_REJECTED)
    ask(PAUSE_CONTINUE, 0.0, times=2)
    pair.run(3.8)
    ask(PAUSE_CONTINUE, 0.0)
    assert pair.phase is Phase.PAUSE
    at_m = pair.place
    pair.run(1.0)
    assert float(np.linalg.norm(pair.place - at_m)) < 0.05
    ask(PAUSE_CONTINUE, 1.0, times=2)
    ask(PAUSE_CONTINUE, 1.0)
    pair.until(lambda: float(np.linalg.norm(pair.place - at_m)) > 0.5, 6.0)
    ask(START)
    assert pair.phase is Phase.CLIMB
    ask(PAUSE_CONTINUE, 0.5, result=DENIED)
    ask(ARM, 1.0, result=UNSUPPORTED)
    ask(SET_MODE, 1.0, 4.0, 3.0, times=2)
    pair.until(lambda: pair.phase is Phase.STANDBY, 3.0)
    assert pair.mode == "BRAKE"
    for command, parameter in ((SET_MODE, 1.0), (START, 0.0), (PAUSE_CONTINUE, 1.0)):
        ask(command, parameter, result=TEMPORARILY_REJECTED, times=3)  # told once
        pair.run(1.0)
    told = [text for text in pair.service.current.announced if "ted by" in text]
    refused = [f"refused: {word}" for word in ("continue", "hand back", "start", "continue")]
    words = [refused[0], "pause", "continue", "start", "hand back", *refused[1:]]
    assert [text.split(" requested by ")[0] for text in told] == words
    assert told[0].endswith("but not in the phase track")
    assert told[-2].endswith("but it flies in BRAKE: switch to GUIDED instead")
    pair.engage()
    pair.until(lambda: pair.phase is Phase.TRACK, 30.0)
    ask(PAUSE_CONTINUE, 0.0)
    pair.service.request_stop("the disk is full")
    pair.until(lambda: pair.phase is Phase.HAND_BACK, 0.5)
    ask(PAUSE_CONTINUE, 0.0, result=TEMPORARILY_REJECTED)


def test_hand_back_takes_precedence_over_start_within_a_tick(served: Served) -> None:
    """A hand-back cancels a start of the same tick; a start does not cancel a hand-back."""
    pair = served("ardupilot", arms=True)
    pair.until(lambda: pair.phase is Phase.STANDBY)
    pair.command(START)
    pair.command(SET_MODE, 1.0)
    pair.run(2.0)
    assert (pair.phase, pair.armed) == (Phase.STANDBY, False)
    flies = served.engaged("ardupilot")
    flies.command(SET_MODE, 1.0)
    flies.command(START)
    flies.until(lambda: flies.phase is Phase.STANDBY, 3.0)
    assert pair.acks == [(START, ACCEPTED), (SET_MODE, ACCEPTED)]
    assert flies.acks == [(SET_MODE, ACCEPTED), (START, TEMPORARILY_REJECTED)]


def test_pilot_takes_over_with_a_short_com_of_loss_t(served: Served) -> None:
    """Regression: with COM_OF_LOSS_T of 0.3 s setpoints always seemed to be missing, and the
    pilot's mode was taken for the vehicle's failsafe. Then the pilot engages and takes over again
    at once: a real PX4 was asked to land, because no TIMESYNC request was sent while the HEARTBEAT
    after the first switch was awaited."""
    pair = served.aloft()
    pair.instance.autopilot.parameters.set("COM_OF_LOSS_T", 0.3)
    pair.state.vehicle.parameters["COM_OF_LOSS_T"] = 0.3  # as if the vehicle had reported it
    pair.engage()
    heard = pair.state.vehicle.heartbeat
    pair.until(lambda: pair.state.vehicle.heartbeat is not heard, 1.5)
    pair.run(0.3)  # CURRENT_MODE comes first, and does not show whether it is a failsafe
    pair.switch("pilot")
    pair.until(lambda: pair.phase is Phase.STANDBY, 2.0)
    yielded, waits = pair.service.current.announced[-2:]
    assert yielded.startswith("yielded: the vehicle left OFFBOARD for AUTO.LOITER")
    assert waits == "waiting for the pilot"
    pair.run(0.1)
    pair.engage()
    pair.run(0.1)
    pair.switch("pilot")
    pair.run(0.15)
    pair.switch("engage")
    pair.run(2.0)
    assert not said(pair, "own failsafe")
    assert pair.landings == []


def test_mode_switch_is_seen_soon_without_current_mode(served: Served) -> None:
    """PX4 1.14 sends no CURRENT_MODE, and one HEARTBEAT a second. If the service waited for that,
    the vehicle would meanwhile follow setpoints that only repeat its attitude."""
    pair = served.aloft()
    pair.instance.view.silent["CURRENT_MODE"] = 0
    pair.run(3.5)
    for _ in range(3):
        pair.switch("engage")
        pair.until(lambda: pair.phase is Phase.CLIMB, 0.4)
        pair.run(0.6)
        pair.switch("pilot")
        pair.until(lambda: pair.phase is Phase.YIELDED, 0.4)
        pair.run(1.7)


def silence(pair: Serving, options: float) -> None:
    """Interrupt the link for 6 s, after which the vehicle has these GUID_OPTIONS."""
    asked = len(pair.commands(512))
    pair.lost_down = pair.lost_up = True
    pair.run(6.0)
    assert pair.phase is Phase.HEALTH
    pair.instance.autopilot.parameters.set("GUID_OPTIONS", options)
    pair.lost_down = pair.lost_up = False
    pair.run(4.0)
    assert len(pair.commands(512)) > asked


def test_parameters_and_uid_are_read_again_after_a_silence(served: Served) -> None:
    """It may have the same system id, use the same radio, and have booted earlier. So parameters
    and hardware number are read again. Regression: it was flown with the parameters of the vehicle
    before, and took thrust for a climb rate."""
    pair = served.engaged("ardupilot")
    pair.switch("pilot")
    pair.run(2.0)

    assert pair.state.vehicle.uid == 1
    pair.peer = ("10.0.0.3", 14580)  # its address has changed in the meantime
    silence(pair, 0.0)
    assert said(pair, "the vehicle now sends from 10.0.0.3:14580")
    assert not said(pair, "another vehicle answers")
    pair.peer = ("10.0.0.4", 14580)  # again, while its parameters keep it in the phase health
    pair.run(4.0)
    assert not said(pair, "the vehicle now sends from 10.0.0.4:14580")
    pair.run(4.0)
    assert said(pair, "the vehicle now sends from 10.0.0.4:14580")
    assert pair.state.in_phase_s < 4.0  # in which number and parameters were read again
    pair.switch("engage")
    pair.until(lambda: pair.mode == "BRAKE", 3.0)
    assert said(pair, "not engaged: GUID_OPTIONS is 0: without bit 3")
    pair.run(2.0)
    pair.state.vehicle.uid = 7  # as if another vehicle had been heard until now
    silence(pair, 8.0)
    pair.until(lambda: pair.phase is Phase.STANDBY, 5.0)
    assert said(pair, "another vehicle answers")
    assert pair.state.vehicle.uid == 1


@pytest.mark.parametrize("kinds", [(), (faults.HEARTBEAT, faults.EXTENDED_SYS_STATE)], ids=str)
def test_no_setpoint_is_streamed_while_two_vehicles_share_an_address(
    served: Served, kinds: tuple[int, ...]
) -> None:
    """One flies; the other one, which booted earlier, stands disarmed. It sends all its telemetry,
    or only messages of these kinds. Regression: setpoints without thrust were streamed."""
    pair, other = served.aloft(), serve().instance
    for _ in range(int(60.0 / STEP_S)):
        other.step()
    alone = pair.down

    def mixed(time_s: float, datagrams: list[bytes]) -> list[bytes]:
        frames = [frame for datagram in other.step() for frame in frames_of(datagram)]
        others = [frame for frame in frames if not kinds or frame_id(frame) in kinds]
        return [*alone(time_s, datagrams), *others]

    pair.down, mixed_s = mixed, pair.time_s
    pair.until(lambda: pair.phase is Phase.HEALTH, 12.0)
    health_s = pair.time_s
    pair.run(6.0)
    assert min(thrusts(pair, mixed_s)) > 0.4
    assert thrusts(pair, health_s + 0.1) == []
    assert said(pair, "health: two vehicles with the same system id send on this link")
    pair.down = alone
    pair.run(20.0)
    assert pair.phase is Phase.STANDBY
    assert min(thrusts(pair, pair.time_s - 0.5)) > 0.4


def test_vehicle_without_copter_parameters_is_left_alone(served: Served) -> None:
    """Regression: an ArduPlane with Q_MAV_TYPE 2 says that it is a quadrotor. Its pilot switched to
    ACRO, whose number is that of GUIDED, and BRAKE was requested, whose number is QSTABILIZE."""
    pair = served.engaged("ardupilot")
    pair.switch("pilot")
    pair.run(2.0)
    unanswered = faults.without(faults.PARAM_VALUE)
    pair.down = lambda time_s, datagrams: unanswered(time_s, pair.deliver(time_s, datagrams))
    silence(pair, 8.0)  # then parameters are read again
    asked = len(pair.modes)
    pair.switch("engage")
    pair.run(4.0)
    assert (pair.phase, pair.mode) == (Phase.HEALTH, "GUIDED")
    assert len(pair.modes) == asked
    assert said(pair, "waiting: no reply for parameter GUID_OPTIONS. Fix: check the link")


def test_request_just_before_a_phase_change_is_obeyed(served: Served) -> None:
    """Regression: a request in the last step before the phase changes was acknowledged, but
    forgotten."""

    def begun(phase: Phase) -> Any:
        pair = served(reference="hover", arms=True)
        pair.until(lambda: pair.phase is Phase.STANDBY)
        pair.command(START)
        pair.until(lambda: pair.phase is phase, 120.0)
        return pair

    undisturbed = begun(Phase.HOVER)
    for before, after in ((Phase.ARM, Phase.TAKEOFF), (Phase.TRACK, Phase.HOVER)):
        changed_s = begun_s(undisturbed, after)
        pair = begun(before)
        pair.until(lambda at_s=changed_s, on=pair: on.time_s > at_s - 1.5 * STEP_S, 90.0)
        assert pair.phase is before
        pair.command(SET_MODE, 1.0)
        pair.until(lambda on=pair: on.phase in (Phase.STANDBY, Phase.LAND), 6.0)
        assert (pair.acks[-1], pair.mode) == ((SET_MODE, ACCEPTED), "AUTO.LOITER")


def test_vehicle_engaged_as_the_service_stops_is_held(served: Served) -> None:
    pair = served.aloft()
    pair.run(0.04)  # the report of the mode comes between two ticks
    pair.switch("engage")
    pair.until(lambda: pair.state.pilot is PilotSwitch.ENGAGED, 1.0)
    assert pair.phase is Phase.STANDBY
    pair.service.request_stop()
    pair.until(pair.service.has_ended, 5.0)
    assert pair.mode == "AUTO.LOITER"


def test_repeats_keep_the_configuration_of_their_flight(served: Served) -> None:
    """The repeats are one flight with its own configuration; the next flight uses the newest one.
    The number of stored announcements is limited, because a service may run for weeks."""
    pair = served.engaged(then="repeat")
    model = pair.service.current
    assert model.limits.log_lost == "land"
    pair.source.newest = prepared(
        "reference.height_m=1.5", "limits.log_lost=go_on", "period_s=0.2",
        reference="hover", vehicle="px4_sih",
    )  # fmt: skip
    for number in range(500):
        model.announce(f"{number}")
        pair.advance()
    for _ in range(2):
        pair.until(lambda: pair.phase is Phase.TRACK, 30.0)
        pair.until(lambda: pair.phase is Phase.HOVER, 10.0)
    score = pair.score()
    assert score.tracked_s == pytest.approx(2 * 2.9, abs=0.1)
    assert score.max_position_m < 0.01
    assert pair.service.current is model
    assert len(model.announced) <= 200
    assert pair.service.current.announcements > 500
    beats = [decode(frame) for _, _, frame in pair.sent if frame[7:10] == b"\0\0\0"]
    assert (3, 17) in [(beat.system_status, beat.custom_mode) for beat in beats]
    assert (4, 6) in [(beat.system_status, beat.custom_mode) for beat in beats]
    pair.switch("pilot")
    pair.run(2.5)
    assert pair.service.current is not model
    assert float(pair.state.plan.track.sample(0.0).position_ned_m[2]) == -1.5
    assert pair.service.current.limits.log_lost == "go_on"
    ticks = thrusts(pair, pair.time_s - 1.0)
    assert len(ticks) == 5  # with the new period of 0.2 s


# --- anything, in any order -----------------------------------------------------------------------


def up(pair: Serving, _: float) -> None:
    if pair.place[2] > -0.5 and not pair.armed:
        with suppress(AssertionError):  # the vehicle may not be able to arm now
            pair.fly_up()
        pair.switch("pilot")


def engage(pair: Serving, for_s: float) -> None:
    """Let the pilot hold in another mode for 1.5 s, and then engage."""
    up(pair, for_s)
    if pair.phase not in TRACKING:
        pair.switch("pilot")
        pair.run(1.5)
        pair.switch("engage")
    pair.run(3.0 * for_s)


def lose(direction: str) -> Callable[[Serving, float], None]:
    def lost(pair: Serving, for_s: float) -> None:
        setattr(pair, direction, True)
        pair.run(for_s)
        setattr(pair, direction, False)

    return lost


def stop(pair: Serving, _: float) -> None:
    """Stop the service as by SIGTERM, and start it again as a service manager does."""
    pair.service.request_stop()
    end_s = pair.time_s + 10.0
    while not pair.service.has_ended() and pair.time_s < end_s:
        pair.advance()
    pair.service.close()
    pair.restart()


def reboot(pair: Serving, _: float) -> None:
    """Reboot a disarmed vehicle with a full battery."""
    if not pair.armed:
        pair.instance.autopilot.plant.set_battery(1.0)
        pair.instance.reboot(1.0)


EVENTS: dict[str, Callable[[Serving, float], object]] = {
    "engage on ground": lambda pair, _: pair.switch("engage"),
    "engage": engage,
    "freeze": lambda pair, for_s: pair.pause(0.4 * for_s),
    "uplink lost": lose("lost_up"),
    "kill": lambda pair, _: pair.restart(),
    "second sender": lambda pair, _: pair.other_setpoint(),
    "switch": lambda pair, _: pair.switch("pilot"),
    "stop": stop,
    "downlink lost": lose("lost_down"),
    "hand back": lambda pair, _: pair.command(SET_MODE, 1, 4, 3),
    "land": lambda pair, _: pair.switch("land"),
    "arm": lambda pair, _: pair.ground(ARM, 1),
    "up": up,
    "start": lambda pair, _: pair.command(START),
    "pause": lambda pair, _: pair.command(PAUSE_CONTINUE, 0),
    "continue": lambda pair, _: pair.command(PAUSE_CONTINUE, 1),
    "reboot": reboot,
}


@BOTH
@pytest.mark.slow
@pytest.mark.timeout(0)
def test_random_events_cause_nothing_unsafe(served: Served, on: str) -> None:
    """Each event happens once, then random ones, until OFFBOARD_DAY_S seconds have passed."""
    pair = served(on)
    chance = random.Random(int(os.environ.get("OFFBOARD_DAY_SEED", "1")))
    drawn = (chance.choice(["engage", *EVENTS]) for _ in repeat(None))
    for number, name in enumerate(chain(EVENTS, drawn)):
        for_s = chance.uniform(1.0, 8.0)
        EVENTS[name](pair, for_s)
        pair.run(for_s)
        assert served.wires[0].unsafe == [], name
        for kept in (pair.sent, pair.logged, pair.phases):
            kept.clear()
        if number >= len(EVENTS) and pair.time_s > float(os.environ.get("OFFBOARD_DAY_S", "45")):
            break
    assert len(pair.logs.begun) > pair.time_s / 200.0
