"""The observer of the service reports what a service must not do: frames are put among its own."""

from __future__ import annotations

import math
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink
from service_wire import Wire
from serving import ARM, HOVER, SET_MODE, TAKEOFF, Serving, serve

from offboard.flight.phases import Phase

CODEC = mavlink.MAVLink(None, srcSystem=1, srcComponent=191)
LEVEL = (1.0, 0.0, 0.0, 0.0)
STEEP = (math.cos(0.45), 0.0, math.sin(0.45), 0.0)
TILTED = (math.cos(0.25), math.sin(0.25), 0.0, 0.0)


def setpoint(thrust: float, q: tuple[float, ...] = LEVEL) -> Any:
    return mavlink.MAVLink_set_attitude_target_message(0, 1, 1, 7, q, 0, 0, 0, thrust)


def command(number: int, *params: float) -> Any:
    filled = (*params, *(0.0,) * (7 - len(params)))
    return mavlink.MAVLink_command_long_message(1, 1, number, 0, *filled)


class Watched:
    """A waiting service with frames of ours among its own, which the vehicle does not get."""

    def __init__(self, pair: Serving) -> None:
        self.pair = pair
        self.extra: list[bytes] = []
        self.silent = False
        turn = pair.companion.turn

        def added(*arguments: Any) -> Any:
            frames = turn(*arguments)
            return () if self.silent else (*frames, *self.extra)

        pair.companion.turn = added  # type: ignore[method-assign]
        self.wire = Wire(pair)
        pair.up = lambda _, frames: [frame for frame in frames if frame not in self.extra]
        pair.until(lambda: pair.phase is Phase.STANDBY)

    def reports(self, message: Any) -> str:
        """What the observer says of this message, without the time."""
        assert self.wire.unsafe == []
        self.extra = [message.pack(CODEC)]
        self.pair.run(0.021)
        self.extra = []
        return self.said()

    def said(self) -> str:
        (said,) = {sentence.partition(": ")[2] for sentence in self.wire.unsafe} or {""}
        self.wire.unsafe.clear()
        return said


def test_on_px4_on_the_ground() -> None:
    reports = Watched(serve()).reports
    assert reports(setpoint(0.0)) == ""
    assert reports(setpoint(0.244)) == "thrust 0.244 on the ground"
    assert reports(command(ARM, 1)) == "command 400 (1, 0)"
    assert reports(command(TAKEOFF)) == "command 22 (0, 0)"
    assert reports(mavlink.MAVLink_param_set_message(1, 1, b"A", 0, 9)) == "message 23"


def test_on_px4_in_the_air() -> None:
    watched, hover = Watched(serve(aloft=True)), HOVER["px4"]
    pair, reports = watched.pair, watched.reports
    pair.run(2.0)
    assert reports(setpoint(hover)) == ""
    assert reports(setpoint(hover, TILTED)) == "setpoint 29 deg away in AUTO.LOITER"
    assert reports(setpoint(0.3 * hover)) == "thrust 0.147 in the air, AUTO.LOITER"
    assert reports(command(SET_MODE, 1, 6)) == "command 176 (1, 6)"
    assert reports(command(SET_MODE, 1, 4, 3)) == "command 176 in AUTO.LOITER"
    assert reports(command(ARM, 0)) == "command 400 (0, 0)"
    pair.engage()
    assert reports(setpoint(hover, TILTED)) == ""
    assert reports(setpoint(hover, STEEP)).startswith("setpoint tilted")
    assert "nan" in reports(setpoint(math.nan))
    pair.lost_down = True
    pair.run(2.7)
    assert reports(setpoint(hover)) == "setpoint without a recent report of the mode"
    assert watched.wire.switches == 1


def test_on_arducopter() -> None:
    """Takes off in GUIDED, which is the mode of setpoints."""
    watched, hover = Watched(serve(on="ardupilot")), HOVER["ardupilot"]
    pair, reports, switch = watched.pair, watched.reports, watched.pair.switch
    assert reports(setpoint(0.0)) == "setpoint in STABILIZE"
    said: list[str] = []

    def in_guided(to: str) -> None:
        """While it flies in GUIDED, to which it was switched on the ground."""
        if to == "pilot":
            said.extend((reports(setpoint(hover)), reports(command(SET_MODE, 1, 17))))
        switch(to)

    pair.switch = in_guided  # type: ignore[method-assign]
    pair.fly_up()
    assert said == [
        "setpoint in GUIDED, to which no pilot has switched in the air",
        "command 176 in GUIDED, in which it is another's",
    ]
    assert reports(setpoint(hover)) == "setpoint in BRAKE"
    pair.engage()
    assert reports(setpoint(hover)) == ""
    watched.silent = True
    pair.run(2.7)
    assert watched.said() == "nobody flies it in GUIDED"
