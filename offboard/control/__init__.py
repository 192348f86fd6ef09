"""Controllers, which compute a command from a predicted state and a reference.

Your own controller is a class with `decide` and `reset`, and a settings class that makes it. Put
both into a package and register the settings class as an entry point:

    # pyproject.toml
    [build-system]
    requires = ["hatchling"]
    build-backend = "hatchling.build"

    [project]
    name = "pd-controller"
    version = "1.0"
    dependencies = ["pso-offboard"]

    [project.entry-points."pso_offboard.controllers"]
    pd = "pd_controller:PdSettings"

    # pd_controller.py
    from typing import Literal

    import numpy as np
    from pydantic import Field

    from offboard.control import Command, ControllerSettings, Decision, Situation


    class PdSettings(ControllerSettings):
        law: Literal["pd"] = "pd"
        stiffness_ps2: float = Field(default=6.0, gt=0, le=20)  # m/s^2 per m
        damping_ps: float = Field(default=4.0, gt=0, le=20)  # m/s^2 per m/s

        def build(self, vehicle, *, period_s, seed):
            return Pd(self, vehicle.gravity_mps2)


    class Pd:
        def __init__(self, settings, gravity_mps2):
            self.settings, self.gravity_ned_mps2 = settings, np.array([0.0, 0.0, gravity_mps2])

        def decide(self, situation: Situation) -> Decision:
            state = situation.state
            target = situation.reference.sample(state.time_s)
            position_error_m = target.position_ned_m - state.position_ned_m
            velocity_error_mps = target.velocity_ned_mps - state.velocity_ned_mps
            acceleration = target.acceleration_ned_mps2 + (
                self.settings.stiffness_ps2 * position_error_m
                + self.settings.damping_ps * velocity_error_mps
            )
            # acceleration = gravity - thrust * direction + disturbance
            push = self.gravity_ned_mps2 + state.disturbance_ned_mps2 - acceleration
            thrust = float(np.linalg.norm(push))
            return Decision(Command(thrust, tuple(push / thrust), float(target.heading_rad)))

        def reset(self) -> None:
            pass

After `pip install` of this package:

    offboard fly --sitl --controller pd
    offboard fly --sitl --controller pd --set controller.damping_ps=5
    offboard compare --controllers pd,pso,pid

A YAML file with `law: pd` and other values is given as `--controller my.yaml`. `Situation`,
`PredictedState` and `Command` say what each value means, with frames and units. A law like this one
is flown with the constants of the vehicle file (`--vehicle`), without identification steps. A law
that is to use the constants identified in flight also implements `Adaptive`.
"""

from offboard.control.base import (
    Adaptive,
    Certificate,
    Controller,
    ControllerSettings,
    Decision,
    DecisionError,
    Situation,
)
from offboard.model.command import Command, PositionCommand, PredictedState, PredictedVertical
from offboard.model.vehicle import Vehicle
from offboard.reference.base import FlatSample, Reference

__all__ = [
    "Adaptive",
    "Certificate",
    "Command",
    "Controller",
    "ControllerSettings",
    "Decision",
    "DecisionError",
    "FlatSample",
    "PositionCommand",
    "PredictedState",
    "PredictedVertical",
    "Reference",
    "Situation",
    "Vehicle",
]
