"""Bad options, files and values, called in this process: one sentence (what, where, what to do) and
exit code 2, before anything is sent or written. What the commands print names the shipped files and
the exit codes."""

from __future__ import annotations

import json
import os
import re
import socket
from collections.abc import Callable
from pathlib import Path

import pytest
import typer
import yaml
from processes import CONFIG, RECORDING, Called
from typer.testing import CliRunner

from offboard.cli.commands import app as offboard
from offboard.documents.errors import UserError
from offboard.run import flight as run
from simulator.command import app as simulator

Refused = Callable[..., str]
FLY = "offboard fly --connect udpin:127.0.0.1:PORT --set limits.connect_s=0.1"
SIMULATOR = "simulator --gcs none"
LONG, DIGITS = 300 * "n", 5000 * "9"
SWARM = "controller.swarm={particles: 10000, iterations: 100000}"
SLOW = "--set controller.steps=40 --set controller.swarm.particles=2000 --set deadline_s=0.0006"
EMPTY, NO_TEXT = "the value is empty; is a variable unset?", r"'caf\udce9' is not UTF-8"
TUNING = """ranges: {controller.%s: [0.1, 0.5]}
training: {scenarios: [%s]}
validation: {scenarios: [gusts]}"""
SPHERE = {"shape": "sphere", "north_m": 0, "east_m": 0, "height_m": 3, "radius_m": 0.5}


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ("--firmware frog", "--firmware frog is unknown; known are px4, ardupilot"),
        ("--connect tcp:127.0.0.1:1", "--sitl starts its own simulator: use --sitl or --connect"),
    ],
)
def test_invalid_sitl_options_are_refused_before_the_build(
    options: str, says: str, refused: Refused, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run, "build", pytest.fail)
    assert says in refused(f"offboard fly --sitl {options}")


@pytest.mark.parametrize(
    ("options", "value", "says"),
    [
        ("--config", "nonsense", "no configuration named 'nonsense'; known are flight, paper"),
        ("--reference", "lemniscte", "'lemniscte', did you mean lemniscate? known are circle"),
        ("--set", "reference.course=no", "course: 'no' should be 'fixed' or 'along_velocity'"),
        ("--reference", "missing.CSV", "missing.CSV cannot be read: No such file"),
        ("--set", "period_s=7", "period_s: 7 should be less than or equal to 0.5"),
        ("--set", "vehicle.mass=3", "vehicle.mass is not a known key, did you mean mass_kg? ("),
        ("--set", "controller.law=frog", "controller.law=frog: law: 'frog' is not one of pso"),
        ("--set", "vehicle.drag_translation_npmps=[0, 0, 1e9]", "must be at most 100 per kg"),
        ("--set limits.land_s=60 --set", "reference.height_m=100", "from 100 m takes 89 s, beyond"),
        ("--reference hover --set", "reference.duration_s=0.2", "a score needs 0.3 s (3 periods)"),
        ("--reference racing --set", "reference.fastest.thrust_mps2=9.9", "than or equal to 10"),
        ("--set", "limits.radius_m=1.5", "it goes 2 m away from the takeoff point, beyond limits"),
        ("--set", "vehicle.hover_thrust=0.92", "0.92 exceeds limits.hover_thrust (0.9)"),
        ("--set", "limits.tilt_rad=0.5", "tilt_max_rad 0.785 exceeds limits.tilt_rad (0.5)"),
        ("--set", SWARM, "particles x iterations must be at most 500000, not 1000000000"),
        ("--require", "rmse<1", "'rmse', did you mean rmse_position_m? there"),
        ("--require", "rmse_position<1", "'rmse_position', did you mean rmse_position_m? there"),
        ("--connect", "udpin:127.0.0.1:0", "port 0 is not within 1 .. 65535"),
        ("--connect", "udpin:127.0.0.1", "is not understood; use udpin:HOST:PORT"),
        ("--connect", "udpin:::1:14540", "an IPv6 address stands in brackets, as in udpin:[::1]"),
        ("--signing-key", "/dev/null", "signing key /dev/null cannot be read: not a regular file"),
        ("--out", "/proc/nowhere", "choose a directory that can be written with --out"),
        ("--firmware", "px4", "--firmware are options of --sitl: add it"),
        ("--vehicle", CONFIG / "campaigns" / "quick.yaml", "is a campaign file; a vehicle file is"),
        ("--out", "--sitl", "--out: '--sitl' is an option, not a value; is a variable unset?"),
        ("--controller horizon --set", f"controller.keep_out={json.dumps([SPHERE])}",
         "keep_out[0] (sphere) contains the start of the reference"),
        (f"{SLOW} --controller", "horizon", "longer than deadline_s or period_s (0.6 ms); plan"),
    ],
)  # fmt: skip
def test_invalid_fly_options_are_refused(
    options: str, value: object, says: str, refused: Refused
) -> None:
    assert says in refused(f"{FLY} {options}", value)


