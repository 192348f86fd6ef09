"""The law `mpc`: the cost of the tracking laws over N decisions within their bounds, by daqp.

If no later bound is active, its command equals that of `lqr`; otherwise it plans for the bound. It
avoids no keep-out volume. `horizon` also uses the reference over N decisions (`look_ahead`) and the
linear problem as one quadratic in all inputs (`HorizonQuadratic`).
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.linalg import block_diag

from offboard.control.base import Certificate, Decision, DecisionError, Situation
from offboard.control.gains import CostToGo
from offboard.control.law import (
    TrackingLaw,
    TrackingProblem,
    TrackingSettings,
    decision,
    to_hover,
    vertical_of,
)
from offboard.control.quadratic import BoxQuadratic, ExactMinimum, at_bound
from offboard.model.vehicle import Vehicle
from offboard.reference.flatness import flat_state

Array = NDArray[np.float64]

MOST_STEPS = 40
_NODES = 2 * MOST_STEPS + 1
OUTLOOK = np.dtype(
    [
        # at the nodes, NED: p, v (each axis at its own times) and b; T when the tilt acts and when
        # the thrust acts; b_z when the thrust acts
        ("positions", "f8", (_NODES, 3)),
        ("velocities", "f8", (_NODES, 3)),
        ("directions", "f8", (_NODES, 3)),
        ("thrusts_tilt", "f8", _NODES),
        ("thrusts_vertical", "f8", _NODES),
        ("b_z", "f8", _NODES),
        # of each hold: feed-forward of b_c north and east and of the vertical thrust, in the middle
        # of the hold; bounds of the deviations from it
        ("feedforward", "f8", (MOST_STEPS, 3)),
        ("lower", "f8", (MOST_STEPS, 3)),
        ("upper", "f8", (MOST_STEPS, 3)),
        ("to_hover", "f8", (MOST_STEPS, 2, 2)),  # `law.Target.to_hover` at the start of each hold
        # A steady vertical disturbance is nearly always a wrong hover thrust or mass: the lateral
        # force of the tilted thrust is multiplied by this share
        ("thrust_share", "f8"),
    ],
    align=True,
)
"""The reference over up to `MOST_STEPS` holds: nodes are start, middle, ..., end of the holds. SI.

