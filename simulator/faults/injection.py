"""Fault injection: begins and ends each fault of a scenario at its time, on one vehicle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from random import Random

from simulator.autopilot.autopilot import Autopilot
from simulator.faults import Fault
from simulator.faults.base import Direction, Moment, Running, Vehicle
from simulator.faults.messages import LinkFault
from simulator.faults.senders import Stranger
from simulator.firmware.values import Behaviour
from simulator.link.impairment import Channel, LinkDirection


@dataclass(slots=True)
class Injection:
    """All faults of one flight. `down` and `up`: directions of the companion link; `strangers`:
    datagrams that wait to be sent to the companion, each list from a port of its own."""

    down: LinkDirection
    up: LinkDirection
    strangers: list[list[bytes]]
    _waiting: list[Running]
    _moments: dict[Moment, float] = field(default_factory=dict)
    _flown: bool = False

    def step(self, now_s: float, vehicle: Vehicle) -> None:
        """Begin and end the faults due at `now_s`, seconds since the start."""
        self._note_moments(now_s, vehicle.autopilot)
        for running in self._waiting:
            self._advance(running, now_s + 1e-6, vehicle)
        if any(running.over for running in self._waiting):
            self._waiting = [running for running in self._waiting if not running.over]

    def _note_moments(self, now_s: float, autopilot: Autopilot) -> None:
        landed = autopilot.position_controller.landed
        self._flown = self._flown or not landed
        by_setpoint = autopilot.commander.mode.behaviour is Behaviour.SETPOINT
        for moment, reached in (
            (Moment.BOOT, True),
            (Moment.ARMED, autopilot.commander.armed),
            (Moment.TOOK_OFF, not landed),
            (Moment.ENGAGED, by_setpoint and autopilot.commander.armed),
            (Moment.LANDING, autopilot.guidance.active.landing and not landed),
            (Moment.LANDED, self._flown and landed),
        ):
            if reached:
                self._moments.setdefault(moment, now_s)

    def _advance(self, running: Running, now_s: float, vehicle: Vehicle) -> None:
        fault = running.fault
        if running.begins_s is None:
            since_s = self._moments.get(fault.after)
            if since_s is None:
                return
            running.begins_s = since_s + fault.at_s
        if now_s < running.begins_s:
            return
        try:
            if running.effect is None:
                running.effect = fault.effect(vehicle, running)
                next(running.effect)
            lasts = fault.for_s is None or now_s < running.begins_s + fault.for_s
            running.effect.send(lasts)
        except StopIteration:
            running.over = True


def prepare(scenario: Sequence[Fault], seed: int) -> Injection | None:
    """Faults of one flight, none begun; None when the scenario has none."""
    if not scenario:
        return None
    paths: dict[Direction, list[Channel]] = {Direction.DOWN: [], Direction.UP: []}
    waiting: list[Running] = []
    for number, fault in enumerate(scenario):
        channels = []
        for direction, path in paths.items():
            if isinstance(fault, LinkFault) and fault.direction in (direction, "both"):
                channels.append(Channel(fault, Random(f"{seed} {number} {direction}")))
                channels[-1].on = False
                path.append(channels[-1])
        waiting.append(Running(fault, channels, Random(f"{seed} {number}")))
    down, up = (LinkDirection(tuple(path)) for path in paths.values())
    strangers = [one.datagrams for one in waiting if isinstance(one.fault, Stranger)]
    return Injection(down, up, strangers, waiting)
