"""Another control law on the states of a recorded flight: how its commands differ, as figures."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from offboard.control.base import Adopting, Controller, Decision, Situation
from offboard.documents.errors import UserError
from offboard.model.command import Command
from offboard.model.vehicle import Vehicle
from offboard.replay.difference import compare
from offboard.replay.recording import Recording
from offboard.replay.replaying import Replay
from offboard.run.configuration import build_controller, flown


def other_law(recording: Recording, name: str) -> tuple[list[str], str]:
    """Fly the recorded flight again while the controller `name` decides beside it, open loop: the
    vehicle follows the flight's own commands, and the other law has no deadline.

    Returns one line for each figure, and `Replay.incomplete`. Raises UserError if there is nothing
    to compare, and DocumentError for a controller that does not exist or cannot be built.
    """
    config = flown(recording.configuration, name)
    other, figures = build_controller(config), Figures()
    replay = Replay(recording, lambda own: shadow(own, other, figures))
    for _ in replay.turns():
        pass
    lines = []
    differences = compare(replay.recorded, replay.replayed).significant
    if differences:
        lines.append(
            f"the replay itself differs from {differences[0].time_s:.3f} s on: see `replay`"
        )
    if figures.failures:
        lines.append(f"{len(figures.failures)} decisions failed, the first: {figures.failures[0]}")
    if figures.others:
        lines.append(f"{figures.others} decisions are no attitude commands, and are not compared")
    if not figures.angle_rad:
        raise UserError("; ".join(filter(None, ["nothing to compare", replay.incomplete, *lines])))
    law, own = config.controller.law, replay.config.controller.law
    lines = [
        f"{law} beside {own} in {len(figures.angle_rad)} decisions, on the states of the flight",
        _line("thrust direction", np.degrees(figures.angle_rad), "deg"),
        _line("thrust", np.array(figures.thrust_mps2), "m/s2"),
        *lines,
    ]
    return lines, replay.incomplete


def _line(name: str, values: np.ndarray[tuple[int], np.dtype[np.float64]], unit: str) -> str:
    rms, most = float(np.sqrt(np.mean(values**2))), float(np.abs(values).max())
    median, high = np.percentile(np.abs(values), (50, 95))
    return (
        f"difference of {name}: rms {rms:.3g}, median {median:.3g}, 95 % {high:.3g}, "
        f"largest {most:.3g} {unit}"
    )


@dataclass(slots=True)
class Figures:
    """How the other law's attitude commands differ: one entry for each decision of both."""

    angle_rad: list[float] = field(default_factory=list)
    thrust_mps2: list[float] = field(default_factory=list)  # the other's minus the flight's
    others: int = 0  # decisions that are no attitude command of one of the two
    failures: list[str] = field(default_factory=list)  # of the other law

    def add(self, own: Decision, other: Decision) -> None:
        first, second = own.command, other.command
        if not (isinstance(first, Command) and isinstance(second, Command)):
            self.others += 1
            return
        one, two = np.array(first.thrust_direction_ned), np.array(second.thrust_direction_ned)
        self.angle_rad.append(
            2.0 * math.atan2(float(np.linalg.norm(one - two)), float(np.linalg.norm(one + two)))
        )
        self.thrust_mps2.append(second.thrust_mps2 - first.thrust_mps2)


class Shadow:
    """A controller that decides as `own`, and asks `other` the same without a deadline."""

    def __init__(self, own: Controller, other: Controller, figures: Figures) -> None:
        self._own, self._other = own, other
        self._figures = figures

    def decide(self, situation: Situation) -> Decision:
        decision = self._own.decide(situation)
        try:
            self._figures.add(decision, self._other.decide(replace(situation, remaining_s=None)))
        except Exception as error:  # of a law from outside, anything
            self._figures.failures.append(f"{type(error).__name__}: {error}")
        return decision

    def reset(self) -> None:
        self._own.reset()
        self._other.reset()


class AdoptingShadow(Shadow):
    """A shadow of a controller that continues with identified constants, as the other does if it
    can."""

    @property
    def bandwidth_radps(self) -> float:
        assert isinstance(self._own, Adopting)
        return self._own.bandwidth_radps

    def adopt(
        self, vehicle: Vehicle, bandwidth_limit_radps: float = math.inf, *, gains: bool = True
    ) -> None:
        for law in (self._own, self._other):
            if isinstance(law, Adopting):
                law.adopt(vehicle, bandwidth_limit_radps, gains=gains)


def shadow(own: Controller, other: Controller, figures: Figures) -> Shadow:
    """`own` with `other` beside it, which can adopt if `own` can."""
    kind = AdoptingShadow if isinstance(own, Adopting) else Shadow
    return kind(own, other, figures)
