"""The `simulator` command: simulated vehicles that run until they are stopped."""

from __future__ import annotations

import math
import os
import signal
import sys
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from offboard.documents import shipped
from offboard.documents.arguments import Command
from offboard.documents.command_line import complain, tell
from offboard.documents.errors import UserError

if TYPE_CHECKING:
    from simulator.firmware.base import Firmware
    from simulator.instance import Instance

COMPANION_PORT, GROUND_PORT = 14540, 14550
LOCAL_COMPANION_PORT, LOCAL_GROUND_PORT = 14580, 18570  # as PX4 SITL
ANY_PORT = 0
NO_LINK = "none"
SYSTEM_MAX = 250
FILE = "NAME|FILE"  # the name of a shipped file, or a path

GROUND_LINK = f"udpout:127.0.0.1:{GROUND_PORT}"
LINKS = (
    "Companion link: udpout:HOST:PORT, udpin:HOST:PORT or tcpin:HOST:PORT.  "
    f"[default: udpout:127.0.0.1:{COMPANION_PORT}]"
)
PATIENCE = (
    "With --lockstep: longest wait for the companion.  [default: 180 for its first message, then 5]"
)
EXIT_CODES = (
    "Exit codes: 0 stopped; 2 usage or configuration error; 3 no companion, or it fell silent "
    "(--lockstep)."
)

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)


def _option(metavar: str, text: str, **limits: Any) -> Any:
    """A command-line option with a value, named as its parameter."""
    return typer.Option(metavar=metavar, help=text, **limits)


def _refuse(sentence: str) -> NoReturn:
    raise UserError(sentence)


@app.command(cls=Command, epilog=f"{shipped.overview('vehicle', 'scenario')}\n\n{EXIT_CODES}")
def simulate(
    connect: Annotated[str | None, _option("LINK", LINKS)] = None,
    gcs: Annotated[str, _option("LINK", f"Ground station link, or {NO_LINK}.")] = GROUND_LINK,
    firmware: Annotated[str, _option("NAME", "px4 or ardupilot.")] = "px4",
    speed: Annotated[
        float | None, _option("FACTOR", "Multiple of real time, 0.1 .. 1000.  [default: 1]")
    ] = None,
    lockstep: Annotated[
        bool, typer.Option("--lockstep", help="Virtual time that waits for the companion.")
    ] = False,
    seed: Annotated[int, _option("N", "Random seed.", min=0, max=2**32 - 1)] = 7,
    scenario: Annotated[
        str | None, _option(FILE, "Scenario.  [default: estimator errors of the firmware]")
    ] = None,
    vehicle: Annotated[
        str | None, _option(FILE, "Vehicle.  [default: SITL vehicle of the firmware]")
    ] = None,
    param: Annotated[
        list[str] | None, _option("NAME=VALUE", "Set a parameter of the autopilot; repeatable.")
    ] = None,
    duration: Annotated[
        float | None, _option("SECONDS", "Stop after this vehicle time.", min=0.0)
    ] = None,
    instance: Annotated[int, _option("N", "Added to ports and system id.", min=0, max=249)] = 0,
    instances: Annotated[int, _option("N", "Number of vehicles.", min=1, max=100)] = 1,
    patience: Annotated[float | None, _option("SECONDS", PATIENCE, min=0.1, max=600.0)] = None,
    signing_key: Annotated[
        Path | None, _option("FILE", "Sign and require signatures, see `offboard key`.")
    ] = None,
    log: Annotated[
        Path | None, _option("FILE", "Record the companion link as a .tlog; a new file.")
    ] = None,
    check: Annotated[Path | None, _option("FILE", "Check a scenario file and exit.")] = None,
    show_version: Annotated[
        bool, typer.Option("--version", help="Print the version and exit.")
    ] = False,
    list_scenarios: Annotated[
        bool, typer.Option("--list-scenarios", help="List the shipped scenarios and exit.")
    ] = False,
) -> None:
    """Simulate vehicles that speak MAVLink as PX4 or ArduCopter does.

    Every option applies to each of --instances vehicles; seed, ports and system id count up.

    Forwards nothing between its two links, as PX4 without MAV_x_FORWARD; PX4's own SITL and
    ArduPilot forward. A ground station that commands component 191 (`offboard daemon`) needs a
    router on the companion link, for example mavlink-router.
    """
    if show_version:
        print(f"pso-offboard {version('pso-offboard')}")
        raise typer.Exit(0)
    if list_scenarios:
        _list_scenarios()
    if check is not None:
        _check(check)
    if lockstep and speed is not None:
        _refuse("--speed and --lockstep exclude each other: lockstep has no speed")
    if speed is not None and not 0.1 <= speed <= 1000.0:
        _refuse(f"--speed {speed:g}: must be 0.1 .. 1000")
    for option, seconds in (("--duration", duration), ("--patience", patience)):
        if seconds is not None and math.isnan(seconds):
            _refuse(f"{option} nan: must be a number")
    if lockstep and instances > 1:
        _refuse("--lockstep and --instances exclude each other: time waits for one companion")
    if instance + instances > SYSTEM_MAX:
        _refuse(f"--instance {instance} --instances {instances}: system ids end at {SYSTEM_MAX}")
    stopping = Stop()

    # imported late, so that a wrong option is answered at once
    from offboard.compiled import loading, prepare

    with loading():
        from offboard.documents.reading import DocumentError
        from offboard.documents.signing_key import read_key
        from offboard.link.clock import unix_us
        from simulator import config
        from simulator.firmware.catalogue import FIRMWARES
        from simulator.instance import VIRTUAL_EPOCH_US, Instance
        from simulator.link.recorder import Recorder
        from simulator.link.sockets import LinkError, open_beside, open_link, shifted
        from simulator.run import Endpoint, Runner, warm_up

    personality = FIRMWARES.get(firmware)
    if personality is None:
        _refuse(f"--firmware {firmware}: unknown; there is {', '.join(FIRMWARES)}")

    key = read_key(signing_key) if signing_key else b""

    # the local ports of PX4 SITL only by default: a real PX4 beside us may use them
    own_ports = connect is None
    connect = connect or f"udpout:127.0.0.1:{COMPANION_PORT + instance}"
    numbers = range(instance, instance + instances)
    try:
        flown = config.scenario(scenario or personality.scenario)
        config.check_for(flown, personality, lockstep=lockstep)
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

    prepare(_warn)
    warm_up(Instance(personality, flyer, flown.conditions, seed, lockstep=True))

    epoch_us = VIRTUAL_EPOCH_US if lockstep else unix_us()
    endpoints = []
    try:
        for number, companion, ground in zip(numbers, companions, grounds, strict=True):
            vehicle_flown = Instance(
                personality,
                flyer,
                flown.conditions,
                seed + number - instance,
                system=number + 1,
                lockstep=lockstep,
                ground_link=ground is not None,
                epoch_us=epoch_us,
                parameters=parameters,
                faults=flown.faults,
                start=flown.start,
                signing_key=key,
            )
            strangers = tuple(open_beside(companion) for _ in vehicle_flown.strangers)
            endpoints.append(Endpoint(vehicle_flown, companion, ground, recorder, strangers))
    except (DocumentError, LinkError) as error:
        _refuse(str(error))
    _warn_if_it_cannot_land(endpoints[0].instance, flyer.hover_thrust)
    purpose = "waiting at" if connect.startswith("udpin:") else "sending to"
    for number in numbers:
        place = shifted(connect, number - instance).partition(":")[2]
        _print(
            f"{firmware} vehicle {flyer.name}, system {number + 1}, scenario {flown.name},"
            f" seed {seed + number - instance}: {purpose} {place}"
        )
    stopping.running = True
    runner = Runner(endpoints, stopping=stopping, report=_warn, duration_s=duration)
    outcome = runner.lockstep(patience) if lockstep else runner.real_time(speed or 1.0)
    if outcome.sentence:
        _warn(outcome.sentence)
    if instances > 1:
        _print(f"{instances} vehicles: {runner.punctuality}")
    for endpoint in endpoints:
        for sentence, count in endpoint.instance.complaints.items():
            _print(f"{count} x {sentence}")
    raise typer.Exit(outcome.code)


