"""The vehicle of the paper (Table 1), read the way a user's file is read."""

from __future__ import annotations

from pathlib import Path

import pytest

from offboard.documents.reading import parse
from offboard.model.vehicle import Vehicle

PAPER_YAML = Path(__file__).parents[2] / "config" / "vehicles" / "paper.yaml"


@pytest.fixture(scope="session")
def paper_vehicle() -> Vehicle:
    return parse(PAPER_YAML.read_text(), Vehicle, PAPER_YAML.name)
