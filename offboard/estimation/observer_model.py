"""Settings of the observer, the plant and filter models of a vehicle, and predicted states."""

from __future__ import annotations

from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from offboard.documents.parameters import Parameters
from offboard.estimation.filtering import set_up, start
from offboard.estimation.observer_filter import (
    LATERAL,
    LATERAL_DRIFT,
    OBSERVER,
)
from offboard.estimation.propagation import (
    BIAS,
    BIAS_TIME_CONSTANT,
    COURSE,
    COURSE_RATE,
    DISTURBANCE,
    DRAG,
    GRAVITY,
    NOW,
    PLANT_SIZE,
    POSITION,
    THRUST,
    THRUST_DELAY,
    THRUST_LAG,
    TILT,
    TILT_DAMPING,
    TILT_DELAY,
    TILT_FREQUENCY,
    TILT_RATE,
    VELOCITY,
    YAW_DAMPING,
    YAW_DELAY,
    YAW_FREQUENCY,
)
from offboard.model.axes import lateral_model, upright
from offboard.model.frames import wrap_pi
from offboard.model.predicted_state import PredictedHeave, PredictedState
from offboard.model.vehicle import Vehicle

Array = NDArray[np.float64]
Record = np.ndarray[Any, Any]

# For each filter: indices of its states in the observer's state, for each axis
PLACES: tuple[list[tuple[int, ...]], ...] = (
    [
        (POSITION + i, VELOCITY + i, TILT + i, TILT_RATE + i, DISTURBANCE + i, BIAS + i)
        for i in (0, 1)
    ],
    [(POSITION + 2, VELOCITY + 2, DISTURBANCE + 2, BIAS + 2)],
    [(COURSE, COURSE_RATE)],
)
# Standard deviations of these states at the first telemetry, which sets position, velocity and
# attitude; disturbance and bias start at zero
START_SDS = (
    (0.1, 0.3, 0.02, 0.3, 1.0, 0.3),
    (0.1, 0.3, 1.5, 0.3),
    (0.05, 0.3),
)


class VelocitySource(StrEnum):
    """How the reported velocity is used."""

    POSITION = "position"  # not used: velocity comes from position and commands
    BIAS = "bias"  # as a measurement with a slowly varying bias
    REPORTED = "reported"  # as the true velocity, without disturbance; for comparison


class ObserverSettings(Parameters):
    """Noise densities per root second and standard deviations of the filters. The defaults were
    flown on PX4 and ArduCopter; half or twice the values made no visible difference."""

    velocity: VelocitySource = VelocitySource.BIAS
    acceleration_density_mps: float = Field(default=0.2, gt=0, le=10)
    disturbance_density_mps2: float = Field(default=0.15, gt=0, le=10)
    tilt_density_radps: float = Field(default=0.6, gt=0, le=50)
    course_density_radps: float = Field(default=0.6, gt=0, le=50)
    bias_density_mps: float = Field(default=0.08, gt=0, le=10)
    bias_time_constant_s: float = Field(default=10.0, gt=0.1, le=1000)
    position_sd_m: float = Field(default=0.002, gt=0, le=1)
    velocity_sd_mps: float = Field(default=0.005, gt=0, le=5)
    attitude_sd_rad: float = Field(default=0.001, gt=0, le=0.5)
    position_jump_m: float = Field(default=0.3, gt=0, le=100)
    velocity_jump_mps: float = Field(default=0.5, gt=0, le=100)
    disturbance_limit_mps2: float = Field(default=8.0, gt=0, le=20)
    # Noise and drift from the innovations: at least the values above, the drift up to the limit
    adaptive: bool = True
    disturbance_density_limit_mps2: float = Field(default=1.0, gt=0, le=10)


def new_record(settings: ObserverSettings) -> Record:
    """A record (1,) of dtype OBSERVER whose vehicle is not set yet."""
    record = np.zeros(1, OBSERVER)
    record["uses_velocity"] = settings.velocity is VelocitySource.BIAS
    record["adaptive"] = settings.adaptive
    record["white_sds"] = settings.position_sd_m, settings.velocity_sd_mps
    record["gates"] = settings.position_jump_m, settings.velocity_jump_mps
    record["attitude_sd"] = settings.attitude_sd_rad
    record["disturbance_limit"] = settings.disturbance_limit_mps2
    for one, places in zip(record["filters"][0], PLACES, strict=True):
        one["axes"] = len(places)
        one["places"][: len(places), : len(places[0])] = places
    return record


def set_vehicle(record: Record, vehicle: Vehicle, settings: ObserverSettings) -> None:
    """Set the plant and the filter models of `record` to those of `vehicle`."""
    record["motion"]["plant"] = plant_vector(vehicle, settings)
    frequency = max(vehicle.tilt.natural_frequency_radps, vehicle.yaw.natural_frequency_radps)
    damping = max(vehicle.tilt.damping, vehicle.yaw.damping, 0.5)
    longest_s = min(0.02, 0.25 / (2.0 * damping * frequency))
    for one, model in zip(record["filters"][0], filter_models(vehicle, settings), strict=True):
        set_up(one, *model)
        one["longest_s"] = longest_s


