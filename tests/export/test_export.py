"""`offboard export`: a format, read by its own library, holds what pymavlink reads in the log."""

from __future__ import annotations

import csv
import json
import math
import sys
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from pair import PX4, hover
from processes import full_disk
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from pyulog import ULog
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner, Result

from offboard.analysis import tlog
from offboard.cli.commands import app
from offboard.export.series import read, samples
from offboard.flight.phases import Phase
from offboard.flight.record import RECORD_ID
from offboard.link.log import entry
from offboard.mavlink import event_record

RECORDINGS = Path(__file__).parents[1] / "wire" / "recordings"
REAL = RECORDINGS / "px4-1.16.1-offboard.tlog"
OURS = (191, 192)


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pair = hover(scenario="px4_like", firmware=PX4)
    assert pair.fly().exit_code == 0
    return pair.log(tmp_path_factory.mktemp("hover") / "flight").path


@pytest.fixture(scope="module")
def messages(flight: Path) -> dict[tuple[str, bool], list[Any]]:
    """The messages by name, and whether they are ours, as pymavlink reads them."""
    found: dict[tuple[str, bool], list[Any]] = {}
    log = mavutil.mavlink_connection(str(flight))
    while (message := log.recv_match()) is not None:
        key = message.get_type(), message.get_srcComponent() in OURS
        found.setdefault(key, []).append(message)
    return found


def run(flight: Path, kind: str, output: Path, *options: str) -> Result:
    return CliRunner().invoke(
        app, ["export", str(flight), "--to", kind, "-o", str(output), *options]
    )


def exported(flight: Path, kind: str, output: Path, *options: str) -> Path:
    result = run(flight, kind, output, *options)
    assert result.exit_code == 0, result.exception
    return output


def test_mcap_export_matches_the_log(
    flight: Path, messages: dict[tuple[str, bool], list[Any]], tmp_path: Path
) -> None:
    path = exported(flight, "mcap", tmp_path / "flight.mcap")
    found: dict[str, list[tuple[int, Any]]] = {}
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for schema, channel, message in reader.iter_messages():
            if channel.message_encoding == "json":
                value = json.loads(message.data)
            else:
                assert schema is not None
                assert schema.name.startswith("foxglove.")
                value = DecoderFactory().decoder_for("protobuf", schema)(message.data)
            found.setdefault(channel.topic, []).append((message.log_time, value))
    positions = messages["LOCAL_POSITION_NED", False]
    attitudes = {m.time_boot_ms: m for m in messages["ATTITUDE_QUATERNION", False]}
    assert len(found["/pose"]) == len(positions) > 500
    for (stamp_ns, pose), sent in list(zip(found["/pose"], positions, strict=True))[::50]:
        since_ms = sent.time_boot_ms - positions[0].time_boot_ms
        assert stamp_ns - found["/pose"][0][0] == pytest.approx(since_ms * 1e6, abs=2000)
        assert pose.timestamp.ToNanoseconds() == stamp_ns
        assert pose.frame_id == "map"
        place = pose.pose.position
        assert (place.x, place.y, place.z) == pytest.approx((sent.y, sent.x, -sent.z))
        attitude = attitudes.get(sent.time_boot_ms)
        if attitude is not None:  # heading clockwise from north -> yaw anticlockwise from east
            turned = pose.pose.orientation
            ned = Rotation.from_quat([attitude.q2, attitude.q3, attitude.q4, attitude.q1])
            flu = Rotation.from_quat([turned.x, turned.y, turned.z, turned.w])
            heading, yaw = ned.as_euler("ZYX")[0], flu.as_euler("ZYX")[0]
            assert math.remainder(math.pi / 2 - heading - yaw, math.tau) == pytest.approx(
                0, abs=1e-6
            )
            assert flu.as_euler("ZYX")[2] == pytest.approx(ned.as_euler("ZYX")[2], abs=1e-6)
    assert len(found["/tf"]) == len(positions)
    (path_update,) = found["/path/flown"]
    points = path_update[1].entities[0].lines[0].points
    assert max(point.z for point in points) == pytest.approx(max(-m.z for m in positions), abs=1e-5)
    assert max(max(abs(p.x), abs(p.y)) for p in points) < 0.5
    texts = [value.message for _, value in found["/log"]]
    assert any(text.startswith("takeoff: armed") for text in texts)
    decisions = [m for m in messages["DEBUG_FLOAT_ARRAY", True] if m.array_id == RECORD_ID]
    assert len(found["/table/decision"]) == len(decisions) > 50
    ninth = found["/table/decision"][9][1]
    assert ninth["decision_thrust_mps2"] == pytest.approx(decisions[9].data[1])
    unix = exported(REAL, "mcap", tmp_path / "unix.mcap")
    with unix.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    stamps = [message.unix_us for message in tlog.read(REAL)]
    assert stamps[0] * 1000 <= summary.statistics.message_start_time
    assert summary.statistics.message_end_time <= (stamps[-1] + 1_000_000) * 1000


