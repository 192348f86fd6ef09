"""The wheel: what a user gets who has no source tree."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

ROOT = Path(__file__).parents[2]
BUILD = (sys.executable, "-m", "hatchling", "build", "--target", "wheel", "--directory")
FLIGHT = (
    "offboard", "fly", "--sitl", "--reference", "hover", "--set", "reference.duration_s=2",
    "--out", "x",
)  # fmt: skip
TEXT = {".py", ".yaml", ".csv", ".md", ".j2", ".txt", ".typed", ".html", ".css", ".js", ""}


def test_a_pure_wheel_flies_from_an_empty_directory_and_an_empty_cache(tmp_path: Path) -> None:
    built = tmp_path / "dist"
    subprocess.run((*BUILD, built), cwd=ROOT, check=True, capture_output=True, timeout=60)
    (wheel,) = built.iterdir()
    assert wheel.name.endswith("-py3-none-any.whl")
    site, empty, cache = (tmp_path / name for name in ("site", "empty", "cache"))
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
        assert {Path(name).suffix for name in archive.namelist()} <= TEXT
    empty.mkdir()

    environment = {**os.environ, "PYTHONPATH": str(site), "XDG_CACHE_HOME": str(cache)}
    flight = subprocess.run(
        (sys.executable, "-m", *FLIGHT),
        cwd=empty,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=150,
    )
    assert (flight.returncode, flight.stderr) == (0, "")
    assert "first run on this machine: compiling" in flight.stdout
    score = json.loads((empty / "x" / "score.json").read_text())
    assert score["rmse_position_m"] < 0.05
    assert not (empty / "offboard").exists()
    assert list(cache.glob("pso-offboard/*/*/*.nbc"))  # the next start finds them
    assert not list(site.rglob("*.nbc"))
