"""Generates the tables in offboard/flight/README.md: the failsafe, and all exits from the air.

`python tests/flight/flight_tables.py` writes them into the README.
"""

from __future__ import annotations

import re
from pathlib import Path

from offboard.flight import flying
from offboard.flight.conditions import Transition
from offboard.flight.failsafe import ROWS
from offboard.flight.phases import ENDS, FLYING, Limits, Phase, ServiceOptions
from offboard.flight.transitions import table

README = Path(__file__).parents[2] / "offboard" / "flight" / "README.md"
_ASKED = {
    Phase.HAND_BACK: "hold",
    Phase.HOLD: "hold, then land",
    Phase.LAND: "land",
    Phase.STAND_DOWN: "to disarm: it stands on the ground",
}
_DISARMED = (
    flying.disarmed,
    flying.rebooted_disarmed,
    flying.disarmed_not_landed,
    flying.landed,
)
IN_THE_AIR = FLYING | {Phase.LAND}


def asked(row: Transition, source: Phase) -> str:
    """Return what is asked of the autopilot if `row` leaves the phase `source` in the air. Empty if
    nothing is asked although the vehicle is armed and nobody else has it."""
    if row.target is source:
        return "the mode that the pilot flew in before"
    if row.target in _ASKED:
        return _ASKED[row.target]
    if row.cause == "mode change":
        return "nothing: a pilot or a failsafe has it"
    if row.condition in _DISARMED:
        return "nothing: it is disarmed"
    before = _ASKED.get(source)
    return f"{before}, in this phase" if before else ""


def exits(service: ServiceOptions | None) -> list[tuple[Transition, Phase]]:
    """Return the rows of the phase table that lead from a phase in the air to an end phase, or to
    one of _ASKED, each with the phase that it leaves."""
    leaving = ENDS | _ASKED.keys()
    rows = [row for row in table(service) if row.target in leaving]
    return [(row, phase) for row in rows for phase in row.phases if phase in IN_THE_AIR]


def exits_markdown() -> str:
    """Return the table of all exits from the air."""
    lines = ["| condition | in the phases | then | asked of the autopilot |", "|---|---|---|---|"]
    sources: dict[tuple[str, str, str], set[Phase]] = {}
    for row, phase in (*exits(None), *exits(ServiceOptions(then="land"))):
        condition = row.condition.__name__.replace("_", " ")
        sources.setdefault((condition, row.target.value, asked(row, phase)), set()).add(phase)
    for (condition, target, request), phases in sources.items():
        names = ", ".join(phase.value for phase in Phase if phase in phases)
        within = "all that fly" if phases >= FLYING else names
        lines.append(f"| {condition} | {within} | {target} | {request} |")
    return "\n".join(lines)


def with_default(setting: re.Match[str]) -> str:
    """Return the name of a setting of `Limits`, followed by its default."""
    return f"{setting[0]}: {getattr(Limits(), setting[1]):g}"


def failsafe_markdown() -> str:
    """Return the table of the failsafe."""
    lines = ["| row | what is measured | limit | held for | then |", "|---|---|---|---|---|"]
    for row in ROWS:
        then = row.action.name.lower()
        measured = " ".join((row.condition.__doc__ or "").partition(".")[0].split())
        limit = re.sub(r"limits\.(\w+)", with_default, row.limit)
        lines.append(f"| {row.name} | {measured} | {limit} | {row.held_s:g} s | {then} |")
    return "\n".join(lines)


def with_tables(text: str) -> str:
    """Return the README with the tables replaced between their markers."""
    for name, rows in (("failsafe", failsafe_markdown()), ("exits", exits_markdown())):
        begin, end = f"<!-- {name}:begin -->\n", f"<!-- {name}:end -->"
        before, _, rest = text.partition(begin)
        _, _, after = rest.partition(end)
        text = f"{before}{begin}{rows}\n{end}{after}"
    return text


if __name__ == "__main__":
    README.write_text(with_tables(README.read_text(encoding="utf-8")), encoding="utf-8")
