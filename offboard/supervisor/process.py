"""The process of the supervisor: it takes the controller's place if the controller's beats stop.

It imports only what it needs, so that it is ready at once and stays small. Its standard input is
its end of the channel to the controller, see `supervisor`.
"""

from __future__ import annotations

import json
import os
import select
import signal
import socket
import sys
from collections.abc import Hashable, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from offboard.link import clock
from offboard.link.after_flight import begin
from offboard.link.background import BackgroundWriter
from offboard.link.interface import Link
from offboard.link.log import append, entry
from offboard.link.stream import ListeningLink, Stream, StreamLink
from offboard.link.udp import UdpLink
from offboard.mavlink import event_record, texts
from offboard.mavlink.dialects.base import SetpointLoss
from offboard.mavlink.event_record import SUPERVISOR, EventRecord
from offboard.mavlink.events import WARNING, VehicleFound
from offboard.mavlink.outgoing import Heartbeat, Outgoing
from offboard.mavlink.session import ACTIVE, Session, SessionSettings
from offboard.mavlink.signing import Signing
from offboard.supervisor.recovery import Recovery, Supervised
from offboard.supervisor.supervisor import READY

POLL_S = 0.02
PAUSE_MAX_S = 0.1  # most of a turn that counts as silence: the rest was a pause of this process
BACKLOG_MAX = 20  # most batches that are read from the link before the first request
CLOSE_S = 2.0
LANDING = 10  # custom_mode (`flight.phases.Phase`): it keeps other `offboard` from flying
DIED = "the controller ended in flight"
HANGS = "the controller has not answered for {silent_s:g} s"


class Watch:
    """Receives the controller's beats, and keeps what is needed to take over."""

    def __init__(self, channel: socket.socket) -> None:
        self._channel = channel
        self._channel.setblocking(False)
        self._received = b""
        self._silent_s = 0.0
        self.newest: dict[str, Any] = {}  # the newest beat
        self.descriptors: list[int] = []  # of the link, then of the log
        self.ended = False  # whether the controller has ended

    def turn(self, elapsed_s: float) -> str:
        """Read the beats that have arrived, and answer them. `elapsed_s`: time since the last call.
        Returns why to take over; empty if there is no reason."""
        self._silent_s += min(elapsed_s, PAUSE_MAX_S)
        with suppress(BlockingIOError):
            while not self.ended:
                self._read()
        if not self._silent_s:
            with suppress(OSError):  # the controller is stopped, or has ended
                self._channel.send(b'""\n')
        known = self.known
        if not (known and known.ours and known.flying):
            return ""
        if self.ended:
            return DIED
        silent_s = known.silent_s
        return HANGS.format(silent_s=silent_s) if self._silent_s >= silent_s else ""

    @property
    def known(self) -> Supervised | None:
        """What the newest beat reports; None before the first."""
        return _known(**self.newest["known"]) if self.newest else None

    def _read(self) -> None:
        data = b""
        descriptors: list[int] = []
        with suppress(ConnectionResetError):  # the controller has ended and left answers unread
            data, descriptors, _, _ = socket.recv_fds(self._channel, 65536, 8)
        self.ended = not data
        if descriptors:
            for descriptor in self.descriptors:
                os.close(descriptor)
            self.descriptors = descriptors
        *lines, self._received = (self._received + data).split(b"\n")
        for line in lines:
            with suppress(ValueError):  # only a part of the line did fit into the buffer
                self.newest, self._silent_s = json.loads(line), 0.0


