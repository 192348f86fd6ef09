"""What is believed of one vehicle: mass, drag, thrust scale and the response of its attitude loop.

A vehicle file (`config/vehicles/*.yaml`) is one `Vehicle`. The controller plans with it; the
simulator builds its truth from one (its own, possibly another). Pure data: no file is read here.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from offboard.documents.parameters import Parameters

Triple = tuple[float, float, float]
PositiveTriple = tuple[
    Annotated[float, Field(gt=0)], Annotated[float, Field(gt=0)], Annotated[float, Field(gt=0)]
]
NonNegativeTriple = tuple[
    Annotated[float, Field(ge=0)], Annotated[float, Field(ge=0)], Annotated[float, Field(ge=0)]
]

DRAG_PER_MASS_MOST_PS = 100.0  # falling, it has 0.1 m/s: no motion to control is left


class AxisResponse(Parameters):
    """Closed attitude loop of one axis: s'' = wn^2 (s_c(t - D) - s) - 2 z wn s'.

    The delay runs from the vehicle time of the newest telemetry when a command is sent to the
    command's effect: age, transport and loop in one number.
    """

    delay_s: float = Field(ge=0, le=0.5)
    natural_frequency_radps: float = Field(gt=0.1, le=100)
    damping: float = Field(gt=0.05, le=5)


class Vehicle(Parameters):
    """One multirotor. SI units, body axes FRD.

    Inputs of the torque interface (Eq. 6) are [f_t, tau_x, tau_y, tau_z]; roll and pitch inputs
    are multiplied by `arm_m` (Eq. 16 is only reproduced with 0.225 m: they are differential
    forces in N). An `arm_m` of 1 makes them torques in N m.
    """

    name: str = Field(min_length=1, max_length=40)
    mass_kg: float = Field(gt=0.01, le=200)
    gravity_mps2: float = Field(default=9.80665, gt=9.7, lt=9.9)
    inertia_kgm2: PositiveTriple
    arm_m: float = Field(default=1.0, gt=0, le=10)
    drag_translation_npmps: NonNegativeTriple  # D_t, Eq. 3, N per m/s
    drag_rotation_nmpradps: NonNegativeTriple  # D_r, Eq. 4, N m per rad/s
    hover_thrust: float = Field(gt=0.02, lt=0.95)  # normalised; PX4 MPC_THR_HOVER
    thrust_delay_s: float = Field(default=0.0, ge=0, le=0.5)
    thrust_lag_s: float = Field(default=0.0, ge=0, le=0.5)
    tilt: AxisResponse
    yaw: AxisResponse
    angular_acceleration_limit_radps2: PositiveTriple = (50.0, 50.0, 20.0)
    tilt_max_rad: float = Field(default=0.7, gt=0.05, lt=1.4)

    @property
    def drag_per_mass_ps(self) -> float:
        """Lateral linear drag per unit of mass, 1/s (`c` of acceleration = ... - c v)."""
        return (
            0.5 * (self.drag_translation_npmps[0] + self.drag_translation_npmps[1]) / self.mass_kg
        )

    @model_validator(mode="after")
    def _moves(self) -> Vehicle:
        if max(self.drag_translation_npmps) > DRAG_PER_MASS_MOST_PS * self.mass_kg:
            raise ValueError(
                f"drag_translation_npmps must be at most {DRAG_PER_MASS_MOST_PS:g} per kg of mass"
            )
        return self

    @property
    def thrust_max_mps2(self) -> float:
        """Collective thrust per unit of mass at full throttle, m/s^2 (linear thrust curve)."""
        return self.gravity_mps2 / self.hover_thrust
