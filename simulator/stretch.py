"""Stretches of flight in which nothing happens, in one compiled call.

While the demand stands, nobody speaks and no rule can fire, a vehicle only flies and reports. A
`Stretch` takes a link's streams through such steps with the bytes that single steps would give.
How long a stretch may be is for others to say (`simulator.instance`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numba
import numpy as np
from numpy.typing import NDArray

from simulator.frame_writer import (
    EAST_DEGREES_PER_M,
    FRAME_MAX,
    HOME_DOWN,
    ORIGIN,
    PAYLOAD_MAX,
    SEEN_WIDTH,
    TRUE_ACCELERATION,
    TRUE_ATTITUDE,
    TRUE_DOWN,
    write_frame,
)
from simulator.plant import ACCELERATION_PLACE, CONTACT_PLACE, advance_steps, report_state
from simulator.sensors import REPORT_WIDTH

if TYPE_CHECKING:
    from simulator.telemetry import View

Array = NDArray[np.float64]
Integers = NDArray[np.int64]
Bytes = NDArray[np.uint8]

LONGEST = 25  # steps of one stretch, so that its frames fit the buffer
_FOREVER = 1 << 62
_KIND, _INTERVAL_US, _DUE_US, _GRID = range(4)
_STEP_US = 4000


SLOW, SILENT = -1, -2  # instead of a place in KINDS: Python writes it; it is not to be said


class Stretch:
    """The streams of one link, kept for compiled code."""

    def __init__(self, view: View) -> None:
        self._view = view
        self._seen = np.zeros(SEEN_WIDTH)
        self._seen[ORIGIN] = view.autopilot.firmware.origin
        self._seen[EAST_DEGREES_PER_M] = view.east_degrees_per_m
        self._frames = np.zeros(0, np.uint8)
        self._ends = np.zeros((0, 2), np.int64)
        self._rows = np.zeros((0, 4), np.int64)
        self._names: list[str] = []

    def schedule(self, streams: Sequence[tuple[str, int, int, int, int]]) -> None:
        """Take these streams, in this order: name, place in KINDS (or SLOW or SILENT), interval
        and next time in microseconds, and of how many steps it keeps to the multiples."""
        self._names = [stream[0] for stream in streams]
        self._rows = np.array([stream[1:] for stream in streams], np.int64).reshape(-1, 4)
        self._ends = np.zeros((LONGEST * len(streams), 2), np.int64)
        self._frames = np.zeros(len(self._ends) * FRAME_MAX, np.uint8)

    @property
    def due_us(self) -> dict[str, int]:
        """When each stream is due next."""
        return dict(zip(self._names, self._rows[:, _DUE_US].tolist(), strict=True))

    def fly(self, count: int, sequence: int) -> tuple[int, list[bytes | str], int]:
        """At most `count` steps (no more than LONGEST), and what is due in them; 0: due now.

        Ends behind the step in which the ground is touched or left, or a slow message is due.
        Returns the steps, frames or names of slow messages whose numbers are kept free, and the
        next step at which something is due.
        """
        view = self._view
        autopilot = view.autopilot
        plant = autopilot.plant
        self._seen[HOME_DOWN] = autopilot.pilot.home_ned_m[2]
        done, spoken, next_step = _fly(
            count,
            autopilot.steps,
            view.clock_offset_us,
            plant.reset_counter,
            view.system,
            sequence,
            self._rows,
            self._seen,
            self._frames,
            self._ends,
            *plant.compiled(),
        )
        plant.flown(done)
        said: list[bytes | str] = []
        if spoken:
            ends = self._ends[:spoken].tolist()
            data = self._frames[: ends[-1][0]].tobytes()
            begin = 0
            for end, slow in ends:
                said.append(data[begin:end] if slow < 0 else self._names[slow])
                begin = end
        return done, said, next_step


@numba.njit(cache=True)
def _next_step(rows: Integers, now: int) -> int:
    """The first step behind `now` at which one of the streams speaks."""
    first = _FOREVER
    for i in range(rows.shape[0]):
        step = max(now + 1, -(-rows[i, _DUE_US] // _STEP_US))
        step = -(-step // rows[i, _GRID]) * rows[i, _GRID]
        first = min(first, step)
    return first


@numba.njit(cache=True)
def _fly(
    count: int,
    step: int,
    clock_offset_us: int,
    resets: int,
    system: int,
    sequence: int,
    rows: Integers,
    seen: Array,
    out: Bytes,
    ends: Integers,
    plant_step: int,
    motors_on: bool,
    substeps: int,
    seed: np.uint64,
    row: Array,
    history: Array,
    delays: Integers,
    constants: Array,
    state: Array,
    believed: Array,
) -> tuple[int, int, int]:
    """Fly to the next step at which a stream speaks, write what is due, and so on."""
    done, spoken, at = 0, 0, int(np.int64(0))  # not a constant: see `simulator.plant`
    payload = np.empty(PAYLOAD_MAX, np.uint8)
    contact, slow = state[CONTACT_PLACE], False
    while True:
        speaks = step if count == 0 else _next_step(rows, step + done)
        if count > 0:
            done += advance_steps(
                min(count, speaks - step) - done,
                plant_step + done,
                motors_on,
                substeps,
                seed,
                row,
                history,
                delays,
                constants,
                state,
            )
        now = step + done
        if now == speaks:
            seen_yet = False
            for i in range(rows.shape[0]):
                if rows[i, _DUE_US] > now * _STEP_US or now % rows[i, _GRID]:
                    continue
                interval_us = rows[i, _INTERVAL_US]
                rows[i, _DUE_US] = (now * _STEP_US // interval_us + 1) * interval_us
                kind = rows[i, _KIND]
                if kind == SILENT:
                    continue
                if kind == SLOW:
                    slow = True
                else:
                    if not seen_yet:
                        _see(state, believed, motors_on, seed, plant_step + done, seen)
                        seen_yet = True
                    time_us = max(0, now * _STEP_US + clock_offset_us)
                    at = write_frame(
                        kind, seen, time_us, resets, system, sequence, payload, out, at
                    )
                sequence = (sequence + 1) & 0xFF
                ends[spoken, 0] = at
                ends[spoken, 1] = i if kind == SLOW else -1
                spoken += 1
        if done >= count or slow or state[CONTACT_PLACE] != contact:
            return done, spoken, _next_step(rows, now)


@numba.njit(cache=True)
def _see(
    state: Array, believed: Array, motors_on: bool, seed: np.uint64, step: int, seen: Array
) -> None:
    report_state(state, believed, motors_on, seed, step, seen[:REPORT_WIDTH])
    for i in range(4):
        seen[TRUE_ATTITUDE + i] = state[i]
    seen[TRUE_DOWN] = state[12]
    for i in range(3):
        seen[TRUE_ACCELERATION + i] = state[ACCELERATION_PLACE + i]
