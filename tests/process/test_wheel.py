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


def test_wheel_flies_at_once_with_no_compiler(tmp_path: Path) -> None:
    built = tmp_path / "dist"
    subprocess.run((*BUILD, built), cwd=ROOT, check=True, capture_output=True, timeout=300)
    (wheel,) = built.iterdir()
    assert wheel.suffix == ".whl"
    site, no_compiler, empty = (tmp_path / name for name in ("site", "no_compiler", "empty"))
    zipfile.ZipFile(wheel).extractall(site)
    no_compiler.mkdir()
    (no_compiler / "numba.py").write_text("raise ImportError('no compiler')\n")
    empty.mkdir()

    found = os.pathsep.join(map(str, (no_compiler, site)))
    environment = {**os.environ, "PYTHONPATH": found, "XDG_CACHE_HOME": str(tmp_path / "cache")}
    flight = subprocess.run(
        (sys.executable, "-m", *FLIGHT),
        cwd=empty,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert (flight.returncode, flight.stderr) == (0, "")
    assert "compiled in" not in flight.stdout
    score = json.loads((empty / "x" / "score.json").read_text())
    assert score["rmse_position_m"] < 0.05
    assert not (empty / "offboard").exists()
    assert len(list(tmp_path.glob("cache/**/*.o"))) > 10  # the next start finds them