Plans are deviations [b_c north, b_c east, T b_z] from the feed-forward, which compensates the
response of the attitude loop: a plan of zeros flies the reference."""


def look_ahead(
    law: TrackingLaw, situation: Situation, problem: TrackingProblem, steps: int
) -> NDArray[np.void]:
    """Return one `OUTLOOK` (1,) over `steps` holds. It begins when a command sent now takes effect:
    in the lateral axes when the tilt acts, in the vertical one when the thrust acts."""
    vehicle, state, period_s = law.vehicle, situation.state, law.period_s
    nodes_s = 0.5 * period_s * np.arange(2 * steps + 1)
    times = np.concatenate((state.time_s + nodes_s, vertical_of(state).time_s + nodes_s))
    sample = situation.reference.sample(times)
    flat = flat_state(
        sample, vehicle.gravity_mps2, vehicle.drag_per_mass_ps, state.disturbance_ned_mps2
    )
    tilt, vertical = np.split(np.arange(len(times)), 2)
    b, down = flat.thrust_direction_ned, flat.thrust_direction_ned[vertical, 2]
    outlook = np.zeros(1, OUTLOOK)
    one = outlook[0]
    for name, values in (
        ("positions", sample.position_ned_m),
        ("velocities", sample.velocity_ned_mps),
    ):
        one[name][: len(tilt)] = np.column_stack((values[tilt, :2], values[vertical, 2]))
    one["directions"][: len(tilt)] = b[tilt]
    one["thrusts_tilt"][: len(tilt)] = flat.thrust_mps2[tilt]
    one["thrusts_vertical"][: len(tilt)] = flat.thrust_mps2[vertical]
    one["b_z"][: len(tilt)] = down
    starts = tilt[:-1:2]
    one["to_hover"][:steps] = to_hover(b[starts], flat.thrust_mps2[starts], state, vehicle)
    nominal = law.feedforward(flat, tilt[1::2], vertical[1::2])
    one["feedforward"][:steps] = nominal
    low, high = law.tilt_bounds(nominal[:, :2])
    down = down[:-1:2].copy()
    down[0] = problem.b_z
    thrusts = problem.quadratic.lower[0] * down, problem.quadratic.upper[0] * down
    one["lower"][:steps] = np.column_stack((low, thrusts[0])) - nominal
    one["upper"][:steps] = np.column_stack((high, thrusts[1])) - nominal
    gravity = vehicle.gravity_mps2
    one["thrust_share"] = gravity / (gravity + float(state.disturbance_ned_mps2[2]))
    return outlook


class HorizonQuadratic:
    """J of N held inputs and of the cost-to-go after them, for the gains of `law`; `over` adds the
    state. Inputs are deviations from the feed-forward of the `OUTLOOK`: N of b_c north, N of b_c
    east, N of vertical thrust. The axes do not couple."""

    def __init__(self, law: TrackingLaw, steps: int) -> None:
        self.steps = steps
        lateral = _condense(law.lateral, steps, law.period_s)
        self._axes = (lateral, lateral, _condense(law.vertical, steps, law.period_s))
        self._hessian: Array = block_diag(*(axis[0] for axis in self._axes))

    def over(self, problem: TrackingProblem, outlook: NDArray[np.void]) -> BoxQuadratic:
        """Return the quadratic in (3 N,) inputs that begins at the deviations of `problem`."""
        starts = (*problem.at_hover.T, problem.vertical)
        axes = list(zip(starts, self._axes, strict=True))
        gradient = np.concatenate([start @ axis[1] for start, axis in axes])
        rest = sum(float(start @ axis[2] @ start) for start, axis in axes)
        bounds = (outlook[0][name][: self.steps].T.ravel() for name in ("lower", "upper"))
        return BoxQuadratic(self._hessian, gradient, rest, *bounds)

    def plan(self, stacked: Array) -> Array:
        """Return the inputs (3 N,) of the quadratic as (N, 3), one row per step."""
        return stacked.reshape(3, self.steps).T


def _condense(to_go: CostToGo, steps: int, period_s: float) -> tuple[Array, Array, Array]:
    """Return H (N, N), F (n, N) and G (n, n) of J = 1/2 u' H u + x' F u + x' G x, for inputs u (N,)
    from the state x (n,)."""
    size = len(to_go.transition)
    at = np.eye(size, size + steps)  # each state as a function of the first one and the inputs
    total = np.zeros((size + steps, size + steps))
    for held in np.eye(size + steps)[size:, None]:
        total += period_s * at[:1].T @ at[:1] + to_go.effort * held.T @ held
        at = to_go.transition @ at + to_go.input_map @ held
    total += at.T @ to_go.terminal @ at
    return 2.0 * total[size:, size:], 2.0 * total[:size, size:], total[:size, :size]


class MpcSettings(TrackingSettings):
    """Settings of the law `mpc`; `steps` is the number of decisions planned."""

    law: Literal["mpc"] = "mpc"
    steps: int = Field(default=10, ge=2, le=MOST_STEPS)

    def build(self, vehicle: Vehicle, *, period_s: float, seed: int) -> MpcLaw:
        return MpcLaw(vehicle, self, period_s=period_s)


class MpcLaw(TrackingLaw):
    """Linear model predictive control."""

    def __init__(self, vehicle: Vehicle, settings: MpcSettings, *, period_s: float = 0.1) -> None:
        self._steps = settings.steps
        super().__init__(vehicle, settings, period_s)
        self._exact = ExactMinimum(3 * self._steps)

    def decide(self, situation: Situation) -> Decision:
        problem = self.problem(situation)
        planned = self._quadratic.over(problem, look_ahead(self, situation, problem, self._steps))
        best = self._exact.minimise(planned)
        if not np.isfinite(best).all():
            raise DecisionError("the quadratic over the horizon has no solution")
        cost = float(planned(best))
        certificate = Certificate(
            cost, optimal_cost=cost, gap=0.0, at_bound=at_bound(planned, best)
        )
        inputs = problem.inputs(self._quadratic.plan(best)[0])
        return decision(problem.quadratic.clip(inputs), certificate)

    def _use_gains(self) -> None:
        super()._use_gains()
        self._quadratic = HorizonQuadratic(self, self._steps)
