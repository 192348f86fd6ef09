"""The time stamps of a signing key, kept on disk so that they never go back."""

from __future__ import annotations

import os
from contextlib import suppress
from hashlib import sha256
from pathlib import Path

from offboard.documents.errors import UserError
from offboard.link import clock
from offboard.link.background import BackgroundWriter
from offboard.link.log import replace_file
from offboard.mavlink.signing import RESERVED, UNITS_PER_S, Signing, stamp_of_unix

CLOSE_S = 2.0  # longest time to write the queue at the end
QUEUED_MAX = 1000  # stamps
CONTENT_MAX = 20  # bytes: a decimal stamp and a line end


def state_directory() -> Path:
    """The directory in which this user's time stamps are kept."""
    if named := os.environ.get("STATE_DIRECTORY"):
        return Path(named.split(":")[0])
    base = os.environ.get("XDG_STATE_HOME")
    return (Path(base) if base else Path.home() / ".local" / "state") / "offboard"


class SigningTime:
    """Context manager that gives the `Signing` of a key and keeps its time stamps.

    Entering raises UserError. If the disk fails later, the flight goes on, and stamps are no longer
    kept.
    """

    def __init__(self, key: bytes) -> None:
        self._key = key
        name = sha256(b"offboard signing " + key).hexdigest()[:16]
        self._path = state_directory() / f"signing-{name}"

    def __enter__(self) -> Signing:
        first = max(stamp_of_unix(clock.unix_us()), self._kept())
        reserved = first + RESERVED
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
            self._write([reserved])
        except OSError as error:
            raise UserError(
                f"the time stamp of the signing key cannot be kept in {self._path.parent}: "
                f"{error.strerror}; set XDG_STATE_HOME to a directory that can be written"
            ) from None
        self._writer = BackgroundWriter[int](self._write, QUEUED_MAX)
        return Signing(
            self._key,
            first - int(UNITS_PER_S * clock.monotonic_s()),
            clock.monotonic_s,
            self._writer.put,
            reserved,
        )

    def __exit__(self, *_: object) -> None:
        self._writer.close(CLOSE_S)

    def _kept(self) -> int:
        """The stamp on disk; 0 if there is no file. Raises UserError."""
        try:
            with self._path.open("rb") as file:
                content = file.read(CONTENT_MAX + 1)
            return int(content) if len(content) <= CONTENT_MAX else int("too long")
        except (FileNotFoundError, NotADirectoryError):
            return 0
        except OSError as error:
            reason = error.strerror
        except ValueError:
            reason = "it holds no time stamp"
        raise UserError(
            f"the time stamp of the signing key in {self._path} cannot be read ({reason}); if this "
            "computer's clock is right, delete the file"
        )

    def _write(self, stamps: list[int]) -> None:
        """Write the newest stamp to disk, unless another process has written a newer one. Raises
        OSError."""
        newest = stamps[-1]
        with suppress(UserError):
            newest = max(newest, self._kept())
        replace_file(self._path, f"{newest}\n")
