"""Stretches of flight in which nothing happens, in one compiled call.

While the demand stands or only the position loop changes it, nobody speaks and no rule can fire, a
vehicle only flies and reports. A `Stretch` takes it through such steps and fills its links with the
bytes that single steps would give. How long a stretch may be is for others to say
(`simulator.instance`).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from offboard.model.kernel import address, entry, kernel
from simulator.autopilot import position_law
from simulator.autopilot.position_law import step_loop
from simulator.mavlink import payloads, seen
from simulator.mavlink.frame_writer import FRAME_MAX, KINDS, write_frame
from simulator.mavlink.schedule import Stream
from simulator.mavlink.seen import Seen
from simulator.mavlink.server import Server
from simulator.mavlink.telemetry import BUILDERS, ON_POSITION_GRID
from simulator.mavlink.view import View
from simulator.steps import LOOP_STEPS, STEP_US
from simulator.vehicle import dynamics
from simulator.vehicle.airframe import CONTACT
from simulator.vehicle.attitude import encode_attitude
from simulator.vehicle.dynamics import advance_steps, report_state

LONGEST = 25  # steps of one stretch
NO_LOOP = 1 << 62  # the step at which a position loop runs that does not
_ROWS_MAX = 128
_OUT_BYTES = 65536
_LINK, _KIND, _INTERVAL_US, _DUE_US, _GRID = range(5)
_SLOW, _SILENT = -1, -2  # instead of a place in KINDS: Python writes it; it is not to be said
_SEQUENCES, _GAP_COUNT, _NEXT_STEP, _EVENTFUL = 2, 4, 5, 6

LINKS = np.dtype(
    [
        ("count", "i8"),
        ("loop_step", "i8"),  # when the position loop runs next, or NO_LOOP
        ("rows", "i8", (_ROWS_MAX, 5)),  # the streams, those of one link together
        # per link: end of what it said, its next sequence number; then how many gaps there are,
        # the step at which somebody speaks next, and whether the autopilot is to look
        ("tally", "i8", 7),
        ("gaps", "i8", (_ROWS_MAX, 4)),  # left to Python: row, link, place in `out`, number
        ("out", "u1", (2, _OUT_BYTES)),
    ],
    align=True,
)
"""What the links of one vehicle say by themselves, and what they said in a stretch."""


class Stretch:
    """The streams of a vehicle's two links, kept for compiled code."""

    def __init__(self, view: View, links: tuple[Server, Server]) -> None:
        self._view, self._seen = view, Seen(view)
        self._links = links
        self._streams: list[tuple[str, Stream]] = []
        self._record = np.zeros(1, LINKS)
        self._rows, self._gaps = self._record["rows"][0], self._record["gaps"][0]
        self._tally, self._out = self._record["tally"][0], self._record["out"][0]
        self._payload = np.zeros(1, payloads.PAYLOAD)
        self._fixed = (self._seen.address, address(self._record), address(self._payload))
        self._next_step = 0
        self._odd = False  # something is silent, stuck or withheld now

    def say(self) -> None:
        """Queue on each link what is due at this step."""
        view = self._view
        if self._odd or view.silent or view.stuck or self._rescheduled:
            self._schedule()
        if view.autopilot.senses.steps >= self._next_step:
            self._seen.note()
            self._fly(0)

    @property
    def possible(self) -> bool:
        """Nothing but streams has either link to say by itself, and none is tampered with."""
        one, other = self._links
        return one.only_streams and other.only_streams and not self._odd

    def prepare(self) -> None:
        """Take over from the autopilot, which rests: what `fly` flies and tells until it wakes."""
        autopilot = self._view.autopilot
        pilot, senses = autopilot.pilot, autopilot.senses
        self._record["loop_step"] = pilot.next_loop_step(senses.steps, senses.look, NO_LOOP)
        autopilot.plant.obey(pilot.demand)
        self._seen.note()

    def fly(self, count: int) -> int:
        """Take the vehicle at most `count` steps on (no more than LONGEST) and queue what is due.

        Ends behind the step in which the ground is touched or left, or one that a slow message
        describes. Returns the steps.
        """
        if self._rescheduled:
            self._schedule()
        return self._fly(count)

    def _fly(self, count: int) -> int:
        autopilot = self._view.autopilot
        one, other = self._links
        self._tally[_SEQUENCES:_GAP_COUNT] = one.outbox.sequence, other.outbox.sequence
        done = _fly.call(
            count,
            autopilot.senses.steps,
            autopilot.plant.address,
            autopilot.pilot.loop.address,
            *self._fixed,
        )
        if done:
            autopilot.plant.flown(done)
            autopilot.senses.moved(done)
        self._deliver()
        return done

    def _deliver(self) -> None:
        """Give each link what it said; ask for what only Python can say."""
        *tally, gap_count, self._next_step, eventful = self._tally.tolist()
        begun = [0, 0]
        if eventful:
            self._view.autopilot.wake()
        if gap_count:
            for row, number, place, sequence in self._gaps[:gap_count].tolist():
                outbox = self._links[number].outbox
                outbox.take(self._out[number, begun[number] : place].tobytes(), sequence)
                outbox.send_now(self._streams[row][0])
                begun[number] = place
        for number, link in enumerate(self._links):
            if tally[number] > begun[number]:
                said = self._out[number, begun[number] : tally[number]].tobytes()
                link.outbox.take(said, tally[_SEQUENCES + number])

    # -- the streams -------------------------------------------------------------------------

    @property
    def _rescheduled(self) -> bool:
        return self._links[0].schedule.changed or self._links[1].schedule.changed

    def _schedule(self) -> None:
        """Take the links' streams, as far as compiled code can write them."""
        view = self._view
        self._hand_back()
        firmware = view.autopilot.firmware
        withheld = {name for name in firmware.streams.withheld_until if view.withheld(name)}
        rows = []
        for number, link in enumerate(self._links):
            link.schedule.changed = False
            for name, stream in link.schedule.streams.items():
                kind = _SLOW
                if name in view.silent or name in withheld:
                    kind = _SILENT
                elif name not in view.stuck and _is_common(view, name):
                    kind = KINDS.index(name)
                grid = firmware.streams.position_grid_steps if name in ON_POSITION_GRID else 1
                rows.append((number, kind, stream.interval_us, stream.due_us, grid))
                self._streams.append((name, stream))
        self._rows[: len(rows)] = np.array(rows, np.int64).reshape(-1, 5)
        self._record["count"] = len(rows)
        self._odd = bool(view.silent or view.stuck or withheld)
        self._next_step = 0

    def _hand_back(self) -> None:
        """Tell the streams when they are due, and forget them."""
        dues = self._rows[: len(self._streams), _DUE_US].tolist()
        for (_, stream), due_us in zip(self._streams, dues, strict=True):
            stream.due_us = due_us
        self._streams.clear()


