"""`offboard doctor` finds what is wrong with a link, and says so of the right cause."""

from __future__ import annotations

import random
from typing import Any

import pytest
from doctor_bench import bench, from_others, said
from pair import Bytes, decode, frames_of
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from offboard.doctor.listening import LONGEST_S, NOTHING_S
from offboard.flight.preflight import Level
from offboard.mavlink.signing import UNITS_PER_S, Signing
from simulator.firmware.px4 import PX4
from simulator.start import Start

OK, WARN, WAIT, BLOCKS = Level.OK, Level.WARN, Level.WAIT, Level.BLOCKS
GCS_HEARTBEAT = mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)
AUTOPILOT_HEARTBEAT = mavlink.MAVLink_heartbeat_message(2, 12, 81, 0, 3, 3)
UNKNOWN_HEARTBEAT = mavlink.MAVLink_heartbeat_message(2, 4, 0, 0, 3, 3)
CAMERA_HEARTBEAT = mavlink.MAVLink_heartbeat_message(30, 8, 0, 0, 4, 3)
SETPOINT = mavlink.MAVLink_set_attitude_target_message(0, 1, 1, 7, (1, 0, 0, 0), 0, 0, 0, 0.5)
TIME = mavlink.MAVLink_timesync_message(0, 12345)
SAME_PLACE = ("127.0.0.1", 14580)
COUNTED = mavlink.MAVLink(None, srcSystem=1)
KEY = bytes(range(32))


def link(**fault: Any) -> dict[str, Any]:
    """A fault of both directions, after the vehicle has booted."""
    return {"faults": [{"fault": "link", "at_s": 5.9} | fault]}


def shared_counter(datagrams: Bytes) -> Bytes:
    """Each frame of the vehicle is followed by one of its camera, with the next sequence number."""
    sent = []
    for frame in (each for datagram in datagrams for each in frames_of(datagram)):
        known = [] if decode(frame).get_type().startswith("UNKNOWN") else [(decode(frame), 1)]
        for message, component in (*known, (CAMERA_HEARTBEAT, 100)):
            COUNTED.srcComponent, COUNTED.seq = component, (COUNTED.seq + 1) % 256
            sent.append(message.pack(COUNTED))
    return sent


@pytest.mark.parametrize(
    ("options", "check", "level", "found"),
    [
        (from_others(AUTOPILOT_HEARTBEAT, 1, 1, 1.0, ("::1", 14999, 0, 0)), "senders", WARN,
         "two programs send as vehicle 1/1: 127.0.0.1:14580, [::1]:14999"),
        (from_others(SETPOINT, 1, 194, place=SAME_PLACE), "senders", BLOCKS, "component 194"),
        (from_others(SETPOINT, 1, 191, place=SAME_PLACE), "senders", BLOCKS, "component 191"),
        (from_others(GCS_HEARTBEAT, 255, 190, 1.0), "senders", OK,
         "besides the vehicle: ground station 255/190"),
        (from_others(TIME, 255, 190, 2.0), "clock", WARN,
         "another time master: component 255/190"),
        (link(latency_s=0.3), "delay", BLOCKS, "the link delays by"),
        (link(jitter_s=0.8, direction="up"), "delay", BLOCKS, "the link delays by"),
        (link(corruption=0.2, direction="down"), "loss", WARN, "of the bytes damaged"),
        # half of the vehicle's sequence numbers are its camera's, and no frame is lost
        ({"down": shared_counter}, "loss", OK, "0.0% of the frames lost"),
        (link(message_rate_hz=30.0, direction="down"), "rates", WARN,
         "LOCAL_POSITION_NED 30.0 of 100 Hz"),
        ({"faults": [{"fault": "clock_jump", "at_s": 9.0, "jump_s": 30.0}]}, "clock", BLOCKS,
         "the vehicle's clock jumped by 30.0 s"),
        ({"faults": [{"fault": "reboot", "at_s": 7.0, "for_s": 0.5}]}, "clock", BLOCKS,
         "the vehicle restarted while it was observed"),
    ],
    ids=["same ids", "controller", "controller with our ids", "ground station", "time master",
         "late", "jitter", "damaged", "camera", "slow", "jump", "restart"],
)  # fmt: skip
def test_what_is_said_of_a_link(options: Any, check: str, level: Level, found: str) -> None:
    """Others beside the vehicle, and faults."""
    tested = bench(**options if isinstance(options, dict) else {"before": options})
    row = tested.check(check)[check]
    assert row.level is level
    assert found in row.findings[0].found


def test_nothing_is_heard() -> None:
    tested = bench(has_vehicle=False)
    began_s = tested.instance.time_s
    rows = tested.check()
    assert tested.instance.time_s - began_s == pytest.approx(NOTHING_S, abs=0.1)
    assert said(rows).keys() == {"vehicle"}
    assert rows["vehicle"].findings[0].found == "nothing is heard in 6 s"
    assert rows["vehicle"].level is BLOCKS
    for hint in ("--connect udpin:0.0.0.0", "-p PORT:PORT/udp", "hostname -I"):
        assert hint in rows["vehicle"].findings[0].hint
    assert tested.sent == []
    tested.has_vehicle = True
    assert said(tested.check()) == {}


