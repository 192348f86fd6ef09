"""Every controller of the table flies, from its shipped file, through the whole flight."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pair import Pair, decode, make
from pydantic import TypeAdapter

from offboard.control.catalogue import names
from offboard.control.keep_out import KeepOut, clearances
from offboard.flight.phases import Phase

# RMSE in m that is to be undercut in calm; the paper's law has a time constant of 39 s, the
# autopilot's own loop lags
MOST_M = dict.fromkeys(names(), 0.01) | {"paper": 2.5, "autopilot": 1.0}
SHORT = ("reference.laps=1", "reference.period_s=6", "reference.half_length_m=1")


def flying(controller: str, tmp_path: Path, *assignments: str, **options: object) -> Pair:
    """A pair that flies the shipped `controller`."""
    tmp_path.mkdir(exist_ok=True)
    chosen = tmp_path / "chosen.yaml"
    chosen.write_text(f"vehicle: px4_sih\ncontroller: {controller}\nreference: lemniscate\n")
    return make(*assignments, name=str(chosen), **options)


@pytest.mark.parametrize("law", [law for law in names() if law not in ("pso", "autopilot")])
def test_flies_a_short_lemniscate_and_lands(law: str, tmp_path: Path) -> None:
    """`pso` is flown by most other tests, `autopilot` by the next one."""
    pair = flying(law, tmp_path, *SHORT)
    outcome = pair.fly()
    assert (outcome.exit_code, outcome.sentence) == (0, "flown and landed")
    score = pair.score(tmp_path)
    assert score.rmse_position_m < MOST_M[law]
    assert score.tracked_s == pytest.approx(6.0, abs=0.3)
    assert not pair.instance.autopilot.commander.armed


def test_autopilot_gets_positions_while_tracking_and_attitudes_before(tmp_path: Path) -> None:
    pair = flying("autopilot", tmp_path, *SHORT)
    assert pair.fly().exit_code == 0
    assert not pair.instance.autopilot.commander.armed
    sent: dict[Phase, set[str]] = {}
    for _, phase, frame in pair.sent:
        name = decode(frame).get_type()
        if name.startswith("SET_"):
            sent.setdefault(phase, set()).add(name)
    assert sent[Phase.TAKEOFF] == {"SET_ATTITUDE_TARGET"}
    for phase in (Phase.JOIN, Phase.TRACK):
        assert sent[phase] == {"SET_POSITION_TARGET_LOCAL_NED"}
    targets = [
        decode(f) for _, phase, f in pair.sent if phase is Phase.TRACK and f[7:10] == b"T\0\0"
    ]
    assert len(targets) == pytest.approx(60, abs=3)
    assert {target.type_mask for target in targets} == {0}
    score = pair.score(tmp_path)
    assert score.rmse_position_m < MOST_M["autopilot"]
    assert score.tracked_s == pytest.approx(6.0, abs=0.3)
    assert score.setpoint_gap_max_s <= 0.12
    assert score.hover_thrust == pytest.approx(0.4895)  # the observer only listened


AT_THE_TOP = {"shape": "sphere", "north_m": 1.41, "east_m": 1.0, "height_m": 3.0, "radius_m": 0.4}
CROSSING = AT_THE_TOP | {"east_m": -6.0, "velocity_east_mps": 1.0}
TOWER = {"shape": "cylinder", "north_m": -1.41, "east_m": 1.0, "height_m": 3.0, "radius_m": 0.3,
         "length_m": 10.0}  # fmt: skip
SHED = {"shape": "box", "north_m": 1.41, "east_m": -1.0, "height_m": 2.5, "size_north_m": 0.5,
        "size_east_m": 0.7, "size_up_m": 2.0}  # fmt: skip


def flown(law: str, tmp_path: Path, *assignments: str) -> tuple[np.ndarray, np.ndarray, float]:
    """Times (n,) of the reference's axis, true positions (n, 3) from the climb to the landing, and
    the RMSE."""
    pair = flying(law, tmp_path, "reference.laps=1", *assignments, aloft=True)
    times, places = [], []
    advance = pair.advance

    def watched() -> None:
        advance()
        companion = pair.companion
        if companion.phase in (Phase.CLIMB, Phase.JOIN, Phase.TRACK, Phase.HOVER):
            plan = companion.plan
            times.append(plan.track_time_s(companion.time_s))
            truth = np.array(pair.instance.autopilot.state.truth.position_ned_m)
            places.append(truth - plan.origin_ned_m)

    pair.advance = watched  # type: ignore[method-assign]
    pair.track()
    return np.array(times[::5]), np.array(places[::5]), pair.score(tmp_path).rmse_position_m


def nearest_m(volumes: list[dict[str, Any]], times: np.ndarray, places: np.ndarray) -> float:
    keep_out = TypeAdapter(tuple[KeepOut, ...]).validate_python(volumes)
    return float(clearances(keep_out, times, places).min())


@pytest.mark.parametrize(
    "volumes",
    [
        [CROSSING],
        pytest.param([AT_THE_TOP, TOWER], marks=pytest.mark.slow),
        pytest.param([SHED], marks=pytest.mark.slow),
    ],
)
def test_volumes_are_kept_clear_of(volumes: list[dict[str, Any]], tmp_path: Path) -> None:
    keep_out = f"controller.keep_out={json.dumps(volumes)}"
    times, places, rmse_m = flown("horizon", tmp_path, keep_out)
    assert nearest_m(volumes, times, places) > 0.3  # clearance_m
    assert rmse_m < 0.4  # and back to the reference behind them


@pytest.mark.parametrize("law", ["lqr", pytest.param("mpc", marks=pytest.mark.slow)])
def test_others_fly_through(law: str, tmp_path: Path) -> None:
    times, places, _ = flown(law, tmp_path)
    for volume in (AT_THE_TOP, CROSSING, TOWER, SHED):
        assert nearest_m([volume], times, places) < -0.2
