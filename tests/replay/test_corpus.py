"""Each flight of the corpus, replayed, sends what is expected, except for the rounding of another
computer, on which it was recorded.

`python tests/replay/test_corpus.py` shows what an intended change has changed, then accepts it.
"""

from __future__ import annotations

import pytest
from corpus import expected, names, replayed, unpacked, write_expected

from offboard.replay.difference import compare, explained


@pytest.mark.parametrize("name", names())
def test_corpus_flight_replays_as_expected(name: str) -> None:
    with unpacked(name) as recording:
        replay = replayed(recording)
        comparison = compare(expected(name), replay.replayed)
        assert not replay.stopped
        assert comparison.setpoints > 80
        if comparison.significant:
            lines = explained(recording, comparison.significant[0])
            pytest.fail("\n".join((comparison.sentence(), *lines)), pytrace=False)


def test_corpus_has_at_least_four_flights() -> None:
    assert len(names()) >= 4


def accept() -> None:
    """Print what has changed, and expect from now on what the present code sends."""
    for name in names():
        with unpacked(name) as recording:
            replay = replayed(recording)
            comparison = compare(expected(name), replay.replayed)
            print(f"{name}: {comparison.sentence()}")
            if comparison.significant:
                print("\n".join(explained(recording, comparison.significant[0])))
                write_expected(name, replay.replayed)


if __name__ == "__main__":
    accept()
