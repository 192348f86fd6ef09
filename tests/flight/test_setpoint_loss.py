"""Controller stopped in track: the supervisor and PX4's own failsafe for missing setpoints.

The vehicle is the simulated PX4; the controller stops as by SIGSTOP. The supervisor's decisions are
those of its process (`supervisor.process.TakeOver`), without sockets.
"""

from __future__ import annotations

import pytest
from pair import LEAN, QUICK_LANDING, decode, hover, in_phase
from watch import LANDED, flown, scenario_of

from offboard.flight.phases import Phase
from offboard.mavlink.dialects.px4 import PX4
from offboard.mavlink.events import VehicleFound
from offboard.mavlink.outgoing import AttitudeTarget, CommandLong
from offboard.mavlink.session import Session, SessionSettings
from offboard.supervisor.recovery import Recovery, Supervised
from simulator import config
from simulator.instance import Instance
from simulator.steps import STEP_S

POSCTL, RETURN, LAND, LOITER = 0, 3, 4, 5  # COM_OBL_RC_ACT
LONGEST_S = 90.0
STREAM_S = 1.5
VEHICLE = VehicleFound(1, 1, "px4")


class Stopped:
    """A PX4 that hovers at 4 m in OFFBOARD; its controller stops after a setpoint. Steps of the
    vehicle, with those of the supervisor."""

    def __init__(self, fallback: int, *, silent_s: float | None = None) -> None:
        flown = scenario_of(start={"height_m": 4.0, "mode": "OFFBOARD"})
        self.instance = Instance(
            LEAN,
            config.vehicle("px4_sih"),
            flown.conditions,
            3,
            ground_link=False,
            start=flown.start,
        )
        parameters = self.instance.autopilot.parameters
        parameters.set("COM_OBL_RC_ACT", fallback)
        for name, value in QUICK_LANDING.items():
            parameters.set(name, value)
        self.session = Session(SessionSettings())
        self.session.set_vehicle(VEHICLE, "vehicle")
        self.recovery: Recovery | None = None
        self.feed = self.instance.feed
        self.feed(self.session.encode(CommandLong.message_interval(436, 50.0)))  # CURRENT_MODE
        self.now_s = -STREAM_S  # since the newest setpoint
        self.asked: list[tuple[float, int, float]] = []  # time, MAV_CMD, height
        self.modes: list[str] = []
        loss = PX4.setpoint_loss({"COM_OF_LOSS_T": 1.0, "COM_OBL_RC_ACT": fallback})
        self.beat = Supervised(VEHICLE, ours=True, flying=True, reported_s=0.0, loss=loss)
        self.silent_s = self.beat.silent_s if silent_s is None else silent_s

    def run(self) -> str:
        """To the end of the recovery, whose reason is returned."""
        hover = AttitudeTarget(0.0, 9.81, (0.0, 0.0, 1.0), 0.0, 0.489)
        steps = 0
        while self.recovery is None or not self.recovery.ended:
            assert self.now_s < LONGEST_S, self.modes
            if self.now_s < 1e-9 and steps % 25 == 0:
                self.instance.feed(self.session.encode(hover))
            steps += 1
            self.now_s = steps * STEP_S - STREAM_S
            self._step()
        return self.recovery.ended

    def _step(self) -> None:
        if self.recovery is None and self.now_s >= self.silent_s:
            self.recovery = Recovery(PX4, self.beat, self.now_s, beat_s=0.0)
        for datagram in self.instance.step():
            reception = self.session.receive(datagram, "vehicle", 100.0 + self.now_s)
            if self.recovery:
                for event in reception.events:
                    self.recovery.see(event, self.now_s)
        mode = self.instance.autopilot.commander.mode.name
        if not self.modes or self.modes[-1] != mode:
            self.modes.append(mode)
        if self.recovery:
            self._ask()

    def _ask(self) -> None:
        assert self.recovery is not None
        request = self.recovery.due(self.now_s)
        if request:
            height_m = -float(self.instance.autopilot.state.truth.position_ned_m[2])
            self.asked.append((self.now_s, request.command.command, height_m))
            self.feed(self.session.encode(request.command))

    @property
    def armed(self) -> bool:
        return self.instance.autopilot.commander.armed


