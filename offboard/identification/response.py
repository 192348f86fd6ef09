"""Exact responses of first- and second-order loops to commands that are held until the next one.

Between two commands the loop decays freely towards the command in force, so the matrix exponential
propagates its state from one command to the next, and from there to any sample (zero-order hold).
Times are in s, signals in any unit.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dtbtrs

Array = NDArray[np.float64]
Transition = Callable[[Array], Array]  # times (N,) to matrix exponentials (N, n, n)


def linear_recursion(transitions: Array, inputs: Array) -> Array:
    """Return states x (N, n, k) with x[0] = b[0] and x[i + 1] = A[i] x[i] + b[i + 1].

    `transitions` (N - 1, n, n) are the A, `inputs` (N, n, k) the b. All equations are solved
    together, as one banded triangular system.
    """
    count, n = inputs.shape[:2]
    bands = np.zeros((2 * n, n * count))
    for row in range(n):
        for column in range(n):
            bands[n + row - column, column : n * (count - 1) : n] = -transitions[:, row, column]
    states, _ = dtbtrs(bands, inputs.reshape(n * count, -1), uplo="L", diag="U")
    solved: Array = states.reshape(inputs.shape)
    return solved


def held_response(
    times: Array, sent_at: Array, commands: Array, delay_s: float, transition: Transition
) -> Array:
    """Return the response (N, axes) at `times` (N,) to `commands` (M, axes) sent at `sent_at` (M,).

    Each command acts `delay_s` after it was sent; the loop starts at rest at the first command. The
    state, the difference from the command in force and its derivatives, decays by `transition`.
    """
    decays = transition(np.diff(sent_at))
    steps = np.zeros((len(sent_at), decays.shape[1], commands.shape[1]))
    steps[1:, 0] = commands[:-1] - commands[1:]
    away = linear_recursion(decays, steps)
    held = np.maximum(np.searchsorted(sent_at + delay_s, times, side="right") - 1, 0)
    since_s = np.maximum(times - sent_at[held] - delay_s, 0.0)
    to_sample = transition(since_s)[:, :1]
    response: Array = commands[held] + (to_sample @ away[held])[:, 0]
    return response


def first_order(
    times: Array, sent_at: Array, commands: Array, delay_s: float, lag_s: float
) -> Array:
    """Return the response (N, axes) of s' = (c(t - delay) - s) / lag."""
    rate = 1.0 / max(lag_s, 1e-6)
    return held_response(
        times, sent_at, commands, delay_s, lambda h: np.exp(-rate * h)[:, None, None]
    )


def second_order(
    times: Array, sent_at: Array, commands: Array, delay_s: float, frequency: float, damping: float
) -> Array:
    """Return the response (N, axes) of s'' = wn^2 (c(t - delay) - s) - 2 z wn s'."""
    return held_response(
        times, sent_at, commands, delay_s, lambda h: free_motion(h, frequency, damping)
    )


def free_motion(times: Array, frequency: float, damping: float) -> Array:
    """Return exp(A t) (N, 2, 2) for A = [[0, 1], [-wn^2, -2 z wn]], as f0 I + f1 A."""
    decay = damping * frequency
    root = frequency * np.sqrt(max(abs(damping**2 - 1.0), 1e-14))
    if damping < 1.0:
        shrunk = np.exp(-decay * times)
        cosine, sine = shrunk * np.cos(root * times), shrunk * np.sin(root * times)
    else:
        slow, fast = np.exp((root - decay) * times), np.exp((-root - decay) * times)
        cosine, sine = 0.5 * (slow + fast), 0.5 * (slow - fast)
    f1 = sine / root
    f0 = cosine + decay * f1
    motion = np.empty((len(times), 2, 2))
    motion[:, 0, 0], motion[:, 0, 1] = f0, f1
    motion[:, 1, 0], motion[:, 1, 1] = -(frequency**2) * f1, f0 - 2.0 * decay * f1
    return motion
