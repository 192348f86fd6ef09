"""Bad links: each impairment against its definition, in numbers."""

from __future__ import annotations

from itertools import pairwise
from random import Random
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from simulator.link.framing import frames
from simulator.link.impairment import Channel, Impairment

STEP_US = 4000


def carried(count: int = 2000, seed: int = 5, **settings: Any) -> list[tuple[int, bytes]]:
    """(time, datagram) of numbered datagrams of 32 bytes sent one per step of 4 ms."""
    channel = Channel(Impairment(**settings), Random(seed))
    arrived: list[tuple[int, bytes]] = []
    for step in range(count + 1000):
        now_us = step * STEP_US
        if step < count:
            channel.put(step.to_bytes(4, "big") * 8, now_us)
        arrived += [(now_us, datagram) for datagram in channel.take(now_us)]
    return arrived


def numbers(arrived: list[tuple[int, bytes]]) -> list[int]:
    return [int.from_bytes(datagram[:4], "big") for _, datagram in arrived]


def delays_us(arrived: list[tuple[int, bytes]]) -> list[int]:
    pairs = zip(arrived, numbers(arrived), strict=True)
    return [at_us - number * STEP_US for (at_us, _), number in pairs]


def test_latency_with_jitter_up_to_its_bound_keeps_the_order() -> None:
    assert set(delays_us(carried(latency_s=0.06))) == {60_000}
    arrived = carried(latency_s=0.02, jitter_s=0.04)
    assert numbers(arrived) == list(range(2000))
    delays = delays_us(arrived)
    assert min(delays) < 40_000
    assert max(delays) == 60_000


def test_loss_and_duplication_are_a_share() -> None:
    assert 1400 < len(carried(loss=0.25)) < 1600
    assert carried(loss=1.0) == []
    kept = numbers(carried(duplication=0.25))
    assert 2400 < len(kept) < 2600
    assert sorted(set(kept)) == list(range(2000))


def test_reordering_holds_a_share_back_behind_later_ones() -> None:
    arrived = carried(reorder=0.1, reorder_s=0.02)
    late = [delay for delay in delays_us(arrived) if delay]
    assert 150 < len(late) < 250
    assert set(late) == {20_000}
    assert sorted(numbers(arrived)) == list(range(2000))
    assert numbers(arrived) != list(range(2000))


def test_corruption_flips_one_bit_of_a_share() -> None:
    flipped = [
        bin(int.from_bytes(got, "big") ^ int.from_bytes(step.to_bytes(4, "big") * 8, "big"))
        for step, (_, got) in enumerate(carried(corruption=0.25))
    ]
    bits = [text.count("1") for text in flipped]
    assert set(bits) == {0, 1}
    assert 400 < sum(bits) < 600


def test_a_narrow_link_passes_its_rate_queues_and_then_loses() -> None:
    arrived = carried(rate_bytes_ps=1600.0, queue_bytes=320)
    # 50 datagrams of 32 bytes a second where 250 are sent
    assert len(arrived) == pytest.approx(2000 / 5, abs=12)
    assert max(delays_us(arrived)) == 200_000  # ten in the queue
    times = [at_us for at_us, _ in arrived]
    assert {b - a for a, b in pairwise(times)} == {20_000}


def test_a_rate_per_message_thins_telemetry_but_no_answers() -> None:
    codec = mavlink.MAVLink(None)
    channel = Channel(Impairment(message_rate_hz=20.0), Random(1))
    heard: dict[int, int] = {}
    for step in range(2500):
        now_us = step * STEP_US
        messages: list[Any] = [mavlink.MAVLink_attitude_message(step, *(0.1,) * 6)]
        if step % 2 == 0:
            messages.append(mavlink.MAVLink_local_position_ned_message(step, *(0.1,) * 6))
        if step % 500 < 2:
            messages.append(mavlink.MAVLink_command_ack_message(176, 0))
        channel.put(b"".join(message.pack(codec) for message in messages), now_us)
        for datagram in channel.take(now_us):
            for message_id, _ in frames(datagram):
                heard[message_id] = heard.get(message_id, 0) + 1
    assert heard == {30: 200, 32: 200, 77: 10}


def test_after_the_end_of_a_fault_nothing_overtakes_what_is_under_way() -> None:
    channel = Channel(Impairment(latency_s=0.02), Random(1))
    channel.put(b"late", 0)
    channel.on = False
    channel.put(b"next", 4000)
    assert channel.take(4000) == []
    assert channel.take(20_000) == [b"late", b"next"]
    channel.put(b"prompt", 24_000)
    assert channel.take(24_000) == [b"prompt"]


def test_a_ramp_grows_to_the_latency_and_keeps_the_order() -> None:
    arrived = carried(latency_s=0.8, ramp_s=4.0)
    assert numbers(arrived) == list(range(2000))
    late_us = delays_us(arrived)
    assert late_us[0] == 0
    assert late_us[500] == pytest.approx(400_000, abs=STEP_US)  # 2 s after the first
    assert set(late_us[1000:]) == {800_000}


def test_a_stalled_link_delivers_what_its_queue_holds_when_it_ends() -> None:
    channel = Channel(Impairment(stalled=True, queue_bytes=320), Random(1))
    sent = [bytes([number]) * 32 for number in range(12)]
    for number, datagram in enumerate(sent):
        channel.put(datagram, number * STEP_US)
        assert channel.take(number * STEP_US) == []
    channel.on = False
    channel.put(b"next", 12 * STEP_US)
    assert channel.take(12 * STEP_US) == [*sent[:10], b"next"]
