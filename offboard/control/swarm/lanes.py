"""The random numbers of a swarm: one xorshift generator (lane) per particle, advanced in place.

Each particle draws from its own lane, so that compiled code fills whole rows at once, and both
interfaces of the swarm draw the same numbers.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

States = NDArray[np.uint64]

_MASK = (1 << 64) - 1
_GOLDEN = 0x9E3779B97F4A7C15


def _splitmix64(value: int) -> int:
    """The splitmix64 hash; never 0, which xorshift would repeat for ever."""
    value = (value ^ (value >> 30)) * 0xBF58476D1CE4E5B9 & _MASK
    value = (value ^ (value >> 27)) * 0x94D049BB133111EB & _MASK
    return (value ^ (value >> 31)) or _GOLDEN


class RandomLanes:
    """Reproducible random lanes that continue from search to search; `reset` starts them anew.

    Lane i depends on the seed and i alone, not on the number of lanes in use. Raises ValueError for
    a seed outside 0 .. 2**64 - 1.
    """

    def __init__(self, seed: int) -> None:
        if not 0 <= seed <= _MASK:
            raise ValueError(f"seed must be in 0 .. 2**64 - 1, got {seed}")
        self._seed = seed
        self._states: States = np.empty(0, np.uint64)
        self._handed_out = self._states

    def states(self, count: int) -> States:
        """The states of the first `count` lanes, shape (count,), to be advanced in place.

        The same array is returned as long as `count` is the same. When `count` grows the lanes are
        copied: an array returned before is no longer connected with them.
        """
        held = len(self._states)
        if count > held:
            start = _splitmix64(self._seed)
            fresh = [_splitmix64((start + (i + 1) * _GOLDEN) & _MASK) for i in range(held, count)]
            self._states = np.concatenate([self._states, np.array(fresh, np.uint64)])
            self._handed_out = self._states
        if count != len(self._handed_out):
            self._handed_out = self._states[:count]
        return self._handed_out

    def reset(self) -> None:
        """Return all lanes to their state at the seed."""
        self._states = np.empty(0, np.uint64)
        self._handed_out = self._states
