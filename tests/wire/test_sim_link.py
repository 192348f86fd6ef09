"""The simulated vehicle's link: rates, requests, texts, parameters, values that are not finite."""

from __future__ import annotations

import math
import struct
from collections import Counter
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as mavlink
from sim_bench import NAN, Bench

from simulator import config
from simulator.autopilot.firmware import Firmware
from simulator.firmware import FIRMWARES
from simulator.firmware.ardupilot import ARDUPILOT
from simulator.firmware.px4 import PX4
from simulator.firmware.px4_messages import COMPANION_RATES_HZ, GROUND_RATES_HZ
from simulator.instance import Instance
from simulator.mavlink.codec import Decoder
from simulator.mavlink.outbox import DATAGRAM_MAX
from simulator.mavlink.telemetry import builders
from simulator.vehicle.conditions import Conditions
from simulator.vehicle.sensors import EstimatorName

LOCAL_POSITION = 32


def packed_command(number: int) -> bytes:
    message = mavlink.MAVLink_command_long_message(1, 1, number, 0, *(math.nan,) * 7)
    return bytes(message.pack(mavlink.MAVLink(None)))


@settings(max_examples=100, deadline=None, derandomize=True)
@given(st.binary(max_size=60).filter(lambda b: not set(b) & {0xFD, 0xFE}))
def test_garbage_in_a_datagram_hides_no_frame(garbage: bytes) -> None:
    decoder = Decoder()
    messages = decoder.read(garbage + packed_command(400) + garbage + packed_command(176))
    assert [m.command for m in messages] == [400, 176]
    assert decoder.dropped["not a frame"] == 2 * len(garbage)


@pytest.mark.parametrize(("name", "obeyed"), [("px4", False), ("ardupilot", True)])
def test_only_arducopter_obeys_messages_to_system_zero(name: str, obeyed: bool) -> None:
    """PX4 1.16 ignores commands, parameters and missions for system 0, except a request for its
    version."""
    bench = Bench(firmware=FIRMWARES[name], boot_scale=0.1)
    bench.run(2.5)
    bench.system = 0
    ask_version, set_home = (bench.command(520), bench.command(179, 1))
    bench.send(mavlink.MAVLink_param_request_read_message(0, 1, b"SYSID_MYGCS", -1))
    bench.send(mavlink.MAVLink_param_request_read_message(0, 1, b"COM_OF_LOSS_T", -1))
    bench.send(mavlink.MAVLink_mission_request_list_message(0, 1))
    bench.run(0.1)
    assert (ask_version, set_home) == ([0], [0] if obeyed else [])
    assert len(bench.of("PARAM_VALUE")) == len(bench.of("MISSION_COUNT")) == obeyed


def test_messages_for_others_are_forwarded_between_the_links() -> None:
    """As by `Mavlink::forward_message` of PX4 1.16, a message goes to the other link if its target
    was seen there or if it is for all."""
    bench = Bench(ground_link=True)
    ground = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)

    def command(system: int, component: int) -> Any:
        return mavlink.MAVLink_command_long_message(system, component, 300, 0, *(0.0,) * 7)

    heartbeat = mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, 8, 0, 0, 4, 3)
    clock = mavlink.MAVLink_timesync_message(0, 1)
    key = mavlink.MAVLink_setup_signing_message(1, 191, bytes(32), 1)
    for message in (
        heartbeat, clock, key, *(command(1, each) for each in (1, 191, 190)), command(2, 0),
    ):  # fmt: skip
        bench.instance.feed_ground(message.pack(ground))
    bench.instance.feed_ground(heartbeat.pack(mavlink.MAVLink(None, 1, 1)))  # the vehicle's own
    bench.run(0.1)
    forwarded = [each for _, each in bench.received if each.get_srcSystem() == 255]
    assert [each.get_type() for each in forwarded] == ["HEARTBEAT", "COMMAND_LONG"]
    assert forwarded[1].target_component == 191
    assert not [each for _, each in bench.of("HEARTBEAT") if each.type == mavlink.MAV_TYPE_GCS][1:]

    bench.instance.drain_ground()
    for each in forwarded:  # through a router that has both links
        bench.instance.feed(bytes(each.get_msgbuf()))
    assert bench.instance.drain_ground() == []
    bench.send(mavlink.MAVLink_command_ack_message(300, 0, 0, 0, 255, 190))
    (datagram,) = bench.instance.drain_ground()
    (answer,) = mavlink.MAVLink(None).parse_buffer(datagram)
    assert (answer.get_srcComponent(), answer.command) == (191, 300)


# -- rates -----------------------------------------------------------------------------------


