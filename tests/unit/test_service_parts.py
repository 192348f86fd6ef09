"""Parts of the service: logs, remembered vehicles, locks, changed configurations, engagement."""

from __future__ import annotations

import errno
import os
import socket
import subprocess
import sys
import time
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from offboard.analysis import tlog
from offboard.cli.daemon import disk_is_full
from offboard.documents.errors import Unavailable, UserError
from offboard.flight.authority import PilotSwitch
from offboard.flight.flight_plan import CLEAR_M, FlightPlan
from offboard.flight.record import joined_configuration
from offboard.identification.vehicle_estimate import IdentifiedVehicle
from offboard.link import clock
from offboard.link.lock import connection_lock, directory_lock
from offboard.link.log import LogError
from offboard.link.stop import StopRequests
from offboard.mavlink.events import VehicleFound
from offboard.mavlink.outgoing import Heartbeat
from offboard.mavlink.session import Session, SessionSettings
from offboard.reference.track import STOP_S
from offboard.run.configuration import load
from offboard.run.flight import build
from offboard.service import daemon, preparation, record
from offboard.service.daemon import Manager
from offboard.service.preparation import Preparation, VehicleFiles
from offboard.service.record import ROLLING_NAMES, Recorder

REST = (0.0, 0.0, 0.0)  # velocity


def session() -> Session:
    made = Session(SessionSettings())
    made.senders.set_vehicle(VehicleFound(1, 1, "px4"), "vehicle")
    return made


def recorded(directory: Path) -> tuple[Recorder, list[Path]]:
    """A recorder, and the flights that it has scored."""
    scored: list[Path] = []
    return Recorder(directory, score=scored.append), scored


