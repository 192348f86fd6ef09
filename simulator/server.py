"""The MAVLink side of one link, without I/O: datagrams in, frames out.

Each link has its own sequence numbers, rates and clients. Answers and telemetry wait in order
until `drain` takes them. Knows no socket and no clock: time is the autopilot's.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from simulator.codec import Decoder, Message, frame, layout
from simulator.commands import Command, Commands
from simulator.firmware.base import Say, Severity
from simulator.mission import Item
from simulator.mission_transfer import HANDLERS as MISSION_HANDLERS
from simulator.mission_transfer import Transfer
from simulator.setpoints import ATTITUDE, GLOBAL, LOCAL
from simulator.steps import STEP_US
from simulator.strict import Strict
from simulator.telemetry import LEAST_INTERVAL_US
from simulator.view import View

MAV_COMP_ID_AUTOPILOT = 1
TEXT_KEPT_US = 5_000_000
TEXT_LENGTH = 50
DATAGRAM_MAX = 1400
PARAMETERS_PER_STEP = 4
PARAMETER_BY_NAME = 65535  # PARAM_VALUE.param_index of an answer that has none
INTERVAL_MAX_US = 2.0**31 - 1  # MESSAGE_INTERVAL.interval_us is an int32
_ITEMS, _GUIDED = ("MISSION_ITEM", "MISSION_ITEM_INT"), 2  # `current` of an item
_FTP_NAK, _FTP_ERROR_NOT_FOUND = 128 + 1, 10


@dataclass(slots=True)
class Stream:
    """One message sent by itself: interval and next time, microseconds of vehicle time."""

    interval_us: int
    due_us: int


@dataclass(slots=True)
class Server:
    """One link of one vehicle. `rates_hz`: what it sends without being asked.

    `barrier` leaves TIMESYNC requests to `send_barrier`: in lockstep they are the clock. What
    `streams` are due is found and written by `simulator.stretch`, which hands it to `take`.
    """

    view: View
    rates_hz: Mapping[str, float]
    barrier: bool = False
    strict: Strict | None = None
    decoder: Decoder = field(default_factory=Decoder)
    heard: bool = False
    answered_ns: int = -1  # ts1 of the newest TIMESYNC answer
    sequence: int = 0
    streams: dict[str, Stream] = field(default_factory=dict)
    rescheduled: bool = True  # the streams are others than they were
    _ground_station_us: float = -math.inf  # last heard
    _texts_kept: list[tuple[int, Say]] = field(default_factory=list)
    _out: list[bytes] = field(default_factory=list)
    _text_id: int = 0
    _parameters_due: list[str] = field(default_factory=list)
    _commands: Commands = field(init=False)
    _transfer: Transfer = field(init=False)

    def __post_init__(self) -> None:
        self._commands = Commands(self)
        self._transfer = self._new_transfer()
        self._start_streams()

    def _new_transfer(self) -> Transfer:
        autopilot = self.view.autopilot
        return Transfer(self, autopilot.mission, autopilot.firmware.missions, self._home)

    def _home(self) -> Item:
        """Home as a mission's item."""
        north_m, east_m, down_m = self.view.autopilot.navigator.home_ned_m
        place = self.view.geodetic(north_m, east_m)
        return Item(0, 16, (0.0,) * 4, *place, self.view.altitude_mm(down_m) * 1e-3)

    def _start_streams(self) -> None:
        self.rescheduled = True
        for name, rate_hz in self.rates_hz.items():
            if not (self.barrier and name == "TIMESYNC"):
                self.streams[name] = Stream(round(1e6 / rate_hz), 0)

    # -- out ---------------------------------------------------------------------------------

    def send(self, name: str, *values: object) -> None:
        """Queue one message; `values` in the order of the XML."""
        self._frame(name, layout(name).pack(values))

    def send_now(self, name: str) -> None:
        """Queue the message of `BUILDERS` called `name`, as it is now."""
        self._frame(name, self.view.payload(name))

    def take(self, frames: bytes, next_sequence: int) -> None:
        """Queue whole frames written elsewhere, numbered from `sequence` to below this."""
        if frames:
            self._out.append(frames)
        self.sequence = next_sequence

    def _frame(self, name: str, payload: bytes) -> None:
        system = self.view.system
        self._out.append(frame(self.sequence, system, MAV_COMP_ID_AUTOPILOT, layout(name), payload))
        self.sequence = (self.sequence + 1) & 0xFF

    def drain(self) -> list[bytes]:
        """Everything queued, as datagrams of whole frames."""
        if not self._out:
            return []
        together = self._out[0] if len(self._out) == 1 else b"".join(self._out)
        self._out.clear()
        return [together] if len(together) <= DATAGRAM_MAX else _datagrams(together)

    def step(self) -> None:
        """Queue what is asked for and goes out bit by bit: missions, lists of parameters."""
        if self._transfer.uploading:
            self._transfer.step(self._now_us * 1e-6)
        if self._parameters_due:
            for name in self._parameters_due[:PARAMETERS_PER_STEP]:
                self.send_parameter(name, listed=True)
            del self._parameters_due[:PARAMETERS_PER_STEP]

    @property
    def only_streams(self) -> bool:
        """Nothing but streams has this link to say by itself."""
        return not (self._transfer.uploading or self._parameters_due)

    @property
    def _now_us(self) -> int:
        """Time by which streams are due; no clock that a fault can turn back."""
        return self.view.autopilot.senses.steps * STEP_US

    def send_barrier(self, stamp_ns: int) -> None:
        """Queue a TIMESYNC request."""
        self.send("TIMESYNC", 0, stamp_ns)

    def restart(self) -> None:
        """As after boot: default rates, nobody known; what was said is said."""
        self._parameters_due = []
        self.streams = {}
        self.sequence = self._text_id = 0
        self._transfer = self._new_transfer()
        self._ground_station_us, self._texts_kept = -math.inf, []
        self._start_streams()

    def say(self, said: Say) -> None:
        """Queue a STATUSTEXT in chunks, if this link gets texts at all."""
        firmware = self.view.autopilot.firmware
        if firmware.text_to_ground_stations_only and not self._ground_station_is_there:
            self._texts_kept.append((self._now_us, said))
            return
        if not self.heard:
            return
        text = (said.text + firmware.text_suffix).encode("ascii", "replace")
        for chunk, at in enumerate(range(0, len(text), TEXT_LENGTH)):
            piece = text[at : at + TEXT_LENGTH]
            self.send("STATUSTEXT", int(said.severity), piece, self._text_id, chunk)
        self._text_id = (self._text_id + 1) & 0xFFFF

    def complain(self, text: str) -> None:
        """A STATUSTEXT on this link alone."""
        self.say(Say(Severity.CRITICAL, text))

    @property
    def _ground_station_is_there(self) -> bool:
        stays_us = self.view.autopilot.firmware.ground_station_stays_s * 1e6
        return self._now_us - self._ground_station_us <= stays_us

    def _say_what_was_kept(self) -> None:
        """Texts wait for a ground station, but not for long."""
        kept, self._texts_kept = self._texts_kept, []
        for at_us, said in kept:
            if self._now_us - at_us < TEXT_KEPT_US:
                self.say(said)

    def send_parameter(self, name: str, *, listed: bool = False) -> None:
        """Queue PARAM_VALUE; `listed`: its number was asked for."""
        table = self.view.autopilot.parameters
        value, kind = table.to_wire(name)
        numbered = listed or self.view.autopilot.firmware.answers_carry_index
        index = table.names.index(name) if numbered else PARAMETER_BY_NAME
        self.send("PARAM_VALUE", name.encode(), value, kind, len(table.names), index)

    def set_interval(self, name: str, interval_us: float) -> bool:
        """0 restores the default, < 0 stops; False when the message has no settable rate."""
        if name not in self.view.builders or name in self.view.autopilot.firmware.streams.fixed:
            return False
        if interval_us == 0:
            rate_hz = self.rates_hz.get(name)
            interval_us = -1.0 if rate_hz is None else 1e6 / rate_hz
        self.rescheduled = True
        if interval_us < 0:
            self.streams.pop(name, None)
            return True
        least_us = LEAST_INTERVAL_US.get(name, 1.0)
        stream = Stream(round(min(INTERVAL_MAX_US, max(least_us, interval_us))), 0)
        stream.due_us = _next_multiple(self._now_us, stream)
        self.streams[name] = stream
        return True

    def interval_us(self, name: str) -> int:
        """Interval of a message; -1 when it is not sent by itself."""
        stream = self.streams.get(name)
        return -1 if stream is None else stream.interval_us

    # -- in ----------------------------------------------------------------------------------

    def receive(self, datagram: bytes) -> None:
        """Handle everything in one datagram; no bytes make this raise."""
        for message in self.decoder.read(datagram):
            self.heard = True
            if message.name != "TIMESYNC":
                self.view.autopilot.wake()
            if self.strict is not None:
                self._judge(message)
            handler = HANDLERS.get(message.name)
            if handler is not None and self._is_for_us(message):
                handler(self, message)

    def _judge(self, message: Message) -> None:
        assert self.strict is not None
        said = self.strict.complaint(message, self._now_us * 1e-6)
        if said is not None:
            self.view.autopilot.commander.texts.append(said)

    def _is_for_us(self, message: Message) -> bool:
        """To our system or all, to the autopilot or all of it."""
        system = message.values.get("target_system", 0)
        component = message.values.get("target_component", 0)
        checked = self.view.autopilot.firmware.target_component_checked
        for_autopilot = component in (0, MAV_COMP_ID_AUTOPILOT) or not checked
        read = self.view.autopilot.parameters.__getitem__
        obeyed = self.view.autopilot.firmware.obeys_system(message.system, self.view.system, read)
        return system in (0, self.view.system) and for_autopilot and obeyed

    def _heartbeat(self, message: Message) -> None:
        autopilot = self.view.autopilot
        read = autopilot.parameters.__getitem__
        if autopilot.firmware.is_ground_station(message.type, message.system, read):
            self._ground_station_us = self._now_us
            autopilot.watch.hear_ground_station(autopilot.senses.time_s)
            self._say_what_was_kept()

    def _command_long(self, message: Message) -> None:
        params = tuple(message.values[f"param{i}"] for i in range(1, 8))
        self._commands.run(Command(message.command, params, message.system, message.component))

    def _command_int(self, message: Message) -> None:
        params = tuple(message.values[f"param{i}"] for i in range(1, 5))
        params += (message.x * 1e-7, message.y * 1e-7, message.z)
        sender = (message.system, message.component)
        self._commands.run(Command(message.command, params, *sender, message.frame))

    def _setpoint(self, message: Message) -> None:
        self.view.autopilot.obey(message.name, message.values)

    def _set_mode(self, message: Message) -> None:
        sender = (message.system, message.component)
        self._commands.set_mode(message.base_mode, message.custom_mode, sender)

    def _mission(self, message: Message) -> None:
        rules = self.view.autopilot.firmware.missions
        if rules.guides and message.name in _ITEMS and message.current == _GUIDED:
            self._guide(message)
            return
        self._transfer.handle(message, self._now_us * 1e-6)

    def _guide(self, message: Message) -> None:
        """An item that is no mission's, but where to go now."""
        scale = 1e-7 if message.name.endswith("INT") else 1.0
        place = (message.x * scale, message.y * scale, message.z)
        goes = self._commands.go_to(place, message.frame)
        self.send("MISSION_ACK", message.system, message.component, 0 if goes else 1, 0)

    def _timesync(self, message: Message) -> None:
        if message.tc1 == 0:
            self.send("TIMESYNC", self.view.time_us * 1000, message.ts1)
        else:
            self.answered_ns = message.ts1

    def _ping(self, message: Message) -> None:
        if message.target_system == 0 and "PING" in self.view.builders:
            self.send("PING", message.time_usec, message.seq, message.system, message.component)

    def _param_request_read(self, message: Message) -> None:
        names = self.view.autopilot.parameters.names
        if message.param_index >= 0:
            if message.param_index < len(names):
                self.send_parameter(names[message.param_index], listed=True)
        elif message.param_id in names:
            self.send_parameter(message.param_id)

    def _log_request_list(self, _: Message) -> None:
        """There are none."""
        self.send("LOG_ENTRY", 0, 0, 0, 0, 0)

    def _request_data_stream(self, message: Message) -> None:
        """Not acknowledged; a rate of 0 is as good as a stop."""
        names = self.view.autopilot.firmware.streams.groups.get(message.req_stream_id, ())
        rate_hz = message.req_message_rate if message.start_stop else 0
        for name in names:
            self.set_interval(name, 1e6 / rate_hz if rate_hz else -1.0)

    def _param_request_list(self, _: Message) -> None:
        self._parameters_due = list(self.view.autopilot.parameters.names)

    def _param_set(self, message: Message) -> None:
        table = self.view.autopilot.parameters
        if table.set_from_wire(message.param_id, message.param_value, message.param_type):
            self.send_parameter(message.param_id)

    def _file_transfer(self, message: Message) -> None:
        asked = message.payload
        number = (asked[0] | asked[1] << 8) + 1 & 0xFFFF
        head = (number & 0xFF, number >> 8, asked[2], _FTP_NAK, 1, asked[3])
        answer = head + (0,) * 6 + (_FTP_ERROR_NOT_FOUND,)
        padded = answer + (0,) * (len(asked) - len(answer))
        self.send("FILE_TRANSFER_PROTOCOL", 0, message.system, message.component, padded)


