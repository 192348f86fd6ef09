"""The observer of the service reports what a service must not do: frames are put among its own."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink
from service_wire import HOVER, Wire
from serving import ARM, SET_MODE, TAKEOFF, Serving, serve

from offboard.flight.flight import Output
from offboard.flight.phases import TRACKING, Phase

CODEC = mavlink.MAVLink(None, srcSystem=1, srcComponent=191)
LEVEL = (1.0, 0.0, 0.0, 0.0)
STEEP = (math.cos(0.45), 0.0, math.sin(0.45), 0.0)
TILTED = (math.cos(0.25), math.sin(0.25), 0.0, 0.0)


def setpoint(share: float, on: str, q: tuple[float, ...] = LEVEL) -> Any:
    return mavlink.MAVLink_set_attitude_target_message(0, 1, 1, 7, q, 0, 0, 0, share * HOVER[on])


def command(number: int, *params: float) -> Any:
    filled = (*params, *(0.0,) * (7 - len(params)))
    return mavlink.MAVLink_command_long_message(1, 1, number, 0, *filled)


class Watched:
    """A service with frames of ours among its own, which the vehicle does not get."""

    def __init__(self, on: str) -> None:
        self.pair: Serving = serve(on=on)
        self.extra: list[bytes] = []
        self.silent = False
        turn = self.pair.companion.turn

        def added(*arguments: Any) -> Any:
            output = turn(*arguments)
            return Output() if self.silent else replace(output, send=(*output.send, *self.extra))

        self.pair.companion.turn = added  # type: ignore[method-assign]
        self.wire = Wire(self.pair)
        self.pair.up = lambda _, frames: [frame for frame in frames if frame not in self.extra]

    def reports(self, message: Any) -> set[str]:
        """What the observer says of this message, without the time."""
        assert self.wire.unsafe == []
        self.extra = [message.pack(CODEC)]
        self.pair.run(0.021)
        self.extra = []
        return self.said()

    def said(self) -> set[str]:
        said = {sentence.partition(": ")[2] for sentence in self.wire.unsafe}
        self.wire.unsafe.clear()
        return said


def test_on_px4() -> None:
    watched, on = Watched("px4"), "px4"
    pair, reports = watched.pair, watched.reports
    pair.until(lambda: pair.phase is Phase.STANDBY)
    assert reports(setpoint(0.0, on)) == set()
    assert reports(setpoint(0.5, on)) == {"thrust 0.244 on the ground"}
    assert reports(command(ARM, 1)) == {"command 400 (1, 0)"}
    assert reports(command(TAKEOFF)) == {"command 22 (0, 0)"}
    assert reports(mavlink.MAVLink_param_set_message(1, 1, b"A", 0, 9)) == {"message 23"}
    pair.fly_up(3.0)
    assert reports(setpoint(1.0, on)) == set()
    assert reports(setpoint(1.0, on, TILTED)) == {"setpoint 29 deg away in AUTO.LOITER"}
    assert reports(setpoint(0.3, on)) == {"thrust 0.147 in the air, AUTO.LOITER"}
    assert reports(command(SET_MODE, 1, 6)) == {"command 176 (1, 6)"}
    assert reports(command(SET_MODE, 1, 4, 3)) == {"command 176 in AUTO.LOITER"}
    assert reports(command(ARM, 0)) == {"command 400 (0, 0)"}
    pair.switch("engage")
    pair.until(lambda: pair.phase in TRACKING, 3.0)
    assert reports(setpoint(1.0, on, TILTED)) == set()
    (sentence,) = reports(setpoint(1.0, on, STEEP))
    assert sentence.startswith("setpoint tilted")
    (sentence,) = reports(setpoint(math.nan, on))
    assert "nan" in sentence
    pair.lost_down = True
    pair.run(2.7)
    assert reports(setpoint(1.0, on)) == {"setpoint without a recent report of the mode"}
    assert watched.wire.switches == 1


def test_on_arducopter() -> None:
    """Takes off in GUIDED, which is the mode of setpoints."""
    watched, on = Watched("ardupilot"), "ardupilot"
    pair, reports = watched.pair, watched.reports
    pair.until(lambda: pair.phase is Phase.STANDBY)
    assert reports(setpoint(0.0, on)) == {"setpoint in STABILIZE"}
    switch = pair.switch

    def in_guided(to: str) -> None:
        """While it flies in GUIDED, to which it was switched on the ground."""
        if to == "pilot":
            said.update(reports(setpoint(1.0, on)))
            said.update(reports(command(SET_MODE, 1, 17)))
        switch(to)

    said: set[str] = set()
    pair.switch = in_guided  # type: ignore[method-assign]
    pair.fly_up(3.0)
    assert said == {
        "setpoint in GUIDED, to which no pilot has switched in the air",
        "command 176 in GUIDED, in which it is another's",
    }
    assert reports(setpoint(1.0, on)) == {"setpoint in BRAKE"}
    pair.switch("engage")
    pair.until(lambda: pair.phase in TRACKING, 3.0)
    assert reports(setpoint(1.0, on)) == set()
    watched.silent = True
    pair.run(2.7)
    assert watched.said() == {"nobody flies it in GUIDED"}
