"""The `simulator` command: simulated vehicles that run until they are stopped."""

from __future__ import annotations

import math
from importlib.metadata import version
from pathlib import Path
from typing import Annotated

import typer

from offboard.documents import shipped
from offboard.documents.arguments import FILE, Command, option
from offboard.documents.errors import UserError
from simulator.options import COMPANION_PORT, NO_LINK, Options, Stop

GROUND_PORT = 14550
SYSTEM_MAX = 250

GROUND_LINK = f"udpout:127.0.0.1:{GROUND_PORT}"
LINKS = (
    "Flight link: udpout:HOST:PORT, udpin:HOST:PORT or tcpin:HOST:PORT.  "
    f"[default: udpout:127.0.0.1:{COMPANION_PORT}]"
)
EXIT_CODES = (
    "Exit codes: 0 stopped; 2 usage or configuration error; 3 (--lockstep) no companion answered, "
    "or it stopped answering."
)

app = typer.Typer(add_completion=False, rich_markup_mode=None)


@app.command(cls=Command, epilog=f"{shipped.overview('vehicle', 'scenario')}\n\n{EXIT_CODES}")
def simulate(
    connect: Annotated[str | None, option("LINK", LINKS)] = None,
    gcs: Annotated[str, option("LINK", f"Ground station link, or {NO_LINK}.")] = GROUND_LINK,
    firmware: Annotated[str, option("NAME", "px4 or ardupilot.")] = "px4",
    speed: Annotated[
        float | None, option("FACTOR", "Multiple of real time, 0.1 .. 1000.  [default: 1]")
    ] = None,
    lockstep: Annotated[
        bool, typer.Option("--lockstep", help="Virtual time that waits for the companion.")
    ] = False,
    seed: Annotated[int, option("N", "Random seed.", min=0, max=2**32 - 1)] = 7,
    scenario: Annotated[
        str | None, option(FILE, "Scenario.  [default: estimator errors of the firmware]")
    ] = None,
    vehicle: Annotated[
        str | None, option(FILE, "Vehicle.  [default: SITL vehicle of the firmware]")
    ] = None,
    param: Annotated[
        list[str] | None, option("NAME=VALUE", "Set a parameter of the autopilot; repeatable.")
    ] = None,
    duration: Annotated[
        float | None, option("SECONDS", "Stop after this vehicle time.", min=0.0)
    ] = None,
    instance: Annotated[
        int, option("N", "Number of the first vehicle: for system id and ports.", min=0, max=249)
    ] = 0,
    instances: Annotated[int, option("N", "Number of vehicles.", min=1, max=100)] = 1,
    signing_key: Annotated[
        Path | None, option("FILE", "Sign and require signatures, see `offboard key`.")
    ] = None,
    log: Annotated[
        Path | None, option("FILE", "Record the companion link as a .tlog; a new file.")
    ] = None,
    show_version: Annotated[
        bool, typer.Option("--version", help="Print the version and exit.")
    ] = False,
) -> None:
    """Simulate vehicles that speak MAVLink as PX4 or ArduCopter does.

    Every option applies to each of the --instances vehicles; seed, ports and system id count up.
    """
    if show_version:
        print(f"pso-offboard {version('pso-offboard')}")
        raise typer.Exit(0)
    if duration is not None and math.isnan(duration):
        raise UserError("--duration nan: must be a number")
    _check_speed(speed, lockstep=lockstep)
    _check_numbers(instance, instances, lockstep=lockstep)
    stopping = Stop()
    options = Options(
        connect=connect,
        gcs=gcs,
        firmware=firmware,
        speed=1.0 if speed is None else speed,
        lockstep=lockstep,
        seed=seed,
        scenario=scenario,
        vehicle=vehicle,
        parameters=tuple(param or ()),
        duration_s=math.inf if duration is None else duration,
        numbers=range(instance, instance + instances),
        signing_key=signing_key,
        log=log,
    )
    from simulator.launch import launch  # imported late: a wrong option is reported at once

    raise typer.Exit(launch(options, stopping))


def _check_speed(speed: float | None, *, lockstep: bool) -> None:
    if lockstep and speed is not None:
        raise UserError("--speed and --lockstep exclude each other: lockstep has no speed")
    if speed is not None and not 0.1 <= speed <= 1000.0:
        raise UserError(f"--speed {speed:g}: must be 0.1 .. 1000")


def _check_numbers(instance: int, instances: int, *, lockstep: bool) -> None:
    if lockstep and instances > 1:
        raise UserError(
            "--lockstep and --instances exclude each other: time waits for one companion"
        )
    if instance + instances > SYSTEM_MAX:
        raise UserError(
            f"--instance {instance} --instances {instances}: system ids end at {SYSTEM_MAX}"
        )
