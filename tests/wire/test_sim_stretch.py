"""Stretches flown in one compiled call give the bytes of single steps, whatever goes on."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sim_bench import OFFBOARD, TAKEOFF

from simulator import config
from simulator.firmware.ardupilot import ARDUPILOT
from simulator.firmware.base import Firmware
from simulator.firmware.px4 import PX4
from simulator.firmware.setpoints import MotionSetpoint
from simulator.instance import Instance
from simulator.mavlink.codec import Decoder, frame, layout
from simulator.mavlink.frame_writer import KINDS
from simulator.mavlink.schedule import Stream
from simulator.vehicle.attitude import Demand
from simulator.vehicle.battery import Battery
from simulator.vehicle.conditions import Conditions
from simulator.vehicle.sensors import EstimatorName

SEED = 7


def _instance(
    firmware: Firmware = PX4,
    *,
    ground_link: bool = False,
    battery: Battery | None = None,
    boot_scale: float = 1.0,
) -> Instance:
    return Instance(
        firmware,
        config.vehicle(firmware.vehicle),
        Conditions(
            estimator=EstimatorName.PX4_LIKE,
            battery=battery or Battery(),
            boot_scale=boot_scale,
        ),
        SEED,
        lockstep=True,
        ground_link=ground_link,
    )


def _single_steps(instance: Instance, end_s: float) -> bool:
    while instance.time_s < end_s:
        instance.advance()
        if instance.barrier_due():
            return True
    return False


def _script() -> Iterator[tuple[float, object]]:
    """Times and what the companion sends then: boot, takeoff, offboard by attitude, sinking to the
    ground, silence."""
    codec = mavlink.MAVLink_command_long_message
    yield 0.1, mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)
    yield 1.0, codec(1, 1, 511, 0, 32, 12_345, 0, 0, 0, 0, 0)  # LOCAL_POSITION_NED at an odd rate
    yield 1.5, codec(1, 1, 511, 0, 30, -1, 0, 0, 0, 0, 0)  # no more ATTITUDE
    yield 2.0, mavlink.MAVLink_param_request_list_message(1, 1)
    yield 2.5, codec(1, 1, 511, 0, 30, 4_000, 0, 0, 0, 0, 0)  # at every step
    yield 5.0, codec(1, 1, 176, 0, 1, TAKEOFF >> 16 & 0xFF, TAKEOFF >> 24, 0, 0, 0, 0)
    yield 5.0, codec(1, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0)
    for i in range(160):
        q, thrust = (0.9999, 0.01 * (i % 2), -0.01, 0.0), 0.49 if i < 90 else 0.2
        yield (
            13.0 + 0.05 * i,
            mavlink.MAVLink_set_attitude_target_message(0, 1, 1, 7, q, 0, 0, 0, thrust),
        )
        if i % 40 == 0:
            yield 13.0 + 0.05 * i, mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)
        if i == 10:
            yield 13.55, codec(1, 1, 176, 0, 1, OFFBOARD >> 16 & 0xFF, 0, 0, 0, 0, 0)
            yield (
                13.55,
                mavlink.MAVLink_set_attitude_target_message(0, 1, 1, 7, q, 0, 0, 0, 0.49),
            )


def _flown(
    instance: Instance, advance: Callable[[Instance, float], bool], duration_s: float
) -> list[list[bytes]]:
    """The datagrams of every barrier; input is heard at barriers, as in lockstep."""
    codec, script = mavlink.MAVLink(None, 255, 190), list(_script())
    said = []
    while instance.time_s < duration_s:
        if not advance(instance, duration_s):
            break
        said.append(instance.barrier()[1])
        while script and script[0][0] <= instance.time_s:
            instance.feed(script.pop(0)[1].pack(codec))  # type: ignore[attr-defined]
        said.append(instance.ground.outbox.drain())
    return [*said, instance.drain()]


@pytest.mark.parametrize("firmware", [PX4, ARDUPILOT], ids=["px4", "ardupilot"])
@pytest.mark.parametrize("ground_link", [False, True], ids=["alone", "with a ground link"])
def test_a_flight_in_stretches_has_the_bytes_of_single_steps(
    firmware: Firmware, ground_link: bool
) -> None:
    one, other = (_instance(firmware, ground_link=ground_link) for _ in range(2))
    expected = _flown(one, _single_steps, 27.0)
    assert _flown(other, Instance.advance_to_barrier, 27.0) == expected
    assert one.steps == other.steps == 6_750


def test_an_arducopter_flies_in_stretches_without_a_setpoint_and_behind_the_last() -> None:
    """In GUIDED: takeoff, hold, velocities of which the stream stops, hold. One of them comes when
    the position loop runs, and one between; what it is asked for is told all the time."""
    command = mavlink.MAVLink_command_long_message
    slow, fast = (
        mavlink.MAVLink_set_position_target_local_ned_message(
            0, 1, 1, 1, 0b1101_1100_0111, 0, 0, 0, north_mps, 0, 0, 0, 0, 0, 0, 0
        )
        for north_mps in (0.5, 1.0)
    )
    script = {
        2.0: command(1, 1, 511, 0, 85, 5_000, 0, 0, 0, 0, 0),
        4.0: command(1, 1, 176, 0, 1, 4, 0, 0, 0, 0, 0),
        4.1: command(1, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0),
        4.2: command(1, 1, 22, 0, 0, 0, 0, 0, 0, 0, 5),
        13.0: slow,
        13.1: slow,
        13.204: fast,
    }
    codec = mavlink.MAVLink(None, 255, 190)
    said: list[list[bytes]] = []
    for step in (Instance.advance, Instance.tick):
        instance = _instance(ARDUPILOT, boot_scale=0.05)
        said.append([])
        for at_s, until_s in itertools.pairwise((0.0, *script, 20.0)):
            if at_s in script:
                instance.feed(script[at_s].pack(codec))
            while instance.time_s < until_s:
                step(instance)
                said[-1] += instance.drain()
        assert instance.autopilot.senses.truth.position_ned_m[2] == pytest.approx(-5.0, abs=0.5)
        assert instance.autopilot.senses.truth.position_ned_m[0] > 2.0
    assert said[0] == said[1]


def test_stretches_end_before_a_battery_is_found_empty() -> None:
    battery = Battery(capacity_ah=0.035)  # ten seconds of flight
    one, other = (_instance(battery=battery) for _ in range(2))
    expected = _flown(one, _single_steps, 27.0)
    assert _flown(other, Instance.advance_to_barrier, 27.0) == expected
    said = b"".join(frames for datagrams in expected for frames in datagrams)
    levels = (b"Low battery", b"Critical battery", b"Emergency battery level")
    assert [said.count(level) for level in levels] == [1, 1, 1]


def test_the_script_flies_by_attitude_and_lands_after_its_end() -> None:
    instance = _instance()
    _flown(instance, Instance.advance_to_barrier, 17.0)
    assert instance.autopilot.commander.armed
    assert instance.autopilot.commander.mode.custom_mode == OFFBOARD
    _flown(instance, Instance.advance_to_barrier, 60.0)
    assert instance.autopilot.pilot.landed


def test_most_steps_of_a_vehicle_left_alone_are_flown_in_stretches(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    instance = _instance()
    while instance.time_s < 6.0:
        instance.advance_to_barrier()
    single: list[int] = []
    advance = Instance.advance

    def counted(self: Instance) -> None:
        single.append(self.steps)
        advance(self)

    monkeypatch.setattr(Instance, "advance", counted)
    before = instance.steps
    while instance.time_s < 10.0:
        instance.advance_to_barrier()
    assert len(single) < 0.1 * (instance.steps - before)


def test_another_rate_of_one_message_leaves_the_others_their_times() -> None:
    instance = _instance()
    while instance.time_s < 3.1:
        instance.advance()
    instance.drain()
    slower = mavlink.MAVLink_command_long_message(1, 1, 511, 0, 31, 40_000, 0, 0, 0, 0, 0)
    instance.feed(slower.pack(mavlink.MAVLink(None, 255, 190)))
    said = Counter[str]()
    while instance.time_s < 3.9:
        for datagram in instance.step():
            said.update(message.name for message in Decoder().read(datagram))
    assert "HEARTBEAT" not in said
    assert said["ATTITUDE_QUATERNION"] == 20
    assert said["ATTITUDE"] == 80


def test_a_duration_ends_between_barriers() -> None:
    instance = _instance()
    while instance.advance_to_barrier(1.012):
        instance.barrier()
    assert instance.steps == 253


def _shake(instance: Instance, random: np.random.Generator, scale: float) -> None:
    """Some state of everything that messages tell of."""
    autopilot, plant = instance.autopilot, instance.autopilot.plant
    for field in ("body", "rotor", "error", "offset"):
        values = plant.record[field][0]
        values[:] = scale * random.standard_normal(len(values))
    attitude = random.standard_normal(4)
    body, rotor = plant.record["body"][0], plant.record["rotor"][0]
    body[:4] = attitude / np.linalg.norm(attitude)
    body[12] = -abs(body[12]) % 9e3
    rotor[:3] = random.random(), 0.0, 10.0 * abs(rotor[2])
    autopilot.senses.forget()
    autopilot.senses.steps = 2 * int(random.integers(0, 2**30))
    autopilot.senses.gps_healthy = bool(random.random() < 0.5)
    pilot = autopilot.pilot
    autopilot.navigator.home_ned_m = (0.0, 0.0, scale)
    pilot.fall(on_ground=bool(random.random() < 0.5))
    pilot.motion = MotionSetpoint(*(tuple(scale * random.standard_normal(3)) for _ in range(2)))
    pilot.thrust_demanded = float(random.random())
    given = tuple(random.standard_normal(4).tolist())
    by_attitude = random.random() < 0.5
    pilot.demand = Demand(
        True, 2.0 * scale - 0.5, given if by_attitude else None, None if by_attitude else given[:3]
    )


@pytest.mark.parametrize("name", KINDS)
def test_compiled_frames_are_the_readable_ones(name: str) -> None:
    """Random states, huge ones and zeros: every byte, the cut of trailing zeros, the checksum."""
    instance = _instance()
    random = np.random.default_rng(SEED)
    instance.companion.schedule.streams.clear()
    instance.companion.schedule.streams[name] = stream = Stream(1 << 40, 0)
    for case in range(200):
        _shake(instance, random, (1.0, 30.0, 1e5, 0.0)[case % 4])
        instance.companion.outbox.sequence = int(random.integers(0, 256))
        payload = instance.view.payload(name)
        expected = frame(instance.companion.outbox.sequence, 1, 1, layout(name), payload)
        stream.due_us = 0
        instance.companion.schedule.changed = True
        instance._stretch.say()
        stream.due_us = 0
        instance._stretch._streams.clear()
        assert instance.companion.outbox.drain() == [expected]


def test_states_that_are_no_numbers_are_written_all_the_same() -> None:
    instance = _instance()
    instance.autopilot.plant.record["body"][0, 10:] = np.nan, np.inf, -np.inf
    for name in KINDS:
        instance.companion.schedule.set_interval(name, 4_000)
        instance.companion.schedule.streams[name].due_us = 0
    instance.advance_to_barrier()
    told = {message.name for message in Decoder().read(b"".join(instance.drain()))}
    assert told >= set(KINDS)
