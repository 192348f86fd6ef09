"""Arbitrary input: the vehicle keeps running, sends well-formed frames only, and flies afterwards.

`FUZZ_DATAGRAMS=1000000 pytest tests/wire/test_sim_fuzz.py` sends half a million to each firmware
and half a million more in flight, before a normal one.
"""

from __future__ import annotations

import itertools
import math
import os

import pytest
from sim_bench import LOITER, NAN, Bench
from sim_fuzz import datagrams

from simulator import config
from simulator.firmware.base import Firmware
from simulator.firmware.catalogue import FIRMWARES
from simulator.firmware.px4 import PX4
from simulator.instance import Instance
from simulator.mavlink.codec import Decoder
from simulator.vehicle.conditions import Conditions

COUNT = int(os.environ.get("FUZZ_DATAGRAMS", "5000"))
PER_STEP = 20


def assault(instance: Instance, seed: int, count: int) -> Decoder:
    """Feed both links, let time pass between; returns the decoder of everything that was sent."""
    reader = Decoder()
    for number, datagram in enumerate(itertools.islice(datagrams(seed), count)):
        (instance.feed if number % 4 else instance.feed_ground)(datagram)
        if number % PER_STEP == 0:
            instance.advance()
            for datagram_out in (*instance.drain(), *instance.ground.outbox.drain()):
                messages = reader.read(datagram_out)
                positions = [m for m in messages if m.get_type() == "LOCAL_POSITION_NED"]
                assert all(math.isfinite(m.x + m.y + m.z) for m in positions)
    return reader


@pytest.mark.timeout(3000)
@pytest.mark.parametrize("firmware", FIRMWARES.values(), ids=FIRMWARES)
def test_nothing_raises_and_every_answer_is_well_formed(firmware: Firmware) -> None:
    vehicle = config.vehicle(firmware.vehicle)
    instance = Instance(firmware, vehicle, Conditions(), 1)
    reader = assault(instance, 5, COUNT // 2)
    assert not reader.dropped
    dropped = instance.companion.decoder.dropped
    assert {"checksum", "truncated", "not a frame", "unknown message"} <= set(dropped)


@pytest.mark.slow
@pytest.mark.timeout(3000)
def test_a_normal_flight_afterwards() -> None:
    bench = Bench(ground_link=True)
    bench.fly_offboard()
    assault(bench.instance, 6, COUNT // 2)
    autopilot = bench.instance.autopilot
    bench.command(21)
    bench.run_until(lambda: autopilot.position_controller.landed, 1000.0)
    bench.command(400, 0, 21196)
    for spec in PX4.parameters:
        autopilot.parameters.set(spec.name, spec.default)
    begun_s = bench.time_s
    assert bench.ask_mode(LOITER) == [0, 0]
    assert bench.command(400, 1) == [0]
    assert bench.command(22, *(NAN,) * 7) == [0]
    bench.run_until(lambda: bench.mode == LOITER, 15.0)
    bench.run(2.0)
    assert bench.height_m == pytest.approx(2.5, abs=0.3)
    assert bench.command(21) == [0]
    bench.run_until(lambda: not bench.armed, 20.0)
    assert bench.texts(begun_s)[-1] == "Disarmed by landing"