@pytest.mark.parametrize("version_1", [False, True])
def test_flight_log_begins_with_the_last_five_seconds(
    version_1: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The log begins with the old home position, the last five seconds and the configuration."""
    monkeypatch.setattr(clock, "local_stamp", lambda: "now")
    recorder, scored = recorded(tmp_path)
    talk, began_us = session(), clock.unix_us() - 20_000_000
    codec = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    home = mavlink.MAVLink_gps_global_origin_message(1, 2, 3).pack(codec, version_1)
    recorder.write(began_us + 10**10, talk.encode(Heartbeat(30)))  # then the clock is set back
    for number in range(150):  # a ground station reads all parameters
        name = f"P{number}".encode()
        parameter = mavlink.MAVLink_param_value_message(name, number, 9, 150, number)
        recorder.write(began_us, parameter.pack(codec, version_1))
    recorder.write(began_us, home)
    for second in range(2, 20):
        recorder.write(began_us + second * 1_000_000, talk.encode(Heartbeat(6)))
    first = Path(recorder.begin(talk, "vehicle: neutral\n", "px4-1-7"))
    recorder.write(began_us + 20_000_000, talk.encode(Heartbeat(18)))
    recorder.end(engaged=False)
    while not scored:  # `close` would leave the scoring to the next start
        time.sleep(0.01)
    second_flight = Path(recorder.begin(talk, "vehicle: neutral\n", "px4-1-7"))
    recorder.close()
    assert (first.name, second_flight.name) == ("now", "now-2")
    assert scored == [first, second_flight]
    assert home in (first / "flight.tlog").read_bytes()
    log = tlog.read(first / "flight.tlog")
    assert 90 < [entry.name for entry in log].count("PARAM_VALUE") <= 100
    beats = [entry.message.type for entry in log if entry.name == "HEARTBEAT"]
    assert beats == [*[6] * 6, 18]
    pieces = [entry.message for entry in log if entry.name == "TUNNEL"]
    payloads = [bytes(piece.payload[: piece.payload_length]) for piece in pieces]
    assert joined_configuration(payloads) == "vehicle: neutral\n"
    assert (first / "flight.yaml").read_text() == "vehicle: neutral\n"


@pytest.mark.parametrize(("age_s", "left"), [(0, "px4-1-7"), (700, ""), (-4000, "px4-1-7")])
def test_next_service_finds_the_unscored_flight_and_engaged_vehicle(
    tmp_path: Path, age_s: int, left: str
) -> None:
    """The next service lists the flight, and knows the engaged vehicle for ten minutes. A log with
    a stamp in the future counts: this computer has booted, and its clock is not set yet."""
    killed, _ = recorded(tmp_path)
    cut = Path(killed.begin(session(), "", "px4-1-7"))
    killed.close()  # its threads write no more, the vehicle stays engaged
    changed_s = time.time() - age_s
    os.utime(cut / "flight.tlog", (changed_s, changed_s))
    recorder, _ = recorded(tmp_path)
    assert (recorder.left, recorder.unscored) == (left, [cut])
    recorder.settle()
    assert recorder.left == ""
    recorder.close()
    assert not (cut / "engaged").exists()


def test_vehicle_counts_as_engaged_until_hand_back(tmp_path: Path) -> None:
    recorder, scored = recorded(tmp_path)
    flights = []
    for engaged in (True, False, False, True):
        flights.append(Path(recorder.begin(session(), "", "px4-1-7")))
        recorder.end(engaged=engaged)
        assert recorder.left == ("px4-1-7" if engaged else "")
    recorder.close()
    assert scored == flights
    assert [(flight / "engaged").exists() for flight in flights] == [False, False, False, True]
    again, _ = recorded(tmp_path)
    assert again.left == "px4-1-7"
    again.close()


def test_the_rolling_log_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(record, "ROLLING_BYTES", 20_000)
    recorder, _ = recorded(tmp_path)
    frame = session().encode(Heartbeat(6))
    for number in range(4000):
        recorder.write(number * 1000, frame)
        if number % 100 == 0:  # the writing thread takes them in several batches
            while recorder._rolling._writer._queue:
                pass
    recorder.close()
    sizes = [(tmp_path / name).stat().st_size for name in ROLLING_NAMES]
    assert 4000 * (len(frame) + 8) > 100_000 > 20_000 >= max(sizes)
    assert sum(sizes) > 10_000


def test_recorder_reports_a_write_error_and_records_the_next_flight(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(clock, "local_stamp", iter([f"{ROLLING_NAMES[0]}/x", "later"]).__next__)
    recorder, scored = recorded(tmp_path)
    talk = session()
    recorder.begin(talk, "", "")
    deadline_s = time.monotonic() + 10.0
    while not recorder.problem and time.monotonic() < deadline_s:
        recorder.write(1, talk.encode(Heartbeat(6)))
        time.sleep(0.01)
    assert "cannot be written (Not a directory)" in recorder.problem
    recorder.end(engaged=False)
    recorder.begin(talk, "", "")
    assert recorder.problem == ""
    recorder.close()
    assert scored == [tmp_path / "later"]


def test_stored_vehicle_is_used_only_with_the_same_file(tmp_path: Path) -> None:
    known = build(load("flight", choices={"vehicle": "px4_sih"}))
    found = known.config.vehicle.model_copy(update={"hover_thrust": 0.51})
    identified = IdentifiedVehicle(found, 0.002, 0.008, 0.04)
    files = VehicleFiles(tmp_path / "vehicles", print)
    files.keep("px4-1-1", known, identified)
    assert files.get("px4-1-1", known) is identified
    files.close()
    told: list[str] = []
    (tmp_path / "vehicles" / "bad.yaml").write_text("tilt_delay_s: no\n")
    again = VehicleFiles(tmp_path / "vehicles", told.append)
    assert again.get("px4-1-1", known) == identified
    assert again.get("px4-2-1", known) is None
    assert len(told) == 1
    assert "bad.yaml is not used" in told[0]
    other = build(load("flight", choices={"vehicle": "arducopter"}))
    assert again.get("px4-1-1", other) is None
    again.discard("px4-1-1")
    again.close()
    assert not (tmp_path / "vehicles" / "px4-1-1.yaml").exists()


def test_lock_names_its_holder_and_is_released_with_it(tmp_path: Path) -> None:
    """The holder runs as a systemd unit does and, if possible, as another user."""
    code = (
        "import os, sys\n"
        "from offboard.link.lock import connection_lock\n"
        "if os.getuid() == 0: os.setuid(65534)\n"
        "with connection_lock('udpin:127.0.0.1:1'), connection_lock('tcp:127.0.0.1:1', 255):\n"
        "    print('held', flush=True)\n"
        "    sys.stdin.read()\n"
    )
    holder = subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        env=os.environ | {"RUNTIME_DIRECTORY": str(tmp_path)},
    )  # fmt: skip
    assert holder.stdout is not None
    assert holder.stdout.readline() == b"held\n"
    with connection_lock("udpin:127.0.0.1:2"), connection_lock("tcp:127.0.0.1:1", 2):
        pass  # another connection, another vehicle behind the same router
    router = "tcp:127.0.0.1:1"
    held = ("udpin:127.0.0.1:1",), ("udpin:127.0.0.1:1", 2), (router, 255), (router,)
    for each in held:
        again = connection_lock(*each)
        with pytest.raises(Unavailable, match=f"process {holder.pid}$"), again:
            pass
    holder.kill()
    holder.wait()
    with connection_lock("udpin:127.0.0.1:1"), connection_lock(router):
        for system in (None, 1, 255):
            with pytest.raises(Unavailable, match=f"process {os.getpid()}$"):
                connection_lock(router, system).__enter__()
    ours = f"has the directory {tmp_path}/new.*: process {os.getpid()}$"
    with directory_lock(tmp_path / "new"), pytest.raises(Unavailable, match=ours):
        directory_lock(tmp_path / "new").__enter__()
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match=r"service.lock, .*file/new \(--out\): Not a directory"):
        directory_lock(tmp_path / "file/new").__enter__()


def test_lock_counts_as_held_if_its_holder_may_not_be_asked(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """AppArmor and SELinux refuse a connection to a program of another domain."""

    def refuses(*_: object) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(socket.socket, "connect", refuses)
    with pytest.raises(Unavailable, match="process unknown"):
        connection_lock("tcp:127.0.0.1:1", 1).__enter__()


def test_full_disk_is_told_apart_from_a_wrong_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with pytest.raises(LogError) as wrong:
        recorded(Path("/dev/null/flights"))
    monkeypatch.setattr(os, "open", full)
    with pytest.raises(LogError) as passing:
        recorded(tmp_path)
    assert [disk_is_full(each.value) for each in (wrong, passing)] == [False, True]


def test_daemon_explains_why_its_unit_cannot_read_a_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "home" / "my.yaml"
    file.parent.mkdir()
    file.touch(0o644)
    assert daemon.unreadable(file).startswith(f"the unit cannot see {file}: it has its own /tmp")
    monkeypatch.setattr(daemon, "PRIVATE", ())
    tmp_path.chmod(0o750)
    assert daemon.unreadable(file).endswith("is closed to others")
    assert daemon.unreadable(Path("/etc/passwd")) == ""


def test_daemon_retries_a_port_in_use(monkeypatch: pytest.MonkeyPatch) -> None:
    """A port in use is reported once and tried until it is free. A wrong address is an error."""
    monkeypatch.setattr(daemon, "LINK_EVERY_S", 0.01)
    holder = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    holder.bind(("127.0.0.1", 0))
    alive, told = [], []

    class Watching(Manager):
        def alive(self, now_s: float, status: str = "") -> None:
            alive.append(now_s)
            if len(alive) == 3:
                holder.close()

    address = f"udpin:127.0.0.1:{holder.getsockname()[1]}"
    with StopRequests() as stops:
        link = daemon.opened(address, stops, told.append, Watching())
        assert link is not None
        link.close()
        assert told == [
            f"connection '{address}' cannot be opened: Address already in use; another program "
            "uses the port; trying again"
        ]
        for wrong in ("udpin:127.0.0.1", f"udpin:{'x' * 300}:14540"):
            with pytest.raises(UserError):
                daemon.opened(wrong, stops, told.append, Watching())


def test_systemd_notifications_do_not_block(monkeypatch: pytest.MonkeyPatch) -> None:
    """The manager reads nothing until its queue is full; a dropped message is sent again."""
    name = f"offboard-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(f"\0{name}")
        monkeypatch.setenv("NOTIFY_SOCKET", f"@{name}")
        manager = Manager()
        for second in range(1, 1000):  # net.unix.max_dgram_qlen is 512 at most
            manager.alive(float(second), f"{second}")
        systemd.settimeout(10.0)
        assert systemd.recv(100) == b"READY=1\nWATCHDOG=1\nSTATUS=1"
        systemd.setblocking(False)
        with suppress(BlockingIOError):
            while systemd.recv(100):
                pass
        manager.alive(1000.0, "1000")
        assert systemd.recv(100) == b"READY=1\nWATCHDOG=1\nSTATUS=1000"


def test_changed_configuration_is_used_and_a_bad_one_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(preparation, "rehearse", lambda parts, keeps_deadline, tell: None)
    file = tmp_path / "my.yaml"
    text = "vehicle: px4_sih\ncontroller: lqr\nreference: {shape: hover, height_m: %s}\n"
    file.write_text(text % 2)
    watched = Preparation(partial(load, str(file)), print)
    first = watched.newest

    def news(height: object) -> list[str]:
        file.write_text(text % height)
        watched.look()
        watched.look()
        return watched.news()

    assert news(2) == []
    (refused,) = news("high")
    assert refused.startswith("the configuration is refused, the old one is kept: ")
    assert "height_m" in refused
    assert watched.newest is first
    for _ in range(2):
        (refused,) = news(200)  # is read, but cannot be flown
        assert "landing from 200 m takes 155.7 s" in refused
        assert watched.newest is first
        assert news(2) == []
    assert news(3) == ["the configuration has changed: used from the next flight on"]
    assert "height_m: 3" in watched.newest.text


def test_pilot_switch_engages_only_in_the_air_without_failsafe() -> None:
    switch = PilotSwitch.FOUND

    def shows(
        ours: bool, failsafe: bool | None = False, in_the_air: bool = True, flies: bool = True
    ) -> bool:
        nonlocal switch
        switch = switch.after(
            in_engage_mode=ours, in_the_air=in_the_air, flies=in_the_air and flies,
            failsafe=failsafe,
        )  # fmt: skip
        return switch is PilotSwitch.ENGAGED

    assert not shows(ours=True)  # in this mode from the start
    assert not shows(ours=False, failsafe=True)
    assert not shows(ours=True)  # PX4 returns to it by itself after the failsafe
    assert switch is PilotSwitch.IDLE
    assert not shows(ours=False)
    assert shows(ours=True)
    assert not shows(ours=False)
    assert not shows(ours=True, in_the_air=False)
    assert not shows(ours=True)  # took off in this mode
    for flies in (True, False):  # it must fly by every sign
        assert not shows(ours=False)
        assert shows(ours=True, failsafe=None, flies=flies) is flies
    assert not shows(ours=False, failsafe=None)
    assert not shows(ours=True)
    assert switch is PilotSwitch.TOO_SOON


def test_low_reference_is_raised_clear_of_the_ground() -> None:
    """The reference is a helix that descends by 4 m."""
    config = load(
        "flight",
        choices={"reference": "helix", "vehicle": "px4_sih"},
        assignments=("reference.climb_mps=-0.4", "reference.height_m=20"),
    )
    plan = FlightPlan(build(config).track)
    start, times = plan.track.sample(0.0).position_ned_m, range(60)
    lowest = max(float(plan.track.sample(float(t)).position_ned_m[2]) for t in times)
    falls_m = lowest - float(start[2])
    assert falls_m > 4.0
    assert plan.place_start((3.0, 4.0, -20.0), REST, 0.0) == 0.0
    assert plan.origin_ned_m[2] + float(start[2]) == pytest.approx(-20.0)
    raised_m = plan.place_start((3.0, 4.0, -1.0), REST, 0.0)
    assert raised_m == pytest.approx(max(falls_m - 1.0 + CLEAR_M, 0.0), abs=0.02)
    assert plan.place_start((3.0, 4.0, -20.0), REST, None) == pytest.approx(falls_m, abs=0.02)
    for down_mps, lowest_m in ((0.2, 0.3), (0.5, CLEAR_M)):  # it hovers; it is landing
        plan.place_start((3.0, 4.0, -0.3), (0.0, 0.0, down_mps), 0.0)
        assert -plan.origin_ned_m[2] - falls_m - float(start[2]) == pytest.approx(
            lowest_m, abs=0.05
        )


def test_repeated_pauses_while_stopping_count_as_one() -> None:
    """Each such pair once made every later sample slower, until one raised RecursionError."""
    config = load("flight", choices={"reference": "lemniscate", "vehicle": "px4_sih"})
    plan = FlightPlan(build(config).track)
    plan.start_track(100.0)
    plan.pause(110.0)
    for time_s in np.linspace(110.0, 110.0 + STOP_S, 1000, endpoint=False).tolist():
        plan.resume(time_s)
        plan.pause(time_s)
    flown = plan.sample(200.0)
    assert flown is not None
    stopped_m = plan.track.sample(10.0 + STOP_S / 2.0).position_ned_m
    np.testing.assert_allclose(flown.position_ned_m, stopped_m, atol=1e-9)
    assert plan.track_time_s(200.0) == pytest.approx(10.0 + STOP_S / 2.0)


@pytest.mark.parametrize("speed_mps", [0.3, 4.0])
def test_reference_starts_where_a_moving_vehicle_stops(speed_mps: float) -> None:
    """The reference does not lead back. A smooth stop with at most 2 m/s^2 needs 35/32 of the way
    of a stop at a constant 1 m/s^2."""
    config = load("flight", choices={"reference": "hover", "vehicle": "px4_sih"})
    plan = FlightPlan(build(config).track)
    velocity = (0.6 * speed_mps, -0.8 * speed_mps, 0.0)
    assert plan.place_start((3.0, 4.0, -20.0), velocity, 0.0) == 0.0
    plan.start_climb(5.0, np.array((3.0, 4.0, -20.0)), np.array(velocity), 0.0)
    assert plan.reference is not None
    flown = plan.reference.sample(np.linspace(5.0, 25.0, 2001))
    along_m = (flown.position_ned_m - (3.0, 4.0, -20.0)) @ np.array((0.6, -0.8, 0.0))
    assert along_m[-1] == pytest.approx(35.0 / 32.0 * speed_mps**2 / 2.0)
    assert along_m.max() < along_m[-1] + 0.01
    assert np.linalg.norm(flown.acceleration_ned_mps2, axis=1).max() < 2.01