def test_ulog_export_matches_the_log(
    flight: Path, messages: dict[tuple[str, bool], list[Any]], tmp_path: Path
) -> None:
    log = ULog(str(exported(flight, "ulog", tmp_path / "flight.ulg")))
    assert not log.file_corruption
    assert log.msg_info_dict["sys_name"] == "PX4"
    topics = {each.name: each.data for each in log.data_list}
    positions = messages["LOCAL_POSITION_NED", False]
    assert topics["vehicle_local_position"]["timestamp"].tolist() == [
        m.time_boot_ms * 1000 for m in positions
    ]
    assert topics["vehicle_local_position"]["z"] == pytest.approx([m.z for m in positions])
    assert topics["vehicle_local_position"]["vy"] == pytest.approx([m.vy for m in positions])
    attitudes = messages["ATTITUDE_QUATERNION", False]
    assert topics["vehicle_attitude"]["q[0]"] == pytest.approx([m.q1 for m in attitudes])
    assert topics["vehicle_angular_velocity"]["xyz[2]"] == pytest.approx(
        [m.yawspeed for m in attitudes]
    )
    setpoints = messages["SET_ATTITUDE_TARGET", True]
    sent = topics["vehicle_attitude_setpoint"]
    assert sent["timestamp"].tolist() == [m.time_boot_ms * 1000 for m in setpoints]
    assert sent["thrust_body[2]"] == pytest.approx([-m.thrust for m in setpoints])
    assert sent["q_d[3]"] == pytest.approx([m.q[3] for m in setpoints])
    references = messages["POSITION_TARGET_LOCAL_NED", True]
    assert topics["trajectory_setpoint"]["position[2]"] == pytest.approx([m.z for m in references])
    armed = topics["actuator_armed"]["armed"]
    assert set(armed.tolist()) == {0, 1}
    assert len(topics["offboard_decision"]["gap"]) > 50
    texts = [each.message for each in log.logged_messages]
    assert any("takeoff: armed" in text for text in texts)


def test_csv_export_matches_the_log(
    flight: Path, messages: dict[tuple[str, bool], list[Any]], tmp_path: Path
) -> None:
    path = exported(flight, "csv", tmp_path / "flight.csv")
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    times = [float(row["vehicle_time_s"]) for row in rows]
    assert times == sorted(times)
    positions = messages["LOCAL_POSITION_NED", False]
    found = [row for row in rows if row["source"] == "position"]
    assert len(found) == len(positions)
    for row, sent in list(zip(found, positions, strict=True))[::100]:
        assert float(row["vehicle_time_s"]) == sent.time_boot_ms / 1e3
        assert float(row["unix_time_s"]) == pytest.approx(sent._timestamp, abs=1e-3)
        assert float(row["position_down_m"]) == pytest.approx(sent.z)
        assert float(row["velocity_north_mps"]) == pytest.approx(sent.vx)
        assert row["setpoint_thrust"] == ""
    phases = [row["decision_phase"] for row in rows if row["source"] == "decision"]
    assert set(phases) <= {phase.value for phase in Phase}
    assert "track" in phases
    thrusts = [float(row["setpoint_thrust"]) for row in rows if row["source"] == "setpoint"]
    assert thrusts == pytest.approx([m.thrust for m in messages["SET_ATTITUDE_TARGET", True]])
    assert any("takeoff: armed" in row["event"] for row in rows if row["source"] == "event")
    units = ("_m", "_s", "_mps", "_mps2", "_rad", "_radps", "thrust", "_w", "_x", "_y", "_z")
    kinds = ("position", "velo", "att", "rate", "set", "ref")
    measured = [name for name in rows[0] if name.startswith(kinds)]
    assert len(measured) > 20
    assert all(name.endswith(units) for name in measured)