@pytest.mark.parametrize(
    ("command", "says"),
    [
        ("offboard flyy", "No such command 'flyy'"),
        ("offboard doctor gsp", "there is no check named 'gsp'; known are port, vehicle,"),
        ("offboard daemon --print-unit --out here", "can write below /var/lib/offboard alone"),
        ("offboard paper --quick --seeds 20 --table none", "--quick is --seeds 1: use one of them"),
        ("offboard compare --system 3", "are options of --connect"),
        ("offboard compare --connect tcp:1:1 --workers 2", "options of the simulator"),
        ("offboard compare --connect tcp:1 --out x", "is not understood; use udpin:HOST:PORT"),
        ("offboard compare --scenario ,", "--scenario is an empty list of names"),
        ("offboard identify x.tlog --system 3", "a log needs no --system,"),
        ("offboard identify --sitl --system 3", "--system is an option of --connect"),
        (f"{FLY} --seed {DIGITS}", "--seed"),
        ("--connect tcp:127.0.0.1:1", "tcp:127.0.0.1:1 is not a link"),
        ("--param MIS_TAKEOFF_ALT", "--param MIS_TAKEOFF_ALT: give NAME=NUMBER"),
        ("--speed nan", "--speed nan: must be 0.1 .. 1000"),
        ("--speed 2 --lockstep", "exclude each other"),
        ("--seed -1", "--seed"),
        ("--log no/x.tlog", "--log no/x.tlog cannot be written: No such file or directory"),
        ("--instances 20 --instance 240", "system ids end at 250"),
    ],
)
def test_invalid_options_of_other_commands_are_refused(
    command: str, says: str, refused: Refused
) -> None:
    assert says in refused(command if command.startswith("offboard") else f"{SIMULATOR} {command}")


def test_unknown_options_and_missing_values_are_refused(called: Called) -> None:
    for command in (FLY, SIMULATOR):
        for option, says in (("--no-such-option", "No such"), ("--seed", "requires an argument")):
            code, _, said = called(command, option)
            assert (code, said.count("\n"), says in said) == (2, 1, True)


@pytest.mark.parametrize(
    "command",
    [
        *(f"{FLY} --config {LONG}", f"{FLY} --out {LONG}", f'{FLY} --set vehicle.name="\\ud800"'),
        *(f"{FLY} --set controller.{DIGITS}=1", f"{FLY} --connect udpin:127.0.0.1:{DIGITS}"),
        *(f"{FLY} --connect udpin:127.0.0.1:²", f"{FLY} --connect udpin:a..b:14540"),
        *(f"{FLY} --connect serial:/dev/null:9999999999", f"offboard score {LONG}"),
        *(f"{SIMULATOR} --log /dev/full --duration 0.1", f"{SIMULATOR} --duration nan"),
    ],
)
def test_excessive_names_and_numbers_are_refused(command: str, refused: Refused) -> None:
    assert len(refused(command)) < 600


