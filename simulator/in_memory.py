"""A simulated vehicle in the companion's process: datagrams are passed as bytes, without sockets.

`offboard` finds it by the entry point `pso_offboard.simulators` and does not import this package.
The same seed gives the same datagrams as `simulator --lockstep` over UDP.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence

from offboard.compiled import prepare
from offboard.documents.reading import parse
from simulator import config
from simulator.firmware import FIRMWARES
from simulator.instance import Instance

VEHICLE = 0  # number of the vehicle as a sender of datagrams; other senders have 1, 2, ...


class InMemoryVehicle:
    """One vehicle in lockstep with one companion, without a ground station.

    Args:
        firmware: "px4" or "ardupilot".
        scenario, vehicle: shipped name or file; None: the default of the firmware.
        seed: seed of all noise.
        parameters: values of autopilot parameters that replace the defaults.

    Raises:
        DocumentError: the scenario or the vehicle cannot be used.
    """

    def __init__(
        self,
        *,
        firmware: str,
        scenario: str | None,
        vehicle: str | None,
        seed: int,
        parameters: Mapping[str, float],
    ) -> None:
        autopilot = FIRMWARES[firmware]
        known_scenario = config.scenario(scenario or autopilot.scenario)
        config.check_for(known_scenario, autopilot, lockstep=True)
        known_vehicle = config.vehicle(vehicle or autopilot.vehicle)
        prepare()
        self._instance = Instance(
            autopilot,
            known_vehicle,
            known_scenario.conditions,
            seed,
            lockstep=True,
            ground_link=False,
            parameters=parameters,
            faults=known_scenario.faults,
            start=known_scenario.start,
        )
        self._received: deque[bytes] = deque()
        self._stamp_ns: int | None = None  # time stamp of the barrier that is not answered yet

    @staticmethod
    def check_scenario(text: str, source: str) -> None:
        """Check the YAML text of a scenario. `source` names it in errors. Raises DocumentError."""
        parse(text, config.Scenario, source, "scenario")

    def exchange(self, frames: Sequence[bytes]) -> list[tuple[int, bytes]]:
        """Handle frames of the companion; if they answer the present barrier, advance to the next.

        Frames after the answer are handled at the next barrier, as over UDP.

        Returns:
            Sender (`VEHICLE`, or the number of a sender that a fault adds) and bytes of every
            datagram since the last barrier; the last frame is the request of the new barrier. An
            empty list while the answer is missing.
        """
        instance = self._instance
        self._received.extend(frames)
        while self._received and instance.companion.answered_ns != self._stamp_ns:
            instance.feed(self._received.popleft())
        if self._stamp_ns not in (None, instance.companion.answered_ns):
            return []
        instance.advance_to_barrier()
        self._stamp_ns, datagrams = instance.barrier()
        return [*self._of_strangers(), *((VEHICLE, datagram) for datagram in datagrams)]

    def _of_strangers(self) -> list[tuple[int, bytes]]:
        """Number and datagram of each sender that is not the vehicle, since the last call."""
        found: list[tuple[int, bytes]] = []
        for number, datagrams in enumerate(self._instance.strangers, VEHICLE + 1):
            found += [(number, datagram) for datagram in datagrams]
            datagrams.clear()
        return found
