"""One simulated vehicle with its two links, without sockets: bytes in, steps, bytes out.

Tests and campaigns drive it byte by byte; `simulator.run` puts sockets and a clock round it. The
same seed and the same bytes in at the same steps give the same bytes out.
"""

from __future__ import annotations

from offboard.model.vehicle import Vehicle
from simulator.autopilot import Autopilot
from simulator.conditions import Conditions
from simulator.firmware.base import Firmware
from simulator.plant import STEP_S, Plant
from simulator.server import Server
from simulator.telemetry import View

STEP_MS = round(STEP_S * 1000)
VIRTUAL_EPOCH_US = 1_767_225_600_000_000  # 2026-01-01, where virtual time begins
BARRIER_INTERVAL_MS = 20
_POSITION_INTERVAL_MS = 8


class Instance:
    """A vehicle in the air or on the ground, its autopilot and its companion and ground links.

    `lockstep` replaces the companion link's TIMESYNC stream by barriers (see `barrier_due`);
    without `ground_link` nothing is built for a ground station.
    """

    def __init__(
        self,
        firmware: Firmware,
        vehicle: Vehicle,
        conditions: Conditions,
        seed: int,
        *,
        system: int = 1,
        lockstep: bool = False,
        ground_link: bool = True,
        epoch_us: int = VIRTUAL_EPOCH_US,
    ) -> None:
        self.autopilot = Autopilot(firmware, Plant(vehicle, conditions, seed))
        view = View(self.autopilot, system, epoch_us)
        self.companion = Server(view, firmware.companion_rates_hz, barrier=lockstep)
        self.ground = Server(view, firmware.ground_rates_hz if ground_link else {})
        self._barrier_ms = 0

    @property
    def time_s(self) -> float:
        """Vehicle time."""
        return self.autopilot.time_s

    @property
    def idle(self) -> bool:
        """Disarmed and on the ground: nothing can happen by itself."""
        return not self.autopilot.armed and self.autopilot.landed

    def advance(self) -> None:
        """One step of STEP_S; what it has to say waits in the links."""
        self.autopilot.step()
        self._spread_texts()
        self.companion.step()
        self.ground.step()

    def step(self) -> list[bytes]:
        """`advance`, and the companion link's datagrams; the ground link's are dropped."""
        self.advance()
        self.ground.drain()
        return self.companion.drain()

    def feed(self, datagram: bytes) -> None:
        """One datagram from the companion, handled at the present vehicle time."""
        self.companion.receive(datagram)
        self._spread_texts()

    def feed_ground(self, datagram: bytes) -> None:
        """One datagram from the ground station."""
        self.ground.receive(datagram)
        self._spread_texts()

    def barrier_due(self) -> bool:
        """Whether lockstep waits here for the companion.

        True at the first step with a position at or after each multiple of 20 ms, so that a
        command takes effect at the stamp of the newest position, as it nearly does in real time.
        """
        now_ms = self.autopilot.steps * STEP_MS
        if now_ms < self._barrier_ms or now_ms % _POSITION_INTERVAL_MS:
            return False
        self._barrier_ms = (now_ms // BARRIER_INTERVAL_MS + 1) * BARRIER_INTERVAL_MS
        return True

    def _spread_texts(self) -> None:
        for said in self.autopilot.texts:
            self.companion.say(said)
            self.ground.say(said)
        self.autopilot.texts.clear()