@pytest.mark.parametrize("app", [offboard, simulator], ids=["offboard", "simulator"])
def test_empty_and_non_utf8_values_are_refused(app: typer.Typer) -> None:
    """This holds for each option and argument, as in `--connect "$LINK"` with an unset variable."""
    command = typer.main.get_command(app)
    commands = getattr(command, "commands", {"": command}).values()
    values = [(each, value) for each in commands for value in each.params if value.nargs]
    values = [(each, value) for each, value in values if not getattr(value, "is_flag", False)]
    assert len(values) >= 13
    for each, value in values:
        option, label = value.opts[-1:], value.opts[-1]
        if value.param_type_name == "argument":
            option, label = [], value.metavar
        for text, says in (("", EMPTY), (" \t", EMPTY), (os.fsdecode(b"caf\xe9"), NO_TEXT)):
            with pytest.raises(UserError) as refused:
                each.make_context("command", [*option, text])
            assert str(refused.value) == f"{label}: {says}"


# --- files ---

CSV = "time_s,north_m,east_m,altitude_m\n0,0,0,3\n3,2,0,3\n6,2,{east},4\n9,0,0,3\n"


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("flight.yaml", "vehicle: px4_sih", "flight.yaml: controller is missing"),
        ("flight.yaml", "vehicle: px4_sih\ncontroler: pso",
         "controller is missing (is it meant by controler?); give a name, a file or a"),
        ("flight.yaml", "# nothing yet", "flight.yaml: no key says what it is"),
        ("mine.yaml", "mass_kg: 1\nhover_trust: 1", "did you mean hover_thrust?"),
        ("mine.yaml", "hover_thrust: 0.5", "no key says what it is: a vehicle has mass_kg, a"),
        ("path.csv", CSV.format(east=90), "reference path.csv: the reference requires"),
        ("path.csv", CSV.format(east=1e300), "a distance of inf m at"),
        ("x.yaml", "bandwidth: 3\nlaw: frog", "x.yaml, line 2, column 1: law: 'frog' is not one"),
        ("circle.yaml", "shape: circle\nperiod_s: 0", "circle.yaml, line 2, column 1: period_s: 0"),
        ("storm.yaml", "name: s\nconditions: {thrust_scale: 9}",
         "storm.yaml, line 2, column 14: conditions.thrust_scale: 9 should be less"),
        ("storm.yaml", "name: s\nconditions: {white_noise: {position_m: 0}}",
         "position_m: 0 should be greater than or equal to 0.00005"),
        ("storm.yaml", "name: s\nfaults: [{fault: frogs}]", "column 1: faults.0.fault: 'frogs' is"),
        ("storm.yaml", "name: s\nfaults: [{fault: silent_message, message: NOPE}]",
         "'NOPE' is not a MAVLink message"),
        ("c.yaml", "parameters: {seed: [1]}\nrequire: [x<1]", "require.0: there is no metric 'x'"),
        ("quick", "controllers: [nope]", "quick: there is no controller named 'nope'; known are"),
        ("c.yaml", "scenarios: [c.yaml]", "c.yaml is a campaign file; a scenario file is needed"),
        ("c.yaml", "parameters: {limits.tilt: [1]}", "limits.tilt is not a known key, did"),
        ("t.yaml", TUNING % ("feedback", "calm"), "ranges.controller.feedback is no real number"),
    ],
)  # fmt: skip
def test_check_reports_errors_in_every_kind_of_file(
    name: str, content: str, says: str, called: Called, tmp_path: Path
) -> None:
    (tmp_path / name).write_text(content)
    code, _, said = called("offboard check", name)
    assert (code, "Traceback" in said) == (2, False)
    assert says in said


def test_all_shipped_files_are_valid(called: Called) -> None:
    files = list(CONFIG.rglob("*.yaml"))
    assert len(files) > 44
    assert called("offboard check", *files)[::2] == (0, "")


def test_check_prints_the_first_ten_of_many_errors(called: Called, tmp_path: Path) -> None:
    (tmp_path / "x.yaml").write_text("law: pid\n" + "".join(f"key_{n}: 1\n" for n in range(5000)))
    code, _, said = called("offboard check", "x.yaml")
    lines = said.splitlines()
    assert (code, len(lines), lines[-1]) == (2, 11, "x.yaml: and 4990 more problems")
    assert lines[0].startswith("x.yaml, line 2, column 1: key_0 is not a known key")


