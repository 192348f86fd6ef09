"""Telemetry of a link: builders, rates, the grid of positions, values that are not finite."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sim_bench import Bench

from simulator import config
from simulator.firmware.base import Firmware
from simulator.firmware.catalogue import FIRMWARES
from simulator.firmware.px4 import PX4
from simulator.instance import Instance
from simulator.mavlink.codec import Decoder
from simulator.mavlink.telemetry import builders
from simulator.vehicle.conditions import Conditions
from simulator.vehicle.sensors import EstimatorName


def _instance() -> Instance:
    return Instance(
        PX4,
        config.vehicle(PX4.vehicle),
        Conditions(estimator=EstimatorName.PX4_LIKE),
        7,
        lockstep=True,
        ground_link=False,
    )


def test_another_rate_of_one_message_does_not_shift_the_others() -> None:
    instance = _instance()
    while instance.time_s < 3.1:
        instance.advance()
    instance.drain()
    slower = mavlink.MAVLink_command_long_message(1, 1, 511, 0, 31, 40_000, 0, 0, 0, 0, 0)
    instance.feed(slower.pack(mavlink.MAVLink(None, 255, 190)))
    sent = Counter[str]()
    while instance.time_s < 3.9:
        for datagram in instance.step():
            sent.update(message.get_type() for message in Decoder().read(datagram))
    assert "HEARTBEAT" not in sent
    assert sent["ATTITUDE_QUATERNION"] == 20
    assert sent["ATTITUDE"] == 80


@pytest.mark.parametrize(
    "body",
    [(np.nan,) * 13, (1.0, *(0.0,) * 9, np.nan, np.inf, -np.inf), (1.0, *(0.0,) * 11, -1e5)],
    ids=["all NaN", "no position", "above the atmosphere"],
)
def test_states_that_are_not_finite_or_out_of_range_are_sent(body: tuple[float, ...]) -> None:
    instance = _instance()
    instance.autopilot.plant.record["body"][0] = body
    streams = instance.companion.schedule.streams
    for name in streams:
        streams[name].due_us = 0
    instance.advance_to_barrier()
    sent = {message.get_type() for message in Decoder().read(b"".join(instance.drain()))}
    assert sent >= {"LOCAL_POSITION_NED", "ODOMETRY", "ATTITUDE", "HIGHRES_IMU", "GPS_RAW_INT"}


@pytest.mark.parametrize("firmware", FIRMWARES.values(), ids=FIRMWARES)
def test_every_message_is_read_by_pymavlink(firmware: Firmware) -> None:
    """Right number, order and types of fields: each message is framed here and decoded there."""
    bench = Bench(firmware=firmware, boot_scale=0.02)
    bench.run(1.0)
    names = builders(firmware)
    for name in names:
        bench.instance.companion.outbox.send_now(name)
    bench.run(0.1)
    assert {message.get_type() for _, message in bench.received} >= set(names)
