"""A companion in memory for tests of the simulator: it speaks to an `Instance` by pymavlink."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

from pymavlink.dialects.v20 import all as mavlink

from offboard.model.vehicle import Vehicle
from simulator import config
from simulator.autopilot.firmware import Firmware
from simulator.config import Scenario
from simulator.firmware.px4 import PX4
from simulator.geodesy import EARTH_RADIUS_M
from simulator.instance import Instance
from simulator.steps import STEP_S
from simulator.vehicle.conditions import Conditions
from simulator.vehicle.sensors import EstimatorName

OFFBOARD, LOITER, POSCTL = 0x00060000, 0x03040000, 0x00030000
LAND, RTL = 0x06040000, 0x05040000
HOVER = 0.4895  # thrust at which PX4's vehicle hovers
NAN = math.nan
STEPS_PER_HEARTBEAT = 250


class Bench:
    """One simulated vehicle, and the messages of its companion link as (vehicle time, message)."""

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
        vehicle: Vehicle | None = None,
        scenario: Scenario | None = None,
    ) -> None:
        conditions = Conditions(estimator=estimator, boot_scale=boot_scale)
        scenario = scenario or Scenario(name="none", conditions=conditions)
        self.instance = Instance(
            firmware,
            vehicle or config.vehicle(firmware.vehicle),
            scenario.conditions,
            seed,
            system=system,
            ground_link=ground_link,
            faults=scenario.faults,
            start=scenario.start,
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
        return -self.place[2]

    @property
    def place(self) -> tuple[float, ...]:
        """True position: north, east, down in m."""
        return self.instance.autopilot.state.truth.position_ned_m

    @property
    def velocity(self) -> tuple[float, ...]:
        return self.instance.autopilot.state.truth.velocity_ned_mps

    @property
    def climb_mps(self) -> float:
        return -self.velocity[2]

    @property
    def heading_deg(self) -> float:
        return math.degrees(self.instance.autopilot.state.estimate.yaw_rad)

    def set(self, name: str, value: float) -> None:
        assert self.instance.autopilot.parameters.set(name, value)

    # -- sending -----------------------------------------------------------------------------

    def send(self, message: Any) -> None:
        self.instance.feed(message.pack(self.codec))

    def _heartbeat(self) -> None:
        if self.heartbeat_type is not None:
            self.send(mavlink.MAVLink_heartbeat_message(self.heartbeat_type, 8, 0, 0, 4, 3))

    def command(self, number: int, *params: float) -> list[int]:
        """Send COMMAND_LONG, let 20 ms pass, and return the results of its COMMAND_ACKs."""
        filled = (*params, *(0.0,) * (7 - len(params)))
        self.send(mavlink.MAVLink_command_long_message(self.system, 1, number, 0, *filled))
        since_s = self.time_s
        self.run(0.02)
        acks = [ack for at_s, ack in self.of("COMMAND_ACK") if at_s > since_s]
        return [ack.result for ack in acks if ack.command == number]

    def ask_mode(self, custom_mode: int) -> list[int]:
        return self.command(176, 1, custom_mode >> 16 & 0xFF, custom_mode >> 24)

    def attitude(
        self,
        quaternion: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0),
        thrust: float = HOVER,
        mask: int = 7,
    ) -> None:
        fields = (0, self.system, 1, mask, quaternion, 0.0, 0.0, 0.0, thrust)
        self.send(mavlink.MAVLink_set_attitude_target_message(*fields))

    def position(self, x: float, y: float, z: float, mask: int = 2552) -> None:
        fields = (0, self.system, 1, 1, mask, x, y, z, *(0.0,) * 8)
        self.send(mavlink.MAVLink_set_position_target_local_ned_message(*fields))

    # -- time --------------------------------------------------------------------------------

    def run(
        self, duration_s: float, each: Callable[[], None] | None = None, period_s: float = 0.05
    ) -> None:
        """Let vehicle time pass. `each` is called at once and then every `period_s`."""
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
        """Let vehicle time pass until `reached`, and return that time. Fail after `limit_s`."""
        begun_s = self.time_s
        while not reached():
            assert self.time_s - begun_s < limit_s, f"not reached within {limit_s} s"
            self.run(STEP_S)
        return self.time_s

    # -- looking -----------------------------------------------------------------------------

    @property
    def received(self) -> list[tuple[float, Any]]:
        """All messages so far, decoded only when they are read: that is half of a test's time."""
        for at_s, datagram in self._unread:
            for message in self._parser.parse_buffer(datagram) or []:
                self._received.append((at_s, message))
        self._unread.clear()
        return self._received

    def received_of(self, ids: frozenset[int]) -> Iterator[tuple[float, Any]]:
        """Messages with these ids among those not read yet; the others are dropped."""
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
        """STATUSTEXTs since `since_s`, chunks joined, without their trailing tab."""
        joined: dict[int, str] = {}
        for _, message in self.of("STATUSTEXT", since_s):
            joined[message.id] = joined.get(message.id, "") + message.text
        return [text.rstrip("\t") for text in joined.values()]

    @property
    def mode(self) -> int:
        """`custom_mode` of the next HEARTBEAT."""
        return self.instance.autopilot.commander.mode.custom_mode

    @property
    def system_status(self) -> int:
        """MAV_STATE of the next HEARTBEAT."""
        view = self.instance.view
        return int(view.builders["HEARTBEAT"](view)[4])

    @property
    def armed(self) -> bool:
        return self.instance.autopilot.commander.armed

    # -- scripts -----------------------------------------------------------------------------

    def fly_offboard(self, height_m: float = 3.0) -> None:
        """Boot, stream position setpoints, engage, arm and climb. The stream then ends."""
        self.run(5.6, lambda: self.position(0, 0, -height_m))
        assert self.ask_mode(OFFBOARD) == [0, 0]
        assert self.command(400, 1) == [0]
        limit_s = self.time_s + 20.0
        while abs(self.height_m - height_m) > 0.1:
            assert self.time_s < limit_s
            self.run(0.2, lambda: self.position(0, 0, -height_m))


