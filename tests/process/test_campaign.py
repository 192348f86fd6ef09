"""Campaigns: however their flights are flown, the table is the same; what goes wrong on the way."""

from __future__ import annotations

import csv
import io
import json
import os
import shlex
import shutil
import signal
import subprocess
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from processes import CONFIG, SHORT, Called, Spawn, children, ended, eventually
from rich.console import Console

from offboard.campaign import flight, workers
from offboard.campaign.cases import Case, base_cases
from offboard.campaign.document import CampaignFile, Promises
from offboard.campaign.flight import Job
from offboard.campaign.results import Record, Results, code_hash
from offboard.campaign.run import Campaign, Summary
from offboard.campaign.tune import Tuned, Tuning
from offboard.campaign.workers import Workers, cluster_workers, local_workers
from offboard.documents.errors import DocumentError, UserError
from offboard.documents.reading import load_document

# Two flights of a few seconds
FILE = """
controllers: [lqr]
references: [hover]
scenarios: [calm, px4_like]
parameters:
  reference.duration_s: [1]
  reference.height_m: [1]
  identify.excite: [false]
sample:
  draws: 1
  seed: 3
  ranges:
    scenario.conditions.mass_scale: [0.9, 1.1]
    controller.bandwidth_radps: [4, 5]
require: [rmse_position_m<0.05]
"""
TABLE = ("campaign.csv", "campaign.html")
INFEASIBLE = FILE.replace("scenarios: [calm, px4_like]", "scenarios: [calm]").replace(
    "reference.height_m: [1]", "reference.height_m: [1, 400]"
)


def campaign(text: str, directory: Path) -> Campaign:
    file = directory.parent / f"{directory.name}.yaml"
    file.write_text(text)
    return Campaign(*load_document(str(file), "campaign", CampaignFile), directory)


@contextmanager
def inline() -> AbstractContextManager[Workers]:  # type: ignore[misc]
    """One worker in this process, which has loaded the code already."""
    with ThreadPoolExecutor(1) as pool:
        yield Workers(1, lambda: pool)


def fly(
    flown: Campaign,
    open_workers: Callable[[], AbstractContextManager[Workers]] = inline,
    shard: slice = slice(None),
) -> Summary:
    return flown.fly(open_workers, Console(file=io.StringIO()), shard)


def table(directory: Path) -> dict[str, bytes]:
    return {name: (directory / name).read_bytes() for name in TABLE}


def rows(directory: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO((directory / "campaign.csv").read_text())))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Directory of a campaign that was flown without an interruption."""
    directory = tmp_path_factory.mktemp("whole") / "out"
    summary = fly(campaign(FILE, directory))
    assert (summary.missing, summary.stopped, len(summary.rows)) == (0, "", 2)
    return directory


def test_campaign_table_has_a_row_per_flight(whole: Path) -> None:
    found = rows(whole)
    assert [(row["scenario"], row["seed"], row["exit_code"]) for row in found] == [
        (scenario, "1", "0") for scenario in ("calm", "px4_like")
    ]
    assert all(0.9 <= float(row["scenario.conditions.mass_scale"]) <= 1.1 for row in found)
    calm, noisy = found
    assert (calm["success"], calm["failed"]) == ("1", "")  # 0.034 m, without any noise
    assert (noisy["success"], noisy["failed"].split(" is ")[0]) == ("0", "rmse_position_m")
    assert all((whole / path).is_file() for path in map(scenario_file, found))
    assert not any("solve_time" in name or "answer" in name for name in calm)


def scenario_file(row: dict[str, str]) -> str:
    words = shlex.split(row["fly_again"])
    return words[words.index("--scenario") + 1]


def test_each_combination_gets_the_configured_number_of_draws(tmp_path: Path) -> None:
    cases = campaign(FILE.replace("draws: 1", "draws: 3"), tmp_path / "out").cases
    assert [case.scenario for case in cases] == ["calm"] * 3 + ["px4_like"] * 3
    drawn = [dict(case.values) for case in cases]
    for key, least, most in (
        ("scenario.conditions.mass_scale", 0.9, 1.1),
        ("controller.bandwidth_radps", 4.0, 5.0),
    ):
        assert len({values[key] for values in drawn}) >= 3
        assert all(least <= float(values[key]) <= most for values in drawn)


@pytest.mark.usefixtures("in_memory")
def test_command_in_a_table_row_repeats_the_flight(
    whole: Path, tmp_path: Path, called: Called
) -> None:
    row = rows(whole)[1]
    program, *arguments = shlex.split(row["fly_again"])
    arguments[arguments.index("--scenario") + 1] = str(whole / scenario_file(row))
    code, output, _ = called(program, *arguments, "--out", "again")
    assert code == 0, output
    score = json.loads((tmp_path / "again" / "score.json").read_text())
    assert score["rmse_position_m"] == float(row["rmse_position_m"])


def await_flights(process: subprocess.Popen[str], directory: Path, count: int) -> list[Path]:
    """Wait until there are `count` results below `directory`, and return them."""
    deadline_s = time.monotonic() + 120.0
    while len(found := list(directory.glob("*/results/*/*.json"))) < count:
        assert time.monotonic() < deadline_s
        assert process.poll() is None, process.communicate()
        time.sleep(0.02)
    return found


@pytest.fixture(scope="module")
def half(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same campaign after one of two shards."""
    directory = tmp_path_factory.mktemp("half") / "out"
    summary = fly(campaign(FILE, directory), shard=slice(0, None, 2))
    assert (len(summary.rows), summary.missing, summary.mine_missing) == (1, 1, 0)
    return directory