class TakeOver:
    """Takes the controller's place: sends on its link what `Recovery` demands, and logs it."""

    def __init__(self, watch: Watch, known: Supervised, tell: BackgroundWriter[str]) -> None:
        beat = watch.newest
        self._tell = tell
        # JSON has no tuples
        peer: Hashable = tuple(beat["peer"]) if isinstance(beat["peer"], list) else beat["peer"]
        name = str(peer) if beat["stream"] else ""
        self._link = _link(watch.descriptors[:-1], name, listens=beat["listens"])
        self._log = BackgroundWriter[bytes](
            lambda entries: append(watch.descriptors[-1], entries), 100_000
        )
        signing = beat["signing"] and Signing.resumed(clock.monotonic_s, beat["signing"])
        self._session = Session(SessionSettings(stream=beat["stream"]), signing)
        self._session.senders.set_vehicle(known.vehicle, peer)
        assert self._session.dialect is not None
        self._dialect = self._session.dialect
        self._recovery = Recovery(self._dialect, known, clock.monotonic_s())
        self._text_id = 0

    def run(self, reason: str) -> None:
        """Take over for `reason`, until `Recovery` ends, for example with a disarmed vehicle."""
        for _ in range(BACKLOG_MAX):  # the mode may have been left since the last beat
            if not self._receive():
                break
        self._ask(f"taking over: {reason}")
        while not self._recovery.end_reason:
            self._link.wait(POLL_S)
            self._receive()
            self._ask()
        self._say(self._recovery.end_reason)
        self._log.close(CLOSE_S)

    def _receive(self) -> bool:
        """Process one batch from the link. Returns whether there was any."""
        chunks = self._link.receive()
        for chunk in chunks:
            reception = self._session.receive(chunk.data, chunk.peer, chunk.arrived_s)
            self._record(*reception.frames)
            # a stream may have buffered it: count it as arrived now
            at_s = clock.monotonic_s() if self._link.is_stream else chunk.arrived_s
            for event in reception.events:
                self._recovery.see(event, at_s)
        self._link.follow(self._session.peer)
        due = self._session.poll(clock.monotonic_s(), (ACTIVE, LANDING))
        self._send(*(message for message in due if isinstance(message, Heartbeat)))
        return bool(chunks)

    def _ask(self, text: str = "") -> None:
        request = self._recovery.due(clock.monotonic_s())
        if request:
            self._send(request)  # before all texts
        if text:
            self._text(text)
        if request:
            holds = request == self._dialect.hold()
            self._say(f"{'hold' if holds else 'land'} requested")
        while self._recovery.news:
            self._say(self._recovery.news.pop(0))

    def _say(self, sentence: str) -> None:
        """Report to the controller or its terminal, the ground station and the log."""
        self._tell.put(sentence)
        self._text(sentence)

    def _text(self, sentence: str) -> None:
        """Send a sentence to the ground station, and write it to the log as a record."""
        self._text_id += 1
        text = f"supervisor: {sentence}"
        self._send(*texts.chunks(WARNING, text, self._text_id))
        for piece in event_record.pieces(EventRecord(text, cause=SUPERVISOR)):
            self._record(self._session.encode(piece))

    def _send(self, *messages: Outgoing) -> None:
        for message in messages:
            frame = self._session.encode(message)
            self._link.send(frame, self._session.peer)
            self._record(frame)

    def _record(self, *frames: bytes) -> None:
        for frame in frames:
            self._log.put(entry(clock.unix_us(), frame))


def _known(vehicle: Mapping[str, Any], setpoint_loss: Mapping[str, Any], **more: Any) -> Supervised:
    """Make a `Supervised` of the JSON of a beat."""
    return Supervised(VehicleFound(**vehicle), setpoint_loss=SetpointLoss(**setpoint_loss), **more)


def _link(descriptors: list[int], stream: str, *, listens: bool) -> Link:
    """Return the link that has these descriptors. `stream`: the name of a stream, empty for UDP.
    `listens`: whether the first descriptor of a stream listens for clients."""
    if not stream:
        return UdpLink(*(socket.socket(fileno=each) for each in descriptors))
    listening = socket.socket(fileno=descriptors[0]) if listens else None
    vehicle = descriptors[listens] if len(descriptors) > listens else None
    begun = None if vehicle is None else Stream(vehicle, partial(os.close, vehicle))
    return ListeningLink(listening, stream, begun) if listening else StreamLink(begun, stream)


def main() -> None:
    """Watch until the controller ends or hangs, and take its place if the vehicle flies for it."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # these signals are meant for the controller
    channel = socket.socket(fileno=os.dup(sys.stdin.fileno()))
    watch = Watch(channel)
    with suppress(OSError):  # the controller has ended already
        _say_to(channel, READY)
    reason, before_s = "", clock.monotonic_s()
    while not (reason or watch.ended):
        select.select([], [], [], POLL_S)
        now_s = clock.monotonic_s()
        reason, before_s = watch.turn(now_s - before_s), now_s
    if reason and watch.known:
        tell = BackgroundWriter[str](lambda said: _tell(channel, said), 1000)
        try:  # a controller that still runs must know it before anything is sent to the vehicle
            _say_to(channel, f"taking over: {reason}")
        except OSError:
            tell.put(f"taking over: {reason}")
        TakeOver(watch, watch.known, tell).run(reason)
        tell.close(CLOSE_S)
        log, watch.descriptors = watch.descriptors[-1], []  # those of the link are closed
        watch.turn(0.0)  # the controller may have been killed in the meantime
        if watch.ended:
            _score(log)


def _score(log: int) -> None:
    """Score the flight in place of the controller. `log`: descriptor of the log."""
    with suppress(OSError):
        path = Path(f"/proc/self/fd/{log}").readlink()
        if path.name == "flight.tlog":
            begin("score", path.parent)


def _say_to(channel: socket.socket, sentence: str) -> None:
    channel.send(json.dumps(sentence).encode() + b"\n")


def _tell(channel: socket.socket, sentences: list[str]) -> None:
    """Report to the controller; if it has ended, to the terminal, which may block."""
    for sentence in sentences:
        try:
            _say_to(channel, sentence)
        except OSError:
            os.write(2, f"offboard supervisor: {sentence}\n".encode())


if __name__ == "__main__":
    main()
