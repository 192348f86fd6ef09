"""Compares the setpoints and commands of two runs of the same flight, and shows the input before
the first difference.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from offboard.analysis.tlog import LoggedMessage, layout, name_of
from offboard.documents.errors import UserError
from offboard.flight.record import TurnInput
from offboard.mavlink.framing import SETPOINTS
from offboard.mavlink.senders import COMMANDS
from offboard.replay.replaying import Recording, Replay, Sent

# Greatest difference of a field that counts as rounding, relative to its value or to 1. Two x86-64
# processors differed by up to 1e-8 rad and 6e-8 of thrust
ROUNDING = 1e-6
_UNSTAMPED = ("time_boot_ms", "target_system", "target_component")  # not shown as differing fields
FIELDS_MAX = 8  # greatest number of fields that are shown of a difference
TOLD_EVERY = 500  # turns between two sentences about the progress
Key = tuple[float, int, bytes, int]  # see `_by_key`


@dataclass(frozen=True, slots=True)
class Difference:
    """A message that differs. `expected` or `actual` is None if that run has not sent it."""

    expected: Sent | None
    actual: Sent | None

    @property
    def time_s(self) -> float:
        """Vehicle time of the newest telemetry before the message."""
        return self._either.time_s

    @property
    def name(self) -> str:
        return name_of(self._either.message_id)

    def fields(self) -> list[tuple[str, float, float, float]]:
        """Return name, expected value, actual value and difference of each field that differs."""
        if self.expected is None or self.actual is None:
            return []
        before, after = _fields(self.expected), _fields(self.actual)
        return [
            (name, value, after[name], abs(after[name] - value))
            for name, value in before.items()
            if value != after[name] and not (math.isnan(value) and math.isnan(after[name]))
        ]

    def is_rounding(self) -> bool:
        """Whether the setpoints differ only by rounding, see `ROUNDING`."""
        fields = self.fields()
        return (
            self._either.message_id in SETPOINTS
            and bool(fields)
            and all(by <= ROUNDING * max(1.0, abs(value)) for _, value, _, by in fields)
        )

    @property
    def _either(self) -> Sent:
        either = self.expected or self.actual
        assert either is not None
        return either


@dataclass(frozen=True, slots=True)
class Comparison:
    """`compared` counts the compared messages by id; `differences` are in the order of time."""

    compared: Counter[int]
    differences: tuple[Difference, ...]

    @property
    def setpoints(self) -> int:
        return sum(self.compared[kind] for kind in SETPOINTS)

    @property
    def commands(self) -> int:
        return sum(self.compared[kind] for kind in COMMANDS)

    @property
    def significant(self) -> tuple[Difference, ...]:
        """The differences that are more than rounding."""
        return tuple(each for each in self.differences if not each.is_rounding())

    def sentence(self) -> str:
        """Return a sentence that says what was compared and how much differs."""
        total = f"{self.setpoints} setpoints and {self.commands} commands"
        if not self.differences:
            return f"{total}: all identical"
        alone = sum(each.expected is None or each.actual is None for each in self.differences)
        changed = [field for each in self.differences for field in each.fields()]
        changes = [(by, name) for name, *_, by in changed if not math.isnan(by)]
        largest, name = max(changes, default=(0.0, "any field"))
        sentence = (
            f"{len(self.differences)} of {total} differ; largest difference {largest:.3g} of {name}"
        )
        if alone:
            return f"{sentence}; {alone} were sent on one side only"
        return sentence if self.significant else f"{sentence}: rounding of another computer"


def compare(expected: Iterable[Sent], actual: Iterable[Sent]) -> Comparison:
    """Compare the payloads of setpoints and commands. Messages of both runs are matched by message
    id, time stamp and the vehicle time at which they were sent (see `_by_key`)."""
    first, second = _by_key(expected), _by_key(actual)
    keys = sorted(first.keys() | second.keys())
    differences = tuple(
        Difference(first.get(key), second.get(key))
        for key in keys
        if key not in first or key not in second or first[key].payload != second[key].payload
    )
    return Comparison(Counter(key[1] for key in keys), differences)


def _by_key(sent: Iterable[Sent]) -> dict[Key, Sent]:
    """Return messages by key: vehicle time, message id, time stamp of a setpoint or number of a
    command (MAV_CMD), and the number of messages before that are equal in all of these."""
    found: dict[Key, Sent] = {}
    counts: defaultdict[tuple[float, int, bytes], int] = defaultdict(int)
    for each in sent:
        if each.message_id in (*SETPOINTS, *COMMANDS):
            at = slice(0, 4) if each.message_id in SETPOINTS else slice(28, 30)
            key = (each.time_s, each.message_id, each.payload[at])
            found[*key, counts[key]] = each
            counts[key] += 1
    return found


def _fields(sent: Sent) -> dict[str, float]:
    kind = layout(name_of(sent.message_id))
    (row,) = np.frombuffer(sent.payload[: kind.itemsize].ljust(kind.itemsize, b"\0"), kind)
    names = [name for name in row.dtype.names or () if name not in _UNSTAMPED]
    return {
        f"{name}[{at}]" if row[name].size > 1 else name: float(value)
        for name in names
        for at, value in enumerate(np.atleast_1d(row[name]).ravel())
    }


# ------------------------------------------------------------------ a replay and its log


def verdict(replay: Replay, tell: Callable[[str], object] = str) -> Comparison:
    """Replay a flight to its end, and compare it with its log. `tell` is called with a sentence
    about the progress from time to time. Raises UserError if nothing can be compared."""
    for _ in replay.turns():
        if replay.count % TOLD_EVERY == 0:
            tell(f"replayed up to {replay.ended_s:.0f} s of vehicle time")
    comparison = compare(replay.recorded, replay.replayed)
    if not comparison.compared.total():
        why = replay.stopped or "the log holds no setpoint and no command"
        raise UserError(f"{replay.recording.log.path}: nothing to compare: {why}")
    return comparison


def explained(recording: Recording, difference: Difference) -> list[str]:
    """Return lines that show a difference field by field, and the input of its turn."""
    name = f"{difference.name} at {difference.time_s:.3f} s"
    if difference.expected is None:
        lines = [f"{name} was not sent in the recorded flight"]
    elif difference.actual is None:
        lines = [f"{name} was not sent in the replay"]
    else:
        lines = [f"{name}:"]
        lines += [
            f"  {field}: {before:.9g} in the log, {after:.9g} in the replay, by {by:.3g}"
            for field, before, after, by in difference.fields()[:FIELDS_MAX]
        ]
    return lines + _input(recording, difference)


def _input(recording: Recording, difference: Difference) -> list[str]:
    """Return lines that show the input of the turn that sent the differing message. For that the
    flight is replayed again up to this turn."""
    replay = Replay(recording)
    number = difference.actual.turn if difference.actual else None
    for turn in replay.turns():
        due = replay.ended_s >= difference.time_s if number is None else replay.count == number
        if due:
            tick = int(replay.ended_s / replay.config.period_s + 1e-6)
            lines = [f"decided in turn {replay.count}, tick {tick}, which was given:"]
            rows = _received(*turn) or [("nothing", "no message had arrived")]
            return lines + [f"  {when}: {names}" for when, names in rows]
    return []


def _received(given: TurnInput, received: Sequence[LoggedMessage]) -> list[tuple[str, str]]:
    """Return the messages that a turn was given, and how long before it they arrived."""
    frames = iter(received)
    rows: list[tuple[str, str]] = []
    for chunk in given.chunks:
        names = [next(frames).name for _ in range(chunk.frames)]
        age_ms = 1e3 * (given.now_s - chunk.arrived_s)
        rows.append((f"{age_ms:.3f} ms before", ", ".join(names) or "nothing that was used"))
    return rows