def continued(half: Path, directory: Path) -> Campaign:
    shutil.copytree(half / "results", directory / "results", dirs_exist_ok=True)
    return campaign(FILE, directory)


def test_merged_shards_give_the_same_table(whole: Path, half: Path, tmp_path: Path) -> None:
    shutil.copytree(whole / "results", tmp_path / "out" / "results")
    assert fly(continued(half, tmp_path / "out"), unused).missing == 0
    assert table(tmp_path / "out") == table(whole)


def unused() -> AbstractContextManager[Workers]:
    raise AssertionError("all flights are finished")


def dask_cluster(workers: int) -> Any:
    from distributed import LocalCluster  # slow to import

    return LocalCluster(
        n_workers=workers, threads_per_worker=1, processes=False, dashboard_address=None,
        scheduler_port=0, protocol="tcp",
    )  # fmt: skip


def test_dask_cluster_of_two_workers_gives_the_same_table(
    whole: Path, half: Path, tmp_path: Path
) -> None:
    with dask_cluster(2) as cluster:
        address = cluster.scheduler_address
        summary = fly(continued(half, tmp_path / "out"), partial(cluster_workers, address))
    assert (summary.missing, summary.stopped) == (0, "")
    assert table(tmp_path / "out") == table(whole)


@pytest.mark.slow
def test_lost_dask_scheduler_keeps_finished_flights(tmp_path: Path, spawn: Spawn) -> None:
    (tmp_path / "out.yaml").write_text(FILE.replace("draws: 1", "draws: 3"))
    with dask_cluster(1) as cluster:
        process = spawn(
            "offboard", "campaign", "out.yaml", "--out", "out",
            "--scheduler", cluster.scheduler_address,
        )  # fmt: skip
        await_flights(process, tmp_path, 1)
    _, errors = process.communicate(timeout=60)
    assert (process.returncode, errors.count("\n")) == (4, 1), errors
    assert errors.startswith("the dask scheduler at ")
    assert " was lost: " in errors
    assert 1 <= len(rows(tmp_path / "out")) < 6


@pytest.mark.slow
def test_unreachable_dask_scheduler_is_reported_in_one_sentence(called: Called) -> None:
    for address in ("udp://127.0.0.1:9", "tcp://127.0.0.1:9"):
        code, _, said = called("offboard campaign quick --out x --scheduler", address)
        assert (code, said.count("\n"), address in said) == (2, 1, True), said


def test_infeasible_case_gets_a_row_with_the_reason(tmp_path: Path) -> None:
    flown = campaign(INFEASIBLE, tmp_path / "out")
    fly(flown, shard=slice(1, None, 2))  # the one at 400 m
    (row,) = rows(tmp_path / "out")
    assert (row["exit_code"], row["success"], row["weakest"]) == ("2", "0", "infeasible")
    assert "landing from 400 m takes" in row["failed"]


