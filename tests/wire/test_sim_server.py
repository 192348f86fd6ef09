"""The simulated vehicle's link: rates, requests, texts, parameters, truth, hostile input."""

from __future__ import annotations

import itertools
import math
import struct
from collections import Counter

import numpy as np
import pytest
from pymavlink.dialects.v20 import all as every
from pymavlink.dialects.v20 import common as mavlink
from sim_bench import NAN, Bench

from simulator.firmware.px4 import PX4
from simulator.firmware.px4_messages import COMPANION_RATES_HZ, GROUND_RATES_HZ
from simulator.mavlink.outbox import DATAGRAM_MAX
from simulator.vehicle.sensors import EstimatorName

LOCAL_POSITION, GPS_RAW = 32, 24


def read(datagrams: list[bytes]) -> list[object]:
    parser = every.MAVLink(None)
    return [m for datagram in datagrams for m in parser.parse_buffer(datagram) or []]


# -- rates -----------------------------------------------------------------------------------


def test_default_rates_are_those_of_px4() -> None:
    bench = Bench()
    bench.run(20.0)
    counts = Counter(m.get_type() for _, m in bench.received)
    assert {name: counts[name] / 20.0 for name in COMPANION_RATES_HZ} == {
        name: pytest.approx(rate, abs=0.1) for name, rate in COMPANION_RATES_HZ.items()
    }


def test_the_ground_link_has_its_own_rates_and_sequence() -> None:
    bench = Bench(ground_link=True)
    companion, ground = [], []
    for _ in range(2500):
        bench.instance.advance()
        companion += bench.instance.companion.outbox.drain()
        ground += bench.instance.ground.outbox.drain()
    heard = read(ground)
    counts = Counter(m.get_type() for m in heard)
    assert {name: counts[name] / 10.0 for name in GROUND_RATES_HZ} == {
        name: pytest.approx(rate, abs=0.2) for name, rate in GROUND_RATES_HZ.items()
    }
    for messages in (heard, read(companion)):
        sequence = [m.get_seq() for m in messages]
        assert sequence == [i % 256 for i in range(len(sequence))]


def test_a_hundred_hertz_come_in_gaps_of_8_and_16_ms() -> None:
    bench = Bench()
    assert bench.command(511, LOCAL_POSITION, 10_000) == [0]
    begun_s = bench.time_s
    bench.run(4.0)
    stamps = [m.time_boot_ms for _, m in bench.of("LOCAL_POSITION_NED", begun_s)]
    gaps = Counter(b - a for a, b in itertools.pairwise(stamps))
    assert set(gaps) == {8, 16}
    assert gaps[8] / gaps[16] == pytest.approx(3.0, rel=0.05)
    assert len(stamps) == pytest.approx(400, abs=2)


def test_an_interval_can_be_stopped_restored_and_read() -> None:
    bench = Bench()
    for interval_us, shown_us, expected in (
        (20_000, 20_000, 50),
        (-1, -1, 0),
        (0, 33_333, 30),
        (3e38, 2**31 - 1, 0),
    ):
        bench.command(511, LOCAL_POSITION, interval_us)
        begun_s = bench.time_s
        bench.run(2.0)
        heard = len(bench.of("LOCAL_POSITION_NED", begun_s)) / 2.0
        assert heard == pytest.approx(expected, abs=1)
        assert bench.command(510, LOCAL_POSITION) == [0]
        assert bench.of("MESSAGE_INTERVAL")[-1][1].interval_us == shown_us


def test_datagrams_hold_whole_frames_and_fit() -> None:
    bench = Bench()
    bench.send(mavlink.MAVLink_param_request_list_message(1, 1))
    sizes = []
    for _ in range(1000):
        for datagram in bench.instance.step():
            sizes.append(len(datagram))
            parser = mavlink.MAVLink(None)
            messages = parser.parse_buffer(datagram)
            assert sum(len(m.get_msgbuf()) for m in messages) == len(datagram)
    assert max(sizes) <= DATAGRAM_MAX


# -- texts -----------------------------------------------------------------------------------


@pytest.mark.parametrize(("kind", "heard"), [(6, True), (18, False), (None, False)])
def test_texts_are_sent_to_ground_stations_only(kind: int | None, heard: bool) -> None:
    bench = Bench(heartbeat_type=kind)
    bench.boot()
    bench.command(400, 1)
    assert ("Armed by external command" in bench.texts()) is heard


def test_long_texts_come_in_chunks_and_end_in_a_tab() -> None:
    bench = Bench()
    bench.run(1.0)
    bench.command(400, 1)
    chunks = [(m.chunk_seq, m.text, m.severity) for _, m in bench.of("STATUSTEXT")]
    assert chunks == [
        (0, "Arming denied: Resolve system health failures firs", 2),
        (1, "t\t", 2),
    ]


# -- time, ping, files -----------------------------------------------------------------------


def test_timesync_is_answered_with_vehicle_time() -> None:
    bench = Bench()
    bench.run(2.0)
    bench.send(mavlink.MAVLink_timesync_message(0, 123456789))
    bench.run(0.02)
    answers = [m for _, m in bench.of("TIMESYNC") if m.tc1 != 0]
    assert [(m.tc1, m.ts1) for m in answers] == [(2_000_000_000, 123456789)]