HANDLERS: dict[str, Callable[[Server, Message], None]] = {
    "HEARTBEAT": Server._heartbeat,
    "COMMAND_LONG": Server._command_long,
    "COMMAND_INT": Server._command_int,
    "SET_MODE": Server._set_mode,
    **dict.fromkeys((ATTITUDE, LOCAL, GLOBAL), Server._setpoint),
    **dict.fromkeys(MISSION_HANDLERS, Server._mission),
    "TIMESYNC": Server._timesync,
    "PING": Server._ping,
    "PARAM_REQUEST_READ": Server._param_request_read,
    "PARAM_REQUEST_LIST": Server._param_request_list,
    "PARAM_SET": Server._param_set,
    "LOG_REQUEST_LIST": Server._log_request_list,
    "REQUEST_DATA_STREAM": Server._request_data_stream,
    "FILE_TRANSFER_PROTOCOL": Server._file_transfer,
}


def _datagrams(frames: bytes) -> list[bytes]:
    """Many unsigned frames, cut between frames into pieces that a datagram holds."""
    datagrams: list[bytes] = []
    begin = at = 0
    while at < len(frames):
        length = 12 + frames[at + 1]
        if at + length - begin > DATAGRAM_MAX:
            datagrams.append(frames[begin:at])
            begin = at
        at += length
    return [*datagrams, frames[begin:]]


def _next_multiple(now_us: int, stream: Stream) -> int:
    """Streams keep to the multiples of their interval, so that the mean rate is exact."""
    return (now_us // stream.interval_us + 1) * stream.interval_us