def _check(path: Path) -> NoReturn:
    from offboard.documents.reading import DocumentError
    from simulator import config

    try:
        config.scenario(str(path if path.suffix in (".yaml", ".yml") else path.absolute()))
    except DocumentError as error:
        _refuse(str(error))
    _print(f"{path}: scenario, valid")
    raise typer.Exit(0)


def _list_scenarios() -> NoReturn:
    for name, text in shipped.descriptions("scenarios").items():
        _print(f"{name:16}  {text}")
    raise typer.Exit(0)


def _parameters(firmware: Firmware, assignments: list[str]) -> dict[str, float]:
    """Values by parameter name. Exits where a name is unknown or a value out of range."""
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


def _warn_if_it_cannot_land(instance: Instance, hover_thrust: float) -> None:
    """Warn where the lowest thrust of the autopilot exceeds the vehicle's weight."""
    firmware, parameters = instance.autopilot.firmware, instance.autopilot.parameters
    least, name = parameters.role("thrust_least"), firmware.parameter_roles["thrust_least"]
    if least >= hover_thrust:
        _warn(
            f"{name} is {least:.3g}, which lifts a vehicle that hovers at {hover_thrust:g}: it"
            f" cannot land; change it with --param {name}=VALUE"
        )


def _warn(sentence: str) -> None:
    complain(f"simulator: {sentence}")


def _print(text: str) -> None:
    tell(text, sys.stdout)


class Stop:
    """Whether SIGTERM or SIGINT was received. While the simulator starts, they end the process."""

    def __init__(self) -> None:
        self.running = False
        self._noted = False
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._note)

    def _note(self, number: int, frame: object) -> None:
        self._noted = True
        if not self.running:
            os._exit(0)  # no file or flight has begun

    def __call__(self) -> bool:
        return self._noted
