"""The particle swarm of Eqs. 19-20 and 30: one law of motion, driven two ways.

`Swarm` (ask/tell) serves any objective, `QuadraticSwarm` a `BoxQuadratic` without leaving compiled
code. Knows objectives only as costs: no model, no reference, no clock.
"""

from offboard.control.swarm.lanes import RandomLanes
from offboard.control.swarm.particles import Swarm
from offboard.control.swarm.quadratic import QuadraticSwarm, warm_up
from offboard.control.swarm.settings import SwarmHistory, SwarmResult, SwarmSettings

__all__ = [
    "QuadraticSwarm",
    "RandomLanes",
    "Swarm",
    "SwarmHistory",
    "SwarmResult",
    "SwarmSettings",
    "warm_up",
]
