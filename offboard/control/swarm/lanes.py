"""The random stream of a swarm: one xorshift generator per particle, advanced in place.

Each particle draws from its own lane, so that compiled code fills whole rows at once and the
stream does not depend on who drives the swarm. Knows neither particles nor costs.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

States = NDArray[np.uint64]

_MASK = (1 << 64) - 1
_GOLDEN = 0x9E3779B97F4A7C15


def _splitmix64(value: int) -> int:
    """A well mixed 64-bit number, never 0 (where xorshift would stay for ever)."""
    value = (value ^ (value >> 30)) * 0xBF58476D1CE4E5B9 & _MASK
    value = (value ^ (value >> 27)) * 0x94D049BB133111EB & _MASK
    return (value ^ (value >> 31)) or _GOLDEN


class RandomLanes:
    """A reproducible stream that goes on from search to search; `reset` starts it anew.

    `states(count)` hands out the live lanes: whoever draws from them advances the stream. Lane i
    depends on the seed and i alone, not on how many lanes are in use.
    """

    def __init__(self, seed: int) -> None:
        if not 0 <= seed <= _MASK:
            raise ValueError(f"seed must be in 0 .. 2**64 - 1, got {seed}")
        self._seed = seed
        self._states: States = np.empty(0, np.uint64)
        self._handed_out = self._states

    def states(self, count: int) -> States:
        """The first `count` lanes, shape (count,), to be advanced in place: the same array as long
        as the same count is asked for. Whoever holds fewer of them when there come to be more goes
        on with those of its own."""
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
        self._states = np.empty(0, np.uint64)
        self._handed_out = self._states
