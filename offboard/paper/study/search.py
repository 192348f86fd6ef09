"""One search of the swarm, particle by particle: the matter of Fig. 4."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from offboard.control.certificate import ExactMinimum
from offboard.control.swarm import QuadraticSwarm, RandomLanes
from offboard.paper.law import PaperSettings
from offboard.paper.study.peers import problems

Array = NDArray[np.float64]

SHOWN_ITERATIONS = (1, 5, 20, 150)  # Fig. 4 a-d


@dataclass(frozen=True, slots=True)
class Search:
    """positions (4 shown iterations, particles, 4); box lower, upper (4,); optimum u* (4,)."""

    damping: float
    positions: Array
    lower: Array
    upper: Array
    optimum: Array


def search(settings: PaperSettings) -> Search:
    """A search midway along the path of Figs. 5-6 with the swarm of `settings`."""
    problem = problems(3, settings)[1]
    swarm = QuadraticSwarm(settings.swarm, 4)
    result = swarm.minimise(problem, RandomLanes(0), keep_history=True)
    if result.history is None:
        raise ValueError("the swarm kept no history")
    picked = np.minimum(SHOWN_ITERATIONS, len(result.history.positions)) - 1
    return Search(
        settings.swarm.damping,
        result.history.positions[picked],
        problem.lower,
        problem.upper,
        ExactMinimum(4).minimise(problem),
    )