def test_unix_time_continues_across_the_wrap_of_time_boot_ms(tmp_path: Path) -> None:
    """The log of a vehicle at twice the speed: a position every 100 ms, recorded every 50 ms."""
    vehicle, began_us = mavlink.MAVLink(None, srcSystem=1, srcComponent=1), 10**15
    frames = [mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 3, 3)]
    for step in range(20):
        stamp_ms = (2**32 - 950 + 100 * step) % 2**32
        frames.append(mavlink.MAVLink_local_position_ned_message(stamp_ms, *6 * [0.0]))
    log = tmp_path / "wrap.tlog"
    entries = [entry(began_us + 50_000 * n, f.pack(vehicle)) for n, f in enumerate(frames)]
    log.write_bytes(b"".join(entries))
    with exported(log, "csv", tmp_path / "wrap.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["source"] == "position"]
    unix_s = [float(row["unix_time_s"]) for row in rows]
    assert unix_s == pytest.approx([1e9 + 0.05 * n for n in range(1, 21)], abs=1e-4, rel=0)


def test_export_includes_event_records_and_ignores_a_second_vehicle(
    flight: Path, tmp_path: Path
) -> None:
    """Vehicle 9, whose clock is 1000 s ahead, changes no time. A record of an event is one more."""
    other = mavlink.MAVLink(None, srcSystem=9, srcComponent=1)
    (event,) = event_record.pieces(event_record.EventRecord("bandwidth 5.0 rad/s"))
    padded = event.data.ljust(128, b"\0")
    record = mavlink.MAVLink_tunnel_message(0, 0, event.payload_type, len(event.data), padded)
    data = b""
    for number, each in enumerate(tlog.read(flight)):
        data += entry(each.unix_us, each.frame.raw)
        if each.name == "LOCAL_POSITION_NED":
            position = mavlink.MAVLink_local_position_ned_message(10**6 + number, *6 * [0])
            data += entry(each.unix_us, position.pack(other))
    ours = mavlink.MAVLink(None, srcSystem=1, srcComponent=OURS[1])
    two = tmp_path / "two.tlog"
    two.write_bytes(data + entry(each.unix_us, record.pack(ours)))
    before, after = (
        exported(log, "csv", log.with_suffix(".csv")).read_text().splitlines()
        for log in (flight, two)
    )
    (more,) = set(after) - set(before)
    assert more.endswith(",offboard: bandwidth 5.0 rad/s")
    assert [line for line in after if line != more] == before
    assert any(line.endswith(",vehicle: mode OFFBOARD") for line in after)
    assert "bandwidth 5.0 rad/s" in CliRunner().invoke(app, ["score", str(two)]).output


def test_unknown_phase_is_exported_as_its_number(flight: Path) -> None:
    rows = read(flight).records[:1].copy()
    rows["phase"] = 99.0
    ((*_, known),) = samples("decision", rows)
    assert known["decision_phase"] == 99.0


def test_export_refuses_bad_outputs_and_missing_packages(
    flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken = tmp_path / "taken.csv"
    taken.write_text("mine")
    assert "exists already" in run(flight, "csv", taken).output
    assert taken.read_text() == "mine"
    nowhere = tmp_path / "none" / "flight.csv"
    assert "there is no directory" in run(flight, "csv", nowhere).output
    monkeypatch.setitem(sys.modules, "mcap.writer", None)
    reason = str(run(flight, "mcap", tmp_path / "a.mcap").exception)
    assert "'mcap>=1.2'" in reason
    assert "pso-offboard" not in reason  # which no index has
    assert list(tmp_path.iterdir()) == [taken]


@pytest.mark.parametrize("kind", ["mcap", "csv"])
def test_export_to_a_full_disk_leaves_no_file(kind: str, flight: Path, tmp_path: Path) -> None:
    """The last byte does not fit, which is written when the file is closed."""
    size = exported(flight, kind, tmp_path / "whole").stat().st_size
    with full_disk(size - 1):
        result = run(flight, kind, tmp_path / "cut")
    assert str(result.exception) == f"{tmp_path / 'cut'} cannot be written (File too large)"
    assert [path.name for path in tmp_path.iterdir()] == ["whole"]
