"""Key files of MAVLink 2 signing: one line with the key, or with a passphrase that gives the key.

    passphrase: TEXT      the key is the SHA-256 of the text, as in MAVProxy, QGroundControl and
                          Mission Planner, which can set it on a vehicle
    key: 64 hex digits    the 32 bytes of the key themselves

Lines that begin with # are comments. Only the owner of the file may have access to it. No error
message shows any of its contents.
"""

from __future__ import annotations

import hashlib
import os
import re
import secrets
import stat
from functools import partial
from pathlib import Path

from offboard.documents.errors import DocumentError, UserError, abridged
from offboard.documents.shipped import read_text

KEY_BYTES = 32
PASSPHRASE_MIN = 16  # characters
_OTHERS = stat.S_IRWXG | stat.S_IRWXO
_KEY = re.compile(
    rb"passphrase:\s*(?P<passphrase>\S.{%d,})|key:\s*(?P<key>[0-9a-fA-F]{%d})"
    % (PASSPHRASE_MIN - 1, 2 * KEY_BYTES)
)
_EXPECTED = (
    f"expected one line, 'passphrase: TEXT' with at least {PASSPHRASE_MIN} characters or "
    "'key: ' and 64 hexadecimal digits; `offboard key` makes a file"
)


def read_key(path: Path) -> bytes:
    """The 32 bytes of the key in the file at `path`. Raises UserError."""
    shown = f"signing key {abridged(path)}"
    try:
        content = read_text(path).encode()
    except DocumentError as error:  # a key file is not a configuration
        raise UserError(f"signing key {error}") from None
    if path.stat().st_mode & _OTHERS:
        raise UserError(f"{shown} can be read or changed by other users: chmod 600 it")
    rows = [row.strip() for row in content.splitlines()]
    rows = [row for row in rows if row and not row.startswith(b"#")]
    found = _KEY.fullmatch(rows[0]) if len(rows) == 1 else None
    if found and found["passphrase"]:
        return hashlib.sha256(found["passphrase"]).digest()
    if found and any(key := bytes.fromhex(found["key"].decode())):  # 0 disables MAVLink signing
        return key
    raise UserError(f"{shown} is too short or no key file: {_EXPECTED}")


def create_key(path: Path) -> str:
    """Create a key file at `path` with a random passphrase, and return the passphrase. Never
    replaces a file. Raises UserError."""
    passphrase = secrets.token_hex(KEY_BYTES)
    try:
        with open(path, "x", encoding="ascii", opener=partial(os.open, mode=0o600)) as file:
            try:
                os.fchmod(file.fileno(), 0o600)
                file.write(f"# MAVLink 2 signing key: keep it secret\npassphrase: {passphrase}\n")
                file.flush()
                os.fsync(file.fileno())
            except OSError:
                path.unlink(missing_ok=True)  # an incomplete key file is useless
                raise
    except FileExistsError:
        raise UserError(f"{abridged(path)} exists and is not replaced: name another") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise UserError(f"{abridged(path)} cannot be created: {reason}") from None
    return passphrase