def _is_common(view: View, name: str) -> bool:
    """Compiled code can write it, and it is not one that the firmware has in a way of its own."""
    return name in KINDS and view.builders[name] is BUILDERS[name]


@entry(
    int,
    int,
    dynamics.RECORD,
    position_law.RECORD,
    seen.RECORD,
    LINKS,
    payloads.PAYLOAD,
)
def _fly(
    count: int,
    step: int,
    plant: Any,
    loop: Any,
    shown: Any,
    links: Any,
    scratch: Any,
) -> int:
    """Fly to the next step at which a link speaks, write what is due, and so on."""
    tally = links.tally
    tally[0] = tally[1] = tally[_GAP_COUNT] = 0
    contact, done, reported = plant.rotor[CONTACT], 0, False
    speaks = step
    while True:
        if count > 0:
            speaks = _next_step(links, step + done)
            goal = min(count, speaks - step)
            while done < goal and plant.rotor[CONTACT] == contact:
                if step + done >= links.loop_step:
                    if not reported:
                        report_state(plant)
                    _hold(plant, loop, shown)
                    links.loop_step = step + done + LOOP_STEPS
                done += advance_steps(min(goal, links.loop_step - step) - done, plant)
                reported = False
        if step + done == speaks:
            if not reported:
                report_state(plant)
            reported = True
            _speak(step + done, plant, shown, links, scratch)
        full = max(tally[0], tally[1]) > _OUT_BYTES - _ROWS_MAX * FRAME_MAX
        if done >= count or full or tally[_GAP_COUNT] or plant.rotor[CONTACT] != contact:
            tally[_NEXT_STEP] = _next_step(links, step + done)
            tally[_EVENTFUL] = tally[_GAP_COUNT] > 0 or plant.rotor[CONTACT] != contact
            return done


@kernel
def _hold(plant: Any, loop: Any, shown: Any) -> None:
    """Run the position loop on the estimate and demand what it gives."""
    for i in range(6):
        loop.estimate[i] = plant.report[i]
    step_loop(loop)
    encode_attitude(loop.attitude, loop.thrust, plant.row)
    for i in range(4):
        shown.attitude[i] = loop.attitude[i]
    shown.thrust = shown.throttle = loop.thrust


@kernel
def _next_step(links: Any, now: int) -> int:
    """The first step behind `now` at which one of the streams speaks."""
    first = NO_LOOP
    for i in range(links.count):
        step = max(now + 1, -(-links.rows[i, _DUE_US] // STEP_US))
        grid = links.rows[i, _GRID]
        first = min(first, -(-step // grid) * grid)
    return first


@kernel
def _speak(now: int, plant: Any, shown: Any, links: Any, scratch: Any) -> None:
    """Write what is due now."""
    tally = links.tally
    time_us = max(0, now * STEP_US + shown.clock_offset_us)
    for i in range(links.count):
        row = links.rows[i]
        if row[_DUE_US] > now * STEP_US or now % row[_GRID]:
            continue
        row[_DUE_US] = (now * STEP_US // row[_INTERVAL_US] + 1) * row[_INTERVAL_US]
        link, kind = row[_LINK], row[_KIND]
        sequence = tally[_SEQUENCES + link]
        if kind == _SILENT:
            continue
        if kind == _SLOW:
            gap = links.gaps[tally[_GAP_COUNT]]
            gap[0], gap[1], gap[2], gap[3] = i, link, tally[link], sequence
            tally[_GAP_COUNT] += 1
        else:
            tally[link] = write_frame(
                kind, plant, shown, time_us, sequence, scratch, links.out[link], tally[link]
            )
        tally[_SEQUENCES + link] = (sequence + 1) & 0xFF