def test_each_link_has_px4_rates_and_its_own_sequence() -> None:
    """Each datagram contains whole frames. The global position waits for the first GPS fix."""
    bench = Bench(ground_link=True)
    bench.run(2.9)
    assert bench.of("LOCAL_POSITION_NED")
    assert not bench.of("GLOBAL_POSITION_INT")
    bench.run(0.2)
    assert len(bench.of("GLOBAL_POSITION_INT")) > 3
    bench.instance.drain_ground()
    bench.send(mavlink.MAVLink_param_request_list_message(1, 1))
    companion, ground = (link.outbox for link in bench.instance.links)
    heard: dict[str, list[bytes]] = {"companion": [], "ground": []}
    for _ in range(5000):
        bench.instance.advance()
        heard["companion"] += companion.drain()
        heard["ground"] += ground.drain()
    for link, rates_hz in (("companion", COMPANION_RATES_HZ), ("ground", GROUND_RATES_HZ)):
        messages = []
        for datagram in heard[link]:
            whole = mavlink.MAVLink(None).parse_buffer(datagram)
            assert sum(len(m.get_msgbuf()) for m in whole) == len(datagram) <= DATAGRAM_MAX
            messages += whole
        counts = Counter(m.get_type() for m in messages)
        assert {name: counts[name] / 20.0 for name in rates_hz} == {
            name: pytest.approx(rate, abs=0.1) for name, rate in rates_hz.items()
        }
        sequence = [m.get_seq() for m in messages]
        assert sequence == [(sequence[0] + i) % 256 for i in range(len(sequence))]


def test_message_interval_can_be_stopped_restored_and_read() -> None:
    """A change of one message's rate does not shift the others."""
    bench = Bench()
    bench.run(1.1)
    for interval_us, shown_us, expected in (
        (20_000, 20_000, 50),
        (-1, 0, 0),
        (0, 33_333, 30),
        (3e38, 2**31 - 1, 0),
    ):
        bench.command(511, LOCAL_POSITION, interval_us)
        begun_s = bench.time_s
        bench.run(2.0)
        assert len(bench.of("LOCAL_POSITION_NED", begun_s)) == pytest.approx(2 * expected, abs=2)
        assert len(bench.of("ATTITUDE", begun_s)) == pytest.approx(200, abs=1)
        assert bench.command(510, LOCAL_POSITION) == [0]
        assert bench.of("MESSAGE_INTERVAL")[-1][1].interval_us == shown_us


def test_px4_sends_imu_outputs_and_times_of_the_flight_on_request() -> None:
    """MAVSDK reads them as scaled IMU, actuator output status and flight information."""
    bench = Bench()
    bench.fly_offboard()
    assert [bench.command(512, number) for number in (26, 375, 264)] == [[0]] * 3
    imu, outputs, times = (
        bench.of(kind)[-1][1]
        for kind in ("SCALED_IMU", "ACTUATOR_OUTPUT_STATUS", "FLIGHT_INFORMATION")
    )
    assert (imu.xacc, imu.yacc, imu.zacc) == pytest.approx((0, 0, -1000), abs=60)
    assert 1300.0 < outputs.actuator[0] == outputs.actuator[3] < 1700.0
    assert (outputs.actuator[4], outputs.actuator[16]) == (900.0, 0.0)
    assert times.arming_time_utc < times.takeoff_time_utc < times.time_boot_ms * 1000
    assert times.arming_time_utc == pytest.approx(5.6e6, abs=0.1e6)
    bench.command(400, 0, 21196)
    bench.command(512, 264)
    times = bench.of("FLIGHT_INFORMATION")[-1][1]
    assert (times.arming_time_utc, times.takeoff_time_utc) == (0, 0)


# -- time, files -----------------------------------------------------------------------------


def test_timesync_and_ping_are_answered_and_ftp_is_refused() -> None:
    """A PING with a target is itself an answer and gets none."""
    for firmware, answered in (FIRMWARES["px4"], [7]), (FIRMWARES["ardupilot"], []):
        bench = Bench(firmware=firmware)
        bench.send(mavlink.MAVLink_ping_message(5, 7, 0, 0))
        bench.send(mavlink.MAVLink_ping_message(5, 8, 1, 1))
        bench.run(0.02)
        assert [m.seq for _, m in bench.of("PING") if m.target_component == 191] == answered
    bench = Bench()
    bench.run(2.0)
    bench.send(mavlink.MAVLink_timesync_message(0, 123456789))
    request = struct.pack("<HBBBBBBI", 41, 3, 4, 2, 0, 0, 0, 0) + b"@PARAM/param.pck"
    payload = list(request.ljust(251, b"\0"))
    bench.send(mavlink.MAVLink_file_transfer_protocol_message(0, 1, 1, payload))
    bench.run(0.02)
    answers = [m for _, m in bench.of("TIMESYNC") if m.tc1 != 0]
    assert [(m.tc1, m.ts1) for m in answers] == [(2_000_000_000, 123456789)]
    ((_, answer),) = bench.of("FILE_TRANSFER_PROTOCOL")
    assert struct.unpack_from("<HBBBB", bytes(answer.payload)) == (42, 3, 129, 1, 4)
    assert answer.payload[12] == 10


