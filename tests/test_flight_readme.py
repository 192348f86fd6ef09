"""The tables in offboard/flight/README.md are those of the code.

`python tests/test_flight_readme.py` writes them.
"""

from __future__ import annotations

from pathlib import Path

from offboard.flight import failsafe, transitions

README = Path(__file__).parents[1] / "offboard" / "flight" / "README.md"
TABLES = {"failsafe": failsafe.markdown, "exits": transitions.markdown}


def with_tables(text: str) -> str:
    """The same page with the tables of the code between their markers."""
    for name, table in TABLES.items():
        begin, end = f"<!-- {name}:begin -->\n", f"<!-- {name}:end -->"
        before, _, rest = text.partition(begin)
        _, _, after = rest.partition(end)
        text = f"{before}{begin}{table()}\n{end}{after}"
    return text


def test_the_tables_are_those_of_the_code() -> None:
    text = README.read_text(encoding="utf-8")
    assert len(failsafe.markdown().splitlines()) == len(failsafe.ROWS) + 2
    assert text == with_tables(text)


if __name__ == "__main__":
    README.write_text(with_tables(README.read_text(encoding="utf-8")), encoding="utf-8")
