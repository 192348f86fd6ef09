"""The doctor beside a simulated vehicle, joined byte by byte in vehicle time, without a socket."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pair import HOST_EPOCH_S, OBEDIENT, Bytes, decode
from pydantic import TypeAdapter
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from offboard.doctor import run
from offboard.doctor.listening import Listening, Observation
from offboard.doctor.run import OF_COMPUTER, Row, examine
from offboard.flight.preflight import Finding, Level
from offboard.link import clock
from offboard.link.interface import Chunk
from offboard.mavlink.session import SessionSettings
from offboard.mavlink.signing import Signing
from offboard.run import configuration
from simulator import config as simulated
from simulator.faults import Fault
from simulator.firmware.ardupilot import ARDUPILOT
from simulator.firmware.base import Firmware
from simulator.firmware.px4 import PX4
from simulator.instance import Instance
from simulator.start import Start
from simulator.steps import STEP_S
from simulator.vehicle.battery import Battery
from simulator.vehicle.conditions import Conditions

BOOT_S = {PX4.name: 6.0, ARDUPILOT.name: 5.0}
BOOT_SCALE = {PX4.name: 1.0, ARDUPILOT.name: 0.1}
# What a vehicle has that was set up as the doctor advises
GOOD = {
    PX4.name: {"COM_OBL_RC_ACT": 4.0, "COM_RCL_EXCEPT": 4.0},
    ARDUPILOT.name: {
        "GUID_OPTIONS": 8.0, "GUID_TIMEOUT": 1.0, "PSC_JERK_XY": 10.0,
    },
}  # fmt: skip
PARAMETER = re.compile(r"param set (\w+) (\S+)")
PERMITTED = {"TIMESYNC", "PARAM_REQUEST_READ", "COMMAND_LONG"}
DOCTOR_ID = 193  # not that of a flight
COMMANDS = {401, 511, 512}  # RUN_PREARM_CHECKS, SET_MESSAGE_INTERVAL, REQUEST_MESSAGE
BUSY = {check.__name__ for check in OF_COMPUTER}  # with other tests


@dataclass
class Bench:
    """`before` is called with the vehicle time at each step and returns further chunks; `down` and
    `up` see the datagrams of each direction."""

    instance: Instance
    config: configuration.FlightConfig
    capacity_bytes_ps: float | None = None
    before: Callable[[float], list[Chunk]] = lambda time_s: []
    down: Callable[[Bytes], Bytes] = lambda datagrams: datagrams
    up: Callable[[Bytes], Bytes] = lambda frames: frames
    has_vehicle: bool = True
    signing: Signing | None = None
    system_id: int | None = None
    sent: list[Any] = field(default_factory=list)

    @property
    def now_s(self) -> float:
        return HOST_EPOCH_S + self.instance.time_s

    def step(self) -> list[Chunk]:
        datagrams = self.down(self.instance.step())
        heard = [Chunk(datagram, ("127.0.0.1", 14580), self.now_s) for datagram in datagrams]
        return (heard if self.has_vehicle else []) + self.before(self.instance.time_s)

    def run_to(self, time_s: float) -> None:
        """Nobody listens meanwhile."""
        while self.instance.time_s < time_s:
            self.step()

    def listen(self) -> Observation:
        settings = SessionSettings(self.system_id, capacity_bytes_ps=self.capacity_bytes_ps)
        listening = Listening(self.now_s, settings, self.signing)
        while not listening.complete(self.now_s):
            for chunk in self.step():
                listening.take(chunk)
            if self.instance.steps % 5 == 0:
                for frame in self.up(listening.due(self.now_s)):
                    self.sent.append(decode(frame))
                    self.instance.feed(frame)
        address, began_s = "udpin:127.0.0.1:14540", clock.monotonic_s()
        return Observation(self.config, listening, address, Path("."), began_s)

    def check(self, *names: str) -> dict[str, Row]:
        """The rows of a check now, by name."""
        seen = self.listen()
        assert_read_only(self.sent)
        chosen = [name for name in run.names(names) if name not in BUSY]
        return {row.check: row for row in examine(chosen, seen)}

    def follow(self, row: Row) -> None:
        """Do what the hints of a row say: set the parameters that they name, as a ground station
        does."""
        lines = [line for finding in row.findings for line in PARAMETER.findall(finding.hint)]
        assert lines, row
        for name, value in lines:
            self._set(name, float(value))

    def _set(self, name: str, value: float) -> None:
        table = self.instance.autopilot.parameters
        _, kind = table.to_wire(name)
        bytewise = self.instance.autopilot.firmware.parameters_bytewise and kind != 9
        wire = struct.unpack("<f", struct.pack("<i", int(value)))[0] if bytewise else value
        codec = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
        message = mavlink.MAVLink_param_set_message(1, 1, name.encode(), wire, kind)
        changes = table.changes
        self.instance.feed_ground(message.pack(codec))
        assert table.changes == changes + 1


def assert_read_only(sent: Sequence[Any]) -> None:
    """Nothing but what the command's help promises."""
    assert {message.get_type() for message in sent} <= PERMITTED
    assert {message.get_srcComponent() for message in sent} <= {DOCTOR_ID}
    commands = {message.command for message in sent if message.get_type() == "COMMAND_LONG"}
    assert commands <= COMMANDS


def bench(
    firmware: Firmware = OBEDIENT,
    faults: Sequence[dict[str, Any]] = (),
    start: Start | None = None,
    charge: float = 1.0,
    choices: dict[str, str] | None = None,
    assignments: Sequence[str] = (),
    parameters: dict[str, float] | None = None,
    mode: str = "",
    **options: Any,
) -> Bench:
    """A vehicle that has booted and that nothing is wrong with, but for what is given. Times of
    `faults` count from the boot, see BOOT_S."""
    conditions = Conditions(boot_scale=BOOT_SCALE[firmware.name], battery=Battery(remaining=charge))
    instance = Instance(
        firmware,
        simulated.vehicle(firmware.vehicle),
        conditions,
        seed=7,
        parameters=GOOD[firmware.name] | (parameters or {}),
        faults=TypeAdapter(list[Fault]).validate_python(list(faults)),
        start=start,
    )
    config = configuration.load("flight", choices=choices or {}, assignments=assignments)
    made = Bench(instance, config, **options)
    made.run_to(BOOT_S[firmware.name])
    if mode:
        instance.autopilot.commander.switch(mode)
    return made


def said(rows: dict[str, Row]) -> dict[str, tuple[Finding, ...]]:
    """The findings that are not ok, by check."""
    return {
        name: tuple(finding for finding in row.findings if finding.level is not Level.OK)
        for name, row in rows.items()
        if row.level is not Level.OK
    }


ELSEWHERE = ("127.0.0.1", 14999)


def from_others(
    message: Any, system: int, component: int, rate_hz: float = 10.0, place: Hashable = ELSEWHERE
) -> Callable[[float], list[Chunk]]:
    """For `Bench.before`: another sender on the link."""
    codec = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
    every = round(1.0 / (rate_hz * STEP_S))

    def before(time_s: float) -> list[Chunk]:
        if round(time_s / STEP_S) % every:
            return []
        data = message.pack(codec) if not isinstance(message, bytes) else message
        return [Chunk(data, place, HOST_EPOCH_S + time_s)]

    return before