# -- parameters ------------------------------------------------------------------------------


def asked(bench: Bench, name: bytes) -> tuple[float, int]:
    """Value and type of a parameter, as answered on the wire."""
    bench.send(mavlink.MAVLink_param_request_read_message(1, 1, name, -1))
    bench.run(0.02)
    _, message = bench.of("PARAM_VALUE")[-1]
    assert message.param_id == name.decode()
    return message.param_value, message.param_type


@pytest.mark.parametrize(
    ("firmware", "name", "value"),
    [
        (PX4, b"FLW_TGT_DST", 8.0),
        (PX4, b"SYS_FAILURE_EN", 0.0),
        (PX4, b"MC_YAWRATE_P", 0.2),
        (ARDUPILOT, b"FENCE_RADIUS", 150.0),
        (ARDUPILOT, b"FLTMODE4", 3.0),
    ],
)
def test_parameters_that_examples_set_have_the_values_of_the_real_ones(
    firmware: Firmware, name: bytes, value: float
) -> None:
    """Without an answer MAVSDK repeats its requests for 6 s per parameter, then gives up."""
    assert asked(Bench(firmware=firmware), name)[0] == pytest.approx(value)


def test_a_changed_parameter_is_reported_on_every_link() -> None:
    """As by PX4 1.16 and ArduPilot: a companion computer hears of what a ground station changes."""
    bench = Bench(ground_link=True)
    ground = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
    value = mavlink.MAVLink_param_set_message(1, 1, b"MPC_THR_HOVER", 0.4, 9)
    bench.instance.feed_ground(value.pack(ground))
    bench.run(0.1)
    ((_, shown),) = bench.of("PARAM_VALUE")
    assert (shown.param_id, shown.param_value) == ("MPC_THR_HOVER", pytest.approx(0.4))


def test_the_parameter_hash_changes_with_the_values() -> None:
    """QGroundControl reads the hash; a client that knows it stops the list of parameters."""
    bench = Bench()
    first = asked(bench, b"_HASH_CHECK")
    assert first[1] == 5
    for value, same in ((2.0, False), (1.0, True)):
        bench.send(mavlink.MAVLink_param_set_message(1, 1, b"COM_OF_LOSS_T", value, 9))
        assert (asked(bench, b"_HASH_CHECK") == first) is same
    bench.send(mavlink.MAVLink_param_request_list_message(1, 1))
    bench.run(0.008)
    bench.send(mavlink.MAVLink_param_set_message(1, 1, b"_HASH_CHECK", 0.0, 5))
    before = len(bench.of("PARAM_VALUE"))
    bench.run(0.5)
    assert len(bench.of("PARAM_VALUE")) == before


def test_parameters_act_within_their_range() -> None:
    """A parameter stores any value, as a recorded session shows, but acts within its range."""
    table = Bench().instance.autopilot.parameters
    for value, obeyed in ((2.5, 2.5), (-1.0, 0.0), (100.0, 60.0), (NAN, 1.0)):
        assert table.set_from_wire("COM_OF_LOSS_T", value, 9)
        assert table.role("stream_timeout_s") == obeyed


# -- contents --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "body",
    [(np.nan,) * 13, (1.0, *(0.0,) * 9, np.nan, np.inf, -np.inf), (1.0, *(0.0,) * 11, -1e5)],
    ids=["all NaN", "no position", "above the atmosphere"],
)
def test_invalid_states_are_still_sent(body: tuple[float, ...]) -> None:
    conditions = Conditions(estimator=EstimatorName.PX4_LIKE)
    instance = Instance(PX4, config.vehicle(PX4.vehicle), conditions, 7)
    instance.autopilot.plant.record["body"][0] = body
    for stream in instance.companion.schedule.streams.values():
        stream.due_us = 0
    sent = {m.get_type() for each in instance.step() for m in Decoder().read(each)}
    assert sent >= {"LOCAL_POSITION_NED", "ODOMETRY", "ATTITUDE", "HIGHRES_IMU", "GPS_RAW_INT"}


@pytest.mark.parametrize("firmware", FIRMWARES.values(), ids=FIRMWARES)
def test_every_message_is_read_by_pymavlink(firmware: Firmware) -> None:
    """Each message has the right number, order and types of fields."""
    bench = Bench(firmware=firmware, boot_scale=0.02)
    bench.run(1.0)
    names = builders(firmware)
    for name in names:
        bench.instance.companion.outbox.send_now(name)
    bench.run(0.1)
    assert {message.get_type() for _, message in bench.received} >= set(names)
