"""Controllers of other packages: the one that `offboard.control` documents, and broken ones."""

from __future__ import annotations

import inspect
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
import yaml
from processes import register

import offboard.control
from offboard.analysis import history, tlog
from offboard.analysis.score import score
from offboard.documents.errors import DocumentError
from offboard.run.configuration import dump, flown, load
from offboard.run.flight import Simulated, fly
from offboard.run.sitl import InMemorySimulator


def documented_package(directory: Path) -> None:
    """Write the files of the example in the docstring of `offboard.control`."""
    text = inspect.getdoc(offboard.control) or ""
    example = text[text.index("    # pyproject.toml") : text.index("After `pip install`")]
    for file in textwrap.dedent(example).split("\n# "):
        name, _, content = file.removeprefix("# ").partition("\n")
        if name in ("pyproject.toml", "pd_controller.py"):
            (directory / name).write_text(content)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory of installed packages with the documented one."""
    source, site = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("site")
    documented_package(source)
    install = (sys.executable, "-m", "pip", "install", "--quiet", "--no-deps")
    offline = ("--no-build-isolation", "--no-index", "--disable-pip-version-check")
    subprocess.run((*install, *offline, "--target", site, source), check=True, timeout=120)
    return site


def test_documented_controller_flies(
    site: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.syspath_prepend(site)
    short = ("reference.duration_s=4", "reference.height_m=1", "identify.online=false")
    config = load("flight", choices={"controller": "pd", "reference": "hover"}, assignments=short,
                  seed=7, known_vehicle="px4_sih")  # fmt: skip
    vehicle = Simulated(scenario="calm")
    outcome = fly(config, tmp_path / "x", vehicle, simulator=InMemorySimulator())
    assert (outcome.exit_code, outcome.sentence) == (0, "flown and landed")
    scored = score(history.gather(tlog.read(tmp_path / "x" / "flight.tlog")))
    assert scored.rmse_position_m < 0.03
    kept = yaml.safe_load((tmp_path / "x" / "flight.yaml").read_text())["controller"]
    assert kept == {"law": "pd", "stiffness_ps2": 6.0, "damping_ps": 4.0}
    # its settings are strict
    with pytest.raises(DocumentError, match=r"controller.damping_ps: 0 should be greater than 0"):
        load("flight", choices={"controller": "pd"}, assignments=["controller.damping_ps=0"])
    (tmp_path / "my.yaml").write_text("law: pd\ndamping: 4\n")
    with pytest.raises(DocumentError, match="damping is not a known key, did you mean damping_ps"):
        load("flight", choices={"controller": str(tmp_path / "my.yaml")})


def test_controller_settings_with_extra_keys_are_read_back(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A replay once decided without such settings. One that no longer exists is still dropped."""
    (tmp_path / "anything.py").write_text(
        "from pydantic import model_validator\n"
        "from offboard.control.base import ControllerSettings\n\n\n"
        "class Settings(ControllerSettings, extra='allow'):\n    law: str = 'any'\n\n"
        "    @model_validator(mode='before')\n    @classmethod\n    def check(cls, given):\n"
        "        return {}['none'] if 'broken' in given else given\n\n"
        "    def build(self, vehicle, *, period_s, seed): ...\n"
    )
    register(tmp_path, "first", "pso_offboard.controllers", any="anything:Settings")
    monkeypatch.syspath_prepend(tmp_path)
    config = load("flight", choices={"controller": "any"}, assignments=["controller.gain=3.5"])
    text = dump(config)
    assert flown(text) == config
    with pytest.raises(DocumentError, match=r"flight.yaml: KeyError: 'none' \(.*anything.py:11\)"):
        load("flight", choices={"controller": "any"}, assignments=["controller.broken=1"])
    unknown = config.controller.model_copy(update={"gain": object()})
    with pytest.raises(DocumentError, match=r"the configuration cannot be recorded: .*Unable to"):
        dump(config.model_copy(update={"controller": unknown}))
    assert flown(text.replace("limits:\n", "limits:\n  gone_s: 1.0\n")).limits == config.limits


@pytest.mark.parametrize(
    ("law", "says"),
    [
        ("gone", "law gone of first 1.0 (no_such_module:Law) cannot be used: ModuleNotFoundError: "
                 "No module named 'no_such_module'"),
        ("raises", "law raises of first 1.0 (raising:Law) cannot be used: ZeroDivisionError: "
                   "division by zero ("),
        ("exits", "law exits of first 1.0 (exiting:Law) cannot be used: SystemExit: 3 ("),
        ("function", "law function of first 1.0 (json:loads) cannot be used: <function loads at"),
        ("unbuilt", "law unbuilt of first 1.0 (offboard.control.base:ControllerSettings) cannot be "
                    "used: <class 'offboard.control.base.ControllerSettings'> is not a subclass of "
                    "ControllerSettings with `build`"),
        ("twice", "law twice is defined twice, by first 1.0 (json:loads) and second 1.0"),
        ("nowhere", "there is no controller named 'nowhere'; known are autopilot, exits,"),
    ],
)  # fmt: skip
def test_broken_controller_is_refused_only_when_selected(
    law: str, says: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    site = tmp_path / "site-packages"
    site.mkdir()
    (site / "raising.py").write_text("1 / 0\n")
    (site / "exiting.py").write_text("raise SystemExit(3)\n")
    laws = "pso_offboard.controllers"
    register(
        site, "first", laws, gone="no_such_module:Law", raises="raising:Law", function="json:loads",
        twice="json:loads", pso="no_such_module:Law", exits="exiting:Law",
        unbuilt="offboard.control.base:ControllerSettings",
    )  # fmt: skip
    register(site, "second", laws, twice="json:dumps")
    monkeypatch.syspath_prepend(site)
    with pytest.raises(DocumentError) as refused:
        load("flight", choices={"controller": law})
    (sentence,) = refused.value.problems
    assert sentence.startswith(says)
    assert "\n" not in sentence
    assert not law.endswith("s") or sentence.endswith("ing.py:1)")
    for name in ("pso", "paper"):  # the built-in law and the paper's
        assert load("flight", choices={"controller": name}).controller.law == name
