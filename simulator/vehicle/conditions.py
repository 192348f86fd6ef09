"""Conditions of a flight: estimator, air, and differences between vehicle and model.

Part of a scenario file. By default there is no wind, and vehicle and model are equal.
"""

from __future__ import annotations

from pydantic import Field

from offboard.documents.parameters import Parameters
from offboard.model.vehicle import Triple
from simulator.vehicle.battery import Battery
from simulator.vehicle.sensors import EstimatorName, WhiteNoise
from simulator.vehicle.wind import Gusts


class Conditions(Parameters):
    """Conditions of a flight that the controller does not know."""

    estimator: EstimatorName = EstimatorName.PERFECT
    white_noise: WhiteNoise = WhiteNoise()  # of the estimator `white`
    wind_ned_mps: Triple = (0.0, 0.0, 0.0)  # velocity of the air: towards, not from
    gusts: Gusts = Gusts()
    thrust_scale: float = Field(default=1.0, ge=0.1, le=3)  # 0.85: 15 % less than the model
    mass_scale: float = Field(default=1.0, ge=0.1, le=5)
    # of each body axis by itself, q |u| u beside the vehicle's linear drag, as ArduPilot SITL's
    # Frame::calculate_forces has it
    quadratic_drag_npmps2: float = Field(default=0.0, ge=0, le=1)
    ground_effect: bool = False
    battery: Battery = Battery()
    # vehicle clock at the start; its 32-bit milliseconds wrap at 4294967.296 s
    clock_start_s: float = Field(default=0.0, ge=0, le=1e8)
    clock_rate: float = Field(default=1.0, ge=0.9, le=1.1)  # of the vehicle clock per second
    boot_scale: float = Field(default=1.0, ge=0.02, le=10)  # on the times of the autopilot's start