def test_comparison_without_a_link_says_how_to_resume(called: Called, tmp_path: Path) -> None:
    """A user makes the key and plugs in the vehicle only after the first attempts."""
    command = "offboard compare --controllers lqr --seeds 2 --out x --connect serial:usb:57600"
    for more, why in (("--signing-key none", "signing key none cannot"), ("", "usb")):
        code, output, errors = called(f"{command} {more}")
        assert (code, "already flown" in output) == (4, False), output
        assert why in errors
        assert "2 of 2 flights are missing; go on with the same command and --out x" in errors
    alone = "offboard compare --controllers lqr --seeds 1 --connect serial:usb:57600 --out"
    said = called(alone, "./-b x")[2]
    assert said.endswith(
        ": 1 of 1 flight is missing; go on with the same command and --out './-b x'\n"
    )
    assert not list(tmp_path.glob("x/results/*/*"))


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (("reference.height_m", "seed"), "parameters.seed: give the seeds with seeds"),
        (("[lqr]", "[lqg]"), "there is no controller named 'lqg'"),
        (("conditions.mass_scale", "conditions.mass"), "conditions.mass is not a known key"),
        (("[4, 5]", "[5, 4]"), "the range [5, 4] is empty"),
        (("rmse_position_m<", "rmse<"), "there is no metric 'rmse'"),
        (("[calm, px4_like]", "[calm, calm]"), "a combination is given twice"),
    ],
)
def test_invalid_campaign_file_is_refused(
    change: tuple[str, str], sentence: str, tmp_path: Path
) -> None:
    with pytest.raises(DocumentError) as refused:
        campaign(FILE.replace(*change), tmp_path / "out")
    assert sentence in str(refused.value)
    assert "out.yaml" in str(refused.value)
    assert not (tmp_path / "out").exists()


def test_case_key_depends_on_referenced_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are relative to the file that names them."""
    monkeypatch.chdir(tmp_path)
    mine, shipped = Path("mine"), (CONFIG / "flight.yaml").read_text()
    mine.mkdir()
    (mine / "flight.yaml").write_text(shipped.replace("lemniscate", "path.yaml"))
    (mine / "all.yaml").write_text("config: flight.yaml\nseeds: 1\n")
    (mine / "path.yaml").write_text("shape: table\nfile: path.csv\n")
    keys = set()
    for height_m in (2, 3, 3):
        rows = "".join(f"{10 * row},{row},0,{height_m}\n" for row in range(5))
        (mine / "path.csv").write_text(f"time_s,north_m,east_m,altitude_m\n{rows}")
        file, _ = load_document("mine/all.yaml", "campaign", CampaignFile)
        keys.add(next(base_cases(file)).key)
    assert len(keys) == 2


def test_out_of_memory_is_an_error_not_a_flight_record(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*parts: object, **options: object) -> None:
        raise MemoryError

    monkeypatch.setattr(flight, "fly", full)
    case = Case("flight", "lqr", "hover", None, None, "px4", "calm", 1)
    with pytest.raises(UserError, match="no flight can be flown here: out of memory"):
        flight.fly_job(Job(case, Promises(), code_hash()))


def test_results_of_another_code_version_are_refused_and_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Results(tmp_path, "0123456789ab").put("case", Record(0, "flown and landed", 1.0, "error"))
    with pytest.raises(UserError, match=f"other code .0123456789ab, this is {code_hash()}"):
        campaign(FILE, tmp_path)
    (tmp_path / "results" / ".DS_Store").touch()  # macOS makes one
    assert Results(tmp_path, "0123456789ab").finished() == 1


@pytest.mark.parametrize("name", ["campaign.csv", "campaign.html", "worst.csv"])
def test_foreign_campaign_table_is_not_overwritten(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("mine")
    with pytest.raises(UserError, match=f"{name} exists, without results of a campaign"):
        campaign(FILE, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_tuning_profile_may_have_any_file_name(
    called: Called, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The folder of flights once had the profile's name, so that the profile was not written."""
    better = Tuned((("controller.bandwidth_radps", 5.0),), 5, 2.0, 1.0, 0.01)
    monkeypatch.setattr(Tuning, "run", lambda *_: better)
    assert called("offboard tune tracking --out x.tune")[0] == 0
    assert "bandwidth_radps: 5.0" in (tmp_path / "x.tune").read_text()


