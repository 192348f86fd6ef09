"""The `simulator` command: options in, one vehicle running until it is told to stop."""

from __future__ import annotations

import os
import signal
import sys
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

from offboard.documents import shipped
from simulator.firmware.base import Firmware
from simulator.firmware.catalogue import FIRMWARES

if TYPE_CHECKING:
    from simulator.instance import Instance

COMPANION_PORT, GROUND_PORT = 14540, 14550
LOCAL_COMPANION_PORT, LOCAL_GROUND_PORT = 14580, 18570  # PX4's
ANY_PORT = 0
NO_LINK = "none"
SYSTEM_MAX = 250

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)


def _refuse(sentence: str) -> NoReturn:
    print(sentence, file=sys.stderr)
    raise typer.Exit(2)


@app.command()
def simulate(
    connect: Annotated[
        str | None, typer.Option(help="Companion link: udpout:, udpin: or tcpin:HOST:PORT.")
    ] = None,
    gcs: Annotated[
        str, typer.Option(help=f"Ground station link, or {NO_LINK}.")
    ] = f"udpout:127.0.0.1:{GROUND_PORT}",
    firmware: Annotated[str, typer.Option(help="Whose behaviour: px4 or ardupilot.")] = "px4",
    speed: Annotated[float | None, typer.Option(help="Times real time, 0.1 .. 1000.")] = None,
    lockstep: Annotated[
        bool, typer.Option("--lockstep", help="Virtual time that waits for the companion.")
    ] = False,
    seed: Annotated[int, typer.Option(min=0, max=2**32 - 1, help="Of all randomness.")] = 7,
    scenario: Annotated[
        str | None, typer.Option(help="Name or file; the firmware's own estimator errors.")
    ] = None,
    vehicle: Annotated[
        str | None, typer.Option(help="Name or file; the firmware's SITL vehicle.")
    ] = None,
    param: Annotated[
        list[str] | None, typer.Option(metavar="NAME=VALUE", help="Set a parameter of the vehicle.")
    ] = None,
    duration: Annotated[
        float | None, typer.Option(min=0.0, help="Stop after so many vehicle seconds.")
    ] = None,
    instance: Annotated[
        int, typer.Option(min=0, max=249, help="Shifts ports and the system id, as PX4's.")
    ] = 0,
    instances: Annotated[
        int, typer.Option(min=1, max=100, help="So many vehicles, numbered from --instance on.")
    ] = 1,
    patience: Annotated[
        float | None,
        typer.Option(
            min=0.1,
            max=600.0,
            help="With --lockstep: seconds to wait for a silent companion; 5, and 180 at first.",
        ),
    ] = None,
    strict: Annotated[
        bool, typer.Option("--strict", help="Say and count what the autopilot would swallow.")
    ] = False,
    log: Annotated[
        Path | None,
        typer.Option(
            help="Record the companion link, all vehicles in one, as a .tlog; never overwrites."
        ),
    ] = None,
    check: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Validate a scenario file, and stop.")
    ] = None,
    show_version: Annotated[
        bool, typer.Option("--version", help="Say which one it is, and stop.")
    ] = False,
    list_scenarios: Annotated[
        bool, typer.Option("--list-scenarios", help="Name and describe the scenarios, and stop.")
    ] = False,
) -> None:
    """Fly simulated vehicles that speak MAVLink like a real autopilot; each option for each."""
    if show_version:
        print(f"pso-offboard {version('pso-offboard')}")
        raise typer.Exit(0)
    if list_scenarios:
        _list_scenarios()
    if check is not None:
        _check(check)
    personality = FIRMWARES.get(firmware)
    if personality is None:
        _refuse(f"--firmware {firmware}: unknown; there is {', '.join(FIRMWARES)}")
    if lockstep and speed is not None:
        _refuse("--speed and --lockstep exclude each other: lockstep has no speed")
    if speed is not None and not 0.1 <= speed <= 1000.0:
        _refuse(f"--speed {speed:g}: must be 0.1 .. 1000")
    if lockstep and instances > 1:
        _refuse("--lockstep and --instances exclude each other: time waits for one companion")
    if instance + instances > SYSTEM_MAX:
        _refuse(f"--instance {instance} --instances {instances}: system ids end at {SYSTEM_MAX}")
    stopping = Stop()

    # late, so that a wrong option is answered at once
    from offboard.documents.reading import DocumentError
    from offboard.flight.clock import unix_us
    from simulator import config
    from simulator.link.links import LinkError, open_link, shifted
    from simulator.link.recorder import Recorder

    # PX4's own local ports only in PX4's place: beside a real one they would starve it
    own_ports = connect is None
    connect = connect or f"udpout:127.0.0.1:{COMPANION_PORT + instance}"
    numbers = range(instance, instance + instances)
    try:
        flown = config.scenario(scenario or personality.scenario)
        flyer = config.vehicle(vehicle or personality.vehicle)
        companions = [
            open_link(
                shifted(connect, number - instance),
                LOCAL_COMPANION_PORT + number if own_ports else ANY_PORT,
            )
            for number in numbers
        ]
        grounds = [
            None if gcs == NO_LINK else open_link(gcs, LOCAL_GROUND_PORT + number)
            for number in numbers
        ]
    except (DocumentError, LinkError) as error:
        _refuse(str(error))

    parameters = _parameters(personality, param or [])
    recorder = None
    if log is not None:
        try:
            recorder = Recorder(log)
        except OSError as error:
            _refuse(f"--log {log} cannot be written: {error.strerror}")

    from offboard.model.kernel import Entry
    from simulator.instance import VIRTUAL_EPOCH_US, Instance
    from simulator.run import Endpoint, Runner, warm_up

    if not Entry.all_compiled():
        _tell("compiling the flight dynamics, once (some seconds)")
    Entry.compile_all()
    warm_up(Instance(personality, flyer, flown.conditions, seed, lockstep=True))

    epoch_us = VIRTUAL_EPOCH_US if lockstep else unix_us()
    endpoints = [
        Endpoint(
            Instance(
                personality,
                flyer,
                flown.conditions,
                seed + number - instance,
                system=number + 1,
                lockstep=lockstep,
                ground_link=ground is not None,
                epoch_us=epoch_us,
                faults=flown.faults,
                strict=strict,
            ),
            companion,
            ground,
            recorder,
        )
        for number, companion, ground in zip(numbers, companions, grounds, strict=True)
    ]
    for endpoint in endpoints:
        for name, value in parameters.items():
            endpoint.instance.autopilot.parameters.set(name, value)
    _tell_if_lifted(endpoints[0].instance, flyer.hover_thrust)
    purpose = "waiting at" if connect.startswith("udpin:") else "sending to"
    for number in numbers:
        place = shifted(connect, number - instance).partition(":")[2]
        print(
            f"{firmware} vehicle {flyer.name}, system {number + 1}, scenario {flown.name},"
            f" seed {seed + number - instance}: {purpose} {place}",
            flush=True,
        )
    stopping.running = True
    runner = Runner(endpoints, stopping=stopping, report=_tell, duration_s=duration)
    outcome = runner.lockstep(patience) if lockstep else runner.real_time(speed or 1.0)
    if outcome.sentence:
        _tell(outcome.sentence)
    if instances > 1:
        print(f"{instances} vehicles: {runner.punctuality}", flush=True)
    for endpoint in endpoints:
        for sentence, count in endpoint.instance.complaints.items():
            print(f"{count} x {sentence}", flush=True)
    raise typer.Exit(outcome.code)


