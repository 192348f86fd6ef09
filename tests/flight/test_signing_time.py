"""The time stamp of signing that is kept on disk, and whole flights over a signed link."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

import pytest
from pair import Pair, calm_hover, hover, in_phase

from offboard.analysis import history
from offboard.analysis.score import score
from offboard.documents.errors import UserError
from offboard.flight.phases import ExitCode, Phase
from offboard.link import clock
from offboard.link.signing_time import SigningTime, state_directory
from offboard.mavlink.outgoing import Heartbeat
from offboard.mavlink.session import Session, SessionSettings
from offboard.mavlink.signing import RESERVED

KEY = bytes(range(32))


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    return tmp_path / "state" / "offboard"


def test_signing_stamps_increase_across_clock_steps_and_restarts(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Stamps are reserved in the file before they are used, here during an hour per clock."""
    now_s, newest = clock.monotonic_s(), 0
    monkeypatch.setattr(clock, "monotonic_s", lambda: now_s)
    for unix_s in (1_800_000_000, 1_800_000_010, 1_700_000_000, 0, 1_900_000_000):
        monkeypatch.setattr(clock, "unix_us", lambda unix_s=unix_s: unix_s * 1_000_000)
        kept = SigningTime(KEY)
        session = Session(SessionSettings(), kept.__enter__())
        for _ in range(120):
            now_s += 30.0
            stamp = int.from_bytes(session.encode(Heartbeat(18))[-12:-6], "little")
            assert stamp > newest
            newest = stamp
        kept.__exit__()  # waits for the disk; a crash leaves as much in the file
        (file,) = home.iterdir()
        assert newest < int(file.read_text()) <= newest + RESERVED
    assert newest >= (1_900_000_000 - 1_420_070_400) * 100_000


def test_each_key_has_a_file_that_does_not_show_it(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for key in (KEY, bytes(32)):
        with SigningTime(key):
            pass
    names = [file.name for file in home.iterdir()]
    assert len(names) == 2
    assert not any(KEY.hex()[:8] in name for name in names)
    monkeypatch.setenv("STATE_DIRECTORY", "/var/lib/a:/var/lib/b")  # set by systemd for a service
    assert state_directory() == Path("/var/lib/a")


def test_damaged_stamp_file_and_unwritable_directory_are_refused(home: Path) -> None:
    with SigningTime(KEY):
        pass
    (file,) = home.iterdir()
    for content in ("", "soon", "9" * 30, "\xff"):
        file.write_text(content, encoding="latin-1")
        with pytest.raises(UserError, match="if this computer's clock is right, delete"):
            SigningTime(KEY).__enter__()
    file.unlink()
    home.rmdir()
    home.write_text("a file")
    with pytest.raises(UserError, match="set XDG_STATE_HOME"):
        SigningTime(KEY).__enter__()


# --- flights ---


def signed_hover(**options: Any) -> Pair:
    """Return `hover` over a signed link."""
    pair = hover(key=KEY, **options)
    pair.instance.keyring.set_up(KEY, 1)
    return pair


def test_forged_frames_in_flight_change_nothing_and_are_counted(tmp_path: Path) -> None:
    """An attacker sends an unsigned HEARTBEAT in another mode, and replays earlier frames."""
    stop = Session(SessionSettings()).encode(Heartbeat(2))
    chance = random.Random(3)
    captured: list[bytes] = []

    def attack(time_s: float, datagrams: list[bytes]) -> list[bytes]:
        captured.extend(datagrams)
        del captured[:-200]
        attacks = round(time_s * 250) % 4 == 0 and bool(captured)
        return [*datagrams, stop, chance.choice(captured)] if attacks else datagrams

    attacked = signed_hover(down=attack)
    assert attacked.fly().exit_code == ExitCode.FLOWN
    assert len(attacked.payloads) == len(calm_hover().payloads)
    shown = attacked.companion.snapshot()
    assert shown.forged > 2000
    assert any("frames refused by signing" in line for line in attacked.companion.announced)
    assert not attacked.failsafes
    log = attacked.log(tmp_path)
    for component, least in ((191, 300), (1, 1000)):  # frames of ours and of the vehicle
        frames = [each.frame for each in log if each.component_id == component]
        assert sum(frame.signed for frame in frames) > least
    scored = score(history.gather(log))
    assert scored.other_datagrams > 800
    assert (scored.completed, scored.rmse_position_m < 0.05) == (1.0, True)
    assert KEY not in (tmp_path / "flight.tlog").read_bytes()


def test_vehicle_with_old_stamps_after_a_reboot_is_heard() -> None:
    pair = signed_hover()
    session: Any = pair.companion.session
    session._signing.offset = 10**12  # our clock is right, the vehicle's is years behind
    pair.at.append((in_phase(Phase.HEALTH, 1.0), lambda p: p.instance.reboot(0.5)))
    pair.at.append((in_phase(Phase.STREAM), lambda p: pytest.fail("it was not rebooted")))
    while not pair.instance.view.time_us < 1e6 * (pair.time_s - 0.5):
        pair.advance()
    pair.at.clear()
    while pair.companion.phase is not Phase.ARM:
        assert not pair.companion.has_ended(), pair.companion.outcome
        pair.advance()
    assert pair.companion.session.senders.forged.total() > 0


def test_vehicle_that_has_just_been_given_a_key_is_refused_with_that_reason() -> None:
    """Regression: only that no TIMESYNC request was answered was said."""
    pair = hover(limits={"health_s": 8.0})
    pair.at.append((in_phase(Phase.HEALTH, 0.1), lambda p: p.instance.keyring.set_up(KEY, 1)))
    outcome = pair.fly()
    assert outcome.exit_code == ExitCode.REFUSED
    assert "signs its messages. Fix: give its key with --signing-key" in outcome.sentence
