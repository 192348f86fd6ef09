"""The table of the ladder in offboard/flight/README.md is that of the code.

`python tests/test_flight_readme.py` writes it.
"""

from __future__ import annotations

from pathlib import Path

from offboard.flight import ladder

README = Path(__file__).parents[1] / "offboard" / "flight" / "README.md"
BEGIN, END = "<!-- ladder:begin -->\n", "<!-- ladder:end -->"


def with_table(text: str) -> str:
    """The same page with the table of the code between its markers."""
    before, _, rest = text.partition(BEGIN)
    _, _, after = rest.partition(END)
    return f"{before}{BEGIN}{ladder.markdown()}\n{END}{after}"


def test_the_ladder_is_that_of_the_code() -> None:
    text = README.read_text(encoding="utf-8")
    assert len(ladder.markdown().splitlines()) == len(ladder.ROWS) + 2
    assert text == with_table(text)


if __name__ == "__main__":
    README.write_text(with_table(README.read_text(encoding="utf-8")), encoding="utf-8")