@pytest.mark.parametrize(("stop_s", "exit_code"), [(0.5, 0), (0.9, 4)])
def test_a_stop_that_ends_before_the_supervisor_acts(stop_s: float, exit_code: int) -> None:
    """The controller flies on if no setpoint was missing for long, else it lands the vehicle."""
    pair = hover("reference.duration_s=4.0", aloft=True)
    if exit_code:
        pair.instance.autopilot.parameters.set("COM_OF_LOSS_T", 0.5)
    pair.at.append((in_phase(Phase.TRACK, 1.0), lambda flying: flying.pause(stop_s)))
    flown(pair, exit_code, "" if exit_code else LANDED)
    assert not pair.armed


def test_the_supervisor_lands_it_before_the_failsafe() -> None:
    stopped = Stopped(POSCTL)
    assert stopped.silent_s == pytest.approx(0.6)
    assert stopped.run() == "the vehicle is disarmed"
    assert not stopped.armed
    assert stopped.modes[:3] == ["OFFBOARD", "AUTO.LOITER", "AUTO.LAND"]


@pytest.mark.parametrize(
    ("after_s", "fallback"),
    [(-0.004, POSCTL), (0.0, LOITER), (0.0, POSCTL), (0.004, RETURN), (0.02, LAND), (0.4, LOITER)],
)
def test_in_a_race_with_the_failsafe_it_is_landed(after_s: float, fallback: int) -> None:
    """The supervisor acts so long after the failsafe; it took that mode for a pilot's and gave
    up."""
    stopped = Stopped(fallback, silent_s=1.0 + after_s)
    assert stopped.run() == "the vehicle is disarmed"
    assert not stopped.armed


@pytest.mark.parametrize(
    ("fallback", "silent_s", "asks"),
    [(POSCTL, 1.2, False), (LOITER, 1.2, True), (LOITER, 0.6, True)],
)
def test_in_the_failsafe_it_is_watched_and_landed_if_it_does_not(
    fallback: int, silent_s: float, asks: bool
) -> None:
    """Every request to hold is lost. POSCTL without sticks sinks by itself."""
    stopped = Stopped(fallback, silent_s=silent_s)
    feed = stopped.feed
    stopped.feed = lambda frame: None if decode(frame).command == 176 else feed(frame)
    assert stopped.run() == "the vehicle is disarmed"
    assert not stopped.armed
    landings = [
        at_s for at_s, command, height_m in stopped.asked if command == 21 and height_m > 0.1
    ]
    assert bool(landings) is asks
    assert all(5.0 < at_s < 7.5 for at_s in landings)


@pytest.mark.parametrize(
    ("mode", "pilot_s"), [("POSCTL", 0.5), ("POSCTL", 1.3), ("POSCTL", 3.0), ("ALTCTL", 1.3)]
)
def test_a_pilots_choice_is_final_before_the_failsafe_and_in_it(mode: str, pilot_s: float) -> None:
    """POSCTL is also the mode of the failsafe: HEARTBEAT shows none once it was chosen. Nothing
    that is asked arrives."""
    stopped = Stopped(POSCTL, silent_s=1.2)
    stopped.feed = lambda frame: None
    step, switched = stopped.instance.step, []

    def flown() -> list[bytes]:
        if not switched and stopped.now_s >= pilot_s:
            switched.append(stopped.now_s)
            stopped.instance.autopilot.commander.switch(mode)
        return step()

    stopped.instance.step = flown  # type: ignore[method-assign]
    assert stopped.run() == f"the vehicle shows {mode}: its pilot or its failsafe has it"
    assert all(at_s < max(pilot_s, 1.2) + 1.1 for at_s, _, _ in stopped.asked)