@pytest.mark.parametrize(
    ("before", "found"),
    [
        (from_others(random.Random(1).randbytes(300), 0, 0, 20.0), "bytes are heard that are not"),
        (from_others(GCS_HEARTBEAT, 255, 190, 1.0), "but no autopilot: ground station 255/190"),
        (from_others(UNKNOWN_HEARTBEAT, 1, 1, 1.0), "autopilot 1/1 is neither PX4 nor ArduCopter"),
        (from_others(AUTOPILOT_HEARTBEAT, 1, 50, 1.0), "autopilot 1/50 is heard, but only"),
    ],
    ids=["noise", "ground station only", "unknown autopilot", "other component"],
)
def test_what_is_heard_is_no_vehicle(before: Any, found: str) -> None:
    row = bench(has_vehicle=False, before=before).check()["vehicle"]
    assert row.level is BLOCKS
    assert found in row.findings[0].found


@pytest.mark.parametrize("start", [None, Start(height_m=5.0)], ids=["disarmed", "armed"])
def test_vehicle_whose_signing_time_is_behind_hears_ours_unless_it_is_armed(
    start: Start | None,
) -> None:
    """By ten minutes."""
    tested = bench(signing=Signing(KEY, 100 * 60 * UNITS_PER_S), start=start)
    tested.instance.keyring.set_up(KEY, 90 * 60 * UNITS_PER_S)
    rows = tested.check()
    if start is None:
        assert said(rows) == {}
        assert tested.sent[0].get_type() == "TIMESYNC"
    else:
        assert rows["vehicle"].level is BLOCKS
        assert "their time stamps are too old" in rows["vehicle"].findings[0].found
        assert tested.sent == []


def test_second_vehicle_on_the_link() -> None:
    tested = bench(before=from_others(AUTOPILOT_HEARTBEAT, 2, 1, 1.0))
    rows = tested.check()
    assert said(rows).keys() == {"senders"}
    several, heard = rows["senders"].findings
    assert several.level is BLOCKS
    assert several.found == "several vehicles are heard, systems 1 and 2: choose one with --system"
    assert heard.found == "besides the vehicle: autopilot 2/1, from 127.0.0.1:14999"
    tested.system_id = 1
    assert tested.check("senders")["senders"].level is OK


def test_delay_is_measured_and_lowers_the_bandwidth() -> None:
    tested = bench(**link(latency_s=0.2))
    row = tested.check("configuration")["configuration"]
    assert row.level is WARN
    measured_ms = float(row.findings[0].found.removeprefix("with a delay of ").split()[0])
    assert measured_ms == pytest.approx(400.0, abs=30.0)  # both directions
    possible = row.findings[0].hint.rpartition("=")[2]
    assert 1.0 <= float(possible) < 7.0
    again = bench(**link(latency_s=0.2), assignments=[f"controller.bandwidth_radps={possible}"])
    assert again.check("configuration")["configuration"].level is OK


def test_loss_is_counted() -> None:
    tested = bench(PX4, **link(loss=0.2, direction="down", for_s=9.0))
    row = tested.check("loss")["loss"]
    assert row.level is WARN
    share = float(row.findings[0].found.partition("%")[0])
    assert share == pytest.approx(20.0, abs=3.0)
    tested.run_to(16.0)
    assert tested.check("loss")["loss"].level is OK


def test_rates_that_are_too_low_block() -> None:
    tested = bench(**link(message_rate_hz=5.0, direction="down", for_s=20.0))
    began_s = tested.instance.time_s
    row = tested.check("rates")["rates"]
    assert row.level is BLOCKS
    assert "at least 10 Hz are needed" in row.findings[0].found
    assert "MAV_x_RATE" in row.findings[0].hint
    assert tested.instance.time_s - began_s < LONGEST_S + 1.1  # 15 s with the rest


def test_line_that_is_too_slow_for_the_telemetry() -> None:
    """What it asks for is thinned to fit; 38400 baud do not carry the least of it."""
    tested = bench(capacity_bytes_ps=3840.0)
    row = tested.check("bandwidth")["bandwidth"]
    assert row.level is WARN
    assert row.findings[0].hint.split()[-2:] == ["115200", "baud"]
    tested.capacity_bytes_ps = 11520.0
    assert tested.check("bandwidth")["bandwidth"].level is OK


def test_what_we_send_does_not_arrive() -> None:
    rows = bench(up=lambda _: []).check()
    assert rows["uplink"].level is BLOCKS
    assert rows["delay"].level is WAIT
    assert rows["parameters"].level is WARN  # PX4 has none that must be answered
    assert rows["parameters"].findings[0].found.startswith("no reply for MPC_THR_HOVER, ")


def test_flood_of_addresses_and_ids_is_bounded() -> None:
    generator = random.Random(3)

    def before(time_s: float) -> list[Any]:
        ids, port = generator.sample(range(1, 255), 2), generator.randrange(9999)
        return from_others(GCS_HEARTBEAT, *ids, 250.0, ("10.0.0.1", port))(time_s)

    seen = bench(before=before).listen()
    assert len(seen.heard.senders.found) == 64
    assert seen.found is not None