FILES: dict[str, Callable[[Path], object]] = {
    "a FIFO": os.mkfifo,
    "/dev/zero": lambda path: path.symlink_to("/dev/zero"),
    "a directory": Path.mkdir,
    "larger than 500 kB": lambda path: path.write_text("# comment\n" * 60_000),
}


@pytest.mark.parametrize("kind", FILES)
def test_only_regular_files_up_to_500_kb_are_read(
    kind: str, refused: Refused, tmp_path: Path
) -> None:
    FILES[kind](tmp_path / "x.yaml")
    reason = kind if kind.startswith("larger") else "not a regular file"
    for command in ("offboard check", "simulator --vehicle"):
        assert f"x.yaml cannot be read: {reason}" in refused(command, "x.yaml")


def test_fly_refuses_a_directory_that_holds_a_flight(refused: Refused, tmp_path: Path) -> None:
    for name in ("flight.yaml", "flight.tlog", "score.json"):
        (tmp_path / name).mkdir()
        (tmp_path / name / name).write_text("precious")
        said = refused(f"{FLY} --out {name}")
        assert said.startswith(f"{name}/{name} exists: the directory already holds a flight;")


@pytest.mark.parametrize(
    ("command", "says"),
    [
        ("offboard paper --quick --table 2 --out x", "is not empty; choose another"),
        (f"offboard identify {RECORDING} -o x/old", "x/old exists already; choose another"),
        (f"offboard identify {RECORDING} -o y/new", "y/new: there is no directory y"),
        (f"offboard identify {RECORDING} --out x", "a log needs no --system, --out or other"),
        (f"{SIMULATOR} --log x/old --duration 0.1", "--log x/old cannot be written: File"),
    ],
)
def test_no_command_overwrites_a_file(
    command: str, says: str, refused: Refused, tmp_path: Path
) -> None:
    (tmp_path / "x").mkdir()
    (tmp_path / "x" / "old").write_text("precious")
    assert says in refused(command)


# --- keys ---


@pytest.mark.parametrize(
    ("command", "content", "mode", "says"),
    [
        ("offboard fly --sitl", "key: 12", 0o600, "signing key k is too short or no key file"),
        ("simulator", "key: " + "ab" * 32, 0o644, "k can be read or changed by other users"),
    ],
)
def test_bad_signing_key_is_refused_without_showing_it(
    command: str, content: str, mode: int, says: str, refused: Refused, tmp_path: Path
) -> None:
    (tmp_path / "k").write_text(content)
    (tmp_path / "k").chmod(mode)
    said = refused(command, "--signing-key", "k")
    assert says in said
    assert "ab" * 32 not in said


def test_key_command_creates_a_key_once_without_printing_it(
    called: Called, refused: Refused, tmp_path: Path
) -> None:
    code, said, _ = called("offboard key my.key")
    assert code == 0
    assert "signing setup PASSPHRASE" in said
    assert "offboard fly --signing-key my.key" in said
    for name, typed in (("my key", "'my key'"), ("./-b x", "'./-b x'")):
        assert f"offboard fly --signing-key {typed}\n" in called("offboard key", name)[1]
    assert (tmp_path / "my.key").read_text().split()[-1] not in said
    assert "my.key exists and is not replaced" in refused("offboard key my.key")
    (tmp_path / "state").write_text("a file")
    said = refused(f"{FLY} --signing-key my.key")
    assert "the time stamp of the signing key cannot be kept" in said


# --- links that cannot be opened ---


@pytest.mark.parametrize(
    ("address", "says"),
    [
        ("tcpin:192.0.2.1:14540", "cannot be opened: Cannot assign requested"),
        ("tcp:127.0.0.1:1", "cannot be opened: Connection refused"),
        ("serial:/dev/nonexistent:57600", "cannot be opened: No such file or directory"),
    ],
)
def test_fly_and_doctor_report_an_unreachable_vehicle_alike(
    address: str, says: str, called: Called
) -> None:
    code, _, said = called("offboard fly --connect", address)
    assert (code, said.count("\n")) == (3, 1)
    assert says in said
    code, told, _ = called("offboard doctor port --connect", address)
    assert (code, told.endswith("\nnot ready to fly, blocked by: port\n")) == (3, True)
    assert says in " ".join(told.split())
    assert "refused" not in says or "fix: start the vehicle, or the router" in told


