"""A whole check: open the link, listen, measure this computer, and give it all to the checks."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from offboard.doctor import ports
from offboard.doctor.bounded import within
from offboard.doctor.listening import Listening
from offboard.doctor.measure import measure
from offboard.doctor.observation import Computer, Observation
from offboard.documents.errors import DocumentError, shown
from offboard.documents.signing_key import read_key
from offboard.link import clock
from offboard.link.connection import open_link
from offboard.link.interface import Link, LinkError
from offboard.link.signing_time import SigningTime
from offboard.mavlink.signing import Signing
from offboard.reference.feasibility import check
from offboard.run.configuration import FlightConfig, build_track

POLL_S = 0.02
# The command ends within 15 s: what takes longer is left out, and a row says so
OPEN_S = 2.0  # to open the link, before listening
LOOK_S = 12.5  # from the beginning to the end of the look at this computer


def observe(
    connection: str,
    config: FlightConfig,
    directory: Path,
    *,
    system_id: int | None = None,
    signing_key: Path | None = None,
) -> Observation:
    """Observe the vehicle at `connection`, the link to it and this computer, for a flight of
    `config` that is recorded in `directory`. Sends nothing that changes the vehicle. `system_id`
    is that of the vehicle, where several send; `signing_key` a key file.

    Raises LinkError for an address that is no address, KeyFileError and SigningTimeError.
    """
    until_s = clock.monotonic_s() + LOOK_S
    key = read_key(signing_key) if signing_key else None
    holders = ports.holders(connection)
    unix_s = clock.monotonic_less_unix_s()
    error = ""
    with ExitStack() as stack:
        try:
            link = within(OPEN_S, lambda: open_link(connection))
            stack.callback(link.close)
        except TimeoutError:
            error = f"connection {shown(connection)} cannot be opened in {OPEN_S:g} s"
            seen = Observation()
        except LinkError as failure:
            if failure.is_usage:
                raise
            error, seen = str(failure), Observation()
        else:
            signing = stack.enter_context(SigningTime(key)) if key else None
            first = not connection.startswith("udpin")
            seen = _listen(link, system_id, signing, sends_first=first)
    step_s = abs(clock.monotonic_less_unix_s() - unix_s)
    seen = replace(
        seen,
        connection=connection,
        link_error=error,
        holders=holders,
        surroundings=ports.surroundings(),
        computer=Computer(str(directory), clock_step_s=step_s),
    )
    left_s = until_s - clock.monotonic_s()
    try:
        return within(
            left_s,
            lambda: replace(
                planned(seen, config), computer=measure(config, directory, clock_step_s=step_s)
            ),
        )
    except TimeoutError:
        return replace(seen, computer=replace(seen.computer, not_measured_s=left_s))


def planned(seen: Observation, config: FlightConfig) -> Observation:
    """The observation with a planned flight."""
    problem, tilt_rad = "", None
    try:
        tilt_rad = check(build_track(config), config.vehicle).tilt_max_rad
    except DocumentError as failure:
        problem = str(failure)
    return replace(seen, config=config, config_problem=problem, tilt_rad=tilt_rad)


def _listen(
    link: Link, system_id: int | None, signing: Signing | None, *, sends_first: bool
) -> Observation:
    listening = Listening(
        clock.monotonic_s(),
        system_id=system_id,
        signing=signing,
        stream=link.is_stream,
        capacity_bytes_ps=link.capacity_bytes_ps,
        sends_first=sends_first,
    )
    while not listening.complete(clock.monotonic_s()):
        for chunk in link.receive(POLL_S):
            listening.take(chunk, -clock.monotonic_less_unix_s())
        for frame in listening.due(clock.monotonic_s()):
            link.send(frame, listening.peer)
    return listening.observation(clock.monotonic_s())
