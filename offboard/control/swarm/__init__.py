"""The particle swarm of Eqs. 19-20 and 30, with two interfaces.

`Swarm` (ask/tell) serves any objective; `QuadraticSwarm` minimises a `BoxQuadratic` entirely in
compiled code. Knows no model, no reference and no clock.
"""

from offboard.control.swarm.lanes import RandomLanes
from offboard.control.swarm.particles import Swarm
from offboard.control.swarm.quadratic import QuadraticSwarm
from offboard.control.swarm.settings import SwarmHistory, SwarmResult, SwarmSettings

__all__ = [
    "QuadraticSwarm",
    "RandomLanes",
    "Swarm",
    "SwarmHistory",
    "SwarmResult",
    "SwarmSettings",
]
