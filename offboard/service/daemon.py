"""The process of the service: locks, page of metrics, configuration, link, supervisor, and loop;
and its systemd unit, from the template beside this module.

The unit runs as a user of its own, which can read only what all users can read, and write only
below its state directory.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from pathlib import Path

from jinja2 import Environment, StrictUndefined
from sdnotify import SystemdNotifier

from offboard import compiled
from offboard.documents.errors import Unavailable, typed
from offboard.flight.phases import WAITING, ExitCode, Outcome, ServiceOptions
from offboard.link import clock
from offboard.link.after_flight import OneByOne
from offboard.link.connection import open_link
from offboard.link.interface import Link
from offboard.link.lock import connection_lock, directory_lock
from offboard.link.stop import StopRequests
from offboard.live.process import LiveProcess
from offboard.mavlink.session import Session
from offboard.run.configuration import FlightConfig
from offboard.run.flight import Connection, discard
from offboard.run.loop import Loop
from offboard.service.flights import Flights
from offboard.service.preparation import Preparation, VehicleFiles
from offboard.service.record import Recorder
from offboard.supervisor.supervisor import Supervisor

LINK_EVERY_S = 2.0  # between two attempts to open the link
WATCHDOG_EVERY_S = 1.0
TEMPLATE = Path(__file__).with_name("offboard.service.j2")
PRIVATE = (Path("/tmp"), Path("/var/tmp"))  # the unit has directories of its own in their place
OTHERS_READ, OTHERS_ENTER = 0o4, 0o1  # permission bits
STOPPED_EARLY = "stopped before the link was open"
UNSCORED = "{number} of the earlier flights without a score: `{command}` makes it"


def run(
    load: Callable[[], FlightConfig],
    vehicle: Connection,
    directory: Path,
    *,
    options: ServiceOptions,
    metrics: str | None = None,
    report: bool = True,
    stops: StopRequests,
    tell: Callable[[str], None],
    show: Callable[[Flights], None],
) -> Outcome:
    """Serve until a stop is requested.

    `load` resolves the configuration, which is read again between flights; `directory` holds the
    directories of the flights. `metrics`: HOST:PORT of the page of metrics; `report`: whether to
    write a report after each flight. `tell` is called with sentences about the preparation, and
    `show` is called often, to show what the flights announce; neither may wait. Raises UserError
    before anything is sent.
    """
    with ExitStack() as stack:
        stack.enter_context(connection_lock(vehicle.address, vehicle.system_id))
        load()  # a wrong configuration is refused before anything starts
        stack.enter_context(directory_lock(directory))
        monitor = LiveProcess("--metrics", metrics) if metrics else None
        if monitor:
            stack.enter_context(closing(monitor)).await_ready()
        signing = vehicle.signing(stack)
        supervisor = stack.enter_context(Supervisor(signing))
        tell("preparing the controller")
        compiled.prepare(tell)
        preparation = stack.enter_context(closing(Preparation(load, tell)))
        supervisor.await_ready()
        scoring = stack.enter_context(closing(OneByOne("report" if report else "score")))
        recorder = Recorder(directory, score=scoring.add)
        stack.callback(recorder.close)
        if recorder.unscored:
            command = typed("offboard", "score", recorder.unscored[-1])
            tell(UNSCORED.format(number=len(recorder.unscored), command=command))
        memory = stack.enter_context(closing(VehicleFiles(directory / "vehicles", tell)))
        manager = Manager()
        link = opened(vehicle.address, stops, tell, manager)
        if link is None:
            tell(STOPPED_EARLY)
            return Outcome(ExitCode.FLOWN, STOPPED_EARLY)
        stack.callback(link.close)
        flights = Flights(
            session=Session(vehicle.settings(link), signing),
            source=preparation,
            record=recorder,
            memory=memory,
            options=options,
            stopwatch=clock.monotonic_s,
        )

        def display() -> None:
            manager.alive(clock.monotonic_s(), flights.phase.value)
            preparation.allowed = flights.phase in WAITING and not flights.current.vehicle.armed
            show(flights)
            if monitor:
                monitor.show(flights)

        preparation.start()
        discard(link)
        tell(f"waiting for a vehicle on {vehicle.address}")
        outcome = Loop(
            flights,
            link,
            recorder,
            stops=stops,
            progress=lambda _: display(),
            supervisor=supervisor,
        ).run()
        manager.tell("STOPPING=1")
        flights.close()
        return outcome


def opened(
    connection: str, stops: StopRequests, tell: Callable[[str], None], manager: Manager
) -> Link | None:
    """Open the link, and try again while a port is in use or a device is not plugged in. Returns
    None if a stop was requested before it was open. Raises UserError for an invalid address."""
    told = ""
    pause = threading.Event()
    while not stops.requested:
        try:
            return open_link(connection)
        except Unavailable as error:
            if str(error) != told:
                told = str(error)
                tell(f"{error}; trying again")
        until_s = clock.monotonic_s() + LINK_EVERY_S
        while clock.monotonic_s() < until_s and not stops.requested:
            manager.alive(clock.monotonic_s())
            pause.wait(0.1)
    return None


class Manager:
    """The service manager (systemd), if there is one. A notice never waits; if the manager has no
    room for it, it is dropped. Readiness, watchdog and status are therefore sent every second."""

    def __init__(self) -> None:
        self._notifier = SystemdNotifier()  # raises nothing
        if self._notifier.socket:
            self._notifier.socket.setblocking(False)
        self._told_s = 0.0
        self._status = ""

    def tell(self, notice: str) -> None:
        """Tell systemd, by the protocol of sd_notify(3)."""
        self._notifier.notify(notice)

    def alive(self, now_s: float, status: str = "") -> None:
        """Tell systemd that the loop runs, and the status: once a second, and if it is new."""
        if now_s - self._told_s >= WATCHDOG_EVERY_S or status != self._status:
            self._told_s, self._status = now_s, status
            self.tell(f"READY=1\nWATCHDOG=1\nSTATUS={status}")


# --- the unit of systemd ---


def unit(arguments: Sequence[str], connection: str, signing_key: Path | None = None) -> str:
    """Return the text of a unit that runs `offboard daemon` with these arguments. They do not
    contain the key. Without `--out` among them, flights are written to the state directory."""
    template = Environment(undefined=StrictUndefined, keep_trailing_newline=True).from_string(
        TEMPLATE.read_text(encoding="utf-8")
    )
    command = [sys.executable, "-P", "-m", "offboard", "daemon", *arguments]
    words = [quoted(word) for word in command]
    if not any(word.startswith("--out") for word in arguments):
        words += ["--out", "%S/offboard"]
    if signing_key:  # not %d, which needs systemd 251
        words += ["--signing-key", "${CREDENTIALS_DIRECTORY}/signing-key"]
    return template.render(
        command=" ".join(words),
        connection=connection.replace("%", "%%"),
        serial=connection.startswith("serial:"),
        signing_key=str(signing_key.absolute()).replace("%", "%%") if signing_key else "",
    )


def unreadable(path: Path) -> str:
    """Why the user of the unit cannot read this file or directory; empty if it can."""
    for place in (path.absolute(), path.resolve()):
        if any(private in place.parents for private in PRIVATE):
            return (
                f"the unit cannot see {place}: it has its own /tmp and /var/tmp; put it elsewhere"
            )
        closed = [each for each in place.parents if not each.stat().st_mode & OTHERS_ENTER]
        if not place.stat().st_mode & OTHERS_READ:
            closed.append(place)
        if closed:
            return f"the user of the unit cannot read {place}: {closed[-1]} is closed to others"
    return ""


def quoted(word: str) -> str:
    """Return a word for ExecStart=, quoted and escaped so that systemd replaces nothing in it."""
    escaped = word.replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%").replace("$", "$$")
    plain = escaped and not any(c.isspace() or c in "\"'\\;" for c in escaped)
    return escaped if plain else f'"{escaped}"'
