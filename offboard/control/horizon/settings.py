"""What the controllers `horizon`, `mppi` and `cem` are told: values only.

Apart from the law, so that a flight with another law neither loads nor compiles the roll-outs.
"""

from __future__ import annotations

from enum import StrEnum

from pydantic import Field

from offboard.control.horizon.keep_out import KeepOut
from offboard.control.horizon.plant import MOST_STEPS
from offboard.control.laws.tracking import TrackingSettings
from offboard.control.swarm.settings import SwarmSettings
from offboard.documents.parameters import Parameters

STEPS, STEPS_AROUND = 10, 20


class SamplingSettings(Parameters):
    """`samples` x `iterations` roll-outs; `deviation` is the first standard deviation as a share
    of the knots' reach, multiplied by `shrink` after each iteration (MPPI). `temperature` is a
    share of the samples' cost spread, `elite` the share that the cross-entropy method keeps."""

    samples: int = Field(default=40, ge=4, le=10_000)
    iterations: int = Field(default=70, ge=1, le=10_000)
    deviation: float = Field(default=0.3, gt=0, le=2)
    shrink: float = Field(default=0.93, gt=0, le=1)
    temperature: float = Field(default=0.1, gt=0, le=10)
    elite: float = Field(default=0.2, gt=0, le=1)


class Method(StrEnum):
    """Who searches the knots."""

    SWARM = "horizon"
    MPPI = "mppi"
    CEM = "cem"


class Dynamics(StrEnum):
    """What the roll-outs fly: thrust times direction, or its linear model about hover."""

    NONLINEAR = "nonlinear"
    LINEAR = "linear"


class HorizonSettings(TrackingSettings):
    """The tracking law's settings, `steps` decisions ahead (none: 10, and 20 around volumes: the
    way past one must fit in), around `keep_out` with `clearance_m` to spare and at most
    `speed_limit_mps` (none: unlimited). `seed_with_qp`: whether the linear problem's exact plan is
    a seed; `polish_steps` bounds the steps from each answer of the swarm to its local minimum.
    """

    steps: int | None = Field(default=None, ge=2, le=MOST_STEPS)
    dynamics: Dynamics = Dynamics.NONLINEAR
    keep_out: tuple[KeepOut, ...] = ()
    clearance_m: float = Field(default=0.3, ge=0, le=50)
    speed_limit_mps: float | None = Field(default=None, gt=0, le=50)
    seed_with_qp: bool = True
    polish_steps: int = Field(default=8, ge=0, le=50)
    swarm: SwarmSettings = SwarmSettings(particles=20, iterations=40, damping=0.8)
    sampling: SamplingSettings = SamplingSettings()

    @property
    def planned(self) -> int:
        """The decisions ahead, as chosen or by default."""
        return self.steps or (STEPS_AROUND if self.keep_out else STEPS)
