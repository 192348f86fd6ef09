"""The bundled simulator in this process, for campaigns: neither socket nor second process.

It is found by entry point, `offboard` never imports `simulator`. A flight is the same, byte for
byte, as in lockstep over UDP, and costs less.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Protocol, cast

from offboard.documents.errors import UserError
from offboard.link import clock
from offboard.link.interface import Chunk, LinkReport
from offboard.run.sitl import Ending

GROUP = "pso_offboard.simulators"
NAME = "bundled"


class InMemoryVehicle(Protocol):
    """A vehicle in lockstep. `exchange` takes frames of the companion and returns sender and bytes
    of the datagrams up to the next barrier; nothing until this barrier is answered."""

    def exchange(self, frames: Sequence[bytes]) -> list[tuple[int, bytes]]: ...


class InMemoryLink:
    """The `Link` to a vehicle in this process. `problem`: the exception that ended the vehicle."""

    is_stream = False
    capacity_bytes_ps: float | None = None
    opened = 0

    def __init__(self, vehicle: InMemoryVehicle) -> None:
        self.report = LinkReport()
        self.problem: Exception | None = None
        self._vehicle = vehicle
        self._sent: list[bytes] = []

    def wait(self, timeout_s: float) -> None: ...

    def receive(self, timeout_s: float) -> list[Chunk]:
        """All datagrams up to the next barrier. Never waits."""
        frames, self._sent = self._sent, []
        if self.problem is not None:
            return []
        try:
            datagrams = self._vehicle.exchange(frames)
        except Exception as error:
            self.problem = error
            return []
        now_s = clock.monotonic_s()
        return [Chunk(data, ("simulator", sender), now_s) for sender, data in datagrams]

    def send(self, data: bytes, peer: Hashable | None) -> None:
        self._sent.append(data)

    def follow(self, peer: Hashable) -> None:
        pass

    def descriptors(self) -> tuple[int, ...]:
        return ()

    def close(self) -> None:
        pass


def check_scenario_text(text: str, source: str) -> None:
    """Let the simulator validate the YAML of a scenario, which errors call `source`. Raises
    DocumentError."""
    registered().load().check_scenario(text, source)


class InMemorySimulator:
    """Takes the place of a `SimulatorProcess`: one vehicle after the other, each in memory."""

    def __init__(self) -> None:
        self._link: InMemoryLink | None = None

    def open_link(
        self,
        *,
        firmware: str,
        scenario: str | None,
        vehicle: str | None,
        seed: int,
        parameters: Mapping[str, float],
    ) -> InMemoryLink:
        """Start a vehicle and return the link to it. Raises DocumentError."""
        make = cast("Callable[..., InMemoryVehicle]", registered().load())
        self._link = InMemoryLink(
            make(
                firmware=firmware,
                scenario=scenario,
                vehicle=vehicle,
                seed=seed,
                parameters=parameters,
            )
        )
        return self._link

    def ended(self, timeout_s: float = 0.0) -> Ending | None:
        """How the vehicle ended, None while it runs."""
        problem = self._link.problem if self._link else None
        if problem is None:
            return None
        return Ending(f"the bundled simulator failed ({type(problem).__name__}: {problem})", False)

    def recall(self) -> None:
        """Drop the vehicle."""
        self._link = None


@cache
def registered() -> EntryPoint:
    """The entry point of the bundled simulator. Raises UserError where it is not installed."""
    for point in entry_points(group=GROUP):
        if point.name == NAME:
            return point
    raise UserError(f"the bundled simulator is not registered ({GROUP}); install the package again")
