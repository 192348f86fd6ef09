"""A whole check: open the link, listen, and look at this computer."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from offboard.doctor.computer import holders, measure, surroundings
from offboard.doctor.listening import LONGEST_S, Listening
from offboard.doctor.observation import Computer, Observation
from offboard.documents.errors import DocumentError, shown
from offboard.link import clock
from offboard.link.connection import open_link
from offboard.link.interface import Link, LinkUnavailable
from offboard.mavlink.signing import Signing
from offboard.reference.feasibility import check
from offboard.run.configuration import FlightConfig, build_track
from offboard.run.flight import Connection

Result = TypeVar("Result")
Tell = Callable[[str], None]
POLL_S = 0.02
# The command ends within 15 s: what takes longer is left out, and a row says so
OPEN_S = 2.0  # to open the link, before listening
LOOK_S = 12.5  # from the beginning to the end of the look at this computer


def within(seconds: float, call: Callable[[], Result]) -> Result:
    """What `call` returns or raises, from a thread of its own. Raises TimeoutError after `seconds`:
    the thread is left alone, and the process does not wait for it at its end."""
    future: Future[Result] = Future()

    def run() -> None:
        try:
            future.set_result(call())
        except BaseException as error:
            future.set_exception(error)

    threading.Thread(target=run, daemon=True).start()
    return future.result(max(0.0, seconds))


def observe(
    vehicle: Connection,
    config: FlightConfig,
    directory: Path,
    *,
    tell: Tell = lambda sentence: None,
) -> Observation:
    """Observe the `vehicle`, the link to it and this computer, for a flight of `config` that is
    recorded in `directory`. Sends nothing that changes the vehicle. `tell` is called with sentences
    about the progress.

    Raises LinkError for an address that is no address, KeyFileError and SigningTimeError.
    """
    until_s, connection = clock.monotonic_s() + LOOK_S, vehicle.address
    others = holders(connection)
    unix_s = clock.monotonic_less_unix_s()
    seen, error = Observation(), ""
    with ExitStack() as stack:
        signing = vehicle.signing(stack)
        try:
            link = within(OPEN_S, lambda: open_link(connection))
        except TimeoutError:
            error = f"connection {shown(connection)} cannot be opened in {OPEN_S:g} s"
        except LinkUnavailable as failure:
            error = str(failure)
        else:
            stack.callback(link.close)
            seen = _listen(link, vehicle, signing, tell)
    step_s = abs(clock.monotonic_less_unix_s() - unix_s)
    seen = replace(
        seen,
        connection=connection,
        link_error=error,
        holders=others,
        surroundings=surroundings(),
        computer=Computer(str(directory), clock_step_s=step_s),
    )
    left_s = until_s - clock.monotonic_s()
    tell("looking at this computer")
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


def _listen(link: Link, vehicle: Connection, signing: Signing | None, tell: Tell) -> Observation:
    began_s = clock.monotonic_s()
    listening = Listening(
        began_s,
        system_id=vehicle.system_id,
        signing=signing,
        stream=link.is_stream,
        capacity_bytes_ps=link.capacity_bytes_ps,
        sends_first=vehicle.sends_first,
    )
    while not listening.complete(clock.monotonic_s()):
        for chunk in link.receive(POLL_S):
            listening.take(chunk)
        for frame in listening.due(clock.monotonic_s()):
            link.send(frame, listening.peer)
        heard = listening.vehicle.found.autopilot if listening.vehicle.found else "no vehicle yet"
        passed_s = clock.monotonic_s() - began_s
        tell(f"listening, {passed_s:.0f} s of at most {LONGEST_S:.0f} s: {heard}")
    return listening.observation(clock.monotonic_s())
