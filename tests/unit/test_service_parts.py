"""Parts of the service: records, remembered vehicles, lock, configurations that change, answers."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from offboard.analysis import tlog
from offboard.documents.errors import UserError
from offboard.flight import clock, manifest
from offboard.flight import request as flight_request
from offboard.flight.flight_plan import CLEAR_M, FlightPlan
from offboard.flight.pilot_switch import PilotSwitch
from offboard.flight.request import FlightRequest
from offboard.identification.learned import Learned
from offboard.identification.uncertainty import Estimate
from offboard.mavlink.events import VehicleFound
from offboard.mavlink.outgoing import Heartbeat
from offboard.mavlink.session import Session, SessionSettings
from offboard.service import preparation
from offboard.service.flights import Prepared
from offboard.service.lock import ConnectionLock, Locked
from offboard.service.memory import VehicleFiles
from offboard.service.monitor import Monitor
from offboard.service.preparation import Preparation
from offboard.service.record import ROLLING_NAMES, Recorder


def session() -> Session:
    made = Session(SessionSettings())
    made.adopt(VehicleFound(1, 1, "px4"), "vehicle")
    return made


def test_a_flight_log_begins_with_what_came_before(tmp_path: Path) -> None:
    scored: list[Path] = []
    recorder = Recorder(tmp_path, stamp=lambda: "now", score=scored.append)
    talk = session()
    codec = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    home = mavlink.MAVLink_gps_global_origin_message(1, 2, 3).pack(codec)
    began_us = clock.unix_us() - 20_000_000
    recorder.write(began_us, home)  # long ago
    for second in range(2, 20):
        recorder.write(began_us + second * 1_000_000, talk.encode(Heartbeat(6)))
    first = Path(recorder.begin(talk, "vehicle: neutral\n"))
    recorder.write(began_us + 20_000_000, talk.encode(Heartbeat(18)))
    recorder.end()
    second_flight = Path(recorder.begin(talk, "vehicle: neutral\n"))
    recorder.write(began_us + 21_000_000, talk.encode(Heartbeat(18)))
    recorder.close()
    assert (first.name, second_flight.name) == ("now", "now-2")
    assert scored == [first, second_flight]
    raw = (first / "flight.tlog").read_bytes()
    assert home in raw
    log = tlog.read(first / "flight.tlog")
    beats = [entry for entry in log.messages if entry.name == "HEARTBEAT"]
    assert len(beats) == 7  # of the last five seconds, and of the flight
    assert beats[-1].message.type == 18
    pieces = [entry.message for entry in log.messages if entry.name == "TUNNEL"]
    payloads = [bytes(piece.payload[: piece.payload_length]) for piece in pieces]
    assert manifest.join(payloads) == "vehicle: neutral\n"
    assert (first / "flight.yaml").read_text() == "vehicle: neutral\n"


def test_the_rolling_log_is_bounded(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, score=lambda directory: None, rolling_bytes=20_000)
    talk = session()
    written = 0
    for number in range(5000):
        frame = talk.encode(Heartbeat(6))
        written += len(frame) + 8
        recorder.write(number * 1000, frame)
        if number % 100 == 0:  # the writing thread takes them in several batches
            while recorder._rolling._writer._queue:
                pass
    recorder.close()
    sizes = [(tmp_path / name).stat().st_size for name in ROLLING_NAMES]
    assert written > 100_000
    assert max(sizes) <= 20_000
    assert sum(sizes) > 10_000


def test_a_flight_that_cannot_be_recorded_says_so_and_the_next_one_is(tmp_path: Path) -> None:
    names = iter([f"{ROLLING_NAMES[0]}/x", "later"])
    scored: list[Path] = []
    recorder = Recorder(tmp_path, stamp=lambda: next(names), score=scored.append)
    talk = session()
    recorder.begin(talk, "")
    deadline_s = time.monotonic() + 10.0
    while not recorder.problem and time.monotonic() < deadline_s:
        recorder.write(1, talk.encode(Heartbeat(6)))
        time.sleep(0.01)
    assert "cannot be written (Not a directory)" in recorder.problem
    recorder.end()
    recorder.begin(talk, "")
    assert recorder.problem == ""
    recorder.close()
    assert scored == [tmp_path / "later"]


def test_an_identified_vehicle_is_kept_and_used_for_the_same_file_alone(tmp_path: Path) -> None:
    request = FlightRequest(tmp_path, choices={"vehicle": "px4_sih"})
    parts = flight_request.build_parts(request.resolve())
    known = Prepared(parts, "")
    found = parts.vehicle.model_copy(update={"hover_thrust": 0.51})
    learned = Learned(found, Estimate(0.056, 0.002), 0.008)
    files = VehicleFiles(tmp_path / "vehicles", print)
    files.keep("px4-1-1", known, learned)
    assert files.get("px4-1-1", known) is learned
    files.close()
    told: list[str] = []
    (tmp_path / "vehicles" / "bad.yaml").write_text("tilt_delay_s: no\n")
    again = VehicleFiles(tmp_path / "vehicles", told.append)
    assert again.get("px4-1-1", known) == learned
    assert again.get("px4-2-1", known) is None
    assert len(told) == 1
    assert "bad.yaml is not used" in told[0]
    other = FlightRequest(tmp_path, choices={"vehicle": "arducopter"}).resolve()
    assert again.get("px4-1-1", Prepared(flight_request.build_parts(other), "")) is None
    again.discard("px4-1-1")
    again.close()
    assert not (tmp_path / "vehicles" / "px4-1-1.yaml").exists()


def test_the_lock_names_its_holder_and_dies_with_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path))
    code = (
        "from offboard.service.lock import ConnectionLock\n"
        "import sys\n"
        "with ConnectionLock('udpin:127.0.0.1:1'):\n"
        "    print('held', flush=True)\n"
        "    sys.stdin.read()\n"
    )
    holder = subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert holder.stdout is not None
    assert holder.stdout.readline() == b"held\n"
    with ConnectionLock("udpin:127.0.0.1:2"):
        pass
    with pytest.raises(Locked, match=f"process {holder.pid}$"), ConnectionLock("udpin:127.0.0.1:1"):
        pass
    holder.kill()
    holder.wait()
    with ConnectionLock("udpin:127.0.0.1:1") as lock:
        assert lock.path.read_text() == f"{os.getpid()}\n"


def test_a_changed_configuration_is_used_and_a_bad_one_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(preparation, "rehearse", lambda parts, keeps_deadline: None)
    file = tmp_path / "my.yaml"
    good = "vehicle: px4_sih\ncontroller: lqr\nreference: {shape: hover, height_m: %s}\n"
    file.write_text(good % 2)
    watched = Preparation(FlightRequest(tmp_path, config=str(file)))
    first = watched.newest()
    watched.look()
    assert watched.newest() is first
    assert watched.news() == []
    file.write_text(good % "high")
    watched.look()
    watched.look()
    (news,) = watched.news()
    assert news.startswith("the configuration is refused, the old one is kept: ")
    assert "height_m" in news
    assert watched.newest() is first
    file.write_text((good % 2) + "estimate: fused\n")
    watched.look()
    assert "estimate cannot be changed" in watched.news()[0]
    file.write_text(good % 3)
    watched.look()
    assert watched.news() == ["the configuration has changed: used from the next flight on"]
    assert "height_m: 3" in watched.newest().text


@pytest.mark.parametrize("address", ["", "9464", "localhost:", "a:b", "127.0.0.1:99999", "[::1:1"])
def test_an_address_to_serve_that_is_none(address: str) -> None:
    with pytest.raises(UserError, match="give HOST:PORT"):
        Monitor(address)


def test_a_switch_counts_in_the_air_from_a_mode_without_failsafe() -> None:
    switch = PilotSwitch()

    def shows(ours: bool, failsafe: bool = False, in_the_air: bool = True) -> bool:
        switch.on_mode(ours=ours, in_the_air=in_the_air, certainly=in_the_air)
        switch.on_heartbeat(ours=ours, failsafe=failsafe)
        return switch.engaged

    assert not shows(ours=True)  # found so
    assert not shows(ours=False, failsafe=True)
    assert not shows(ours=True)  # PX4 returns by itself
    assert not shows(ours=False)
    assert shows(ours=True)
    assert not shows(ours=False)
    assert not shows(ours=True, in_the_air=False)
    assert not shows(ours=True)  # took off in this mode


def test_a_reference_that_is_placed_low_stays_clear_of_the_ground(tmp_path: Path) -> None:
    request = FlightRequest(tmp_path, choices={"reference": "helix", "vehicle": "px4_sih"})
    plan = FlightPlan(flight_request.build_parts(request.resolve()).track)
    start, times = plan.track.sample(0.0).position_ned_m, range(60)
    lowest = max(float(plan.track.sample(float(t)).position_ned_m[2]) for t in times)
    falls_m = lowest - float(start[2])
    assert plan.place_start((3.0, 4.0, -20.0), 0.0) == 0.0
    assert plan.origin_ned_m[2] + float(start[2]) == pytest.approx(-20.0)
    raised_m = plan.place_start((3.0, 4.0, -1.0), 0.0)
    assert raised_m == pytest.approx(max(falls_m - 1.0 + CLEAR_M, 0.0), abs=0.02)


@pytest.mark.parametrize("certainly", [True, False])
def test_only_a_vehicle_that_certainly_flies_is_engaged(certainly: bool) -> None:
    switch = PilotSwitch()
    switch.on_heartbeat(ours=False, failsafe=False)
    switch.on_mode(ours=True, in_the_air=True, certainly=certainly)
    assert switch.engaged is certainly
