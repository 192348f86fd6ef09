"""The rigid body followed in time by machine code, for who has no compiled loop of his own."""

from __future__ import annotations

from typing import Any

from offboard.compiled import array, entry
from offboard.model.rigid_body import rk4_into


@entry(array(1), array(1), array(1), array(1), float, int, array(2))
def follow(
    state: Any, inputs: Any, wind_ned: Any, parameters: Any, step_s: float, steps: int, scratch: Any
) -> int:
    """So many RK4 steps of held inputs and wind, in place; shapes as in `rk4_into`."""
    for _ in range(steps):
        rk4_into(state, inputs, wind_ned, parameters, step_s, scratch, state)
    return 0
