"""The results of a campaign: one JSON file per finished flight, DIR/results/CODE/CASE.json. CODE is
a hash of the code that flies, so that results of different code are never mixed."""

from __future__ import annotations

import hashlib
import json
import platform
from dataclasses import asdict, dataclass, field
from functools import cache
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path

from pydantic import TypeAdapter

from offboard.documents import shipped
from offboard.documents.errors import UserError
from offboard.link.log import replace_file
from offboard.run.sitl import registered

# Folders of campaign and tuning files, which are not part of the code: each case has its own hash
PLANS = {shipped.folder(kind).name for kind in ("campaign", "tuning")}
PACKAGES = ("numpy", "scipy", "numba", "pymavlink", "daqp", "control")
INFEASIBLE = "infeasible"


@dataclass(frozen=True, slots=True)
class Record:
    """The result of a flight. `margin` and the name of its smallest term, `weakest`, are defined in
    `campaign.flight`; `figures` are the metrics of the score, without NaN."""

    exit_code: int
    sentence: str
    margin: float
    weakest: str
    figures: dict[str, float] = field(default_factory=dict)

    @property
    def completed(self) -> bool:
        return self.exit_code == 0

    @property
    def infeasible(self) -> bool:
        """Whether nothing was flown because the configuration cannot be flown."""
        return self.weakest == INFEASIBLE

    @property
    def breaks_a_promise(self) -> bool:
        return self.margin < 0.0 and not self.infeasible


_RECORD = TypeAdapter(Record)


class Results:
    """The results in a directory that were flown by one code, given by its hash.

    The constructor raises UserError if the directory cannot be written, or holds the results of
    other code.
    """

    def __init__(self, directory: Path, code: str) -> None:
        self.directory = directory
        self._folder = directory / "results" / code
        try:
            for other in (directory / "results").glob("*/"):
                if other.name != code:
                    raise UserError(
                        f"{directory} holds results of other code ({other.name}, this is {code}); "
                        "choose another --out, or delete its folder results"
                    )
            self._folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(
                f"{directory} cannot be written ({error.strerror}); choose another --out"
            ) from None

    def get(self, key: str) -> Record | None:
        """Return the record of a finished case, else None."""
        try:
            return _RECORD.validate_json((self._folder / f"{key}.json").read_bytes())
        except (OSError, ValueError):
            return None

    def put(self, key: str, record: Record) -> None:
        """Store a record at once. Raises UserError, for example when the disk is full."""
        self.write(self._folder / f"{key}.json", json.dumps(asdict(record), sort_keys=True))

    def finished(self) -> int:
        """Return the number of finished flights in the folder."""
        return sum(1 for _ in self._folder.glob("*.json"))

    def write(self, path: Path, text: str) -> None:
        """Write a file of the campaign, either completely or not at all. Raises UserError."""
        try:
            replace_file(path, text)
        except OSError as error:
            raise UserError(
                f"{self.directory} cannot be written ({error.strerror}); finished flights are kept"
            ) from None


@cache
def code_hash() -> str:
    """Return a hash of the sources of controller and simulator, the shipped configuration, and the
    versions of Python and of the packages in PACKAGES; 12 hexadecimal digits."""
    digest = hashlib.sha256(platform.python_version().encode())
    for package in PACKAGES:
        digest.update(f" {package} {version(package)}".encode())
    for folder, pattern in _sources():
        for path in sorted(folder.rglob(pattern)):
            if PLANS.isdisjoint(path.relative_to(folder).parts):
                digest.update(str(path.relative_to(folder)).encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:12]


def _sources() -> list[tuple[Path, str]]:
    packages = ("offboard", registered().module.partition(".")[0])
    specs = [find_spec(package) for package in packages]
    folders = [Path(spec.origin).parent for spec in specs if spec and spec.origin]
    return [*((folder, "*.py") for folder in folders), (shipped.directory(), "*.yaml")]