def test_campaign_resumes_after_a_full_disk(
    whole: Path, half: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flown = continued(half, tmp_path / "out")
    replace_with, failed = Path.replace, []

    def full(path: Path, target: Path) -> Path:
        if failed or "results" not in path.parts:
            return replace_with(path, target)
        failed.append(path)
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as limited:
        limited.setattr(Path, "replace", full)
        summary = fly(flown)
    assert "cannot be written (No space left on device); finished flights are kept" in (
        summary.stopped
    )
    (kept,) = (tmp_path / "out" / "results").rglob("*.*")
    assert kept.suffix == ".json"
    assert len(rows(tmp_path / "out")) == 1
    stamp = kept.stat().st_mtime_ns
    assert fly(campaign(FILE, tmp_path / "out"), partial(local_workers, 1)).missing == 0
    assert kept.stat().st_mtime_ns == stamp  # none is flown twice
    kept.write_text(json.dumps({**json.loads(kept.read_text()), "margin": "wide"}))
    assert fly(campaign(FILE, tmp_path / "out"), partial(local_workers, 1)).missing == 0
    assert table(tmp_path / "out") == table(whole)


def dies(job: Job) -> Record:
    """End the worker process in the flight with seed 2, and note that in a file."""
    if job.case.seed == 2:
        with (Path(job.code) / "deaths").open("a") as deaths:
            deaths.write("died\n")
        os._exit(1)
    return Record(0, "flown and landed", 1.0, "error")


@pytest.mark.slow
def test_flight_whose_worker_dies_twice_gets_exit_code_4(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(workers, "fly_job", dies)
    case = Case("flight", "lqr", "hover", None, None, "px4", "calm", 1)
    jobs = [
        Job(replace(case, seed=seed), Promises(), str(tmp_path), tmp_path / f"{seed}")
        for seed in (1, 2)
    ]
    with local_workers(1) as opened:
        ended = {job.case.seed: record for job, record in opened.fly(jobs, lambda: False)}
    assert (tmp_path / "deaths").read_text() == "died\n" * 2
    assert ended[1].exit_code == 0
    assert (ended[2].exit_code, ended[2].sentence) == (
        4,
        "the worker process died twice during this flight",
    )


@pytest.mark.slow
def test_kept_flight_directory_appears_only_when_complete(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A flight that ends before that leaves no directory that looks like a kept flight."""
    case = campaign(FILE, tmp_path / "out").cases[0]
    kept = tmp_path / "flights" / case.key
    job = Job(case, Promises(), code_hash(), kept)

    def ends(directory: Path, *score: object) -> None:
        assert (directory / "flight.tlog").is_file()
        raise SystemExit

    with monkeypatch.context() as ending:
        ending.setattr(flight, "keep_score", ends)
        with pytest.raises(SystemExit):
            flight.fly_job(job)
    assert not kept.exists()
    assert flight.fly_job(job).completed
    assert {path.name for path in kept.iterdir()} >= {"flight.tlog", "flight.yaml", "score.json"}


@pytest.mark.slow
def test_killed_or_interrupted_comparison_resumes(spawn: Spawn, tmp_path: Path) -> None:
    """The interrupt goes to the whole group of processes, as from a terminal."""
    command = (
        "offboard", "compare", "--controllers", "lqr", "--reference", "hover", "--scenario", "calm",
        "--seeds", 8, "--workers", 2, "--out", "x", *SHORT,
    )  # fmt: skip
    process = spawn(*command)
    kept = {path: path.stat().st_mtime_ns for path in await_flights(process, tmp_path, 1)}
    process.kill()
    assert process.communicate()[1] == ""  # not even a warning of semaphores
    process = spawn(*command)
    await_flights(process, tmp_path, len(kept) + 2)
    assert {path: path.stat().st_mtime_ns for path in kept} == kept  # none is flown twice
    started = children(process.pid)
    os.killpg(process.pid, signal.SIGINT)
    output, errors = process.communicate(timeout=60)
    assert process.returncode == 4
    assert (errors.count("\n"), "Traceback" in errors) == (1, False)
    assert "interrupted: flights in progress are finished first" in output
    flown = rows(tmp_path / "x")
    assert 3 <= len(flown) <= 7
    assert f"interrupted: {8 - len(flown)} of 8 flights are missing; go on with" in errors
    assert "not flown yet" in (tmp_path / "x" / "campaign.html").read_text(encoding="utf-8")
    assert len(list((tmp_path / "x" / "flights").glob("lqr-hover-calm-*/score.json"))) == len(flown)
    eventually(lambda: all(map(ended, started)))
    process = spawn(*command)
    output, errors = process.communicate(timeout=120)
    assert (process.returncode, errors) == (0, "")
    assert f"8 flights, {len(flown)} already flown\n" in output
    assert "kept: 8 flights; `offboard report x/flights/lqr-hover-calm-" in output
    again = rows(tmp_path / "x")
    assert len(again) == 8
    assert all(row in again for row in flown)
