"""What one flight is flown in: estimator, air, and what the vehicle is other than believed.

Pure data, part of a scenario file; the defaults are a calm day with the vehicle as believed.
"""

from __future__ import annotations

from pydantic import Field

from offboard.documents.parameters import Parameters
from offboard.model.vehicle import Triple
from simulator.vehicle.battery import Battery
from simulator.vehicle.sensors import EstimatorName, WhiteNoise
from simulator.vehicle.wind import Gusts


class Weakening(Parameters):
    """From `at_s` of vehicle time on the thrust is multiplied by `thrust_scale`."""

    at_s: float = Field(ge=0, le=1e5)
    thrust_scale: float = Field(ge=0, le=2)


class Conditions(Parameters):
    """Everything true of a flight that the controller is not told."""

    estimator: EstimatorName = EstimatorName.PERFECT
    white_noise: WhiteNoise = WhiteNoise()  # of the estimator `white`
    wind_ned_mps: Triple = (0.0, 0.0, 0.0)  # where the air goes to, not where it comes from
    gusts: Gusts = Gusts()
    thrust_scale: float = Field(default=1.0, ge=0.1, le=3)  # .85: 15 % weaker than believed
    mass_scale: float = Field(default=1.0, ge=0.1, le=5)
    weakening: Weakening | None = None
    ground_effect: bool = False
    battery: Battery = Battery()
    boot_scale: float = Field(default=1.0, ge=0.02, le=10)  # of the times of the vehicle's start
