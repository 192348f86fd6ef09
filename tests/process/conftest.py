"""Fixtures of the tests with real processes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from processes import Spawn, free_port, spawning


@pytest.fixture
def port() -> int:
    return free_port()


@pytest.fixture
def spawn(tmp_path: Path) -> Iterator[Spawn]:
    with spawning(tmp_path) as spawn:
        yield spawn
