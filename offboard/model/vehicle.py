"""Parameters of one vehicle: mass, drag, thrust and the response of its attitude loop.

A vehicle file (`config/vehicles/*.yaml`) has the fields of `Vehicle`. The controller uses one as
its model; the simulated vehicle is made from one too, which may be a different one. This module
reads no file.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field, model_validator

from offboard.documents.parameters import Parameters

Triple = tuple[float, float, float]
PositiveTriple = tuple[
    Annotated[float, Field(gt=0)], Annotated[float, Field(gt=0)], Annotated[float, Field(gt=0)]
]
NonNegativeTriple = tuple[
    Annotated[float, Field(ge=0)], Annotated[float, Field(ge=0)], Annotated[float, Field(ge=0)]
]

# Limits of a vehicle file, and of the constants that identification searches and adopts in flight
HOVER_THRUST_LIMITS = (0.02, 0.95)
DELAY_LIMITS_S = (0.0, 0.5)
FREQUENCY_LIMITS_RADPS = (0.5, 60.0)
DAMPING_LIMITS = (0.1, 6.0)
DRAG_PER_MASS_MOST_PS = 100.0  # terminal velocity 0.1 m/s: no vehicle that can be controlled


class AxisResponse(Parameters):
    """Closed attitude loop of one axis: s'' = wn^2 (s_c(t - D) - s) - 2 z wn s'.

    The delay D is the time from the stamp (vehicle time) of the newest telemetry at the decision to
    the effect of the command: the sum of the delays of telemetry, setpoint and attitude loop.
    """

    delay_s: float = Field(ge=DELAY_LIMITS_S[0], le=DELAY_LIMITS_S[1])
    natural_frequency_radps: float = Field(
        ge=FREQUENCY_LIMITS_RADPS[0], le=FREQUENCY_LIMITS_RADPS[1]
    )
    damping: float = Field(ge=DAMPING_LIMITS[0], le=DAMPING_LIMITS[1])


class Vehicle(Parameters):
    """Parameters of one multirotor, or of one helicopter as far as setpoints need them. SI units,
    body axes FRD.

    A tracking law needs `hover_thrust`, `tilt`, `yaw`, the thrust's delay and lag, the drag and
    the limits; identification in flight refines them. Inertia and `arm_m` are used by the simulator
    and by the paper's law, whose inputs (Eq. 6) are [f_t, tau_x, tau_y, tau_z]: roll and pitch
    inputs are differential forces in N at `arm_m`, or torques in N m if `arm_m` is 1.
    """

    name: str = Field(min_length=1, max_length=40)
    airframe: Literal["multirotor", "helicopter"] = "multirotor"  # MAV_TYPEs that are flown
    mass_kg: float = Field(ge=0.01, le=200)
    gravity_mps2: float = Field(default=9.80665, ge=9.7, le=9.9)
    inertia_kgm2: PositiveTriple
    arm_m: float = Field(default=1.0, gt=0, le=10)
    drag_translation_npmps: NonNegativeTriple  # D_t, Eq. 3, N per m/s
    drag_rotation_nmpradps: NonNegativeTriple  # D_r, Eq. 4, N m per rad/s
    hover_thrust: float = Field(
        ge=HOVER_THRUST_LIMITS[0], le=HOVER_THRUST_LIMITS[1]
    )  # normalised; PX4 MPC_THR_HOVER
    thrust_delay_s: float = Field(default=0.0, ge=0, le=0.5)
    thrust_lag_s: float = Field(default=0.0, ge=0, le=0.5)
    tilt: AxisResponse
    yaw: AxisResponse
    angular_acceleration_limit_radps2: PositiveTriple = (50.0, 50.0, 20.0)
    angular_rate_limit_radps: PositiveTriple = (3.84, 3.84, 3.49)  # PX4: 220, 220, 200 deg/s
    tilt_max_rad: float = Field(default=0.7, ge=0.05, le=1.4)

    def later_by(self, delay_s: float) -> Vehicle:
        """Return this vehicle with `delay_s` of a link added to each of its delays, within their
        limits."""
        least_s, most_s = DELAY_LIMITS_S

        def later(own_s: float) -> float:
            return min(max(own_s + delay_s, least_s), most_s)

        def axis(response: AxisResponse) -> AxisResponse:
            return response.model_copy(update={"delay_s": later(response.delay_s)})

        axes = {"tilt": axis(self.tilt), "yaw": axis(self.yaw)}
        return self.model_copy(update={**axes, "thrust_delay_s": later(self.thrust_delay_s)})

    @property
    def drag_per_mass_ps(self) -> float:
        """Lateral linear drag per unit of mass, 1/s: c in acceleration = ... - c v."""
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
    def thrust_min_mps2(self) -> float:
        """Least collective thrust per unit of mass that is sent in the air, m/s^2: a third of that
        in hover."""
        return self.gravity_mps2 / 3.0

    @property
    def thrust_max_mps2(self) -> float:
        """Collective thrust per unit of mass at full throttle, m/s^2 (linear thrust curve)."""
        return self.gravity_mps2 / self.hover_thrust


@dataclass(frozen=True, slots=True)
class DelayUncertainty:
    """Uncertainty of a vehicle's delays, s.

    `tilt_s` and `thrust_s` are the largest expected errors of the delays, three standard deviations
    of an identified one. `link_s` is the increase of the link delay since takeoff; it is known
    and compensated by prediction.
    """

    tilt_s: float = 0.0
    thrust_s: float = 0.0
    link_s: float = 0.0
