"""A simulated vehicle in the process of its companion: datagrams are handed over as bytes.

`offboard` finds it as entry point `pso_offboard.simulators` and does not import this package. The
same seed gives the same datagrams as `simulator --lockstep` over UDP.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence

from offboard.compiled import prepare
from offboard.documents.reading import parse
from simulator import config
from simulator.firmware import FIRMWARES
from simulator.instance import Instance

VEHICLE = 0  # sender of the vehicle's datagrams; others count up from it


class InMemoryVehicle:
    """One vehicle in lockstep with one companion, without a ground station.

    Args:
        firmware: "px4" or "ardupilot".
        scenario, vehicle: shipped names or files; None: the defaults of the firmware.
        seed: of all noise.
        parameters: of the autopilot, in place of its defaults.

    Raises:
        DocumentError: scenario or vehicle cannot be used.
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
        personality = FIRMWARES[firmware]
        flown = config.scenario(scenario or personality.scenario)
        config.check_for(flown, personality, lockstep=True)
        flyer = config.vehicle(vehicle or personality.vehicle)
        prepare()
        self._instance = Instance(
            personality,
            flyer,
            flown.conditions,
            seed,
            lockstep=True,
            ground_link=False,
            parameters=parameters,
            faults=flown.faults,
            start=flown.start,
        )
        self._received: deque[bytes] = deque()
        self._stamp_ns: int | None = None  # of the barrier that waits for its answer

    @staticmethod
    def check_scenario(text: str, source: str) -> None:
        """Check the YAML of a scenario, which errors call `source`. Raises DocumentError."""
        parse(text, config.Scenario, source)

    def exchange(self, frames: Sequence[bytes]) -> list[tuple[int, bytes]]:
        """Receive frames of the companion and go on to the next barrier, if they answer this one.

        What was sent after the answer is handled at the next barrier, as over UDP.

        Returns:
            Sender (`VEHICLE`, or another one that a fault adds) and bytes of every datagram since
            the last barrier, which is the last frame. Nothing while the answer is missing.
        """
        instance = self._instance
        self._received.extend(frames)
        while self._received and instance.companion.answered_ns != self._stamp_ns:
            instance.feed(self._received.popleft())
        if self._stamp_ns not in (None, instance.companion.answered_ns):
            return []
        instance.advance_to_barrier()
        self._stamp_ns, datagrams = instance.barrier()
        return [*self._strange(), *((VEHICLE, datagram) for datagram in datagrams)]

    def _strange(self) -> list[tuple[int, bytes]]:
        """Datagrams of senders that are not the vehicle."""
        found: list[tuple[int, bytes]] = []
        for number, datagrams in enumerate(self._instance.strangers, VEHICLE + 1):
            found += [(number, datagram) for datagram in datagrams]
            datagrams.clear()
        return found