def test_a_port_in_use_is_refused(called: Called, refused: Refused) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        link = f"udpin:127.0.0.1:{taken.getsockname()[1]}"
        said = refused(f"{SIMULATOR} --connect", link)
        assert said == f"{link} cannot be opened: Address already in use\n"
        code, _, said = called("offboard fly --connect", link)
    assert (code, said.count("\n")) == (3, 1)
    assert f"'{link}' cannot be opened" in said
    assert "another program uses the port" in said
    with socket.create_server(("127.0.0.1", 0)) as served:
        page = f"127.0.0.1:{served.getsockname()[1]}"
        code, _, said = called(f"{FLY} --live", page)
    assert (code, said.count("\n")) == (3, 1)
    assert said.startswith(f"--live: {page} cannot be listened on (Address already in use)")


def test_simulator_warns_of_a_vehicle_too_light_to_land(called: Called, tmp_path: Path) -> None:
    light = (CONFIG / "vehicles" / "px4_sih.yaml").read_text()
    (tmp_path / "light.yaml").write_text(re.sub(r"(hover_thrust:) \S+", r"\1 0.1", light))
    flown = f"{SIMULATOR} --vehicle light.yaml --connect udpout:127.0.0.1:9 --duration 0.1"
    code, _, said = called(flown)
    assert code == 0
    assert "MPC_THR_MIN is 0.12, which lifts a vehicle that hovers at 0.1" in said
    assert called(f"{flown} --param MPC_THR_MIN=0.09")[::2] == (0, "")


# --- what is printed ---

FOLDERS = ("references", "controllers", "vehicles", "scenarios", "campaigns", "tunings", "")
COMMANDS = tuple(typer.main.get_command(offboard).commands)  # type: ignore[attr-defined]
CODES = {"fly": "0 1 2 3 4 130 141", "daemon": "0 2 3 4", "doctor": "0 2 3", "list": "",
         **dict.fromkeys(("check", "report", "export", "key", "paper"), "0 2"),
         **dict.fromkeys(("score", "identify", "replay"), "0 1 2"),
         **dict.fromkeys(("campaign", "compare", "tune"), "0 1 2 4")}  # fmt: skip
NAMED = {"fly": FOLDERS[:4], "compare": FOLDERS[:4], "simulator": FOLDERS[2:4]}


def shipped(folder: str) -> list[Path]:
    return sorted((CONFIG / folder).glob("*.yaml"))


def test_help_lists_exit_codes_and_shipped_files() -> None:
    for command in (*COMMANDS, "simulator"):
        app, words = (simulator, []) if command == "simulator" else (offboard, [command])
        shown = CliRunner().invoke(app, [*words, "--help"], terminal_width=80).output
        codes = re.findall(r"(?:codes:|;)\s+(\d+)\s", shown.partition("Exit")[2])
        assert command == "simulator" or " ".join(codes) == CODES[command], command
        for folder in NAMED.get(command, ()):
            named = set(re.split(r"[\s,.]+", shown))
            assert {path.stem for path in shipped(folder)} <= named


def test_offboard_without_arguments_lists_the_commands(called: Called) -> None:
    code, shown, said = called("offboard")
    assert (code, said) == (2, "")
    assert all(f"\n  {command} " in shown for command in COMMANDS)


def test_list_shows_every_shipped_file_with_its_description(called: Called) -> None:
    lines = CliRunner().invoke(offboard, ["list"]).output.splitlines()
    assert max(map(len, lines)) <= 80
    listed = [tuple(line.split(maxsplit=1)) for line in lines if line.startswith(" ")]
    files = [path for folder in FOLDERS for path in shipped(folder)]
    assert len(files) >= 44
    assert listed == [(p.stem, yaml.safe_load(p.read_text())["description"]) for p in files]
    code, output, _ = called("offboard doctor --list gps")
    assert (code, output.startswith("gps  GPS fix.")) == (0, True)
