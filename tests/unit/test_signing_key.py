"""Key files of MAVLink 2 signing: what is made, what is refused, and that nothing shows the key."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

import pytest
from processes import full_disk

from offboard.documents.errors import UserError
from offboard.documents.signing_key import FILE_BYTES_MAX, create_key, read_key

SECRET = "0123456789abcdef" * 4


def written(path: Path, text: str, mode: int = 0o600) -> Path:
    path.write_text(text)
    path.chmod(mode)
    return path


def test_a_new_key_is_private_random_and_the_hash_of_its_passphrase(tmp_path: Path) -> None:
    before = os.umask(0o777)  # as far as a umask can go
    try:
        passphrases = [create_key(tmp_path / name) for name in "ab"]
    finally:
        os.umask(before)
    assert (tmp_path / "a").stat().st_mode & 0o777 == 0o600
    assert passphrases[0] != passphrases[1]
    assert all(len(bytes.fromhex(each)) == 32 for each in passphrases)
    key = hashlib.sha256(passphrases[0].encode()).digest()
    assert read_key(tmp_path / "a") == key
    with pytest.raises(UserError, match="exists and is not replaced"):
        create_key(tmp_path / "a")
    assert read_key(tmp_path / "a") == key


def test_a_file_that_cannot_be_written_whole_is_not_left(tmp_path: Path) -> None:
    with full_disk(20), pytest.raises(UserError, match="cannot be created: File too large"):
        create_key(tmp_path / "key")
    assert not (tmp_path / "key").exists()


@pytest.mark.parametrize(
    ("text", "key"),
    [
        (f"# mine\n\nkey: {SECRET}\n", bytes.fromhex(SECRET)),
        (f"key:{SECRET.upper()}", bytes.fromhex(SECRET)),
        ("passphrase: sixteen letters!", hashlib.sha256(b"sixteen letters!").digest()),
        ("passphrase: a: b, c and d: e\r\n", hashlib.sha256(b"a: b, c and d: e").digest()),
    ],
)
def test_both_forms_are_read(text: str, key: bytes, tmp_path: Path) -> None:
    assert read_key(written(tmp_path / "key", text)) == key


@pytest.mark.parametrize(
    "text",
    [
        "",
        SECRET,
        f"key: {SECRET[:-1]}",
        f"key: {SECRET}0",
        f"key: {SECRET[:-1]}g",
        f"key: {'0' * 64}",
        f"key: {SECRET}\nkey: {SECRET}",
        "passphrase: fifteen letters",
        f"secret: {SECRET}",
        "key: \xff",
    ],
)
def test_what_is_no_key_is_refused_without_showing_it(text: str, tmp_path: Path) -> None:
    with pytest.raises(UserError) as refused:
        read_key(written(tmp_path / "key", text))
    sentence = str(refused.value)
    assert "too short or no key file" in sentence
    assert len(sentence.splitlines()) == 1
    assert not any(each in sentence for each in (SECRET, SECRET[:-1], "fifteen letters"))


def test_a_file_that_others_can_use_is_refused(tmp_path: Path) -> None:
    for mode in (0o640, 0o604, 0o620, 0o601):
        with pytest.raises(UserError, match="by other users: chmod 600 it"):
            read_key(written(tmp_path / "key", f"key: {SECRET}", mode))


def test_what_is_no_file_is_refused_without_waiting(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo", 0o600)
    large = written(tmp_path / "large", "#" * (FILE_BYTES_MAX + 1))
    for path, reason in (
        (tmp_path, "is not a file"),
        (tmp_path / "fifo", "is not a file"),
        (tmp_path / "none", "No such file"),
        (large, "4,097 bytes: that is no key file"),
        (Path("a\0b"), "cannot be read"),
    ):
        with pytest.raises(UserError, match=reason):
            read_key(path)
