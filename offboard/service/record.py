"""The logs of the service: one directory for each flight, and a bounded rolling log between them.

The rolling log is two files of at most `ROLLING_BYTES`; when one is full, the other is begun anew.
A flight's log begins with its configuration, with what the vehicle sends only once, and with the
last seconds before the flight, so that it is complete by itself. Files are opened, written and
closed by threads: the loop waits for none of them.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from itertools import chain, count
from pathlib import Path

from offboard.flight.record import configuration_pieces, vehicle_record
from offboard.link import clock
from offboard.link.background import BackgroundWriter
from offboard.link.log import CLOSE_S, QUEUED_MAX, FlightLog, LogError, append, entry
from offboard.mavlink.framing import message_id_of, payload_of
from offboard.mavlink.session import Session

ROLLING_BYTES = 16 * 2**20
ROLLING_NAMES = ("standby.1.tlog", "standby.2.tlog")
BEFORE_US = 5_000_000  # time before a flight, in microseconds, that its log holds too
BEFORE_MAX = 20_000  # most frames of this time
PARAM_VALUE = 22
SENT_ONCE = {PARAM_VALUE, 49, 148, 242}  # GPS_GLOBAL_ORIGIN, AUTOPILOT_VERSION, HOME_POSITION
PARAM_ID = slice(8, 24)  # in the payload of PARAM_VALUE
KEPT_MAX = 100  # most parameters whose newest PARAM_VALUE is kept
ENGAGED = "engaged"  # file of a flight, with the key of a vehicle that was not handed back
ENGAGED_MAX_S = 600.0  # after the end of the log: a vehicle that was left longer ago has landed


class RollingLog:
    """Two files in `directory` that stay open until `close`, so that another process can have their
    descriptors. Raises LogError."""

    def __init__(self, directory: Path) -> None:
        flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND
        try:
            directory.mkdir(parents=True, exist_ok=True)
            self._descriptors = [os.open(directory / n, flags, 0o666) for n in ROLLING_NAMES]
        except OSError as error:
            raise LogError(
                f"the service cannot record in {directory}: {error.strerror}; choose a directory "
                "that can be written with --out"
            ) from None
        self._written = 0
        self._writer = BackgroundWriter[bytes](self._append, QUEUED_MAX)

    @property
    def descriptor(self) -> int:
        """Descriptor of the file that is being written."""
        return self._descriptors[0]

    def write(self, unix_us: int, frame: bytes) -> None:
        self._writer.put(entry(unix_us, frame))

    def _append(self, records: list[bytes]) -> None:
        size = sum(map(len, records))
        if self._written + size > ROLLING_BYTES:
            self._descriptors.reverse()
            os.ftruncate(self._descriptors[0], 0)
            self._written = 0
        self._written += size
        with suppress(OSError):  # a full disk ends no service; the flights' logs report it
            append(self._descriptors[0], records)

    def close(self) -> None:
        self._writer.close(CLOSE_S)
        if self._writer.is_free():
            for descriptor in self._descriptors:
                os.close(descriptor)


class FlightRecord(FlightLog):
    """The log of one flight of `vehicle`, with its file `engaged`. The loop waits for no disk."""

    def __init__(self, directory: Path, configuration: str, vehicle: str) -> None:
        super().__init__(directory, configuration, real_time=True)
        self.vehicle = vehicle
        self.start()

    def _open(self) -> None:
        self.directory.mkdir(parents=True, exist_ok=True)
        # written first, whatever fails afterwards
        (self.directory / ENGAGED).write_text(self.vehicle, encoding="utf-8")
        super()._open()


class Recorder:
    """The log for the loop, and the directories of the flights, below `directory`. No method except
    `close` waits. `score` gives a flight to the process that scores it and outlives this one; a
    failure is ignored. `unscored`: the directories of flights of earlier services without a score.
    """

    def __init__(self, directory: Path, *, score: Callable[[Path], object]) -> None:
        self._directory = directory
        self._score = score
        self._rolling = RollingLog(directory)
        self._flight: FlightRecord | None = None
        self._before: deque[tuple[int, bytes]] = deque(maxlen=BEFORE_MAX)
        self._once: dict[tuple[int, bytes], tuple[int, bytes]] = {}
        self._clerk = ThreadPoolExecutor(max_workers=1, thread_name_prefix="record")
        self._closed = False
        self._engaged = sorted(path.parent for path in directory.glob(f"*/{ENGAGED}"))
        self._left, self._left_until_s = _left(self._engaged)
        logs = sorted(directory.glob("*/flight.tlog"))
        self.unscored = [log.parent for log in logs if not (log.parent / "score.json").exists()]
        # read only once, because in flight the file system may make its caller wait
        self._taken = {path.name for path in directory.iterdir()}

    # ------------------------------------------------------------------ the loop's log

    @property
    def descriptor(self) -> int:
        """Descriptor of the file that is being written."""
        flight = self._flight
        return flight.descriptor if flight and flight.descriptor >= 0 else self._rolling.descriptor

    @property
    def problem(self) -> str:
        """What the log of the present flight has lost. Losses of the rolling log do not count."""
        return self._flight.problem if self._flight else ""

    @property
    def lost(self) -> int:
        return self._flight.lost if self._flight else 0

    def write(self, unix_us: int, frame: bytes) -> None:
        """Queue one frame and its Unix time."""
        if self._flight:
            self._flight.write(unix_us, frame)
            return
        self._rolling.write(unix_us, frame)
        self._before.append((unix_us, frame))
        while not 0 <= unix_us - self._before[0][0] <= BEFORE_US:  # the wall clock may be set
            self._before.popleft()
        message = message_id_of(frame)
        if message in SENT_ONCE:
            name = message, payload_of(frame)[PARAM_ID] if message == PARAM_VALUE else b""
            if message != PARAM_VALUE or name in self._once or len(self._once) < KEPT_MAX:
                self._once[name] = unix_us, frame

    # ------------------------------------------------------------------ flights

    def begin(self, session: Session, configuration: str, vehicle: str) -> str:
        """Begin the log of a flight of `vehicle`, given by its key. Returns its directory."""
        self.settle()
        directory = self._new_directory()
        self._engaged = [directory]
        self._flight = flight = FlightRecord(directory, configuration, vehicle)
        now_us = clock.unix_us()
        assert session.vehicle is not None
        found = vehicle_record(session.vehicle)
        for piece in (*configuration_pieces(configuration), found):
            flight.write(now_us, session.encode(piece))
        newest = set(self._before)
        earlier = [each for each in self._once.values() if each not in newest]
        for sent_us, frame in (*earlier, *self._before):
            flight.write(sent_us, frame)
        self._before.clear()
        return str(directory)

    def _new_directory(self) -> Path:
        """Return a directory with a name that is not taken yet: flights may begin in the same
        second, and an existing directory is not overwritten."""
        stamp = clock.local_stamp()
        names = chain([stamp], (f"{stamp}-{number}" for number in count(2)))
        name = next(each for each in names if each not in self._taken)
        self._taken.add(name)
        return self._directory / name

    def end(self, *, engaged: bool) -> None:
        """Close the flight's log and score it, in another thread. `engaged`: whether the vehicle
        may still be in the mode of setpoints."""
        vehicle = self._flight.vehicle if self._flight else ""
        self._close_flight()
        if engaged:
            self._left, self._left_until_s = vehicle, clock.monotonic_s() + ENGAGED_MAX_S
        else:
            self.settle()

    def _close_flight(self) -> None:
        flight, self._flight = self._flight, None
        if flight:
            self._clerk.submit(self._finish, flight)

    def _finish(self, flight: FlightRecord) -> None:
        flight.close()
        if flight.path.exists():
            self._score(flight.directory)

    @property
    def left(self) -> str:
        """Key of the vehicle that the previous flight left engaged, for example because the service
        was killed; empty if there is none."""
        return self._left if clock.monotonic_s() < self._left_until_s else ""

    def settle(self) -> None:
        """Note that no vehicle is left engaged any more."""
        files = [directory / ENGAGED for directory in self._engaged]
        self._left, self._engaged = "", []
        if self._closed:
            _remove(files)
        elif files:
            self._clerk.submit(_remove, files)

    def close(self) -> None:
        if self._closed:
            return
        self._close_flight()
        self._closed = True
        self._clerk.shutdown(wait=True)
        self._rolling.close()


def _left(engaged: list[Path]) -> tuple[str, float]:
    """Key of the vehicle of the newest flight, and monotonic time until which it may be engaged."""
    with suppress(IndexError, OSError, ValueError):
        ended_us = (engaged[-1] / "flight.tlog").stat().st_mtime_ns // 1000
        passed_s = 1e-6 * (clock.unix_us() - ended_us)
        if passed_s < ENGAGED_MAX_S:
            vehicle = (engaged[-1] / ENGAGED).read_text(encoding="utf-8")
            # it is negative if the wall clock is behind, as after a boot until it is set
            return vehicle, clock.monotonic_s() + ENGAGED_MAX_S - max(passed_s, 0.0)
    return "", 0.0


def _remove(paths: list[Path]) -> None:
    for path in paths:
        with suppress(OSError):
            path.unlink()
