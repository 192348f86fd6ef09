"""MAVLink server of one link, without I/O: it handles received messages and sends telemetry.

Each link has its own sequence numbers, rates and clients. Answers and telemetry wait in order in
the `outbox`. Knows no socket and no clock: time is the autopilot's.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

from simulator.autopilot.autopilot import ATTITUDE, GLOBAL, LOCAL
from simulator.autopilot.sticks import RELEASE
from simulator.mavlink.codec import Decoder, Keyring, Message, Peer, sender_of, target_of
from simulator.mavlink.commands import Command, Commands
from simulator.mavlink.outbox import MAV_COMP_ID_AUTOPILOT, Outbox
from simulator.mavlink.telemetry import Schedule
from simulator.mavlink.transfers import MissionTransfer, ParameterTransfer
from simulator.mavlink.view import View

_GUIDED = 2  # `current` of a mission item that is a place to fly to now
_AXIS_NOT_USED = 2**15 - 1  # value of an axis of MANUAL_CONTROL
_NO_PLACE = 2**31 - 1  # value of x and y of COMMAND_INT
_OF_ALL = (519, 520)  # MAV_CMD: requests of protocol and version, answered if sent to all systems
_SEEN_MAX = 16  # MAX_REMOTE_COMPONENTS of PX4
_NOT_FORWARDED = ("TIMESYNC", "SETUP_SIGNING")  # clock of lockstep; contains a key
_FTP_NAK, _FTP_ERROR_NOT_FOUND = 128 + 1, 10


class Server:
    """One link of one vehicle.

    Args:
        view: contents of the messages.
        rates_hz: rates of the messages sent without a request.
        keyring: signing key of the vehicle.
        number: link id in signatures.
        barrier: whether TIMESYNC requests are sent by `send_barrier` only, as the clock of
            lockstep.

    `others` are the vehicle's other links, to which messages are forwarded.
    """

    def __init__(
        self,
        view: View,
        rates_hz: Mapping[str, float],
        keyring: Keyring,
        number: int,
        *,
        barrier: bool = False,
    ) -> None:
        self.view, self.keyring, self.barrier = view, keyring, barrier
        self.decoder = Decoder(keyring)
        self.answered_ns = -1  # ts1 of the newest TIMESYNC answer
        self.outbox = Outbox(view, keyring, number)
        self.others: tuple[Server, ...] = ()
        clock = ("TIMESYNC",) if barrier else ()
        self._rates_hz = {name: hz for name, hz in rates_hz.items() if name not in clock}
        self._begin()

    def _begin(self) -> None:
        """Set the default rates, without known peers or transfers, as after boot."""
        self.schedule = Schedule(self.view, self._rates_hz)
        self._seen: list[Peer] = []
        self._commands = Commands(self.outbox, self.schedule)
        self._parameters = ParameterTransfer(self.outbox)
        self._missions = MissionTransfer(self.outbox)

    def restart(self) -> None:
        """Reset as after boot."""
        self.outbox.restart()
        self._begin()

    def step(self) -> None:
        """Queue the messages due at this step: mission requests, parameter lists, telemetry."""
        self._missions.step()
        self._parameters.step()
        for name in self.schedule.take_due():
            self.outbox.send_now(name)

    def send_barrier(self, stamp_ns: int) -> None:
        """Queue the TIMESYNC request of a barrier."""
        self.outbox.send("TIMESYNC", 0, stamp_ns)

    # -- received messages -------------------------------------------------------------------

    def receive(self, datagram: bytes) -> None:
        """Handle all messages of one datagram; it never raises, whatever the bytes."""
        for message in self.decoder.read(datagram):
            self.outbox.connected = True
            self._forward(message)
            ignored = message.get_type() in self.view.autopilot.firmware.ignored
            handler = None if ignored else HANDLERS.get(message.get_type())
            if handler is not None and self._is_for_us(message):
                handler(self, message)

    def _forward(self, message: Message) -> None:
        """Forward a message to each other link on which its target was seen (anybody, if it is for
        all), as PX4's SITL and ArduPilot do. Messages for the autopilot alone are not forwarded,
        nor frames that come back, for example through a router that is connected to both links."""
        sender, target, frame = sender_of(message), target_of(message), bytes(message.get_msgbuf())
        ours = self.view.system, MAV_COMP_ID_AUTOPILOT
        if sender == ours or frame in self.outbox.forwarded:
            return
        if sender not in self._seen and len(self._seen) < _SEEN_MAX:
            self._seen.append(sender)
        if target == ours or message.get_type() in _NOT_FORWARDED:
            return
        for link in self.others:
            if any(_matches(target, peer) for peer in link._seen):
                link.outbox.forward(frame)

    def _is_for_us(self, message: Message) -> bool:
        """Whether the autopilot has to handle this message: it or all are the target, and the
        firmware obeys the sender."""
        firmware, ours = self.view.autopilot.firmware, self.view.system
        system, component = target_of(message)
        kind = message.get_type().partition("_")[0]
        to_all = kind not in firmware.never_to_all or getattr(message, "command", 0) in _OF_ALL
        for_autopilot = component in (0, MAV_COMP_ID_AUTOPILOT)
        for_autopilot |= not firmware.target_component_checked
        parameters = self.view.autopilot.parameters
        obeyed = firmware.obeys_system(message.get_srcSystem(), ours, parameters)
        return (system == ours or (to_all and system == 0)) and for_autopilot and obeyed

    def _heartbeat(self, message: Message) -> None:
        autopilot, system = self.view.autopilot, message.get_srcSystem()
        if autopilot.firmware.is_ground_station(message.type, system, autopilot.parameters):
            autopilot.health.ground_station_heard(autopilot.state.time_s)
            self.outbox.note_ground_station()

    def _command_long(self, message: Message) -> None:
        params = tuple(getattr(message, f"param{i}") for i in range(1, 8))
        self._commands.run(Command(message.command, params, *sender_of(message)))

    def _command_int(self, message: Message) -> None:
        params = tuple(getattr(message, f"param{i}") for i in range(1, 5))
        place = (message.x * 1e-7, message.y * 1e-7)
        if message.x == message.y == _NO_PLACE:
            place = (math.nan, math.nan)
        params += (*place, message.z)
        self._commands.run(Command(message.command, params, *sender_of(message), message.frame))

    def _setpoint(self, message: Message) -> None:
        self.view.autopilot.take_setpoint(message.get_type(), message.to_dict())

    def _set_mode(self, message: Message) -> None:
        self._commands.set_mode(message.base_mode, message.custom_mode, sender_of(message))

    def _set_parameter(self, message: Message) -> None:
        """PARAM_SET, which is answered on all links."""
        if self._parameters.set(message):
            for link in (self, *self.others):
                link._parameters.show(message.param_id)

    def _mission_item(self, message: Message) -> None:
        if not (self.view.autopilot.firmware.ardupilot_commands and message.current == _GUIDED):
            self._missions.item(message)
            return
        scale = 1e-7 if message.get_type().endswith("INT") else 1.0
        place = (message.x * scale, message.y * scale, message.z)
        accepted = self._commands.go_to(place, message.frame)
        result = 0 if accepted else 1  # MAV_MISSION_RESULT
        self.outbox.send("MISSION_ACK", *sender_of(message), result, 0)

    def _timesync(self, message: Message) -> None:
        if message.tc1 == 0:
            self.outbox.send("TIMESYNC", self.view.time_us * 1000, message.ts1)
        else:
            self.answered_ns = message.ts1

    def _ping(self, message: Message) -> None:
        """Answer a PING request; a PING with a target is an answer."""
        if not message.target_system:
            self.outbox.send("PING", message.time_usec, message.seq, *sender_of(message))

    def _set_origin(self, _: Message) -> None:
        """Send the origin, which SET_GPS_GLOBAL_ORIGIN does not change."""
        self.outbox.send_now("GPS_GLOBAL_ORIGIN")

    def _rc_channels_override(self, message: Message) -> None:
        self._sticks(message, [getattr(message, f"chan{i}_raw") for i in range(1, 9)])

    def _manual_control(self, message: Message) -> None:
        """Convert joystick axes (-1000 .. 1000, throttle 0 .. 1000) to pulse widths; an unused axis
        is released."""
        if message.target != self.view.system:
            return
        pitch, roll, throttle, yaw = message.x, message.y, message.z, message.r
        widths = (
            (roll, 1500 + roll // 2),
            (pitch, 1500 - pitch // 2),
            (throttle, 1000 + throttle),
            (yaw, 1500 + yaw // 2),
        )
        pulses = [
            RELEASE if axis == _AXIS_NOT_USED else min(2000, max(1000, width))
            for axis, width in widths
        ]
        self._sticks(message, pulses if throttle >= 0 else ())

    def _sticks(self, message: Message, widths_us: Sequence[int]) -> None:
        """Apply stick positions. Those of the ground station count as its heartbeat, too."""
        autopilot, system = self.view.autopilot, message.get_srcSystem()
        firmware, now_s = autopilot.firmware, autopilot.state.time_s
        if not firmware.takes_sticks_from(system, autopilot.parameters):
            return
        if firmware.is_ground_station(0, system, autopilot.parameters):
            autopilot.health.ground_station_heard(now_s)
        if autopilot.guidance.sticks.override(widths_us, now_s):
            autopilot.handle("sticks moved")

    def _setup_signing(self, message: Message) -> None:
        """Take a new signing key, but not while armed."""
        if not self.view.autopilot.commander.armed:
            self.keyring.set_up(bytes(message.secret_key), message.initial_timestamp)

    def _log_request_list(self, _: Message) -> None:
        """Answer that there are no logs."""
        self.outbox.send("LOG_ENTRY", 0, 0, 0, 0, 0)

    def _request_data_stream(self, message: Message) -> None:
        rate_hz = message.req_message_rate if message.start_stop else 0
        self.schedule.set_group(message.req_stream_id, rate_hz)

    def _file_transfer(self, message: Message) -> None:
        request = message.payload
        number = (request[0] | request[1] << 8) + 1 & 0xFFFF
        head = (number & 0xFF, number >> 8, request[2], _FTP_NAK, 1, request[3])
        answer = head + (0,) * 6 + (_FTP_ERROR_NOT_FOUND,)
        padded = answer + (0,) * (len(request) - len(answer))
        self.outbox.send("FILE_TRANSFER_PROTOCOL", 0, *sender_of(message), padded)


def _matches(target: Peer, peer: Peer) -> bool:
    system, component = target
    return system == 0 or (system == peer[0] and component in (0, peer[1]))


# Handlers by message name. They are called only if this vehicle, or all, is the message's target
HANDLERS: dict[str, Callable[[Server, Message], None]] = {
    "HEARTBEAT": Server._heartbeat,
    "COMMAND_LONG": Server._command_long,
    "COMMAND_INT": Server._command_int,
    "SET_MODE": Server._set_mode,
    **dict.fromkeys((ATTITUDE, LOCAL, GLOBAL), Server._setpoint),
    "MISSION_ACK": lambda server, message: server._missions.ack(message),
    "MISSION_COUNT": lambda server, message: server._missions.count(message),
    "MISSION_WRITE_PARTIAL_LIST": lambda server, message: server._missions.write_partial_list(
        message
    ),
    "MISSION_ITEM": Server._mission_item,
    "MISSION_ITEM_INT": Server._mission_item,
    "MISSION_REQUEST_LIST": lambda server, message: server._missions.request_list(message),
    "MISSION_REQUEST": lambda server, message: server._missions.request(message),
    "MISSION_REQUEST_INT": lambda server, message: server._missions.request(message),
    "MISSION_CLEAR_ALL": lambda server, message: server._missions.clear_all(message),
    "MISSION_SET_CURRENT": lambda server, message: server._missions.set_current(message),
    "TIMESYNC": Server._timesync,
    "PING": Server._ping,
    "SET_GPS_GLOBAL_ORIGIN": Server._set_origin,
    "PARAM_REQUEST_READ": lambda server, message: server._parameters.request_read(message),
    "PARAM_REQUEST_LIST": lambda server, message: server._parameters.request_list(message),
    "PARAM_SET": Server._set_parameter,
    "RC_CHANNELS_OVERRIDE": Server._rc_channels_override,
    "MANUAL_CONTROL": Server._manual_control,
    "SETUP_SIGNING": Server._setup_signing,
    "LOG_REQUEST_LIST": Server._log_request_list,
    "REQUEST_DATA_STREAM": Server._request_data_stream,
    "AUTOPILOT_VERSION_REQUEST": lambda server, _: server.outbox.send_now("AUTOPILOT_VERSION"),
    "FILE_TRANSFER_PROTOCOL": Server._file_transfer,
}