def start_filters(record: Record, settings: ObserverSettings) -> None:
    """Set covariances, disturbance and bias to those at the first message."""
    for one, sds in zip(record["filters"][0], START_SDS, strict=True):
        start(one, np.square(sds))
    if settings.velocity is VelocitySource.REPORTED:
        record["filters"]["covariance"][0, LATERAL, LATERAL_DRIFT, LATERAL_DRIFT] = 0.0
    record["motion"]["states"][0, NOW, DISTURBANCE : DISTURBANCE + 3] = 0.0
    record["motion"]["states"][0, NOW, BIAS : BIAS + 3] = 0.0


def plant_vector(vehicle: Vehicle, settings: ObserverSettings) -> Array:
    """The plant vector (PLANT_SIZE,) of `propagation`."""
    plant = np.empty(PLANT_SIZE)
    plant[GRAVITY] = vehicle.gravity_mps2
    plant[DRAG] = vehicle.drag_per_mass_ps
    plant[TILT_FREQUENCY] = vehicle.tilt.natural_frequency_radps
    plant[TILT_DAMPING] = vehicle.tilt.damping
    plant[TILT_DELAY] = vehicle.tilt.delay_s
    plant[THRUST_LAG] = vehicle.thrust_lag_s
    plant[THRUST_DELAY] = vehicle.thrust_delay_s
    plant[YAW_FREQUENCY] = vehicle.yaw.natural_frequency_radps
    plant[YAW_DAMPING] = vehicle.yaw.damping
    plant[YAW_DELAY] = vehicle.yaw.delay_s
    plant[BIAS_TIME_CONSTANT] = settings.bias_time_constant_s
    return plant


def filter_models(vehicle: Vehicle, settings: ObserverSettings) -> tuple[tuple[Array, Array], ...]:
    """Dynamics (n, n) and densities (n,) of the lateral, vertical and course filters.

    Linearised about hover: the acceleration per error of the thrust direction b is g.
    """
    trusted = settings.velocity is VelocitySource.REPORTED
    drift = 0.0 if trusted else settings.disturbance_density_mps2
    motion, bias = settings.acceleration_density_mps, settings.bias_density_mps
    forgetting = -1.0 / settings.bias_time_constant_s
    lateral = np.zeros((6, 6))
    lateral[:4, :4] = lateral_model(vehicle).dynamics
    lateral[1, 4], lateral[5, 5] = 1.0, forgetting
    vertical = np.zeros((4, 4))
    vertical[0, 1] = vertical[1, 2] = 1.0
    vertical[1, 1], vertical[3, 3] = -vehicle.drag_per_mass_ps, forgetting
    heading = np.zeros((2, 2))
    frequency = vehicle.yaw.natural_frequency_radps
    heading[0, 1] = 1.0
    heading[1] = -(frequency**2), -2.0 * vehicle.yaw.damping * frequency
    return (
        (lateral, np.array([0.0, motion, 0.0, settings.tilt_density_radps, drift, bias])),
        (vertical, np.array([0.0, motion, drift, bias])),
        (heading, np.array([0.0, settings.course_density_radps])),
    )


def predicted_state(
    time_s: float, state: Array, rates_frd_radps: Array, heave: PredictedHeave
) -> PredictedState:
    """What the controller is given of a state (STATE_SIZE,) of `propagation` at `time_s`."""
    north, east, rate_n, rate_e = state[TILT : TILT_RATE + 2].tolist()
    down = upright(north, east)
    return PredictedState(
        time_s=time_s,
        position_ned_m=state[POSITION : POSITION + 3],
        velocity_ned_mps=state[VELOCITY : VELOCITY + 3],
        thrust_direction_ned=np.array([north, east, down]),
        thrust_direction_rate_ned_ps=np.array(
            [rate_n, rate_e, -(north * rate_n + east * rate_e) / down]
        ),
        course_rad=wrap_pi(float(state[COURSE])),
        course_rate_radps=float(state[COURSE_RATE]),
        thrust_mps2=float(state[THRUST]),
        disturbance_ned_mps2=state[DISTURBANCE : DISTURBANCE + 3],
        rates_frd_radps=rates_frd_radps,
        heave=heave,
    )


def predicted_heave(time_s: float, state: Array) -> PredictedHeave:
    """The vertical part of a state (STATE_SIZE,) at `time_s`."""
    numbers = state.tolist()
    return PredictedHeave(
        time_s=time_s,
        position_down_m=numbers[POSITION + 2],
        velocity_down_mps=numbers[VELOCITY + 2],
        thrust_down_mps2=numbers[THRUST] * upright(numbers[TILT], numbers[TILT + 1]),
    )