def _check(path: Path) -> NoReturn:
    from offboard.documents.reading import DocumentError
    from simulator import config

    try:
        config.scenario(str(path if path.suffix in (".yaml", ".yml") else path.absolute()))
    except DocumentError as error:
        _refuse(str(error))
    print(f"{path}: scenario, valid")
    raise typer.Exit(0)


def _list_scenarios() -> NoReturn:
    from simulator import config

    for name in shipped.names("scenarios"):
        print(f"{name:18s} {config.scenario(name).description}")
    raise typer.Exit(0)


def _parameters(firmware: Firmware, assignments: list[str]) -> dict[str, float]:
    """Values by name, each known and in range; else a sentence."""
    known = {spec.name: spec for spec in firmware.parameters}
    values: dict[str, float] = {}
    for text in assignments:
        name, _, number = text.partition("=")
        if name not in known:
            _refuse(f"--param {text}: {firmware.name} has no parameter {name}")
        spec = known[name]
        try:
            values[name] = float(number)
        except ValueError:
            _refuse(f"--param {text}: give NAME=NUMBER")
        if not spec.minimum <= values[name] <= spec.maximum:
            _refuse(f"--param {text}: must be {spec.minimum:g} .. {spec.maximum:g}")
    return values


def _tell_if_lifted(instance: Instance, hover_thrust: float) -> None:
    """Say that the least thrust is more than the vehicle weighs, as it may be on a real one."""
    firmware, parameters = instance.autopilot.firmware, instance.autopilot.parameters
    least, name = parameters.role("thrust_least"), firmware.parameter_roles["thrust_least"]
    if least >= hover_thrust:
        _tell(
            f"{name} is {least:.3g}, which lifts a vehicle that hovers at {hover_thrust:g}: it will"
            f" not come down; --param {name}=... sets another"
        )


def _tell(sentence: str) -> None:
    print(f"simulator: {sentence}", file=sys.stderr, flush=True)


class Stop:
    """Becomes true with the first SIGTERM or SIGINT; ends the process at once while starting."""

    def __init__(self) -> None:
        self.running = False
        self._noted = False
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._note)

    def _note(self, number: int, frame: object) -> None:
        self._noted = True
        if not self.running:
            os._exit(0)  # nothing is open yet that could be left half done

    def __call__(self) -> bool:
        return self._noted


def main() -> None:
    """Console entry point. Exit codes: 0 stopped, 2 usage or configuration, 3 no companion."""
    app()
