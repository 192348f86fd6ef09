"""Recording: what a replay needs of a .tlog: the configuration, the inputs of each turn, frames."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from offboard.analysis import history, tlog
from offboard.analysis.history import record_type
from offboard.analysis.tlog import Tlog
from offboard.documents.errors import UserError
from offboard.flight import record
from offboard.flight.record import COMPONENT_ID, SETTINGS, Entry, Note


@dataclass(frozen=True, slots=True)
class Recording:
    """`settings` are those of the session: lockstep, stream, sends_first, capacity_bytes_ps."""

    log: Tlog
    configuration: str
    settings: dict[str, object]
    inputs: tuple[bytes, ...]  # the pieces of `flight.record`

    @property
    def signed(self) -> bool:
        """Whether the link was signed: then what we sent is, too."""
        return any(m.frame.signed for m in self.log if m.component_id == COMPONENT_ID)

    def entries(self) -> Iterator[Entry]:
        """The inputs in order. Raises record.InputsError where they are damaged."""
        return record.entries(self.inputs)


def read(flight: Path) -> Recording:
    """The recording in a flight directory or .tlog. Raises UserError or TlogError."""
    path = tlog.find(flight)
    log = tlog.read(path)
    configuration = history.configuration(log)
    if configuration is None:
        raise UserError(
            f"{path} does not hold the configuration of a flight: only logs of offboard can be "
            "replayed"
        )
    recorded = tuple(m.tunnelled for m in log if record_type(m) == record.PAYLOAD_TYPE)
    if not recorded:
        raise UserError(
            f"{path} cannot be replayed, only scored and reported: it has no inputs of each turn; "
            "a flight of `offboard daemon` goes on with what was received before its log begins"
        )
    return Recording(log, configuration, _settings(path, recorded), recorded)


def _settings(path: Path, recorded: tuple[bytes, ...]) -> dict[str, object]:
    try:
        first = next(record.entries(recorded), None)
    except record.InputsError as error:
        raise UserError(f"{path}: the record of the inputs is damaged: {error}") from None
    if not isinstance(first, Note) or first.values[0] != SETTINGS:
        raise UserError(f"{path}: the record of the inputs does not begin with the settings")
    return dict(first.values[1])
