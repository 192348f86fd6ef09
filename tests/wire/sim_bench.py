"""A companion in memory for tests of the simulator: pymavlink on one side, an Instance behind."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

from pymavlink.dialects.v20 import all as mavlink

from offboard.model.vehicle import Vehicle
from simulator import config
from simulator.config import Scenario
from simulator.firmware.base import Firmware
from simulator.firmware.px4 import PX4
from simulator.instance import Instance
from simulator.steps import STEP_S
from simulator.vehicle.conditions import Conditions
from simulator.vehicle.sensors import EstimatorName

OFFBOARD, LOITER, POSCTL = 0x00060000, 0x03040000, 0x00030000
TAKEOFF, LAND, RTL = 0x02040000, 0x06040000, 0x05040000
HOVER = 0.4895
NAN = math.nan
STEPS_PER_HEARTBEAT = 250


def px4_vehicle() -> Vehicle:
    return config.vehicle("px4_sih")


class Bench:
    """One instance and what its companion link has sent so far, as (vehicle time, message)."""

    def __init__(
        self,
        estimator: EstimatorName = EstimatorName.PERFECT,
        *,
        seed: int = 1,
        heartbeat_type: int | None = mavlink.MAV_TYPE_GCS,
        system: int = 1,
        ground_link: bool = False,
        firmware: Firmware = PX4,
        boot_scale: float = 1.0,
        strict: bool = False,
        vehicle: Vehicle | None = None,
        scenario: Scenario | None = None,
    ) -> None:
        conditions = Conditions(estimator=estimator, boot_scale=boot_scale)
        if scenario is not None:
            conditions = scenario.conditions
        vehicle = vehicle or config.vehicle(firmware.vehicle)
        self.instance = Instance(
            firmware,
            vehicle,
            conditions,
            seed,
            system=system,
            ground_link=ground_link,
            faults=() if scenario is None else scenario.faults,
            start=None if scenario is None else scenario.start,
        )
        self.system = system
        self.codec = mavlink.MAVLink(None, srcSystem=1, srcComponent=191)
        self.raw = bytearray()
        self._received: list[tuple[float, Any]] = []
        self._unread: list[tuple[float, bytes]] = []
        self._parser = mavlink.MAVLink(None)
        self.heartbeat_type = heartbeat_type
        self._heartbeat()

    @property
    def time_s(self) -> float:
        return self.instance.time_s

    @property
    def height_m(self) -> float:
        return -float(self.instance.autopilot.state.truth.position_ned_m[2])

    # -- sending -----------------------------------------------------------------------------

    def send(self, message: Any) -> None:
        self.instance.feed(message.pack(self.codec))

    def _heartbeat(self) -> None:
        if self.heartbeat_type is not None:
            self.send(mavlink.MAVLink_heartbeat_message(self.heartbeat_type, 8, 0, 0, 4, 3))

    def command(self, number: int, *params: float, to: tuple[int, int] | None = None) -> list[int]:
        """Send COMMAND_LONG, let a moment pass and return the results of its acks."""
        system, component = (self.system, 1) if to is None else to
        filled = (*params, *(0.0,) * (7 - len(params)))
        self.send(mavlink.MAVLink_command_long_message(system, component, number, 0, *filled))
        since_s = self.time_s
        self.run(0.02)
        return [
            message.result
            for at_s, message in self.of("COMMAND_ACK")
            if at_s > since_s and message.command == number
        ]

    def ask_mode(self, custom_mode: int) -> list[int]:
        return self.command(176, 1, custom_mode >> 16 & 0xFF, custom_mode >> 24)

    def attitude(
        self,
        quaternion: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0),
        thrust: float = HOVER,
        mask: int = 7,
        rates: tuple[float, float, float] = (0.0, 0.0, 0.0),
        to: tuple[int, int] | None = None,
    ) -> None:
        system, component = (self.system, 1) if to is None else to
        self.send(
            mavlink.MAVLink_set_attitude_target_message(
                0, system, component, mask, quaternion, *rates, thrust
            )
        )

    def position(self, x: float, y: float, z: float, mask: int = 2552, frame: int = 1) -> None:
        self.send(
            mavlink.MAVLink_set_position_target_local_ned_message(
                0, self.system, 1, frame, mask, x, y, z, *(0.0,) * 8
            )
        )

    # -- time --------------------------------------------------------------------------------

    def run(
        self, duration_s: float, each: Callable[[], None] | None = None, period_s: float = 0.05
    ) -> None:
        """Let vehicle time pass; `each` is called at once and then every `period_s`."""
        every = round(period_s / STEP_S)
        for step in range(round(duration_s / STEP_S)):
            if each is not None and step % every == 0:
                each()
            if self.instance.steps % STEPS_PER_HEARTBEAT == 0:
                self._heartbeat()
            self.instance.advance()
            for datagram in self.instance.drain():
                self.raw += datagram
                self._unread.append((self.time_s, datagram))

    def run_until(self, reached: Callable[[], bool], limit_s: float) -> float:
        """Let vehicle time pass until `reached`; return that time, fail after `limit_s`."""
        begun_s = self.time_s
        while not reached():
            assert self.time_s - begun_s < limit_s, f"not reached within {limit_s} s"
            self.run(STEP_S)
        return self.time_s

    # -- looking -----------------------------------------------------------------------------

    @property
    def received(self) -> list[tuple[float, Any]]:
        """Everything so far; decoded only when somebody looks, which is half of a test's time."""
        for at_s, datagram in self._unread:
            for message in self._parser.parse_buffer(datagram) or []:
                self._received.append((at_s, message))
        self._unread.clear()
        return self._received

    def received_of(self, ids: frozenset[int]) -> Iterator[tuple[float, Any]]:
        """Messages with these ids alone, of those that nobody has looked at; the rest is lost."""
        for at_s, datagram in self._unread:
            at = 0
            while at < len(datagram):
                end = at + 12 + datagram[at + 1]
                if int.from_bytes(datagram[at + 7 : at + 10], "little") in ids:
                    yield at_s, self._parser.parse_char(datagram[at:end])
                at = end
        self._unread.clear()

    def of(self, kind: str, since_s: float = 0.0) -> list[tuple[float, Any]]:
        return [
            (at_s, message)
            for at_s, message in self.received
            if message.get_type() == kind and at_s >= since_s
        ]

    def texts(self, since_s: float = 0.0) -> list[str]:
        """STATUSTEXTs since then, chunks joined, without their trailing tab."""
        joined: dict[int, str] = {}
        for _, message in self.of("STATUSTEXT", since_s):
            joined[message.id] = joined.get(message.id, "") + message.text
        return [text.rstrip("\t") for text in joined.values()]

    def text_at(self, text: str) -> float:
        """Vehicle time of the newest STATUSTEXT with this beginning."""
        return [at_s for at_s, m in self.of("STATUSTEXT") if m.text.startswith(text)][-1]

    @property
    def mode(self) -> int:
        """custom_mode as the next heartbeat will show it."""
        return self.instance.autopilot.commander.mode.custom_mode

    @property
    def system_status(self) -> int:
        """MAV_STATE as the next heartbeat will show it."""
        view = self.instance.view
        return int(view.builders["HEARTBEAT"](view)[4])

    @property
    def armed(self) -> bool:
        return self.instance.autopilot.commander.armed

    # -- scripts -----------------------------------------------------------------------------

    def boot(self) -> None:
        self.run(5.0)

    def take_off(self) -> None:
        """By command from the ground, until AUTO.LOITER, 2.5 m up."""
        assert self.command(22, *(NAN,) * 7) == [0]
        assert self.command(400, 1) == [0]
        self.run_until(lambda: self.mode == LOITER, 15.0)

    def fly_offboard(self, height_m: float = 3.0) -> None:
        """Boot, stream, engage, arm and climb by position setpoints; the stream then ends."""
        self.boot()
        self.run(0.6, lambda: self.position(0, 0, -height_m))
        assert self.ask_mode(OFFBOARD) == [0, 0]
        assert self.command(400, 1) == [0]
        limit_s = self.time_s + 20.0
        while abs(self.height_m - height_m) > 0.1:
            assert self.time_s < limit_s
            self.run(0.2, lambda: self.position(0, 0, -height_m))