def test_file_transfer_is_refused() -> None:
    bench = Bench()
    request = struct.pack("<HBBBBBBI", 41, 3, 4, 2, 0, 0, 0, 0) + b"@PARAM/param.pck"
    payload = list(request.ljust(251, b"\0"))
    bench.send(mavlink.MAVLink_file_transfer_protocol_message(0, 1, 1, payload))
    bench.run(0.02)
    ((_, answer),) = bench.of("FILE_TRANSFER_PROTOCOL")
    head = struct.unpack_from("<HBBBB", bytes(answer.payload))
    assert head == (42, 3, 129, 1, 4)
    assert answer.payload[12] == 10


# -- parameters ------------------------------------------------------------------------------


def parameter(bench: Bench, name: str) -> tuple[float, int]:
    """Value (integers from their bytes) and type, as answered on the wire."""
    bench.send(mavlink.MAVLink_param_request_read_message(1, 1, name.encode(), -1))
    bench.run(0.02)
    message = next(m for _, m in reversed(bench.of("PARAM_VALUE")) if m.param_id == name)
    if message.param_type == 6:
        return struct.unpack("<i", struct.pack("<f", message.param_value))[0], 6
    return message.param_value, message.param_type


def test_parameters_are_listed_once_each() -> None:
    bench = Bench()
    bench.send(mavlink.MAVLink_param_request_list_message(1, 0))
    bench.run(0.5)
    listed = [(m.param_index, m.param_id, m.param_count) for _, m in bench.of("PARAM_VALUE")]
    names = [spec.name for spec in PX4.parameters]
    hashed = (65535, "_HASH_CHECK", len(names))
    assert listed == [hashed, *((i, name, len(names)) for i, name in enumerate(names))]


def test_the_parameter_hash_changes_with_the_values() -> None:
    """As QGroundControl reads it; a client that knows the hash stops the list."""
    bench = Bench()

    def known_as() -> tuple[float, int]:
        bench.send(mavlink.MAVLink_param_request_read_message(1, 1, b"_HASH_CHECK", -1))
        bench.run(0.02)
        _, answer = bench.of("PARAM_VALUE")[-1]
        assert answer.param_id == "_HASH_CHECK"
        return answer.param_value, answer.param_type

    first = known_as()
    assert first[1] == 5
    bench.send(mavlink.MAVLink_param_set_message(1, 1, b"COM_OF_LOSS_T", 2.0, 9))
    assert known_as() != first
    bench.send(mavlink.MAVLink_param_set_message(1, 1, b"COM_OF_LOSS_T", 1.0, 9))
    assert known_as() == first
    bench.send(mavlink.MAVLink_param_request_list_message(1, 1))
    bench.run(0.008)
    bench.send(mavlink.MAVLink_param_set_message(1, 1, b"_HASH_CHECK", 0.0, 5))
    before = len(bench.of("PARAM_VALUE"))
    bench.run(0.5)
    assert len(bench.of("PARAM_VALUE")) == before


def test_parameters_take_any_value_and_are_obeyed_within_their_range() -> None:
    bench = Bench()
    table = bench.instance.autopilot.parameters
    for value, obeyed in ((2.5, 2.5), (-1.0, 0.0), (100.0, 60.0), (NAN, 1.0)):
        bench.send(mavlink.MAVLink_param_set_message(1, 1, b"COM_OF_LOSS_T", value, 9))
        bench.run(0.02)
        kept = bench.of("PARAM_VALUE")[-1][1].param_value
        assert kept == pytest.approx(value, nan_ok=True)
        assert table.role("stream_timeout_s") == obeyed
    bytewise = struct.unpack("<f", struct.pack("<i", 4))[0]
    bench.send(mavlink.MAVLink_param_set_message(1, 1, b"COM_OBL_RC_ACT", bytewise, 6))
    assert parameter(bench, "COM_OBL_RC_ACT") == (4, 6)
    answers = len(bench.of("PARAM_VALUE"))
    bench.send(mavlink.MAVLink_param_set_message(1, 1, b"COM_OBL_RC_ACT", 1.0, 9))
    bench.run(0.02)
    assert len(bench.of("PARAM_VALUE")) == answers  # of the wrong type
    assert table["COM_OBL_RC_ACT"] == 4


# -- truth -----------------------------------------------------------------------------------


def test_gps_errors_are_as_large_as_those_of_sih() -> None:
    """Standing still: eight fixes a second however fast they are asked for, white about the truth
    with the deviations measured on PX4's SIH (N .19, E .13, D .52 m; .062 and .072 m/s)."""
    bench = Bench(EstimatorName.PX4_LIKE, seed=4)
    bench.boot()
    assert bench.command(511, GPS_RAW, 10_000) == [0]
    begun_s = bench.time_s
    bench.run(60.0)
    fixes = [message for _, message in bench.of("GPS_RAW_INT", begun_s)]
    assert len(fixes) == pytest.approx(480, abs=2)
    latitude, longitude, amsl = PX4.origin
    degree_m = math.radians(1.0) * 6_371_000
    shrink = math.cos(math.radians(latitude))
    rows = np.array(
        [
            (
                (f.lat * 1e-7 - latitude) * degree_m,
                (f.lon * 1e-7 - longitude) * degree_m * shrink,
                f.alt / 1e3 - amsl,
                f.vel / 100 * math.cos(math.radians(f.cog / 100)),
                f.vel / 100 * math.sin(math.radians(f.cog / 100)),
            )
            for f in fixes
        ]
    )
    assert rows.std(axis=0) == pytest.approx((0.19, 0.13, 0.52, 0.062, 0.072), rel=0.12)
    assert np.abs(rows.mean(axis=0)).max() < 0.08
    neighbours = [np.corrcoef(column[1:], column[:-1])[0, 1] for column in rows.T]
    assert np.abs(neighbours).max() < 0.15


# -- hostile input ---------------------------------------------------------------------------