def degrees(bench: Bench, north_m: float, east_m: float) -> tuple[float, float]:
    """Latitude and longitude in degrees of a place relative to the origin of the local frame."""
    latitude, longitude, _ = bench.instance.autopilot.firmware.origin
    shrink = math.cos(math.radians(latitude))
    north_deg, east_deg = (math.degrees(way / EARTH_RADIUS_M) for way in (north_m, east_m))
    return latitude + north_deg, longitude + east_deg / shrink


def aloft(
    *faults: dict[str, Any],
    firmware: Firmware = PX4,
    height_m: float = 8.0,
    mode: str | None = None,
    **more: Any,
) -> Bench:
    """A vehicle that starts in hover, where the faults' time begins. `more`: other keys."""
    content = {"start": {"height_m": height_m, "mode": mode}, "faults": faults, **more}
    bench = Bench(firmware=firmware, scenario=Scenario.model_validate({"name": "test", **content}))
    bench._parser.robust_parsing = True  # faults may damage frames
    return bench


def engaged(*faults: dict[str, Any], firmware: Firmware = PX4) -> Bench:
    """A hovering vehicle in OFFBOARD or GUIDED; the faults' time begins with that mode."""
    counted = ({"after": "engaged", **fault} for fault in faults)
    if firmware is not PX4:
        return aloft(*counted, firmware=firmware, mode="GUIDED")
    bench = aloft(*counted)
    hold(bench, 0.6)
    assert bench.ask_mode(OFFBOARD)[-1] == 0
    return bench


def hold(bench: Bench, duration_s: float, height_m: float = 8.0) -> None:
    """Hold a height above the origin by position setpoints."""
    bench.run(duration_s, lambda: bench.position(0, 0, -height_m), 0.1)
