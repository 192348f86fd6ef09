"""The controllers by name: one configuration value per law, and the controller built from it.

A controller file (`config/controllers/*.yaml`) is one of these values, told apart by `law`. The
table is also the test matrix.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Annotated, Literal

from pydantic import Field

from offboard.control.base import Controller
from offboard.control.horizon.settings import HorizonSettings, Method
from offboard.control.laws.autopilot import AutopilotLaw, AutopilotSettings
from offboard.control.laws.mpc import MpcLaw, MpcSettings
from offboard.control.laws.pid import PidLaw, PidSettings
from offboard.control.laws.tracking import OneDecisionSettings, Search, TrackingLaw
from offboard.documents.parameters import Parameters
from offboard.model.vehicle import Vehicle
from offboard.paper.controller import PaperController
from offboard.paper.law import PaperSettings


class Pso(OneDecisionSettings):
    """Cost-to-go over one held input, searched by the swarm."""

    law: Literal["pso"]


class Lqr(OneDecisionSettings):
    """The exact minimiser of the same cost."""

    law: Literal["lqr"]


class Mpc(MpcSettings):
    """The same cost over N steps in their boxes, exactly."""

    law: Literal["mpc"]


class Horizon(HorizonSettings):
    """N steps of nonlinear roll-outs, limits and keep-out volumes, searched by the swarm."""

    law: Literal["horizon"]


class Mppi(HorizonSettings):
    """The same roll-outs, searched by model predictive path integral control."""

    law: Literal["mppi"]


class Cem(HorizonSettings):
    """The same roll-outs, searched by the cross-entropy method."""

    law: Literal["cem"]


class Pid(PidSettings):
    """Cascaded position and velocity loops with the same feed-forward and observer."""

    law: Literal["pid"]


class Autopilot(AutopilotSettings):
    """The autopilot's own position loop."""

    law: Literal["autopilot"]


class Paper(PaperSettings):
    """The paper's law, one step ahead."""

    law: Literal["paper"]


Law = Pso | Lqr | Mpc | Horizon | Mppi | Cem | Pid | Autopilot | Paper
ControllerConfig = Annotated[Law, Field(discriminator="law")]
LAWS: Mapping[str, type[Parameters]] = {
    "pso": Pso,
    "lqr": Lqr,
    "mpc": Mpc,
    "horizon": Horizon,
    "mppi": Mppi,
    "cem": Cem,
    "pid": Pid,
    "autopilot": Autopilot,
    "paper": Paper,
}


def build(
    config: Law,
    vehicle: Vehicle,
    period_s: float,
    seed: int,
    stopwatch: Callable[[], float] | None = None,
) -> Controller:
    """A controller for `vehicle`, deciding every `period_s`, its random stream from `seed`.

    `stopwatch` () -> s keeps deadlines and measures solve times; without one there are neither.
    """
    match config:
        case Pso() | Lqr():
            return TrackingLaw(
                vehicle,
                config,
                Search(config.law),
                stopwatch,
                config.feedforward,
                period_s=period_s,
                seed=seed,
            )
        case Mpc():
            return MpcLaw(vehicle, config, stopwatch, period_s=period_s)
        case Horizon() | Mppi() | Cem():
            # Imported where it flies: what is imported is compiled before the first flight
            from offboard.control.horizon.law import HorizonLaw

            method = Method(config.law)
            return HorizonLaw(vehicle, config, method, stopwatch, period_s=period_s, seed=seed)
        case Pid():
            return PidLaw(vehicle, config, stopwatch, period_s=period_s)
        case Autopilot():
            return AutopilotLaw(config, period_s=period_s)
        case Paper():
            return PaperController(vehicle, config, period_s, stopwatch, seed)
