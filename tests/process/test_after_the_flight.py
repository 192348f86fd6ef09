"""`fly` with everything that shows a flight: JSON lines, live page, and the report afterwards."""

from __future__ import annotations

import json
import time
from pathlib import Path

from processes import SHORT, Spawn

REPORT_S = 60.0  # for the report on a busy machine


def test_the_report_follows_a_flight_that_does_not_wait_for_it(
    spawn: Spawn, tmp_path: Path
) -> None:
    process = spawn(
        "offboard", "fly", "--sitl", "--scenario", "calm", "--out", "x", *SHORT,
        "--json-lines", "--live", "127.0.0.1:0", OFFBOARD_REPORT="1",
    )  # fmt: skip
    told, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (0, "")
    assert not (tmp_path / "x" / "report.html").exists()
    objects = [json.loads(line) for line in told.splitlines()]
    assert objects[0]["text"].startswith("live: http://127.0.0.1:")
    *others, result = objects
    assert {each["type"] for each in others} == {"preparation", "announcement", "snapshot"}
    assert (result["type"], result["exit_code"], result["completed"]) == ("result", 0, True)
    score = json.loads((tmp_path / "x" / "score.json").read_text())
    assert result["figures"]["rmse_position_m"] == float(f"{score['rmse_position_m']:.9g}")
    times = [each["time_s"] for each in others if each["type"] == "snapshot"]
    assert times[1:] == [float(second) for second in range(1, len(times))]

    deadline_s = time.monotonic() + REPORT_S
    report = tmp_path / "x" / "report.html"
    while not report.exists() and time.monotonic() < deadline_s:
        time.sleep(0.1)
    assert report.read_text(encoding="utf-8").endswith("</html>")
    names = {path.name for path in report.parent.iterdir() if not path.name.startswith(".")}
    assert names == {"flight.tlog", "flight.yaml", "score.json", "report.html"}
