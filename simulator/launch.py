"""A run of the `simulator` command: makes vehicles, links and files from the options."""

from __future__ import annotations

import sys

from offboard.compiled import prepare
from offboard.documents.command_line import complain, tell
from offboard.documents.errors import UserError
from offboard.documents.signing_key import read_key
from offboard.link.clock import unix_us
from simulator import config
from simulator.autopilot.firmware import Firmware
from simulator.firmware import FIRMWARES
from simulator.instance import VIRTUAL_EPOCH_US, Instance
from simulator.link.framing import Recorder
from simulator.link.sockets import Link, open_beside, open_link, shifted
from simulator.options import COMPANION_PORT, NO_LINK, Options, Stop
from simulator.run import Endpoint, Runner, warm_up

LOCAL_COMPANION_PORT, LOCAL_GROUND_PORT = 14580, 18570  # local UDP ports of PX4 SITL
ANY_PORT = 0


def launch(options: Options, stopping: Stop) -> int:
    """Run the vehicles until they are stopped, and return the exit code.

    Raises:
        UserError: an option, a link or a file cannot be used.
    """
    firmware = FIRMWARES.get(options.firmware)
    if firmware is None:
        raise UserError(
            f"--firmware {options.firmware} is unknown; known are {', '.join(FIRMWARES)}"
        )
    flown = config.scenario(options.scenario or firmware.scenario)
    config.check_for(flown, firmware, lockstep=options.lockstep)
    vehicle = config.vehicle(options.vehicle or firmware.vehicle)
    links = [_links(options, number) for number in options.numbers]
    parameters, recorder = _parameters(firmware, options.parameters), _recorder(options)
    key = read_key(options.signing_key) if options.signing_key else b""
    epoch_us = VIRTUAL_EPOCH_US if options.lockstep else unix_us()
    prepare(_warn)
    warm_up(Instance(firmware, vehicle, flown.conditions, options.seed, lockstep=True))
    endpoints = []
    for number, (companion, ground) in zip(options.numbers, links, strict=True):
        instance = Instance(
            firmware,
            vehicle,
            flown.conditions,
            options.seed + number - options.numbers[0],
            system=number + 1,
            lockstep=options.lockstep,
            ground_link=ground is not None,
            epoch_us=epoch_us,
            parameters=parameters,
            faults=flown.faults,
            start=flown.start,
            signing_key=key,
        )
        strangers = tuple(open_beside(companion) for _ in instance.strangers)
        endpoints.append(Endpoint(instance, companion, ground, recorder, strangers))
    _warn_if_it_cannot_land(endpoints[0].instance, vehicle.hover_thrust)
    _announce(options, f"{options.firmware} vehicle {vehicle.name}", flown.name)
    stopping.running = True
    runner = Runner(endpoints, stopping, _warn, options.duration_s)
    silence = ""
    if options.lockstep:
        silence = runner.lockstep()
    else:
        runner.real_time(options.speed)
    if silence:
        _warn(silence)
    if len(options.numbers) > 1:
        tell(f"{len(options.numbers)} vehicles: {runner.punctuality}", sys.stdout)
    for endpoint in endpoints:
        for sentence, count in endpoint.instance.refusals.items():
            tell(f"{count} x {sentence}", sys.stdout)
    return 3 if silence else 0


def _companion_link(options: Options) -> str:
    """Return the URL of the companion link of the first instance."""
    return options.connect or f"udpout:127.0.0.1:{COMPANION_PORT + options.numbers[0]}"


def _links(options: Options, number: int) -> tuple[Link, Link | None]:
    """Open the companion link and the ground station link of an instance.

    With `--connect`, any free local port is used: a real PX4 SITL beside ours may use 14580.
    """
    port = ANY_PORT if options.connect else LOCAL_COMPANION_PORT + number
    url = shifted(_companion_link(options), number - options.numbers[0])
    companion = open_link(url, port)
    if port not in (ANY_PORT, companion.port):
        _warn(f"port {port} is in use: another simulator or PX4 may send to {url}, too")
    if options.gcs == NO_LINK:
        return companion, None
    return companion, open_link(options.gcs, LOCAL_GROUND_PORT + number)


def _recorder(options: Options) -> Recorder | None:
    if options.log is None:
        return None
    try:
        return Recorder(options.log)
    except OSError as error:
        sentence = f"--log {options.log} cannot be written: {error.strerror}"
        raise UserError(sentence) from None


def _announce(options: Options, what: str, scenario: str) -> None:
    """Print a line for each vehicle."""
    link, first = _companion_link(options), options.numbers[0]
    purpose = "waiting at" if link.startswith(("udpin:", "tcpin:")) else "sending to"
    for number in options.numbers:
        place = shifted(link, number - first).partition(":")[2]
        tell(
            f"{what}, system {number + 1}, scenario {scenario},"
            f" seed {options.seed + number - first}: {purpose} {place}",
            sys.stdout,
        )


def _parameters(firmware: Firmware, assignments: tuple[str, ...]) -> dict[str, float]:
    """Return values by parameter name. Raises UserError for an unknown name or a value out of
    range."""
    known = {spec.name: spec for spec in firmware.parameters}
    values: dict[str, float] = {}
    for text in assignments:
        name, _, number = text.partition("=")
        try:
            values[name] = float(number)
        except ValueError:
            raise UserError(f"--param {text}: give NAME=NUMBER") from None
        if name not in known:
            raise UserError(f"--param {text}: {firmware.name} has no parameter {name}")
        spec = known[name]
        if not spec.minimum <= values[name] <= spec.maximum:
            raise UserError(f"--param {text}: must be {spec.minimum:g} .. {spec.maximum:g}")
    return values


def _warn_if_it_cannot_land(instance: Instance, hover_thrust: float) -> None:
    """Warn if the least thrust of the autopilot is at least the vehicle's hover thrust."""
    firmware, parameters = instance.autopilot.firmware, instance.autopilot.parameters
    least, name = parameters.role("thrust_least"), firmware.parameter_roles["thrust_least"]
    if least >= hover_thrust:
        _warn(
            f"{name} is {least:.3g}, which lifts a vehicle that hovers at {hover_thrust:g}: it"
            f" cannot land; change it with --param {name}=VALUE"
        )


def _warn(sentence: str) -> None:
    complain(f"simulator: {sentence}")
