"""Vehicles, laws and states for tests of control laws."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from offboard.control.base import Controller
from offboard.control.catalogue import names, settings_of
from offboard.control.law import LqrLaw, LqrSettings, PsoLaw, PsoSettings, Target
from offboard.model.command import Command, PredictedState
from offboard.model.vehicle import AxisResponse, Vehicle
from offboard.reference.base import Reference

G = 9.80665
PX4 = Vehicle(
    name="px4",
    mass_kg=1.0,
    inertia_kgm2=(0.025, 0.025, 0.03),
    drag_translation_npmps=(1.02, 1.02, 1.02),
    drag_rotation_nmpradps=(0.02, 0.02, 0.02),
    hover_thrust=0.4895,
    thrust_delay_s=0.015,
    thrust_lag_s=0.05,
    tilt=AxisResponse(delay_s=0.057, natural_frequency_radps=11.4, damping=0.56),
    yaw=AxisResponse(delay_s=0.148, natural_frequency_radps=3.1, damping=0.4),
)
LEVEL = Command(G, (0.0, 0.0, 1.0), 0.0)
# Laws that track closely: neither the paper's, which is slow, nor the autopilot's own loop
TRACKING = [name for name in names() if name not in ("paper", "autopilot")]


def lqr(bandwidth: float = 5.0, vehicle: Vehicle = PX4, **more: object) -> LqrLaw:
    return LqrLaw(vehicle, LqrSettings.model_validate({"bandwidth_radps": bandwidth, **more}))


def pso() -> PsoLaw:
    return PsoLaw(PX4, PsoSettings(bandwidth_radps=5.0), seed=0)


def state_of(rng: np.random.Generator, reference: Reference, size: float) -> PredictedState:
    """A random state near the reference at 5.057 s: about `size` off in m and m/s."""
    sample = reference.sample(5.057)
    tilt = np.clip(0.05 * size * rng.normal(size=2), -0.6, 0.6)
    return PredictedState(
        time_s=5.057,
        position_ned_m=sample.position_ned_m + size * rng.normal(size=3),
        velocity_ned_mps=sample.velocity_ned_mps + size * rng.normal(size=3),
        thrust_direction_ned=np.array([*tilt, math.sqrt(1 - tilt @ tilt)]),
        thrust_direction_rate_ned_ps=np.array([*(0.2 * size * rng.normal(size=2)), 0.0]),
        heading_rad=0.0,
        heading_rate_radps=0.0,
        thrust_mps2=G + 0.3 * size * rng.normal(),
        disturbance_ned_mps2=0.3 * size * rng.normal(size=3),
        rates_frd_radps=np.zeros(3),
    )


def on_target(state: PredictedState, target: Target) -> PredictedState:
    """`state` with position, velocity, tilt and thrust as `target` demands them."""
    down = math.sqrt(1.0 - target.lateral[2] @ target.lateral[2])
    position, velocity, direction, rate = target.lateral
    return replace(
        state,
        position_ned_m=np.array([*position, target.vertical[0]]),
        velocity_ned_mps=np.array([*velocity, target.vertical[1]]),
        thrust_direction_ned=np.array([*direction, down]),
        thrust_direction_rate_ned_ps=np.array([*rate, 0.0]),
        thrust_mps2=target.vertical[2] / down,
    )


def law_named(name: str) -> Controller:
    chosen = {"bandwidth_radps": 5.0} if name in TRACKING else {}
    return settings_of(name)(law=name, **chosen).build(PX4, period_s=0.1, seed=7)


def at(position: ArrayLike, heading_rad: float) -> PredictedState:
    """A state at rest and level, `position` in NED."""
    return PredictedState(
        0.057, np.array(position), np.zeros(3), np.array([0.0, 0.0, 1.0]), np.zeros(3),
        heading_rad, 0.0, G, np.zeros(3), np.zeros(3),
    )  # fmt: skip
