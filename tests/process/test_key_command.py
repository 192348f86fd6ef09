"""`offboard key`, and what the commands say about key files, as processes see them."""

from __future__ import annotations

from pathlib import Path

import pytest
from processes import Called

from offboard.documents.signing_key import read_key


@pytest.fixture
def call(called: Called, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Called:
    """`call("offboard", "key")` -> exit code, stdout, stderr."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    return called


def test_a_key_is_made_once_and_explained_without_showing_it(call: Called, tmp_path: Path) -> None:
    code, said, _ = call("offboard", "key", "my.key")
    assert code == 0
    assert "signing setup PASSPHRASE" in said
    assert "offboard fly --signing-key my.key" in said
    key = read_key(tmp_path / "my.key")
    text = (tmp_path / "my.key").read_text()
    assert text.split()[-1] not in said
    code, _, complaint = call("offboard", "key", "my.key")
    assert (code, len(complaint.splitlines())) == (2, 1)
    assert "my.key exists and is not replaced" in complaint
    assert read_key(tmp_path / "my.key") == key


@pytest.mark.parametrize(
    ("command", "content", "mode", "expected"),
    [
        ("offboard fly", None, 0, "signing key k cannot be read: No such file or directory"),
        ("offboard fly --sitl", "key: 12", 0o600, "signing key k is too short or no key file"),
        ("simulator", "key: " + "ab" * 32, 0o644, "k can be read or changed by other users"),
    ],
)
def test_a_bad_key_file_is_one_sentence_before_anything_is_sent(
    command: str, content: str | None, mode: int, expected: str, call: Called, tmp_path: Path
) -> None:
    if content is not None:
        (tmp_path / "k").write_text(content)
        (tmp_path / "k").chmod(mode)
    files = sorted(tmp_path.iterdir())
    code, _, complaint = call(*command.split(), "--signing-key", "k")
    assert (code, len(complaint.splitlines())) == (2, 1)
    assert expected in complaint
    assert "ab" * 32 not in complaint
    assert sorted(tmp_path.iterdir()) == files


def test_where_no_time_stamp_can_be_kept_nothing_is_flown(call: Called, tmp_path: Path) -> None:
    call("offboard", "key", "my.key")
    (tmp_path / "state").write_text("a file")
    connection = ("--connect", "udpin:127.0.0.1:PORT")
    code, _, complaint = call("offboard", "fly", *connection, "--signing-key", "my.key")
    assert code == 2
    assert "the time stamp of the signing key cannot be kept" in complaint
