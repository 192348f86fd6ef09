"""What the service's next flight begins with: the configuration, read again while the service
waits, and the vehicle as earlier flights have identified it.

`DIR/vehicles/KEY.yaml` holds an identified vehicle, the uncertainty of its delays, the delay of the
link, and a digest of the vehicle file that the identification began with. With another vehicle file
it is not used.
"""

from __future__ import annotations

import hashlib
import math
import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import yaml
from pydantic import Field

from offboard.documents.errors import DocumentError
from offboard.documents.parameters import Parameters
from offboard.documents.reading import parse
from offboard.documents.shipped import read_text
from offboard.identification.vehicle_estimate import IdentifiedVehicle
from offboard.link.log import replace_file
from offboard.model.vehicle import Vehicle
from offboard.run.configuration import FlightConfig, dump
from offboard.run.flight import Prepared, build, rehearse

EVERY_S = 2.0  # between two readings of the configuration


class Preparation:
    """Keeps the newest usable configuration that `load` has returned in `newest`. A thread calls
    `load` every EVERY_S while `allowed` is True; it is False while the vehicle is armed. A changed
    configuration is built, and its controller is called, so that nothing is compiled in flight.
    `tell` is called with what happens before the first one is ready. Raises DocumentError if that
    cannot be used."""

    def __init__(self, load: Callable[[], FlightConfig], tell: Callable[[str], None]) -> None:
        self._load = load
        self.newest = _ready(load(), tell)
        self._refused = ""  # text of the newest refused one, or why it has no text
        self._news: deque[str] = deque()
        self.allowed = True
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True, name="configuration")

    def start(self) -> None:
        """Begin to watch the configuration."""
        self._thread.start()

    def close(self) -> None:
        self._ended.set()

    def news(self) -> list[str]:
        """Return the sentences about configurations since the last call."""
        return [self._news.popleft() for _ in range(len(self._news))]

    def _run(self) -> None:
        while not self._ended.wait(EVERY_S):
            if self.allowed:
                self.look()

    def look(self) -> None:
        """Read the configuration again, and use it if it has changed. A refused one is tried again,
        because the computer may have been too busy for it, but it is announced only once."""
        text = ""
        try:
            config = self._load()
            text = dump(config)
            if text != self.newest.text:
                self.newest = _ready(config, self._news.append)
                self._news.append("the configuration has changed: used from the next flight on")
            self._refused = ""
        except Exception as error:  # whatever a controller raises, the old configuration is kept
            sentence = "; ".join(str(error).splitlines())
            refused = text or sentence  # the sentence may have figures that vary
            if refused != self._refused:
                self._news.append(f"the configuration is refused, the old one is kept: {sentence}")
            self._refused = refused


def _ready(config: FlightConfig, tell: Callable[[str], None]) -> Prepared:
    prepared = build(config)
    rehearse(prepared, keeps_deadline=True, tell=tell)
    return prepared


# --- identified vehicles ---


class Document(Parameters):
    """The content of a file of an identified vehicle."""

    identified_from: str  # digest of the vehicle file
    tilt_delay_sd_s: float = Field(gt=0, le=1)
    link_delay_s: float = Field(ge=0, le=10)
    thrust_delay_sd_s: float | None = Field(default=None, gt=0, le=1)  # of delay and lag together
    vehicle: Vehicle


class VehicleFiles:
    """The files of identified vehicles in `directory`. They are read at the start, and written by a
    thread. `tell` is called with sentences about files that cannot be used."""

    def __init__(self, directory: Path, tell: Callable[[str], None]) -> None:
        self._directory = directory
        self._known: dict[str, tuple[str, IdentifiedVehicle]] = {}
        self._clerk = ThreadPoolExecutor(max_workers=1, thread_name_prefix="vehicles")
        for path in sorted(directory.glob("*.yaml")) if directory.is_dir() else ():
            try:
                self._known[path.stem] = _load(path)
            except (DocumentError, OSError) as error:
                tell(f"{path} is not used: {error}")

    def get(self, key: str, prepared: Prepared) -> IdentifiedVehicle | None:
        """What is known about this vehicle if it was identified from the same vehicle file."""
        source, identified = self._known.get(key, ("", None))
        return identified if source == _digest(prepared.config.vehicle) else None

    def keep(self, key: str, prepared: Prepared, identified: IdentifiedVehicle) -> None:
        source = _digest(prepared.config.vehicle)
        self._known[key] = source, identified
        self._clerk.submit(self._write, key, source, identified)

    def discard(self, key: str) -> None:
        self._known.pop(key, None)
        self._clerk.submit(self._remove, key)

    def close(self) -> None:
        self._clerk.shutdown(wait=True)

    def _write(self, key: str, source: str, identified: IdentifiedVehicle) -> None:
        thrust_sd_s = identified.thrust_sd_s
        document = {
            "identified_from": source,
            "tilt_delay_sd_s": identified.delay_sd_s,
            "link_delay_s": identified.link_s,
            "thrust_delay_sd_s": thrust_sd_s if math.isfinite(thrust_sd_s) else None,
            "vehicle": identified.vehicle.model_dump(mode="json"),
        }
        path = self._directory / f"{key}.yaml"
        with suppress(OSError):  # then the next start identifies it again
            replace_file(path, yaml.safe_dump(document, sort_keys=False))

    def _remove(self, key: str) -> None:
        with suppress(OSError):
            (self._directory / f"{key}.yaml").unlink()


def _load(path: Path) -> tuple[str, IdentifiedVehicle]:
    document = parse(read_text(path), Document, str(path))
    identified = IdentifiedVehicle(
        document.vehicle,
        document.tilt_delay_sd_s,
        document.link_delay_s,
        document.thrust_delay_sd_s or math.inf,
    )
    return document.identified_from, identified


def _digest(vehicle: Vehicle) -> str:
    return hashlib.sha256(vehicle.model_dump_json().encode()).hexdigest()[:16]
