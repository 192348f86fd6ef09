"""Signing by session and simulated vehicle against pymavlink: frames sent, accepted and refused.

FORGED_FRAMES=100000 is the long form of the test with forged and replayed frames.
"""

from __future__ import annotations

import os
import random
from collections.abc import Callable
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from vehicle_frames import PEER, Sender

from offboard.mavlink import events
from offboard.mavlink.outgoing import Heartbeat
from offboard.mavlink.session import Session, SessionSettings
from offboard.mavlink.signing import RESERVED, UNITS_PER_S, Refusal, Signing, stamp_of_unix
from simulator import config
from simulator.autopilot.firmware import Firmware
from simulator.firmware.ardupilot import ARDUPILOT
from simulator.firmware.px4 import PX4
from simulator.instance import VIRTUAL_EPOCH_US, Instance
from simulator.vehicle.conditions import Conditions

KEY, OTHER_KEY = bytes(range(32)), bytes(range(1, 33))
NOW = stamp_of_unix(1_800_000_000_000_000)
TEN_MINUTES = 600 * UNITS_PER_S
COUNT = int(os.environ.get("FORGED_FRAMES", "2000"))


def signer(key: bytes = KEY, component: int = 1, stamp: int = NOW) -> Sender:
    return Sender(1, component, key, stamp)


def session() -> Session:
    return Session(SessionSettings(), Signing(KEY, NOW))


def stamp_of(frame: bytes) -> int:
    return int.from_bytes(frame[-12:-6], "little")


def paired() -> tuple[Session, Sender]:
    """A session that has found its vehicle."""
    ours, vehicle = session(), signer()
    ours.receive(vehicle.heartbeat(), PEER, 0.0)
    assert ours.vehicle == events.VehicleFound(1, 1, "px4")
    return ours, vehicle


def test_forged_and_replayed_frames_are_refused() -> None:
    """A forged time stamp does not shut out the vehicle, either."""
    ours, vehicle = paired()
    chance = random.Random(13)
    real = [vehicle.position(1000 + 20 * number) for number in range(50)]
    other, unsigned = signer(OTHER_KEY, stamp=(1 << 48) - 10**6), signer(b"")
    for frame in real:
        assert ours.receive(frame, PEER, 0.1).events

    def altered(byte: int, end: int) -> bytes:
        """A captured frame with another time stamp, link id or content, and a right checksum."""
        frame = bytearray(chance.choice(real))
        frame[byte:end] = chance.randbytes(end - byte)
        crc = mavlink.x25crc(bytes(frame[1:-15]))
        crc.accumulate(bytes([mavlink.MAVLink_local_position_ned_message.crc_extra]))
        frame[-15:-13] = crc.crc.to_bytes(2, "little")
        return bytes(frame)

    forgeries: tuple[Callable[[], bytes], ...] = (
        lambda: chance.choice(real),  # a replay
        lambda: other.position(chance.randrange(2**31)),
        lambda: unsigned.position(chance.randrange(2**31)),
        lambda: altered(-12, -6),  # time stamp
        lambda: altered(-13, -12),  # link id: a stream that was never heard
        lambda: altered(10, 30),  # content
        lambda: real[-1][:-6] + chance.randbytes(6),  # signature
    )
    for _ in range(COUNT):
        reception = ours.receive(chance.choice(forgeries)(), PEER, 0.2)
        assert (reception.events, reception.frames, reception.replies) == ([], [], [])
    # by chance some altered frames equal the original: they are replays
    assert ours.senders.forged.total() == COUNT
    assert {*Refusal} - {*ours.senders.forged} == {Refusal.OLD_STAMP}
    assert ours.receive(vehicle.position(3000), PEER, 0.3).events  # and the vehicle still is


def test_only_radio_status_is_accepted_unsigned() -> None:
    """A frame of MAVLink 1 is refused. An unsigned setpoint with our ids is no second sender."""
    ours, _ = paired()
    radio = mavlink.MAVLink_radio_status_message(1, 1, 100, 0, 0, 0, 0)
    ours.receive(Sender(ord("3"), ord("D")).frame(radio), PEER, 0.0)
    assert ours.senders.forged.total() == 0
    position = mavlink.MAVLink_local_position_ned_message(1000, *(0,) * 6)
    setpoint = mavlink.MAVLink_set_attitude_target_message(0, 1, 1, 7, [1, 0, 0, 0], 0, 0, 0, 0.5)
    version_1 = signer(b"").frame(position, mavlink1=True)
    for frame in (signer(b"").frame(position), version_1, signer(b"", 191).frame(setpoint)):
        assert ours.receive(frame, PEER, 0.0).events == []
    assert ours.senders.forged[Refusal.UNSIGNED] == 3
    (seen,) = ours.receive(signer(component=191).frame(setpoint), PEER, 0.0).events
    assert isinstance(seen, events.OtherSender)


def test_session_explains_why_no_vehicle_was_found() -> None:
    for ours, key, sentence in (
        (session(), OTHER_KEY, "signature does not match: it is another key's"),
        (session(), b"", "arrive unsigned: set the key on the vehicle, or omit --signing-key"),
        (Session(SessionSettings()), KEY, "give its key with --signing-key"),
    ):
        assert ours.receive(signer(key).heartbeat(), PEER, 0.0).events == []
        assert sentence in ours.senders.why_none()
    ours = Session(SessionSettings())
    assert ours.receive(Sender(1, 7).heartbeat(12), PEER, 0.0).events == []
    assert "an autopilot is heard as component 7" in ours.senders.why_none()


def test_vehicle_whose_signing_clock_is_behind_is_found() -> None:
    """PX4 begins with the stamp that came with its key, perhaps years ago. Our stamps follow those
    of a vehicle that is ahead."""
    ours, vehicle = session(), signer(stamp=NOW - TEN_MINUTES)
    reception = ours.receive(vehicle.heartbeat(), PEER, 0.0)
    assert reception.events == [events.ClockBehind(1, armed=False)]
    assert ours.vehicle is None
    (heartbeat,) = ours.poll(0.0)
    assert vehicle.codec.decode(bytearray(ours.encode(heartbeat))).type == 18
    ours.receive(vehicle.heartbeat(), PEER, 1.0)
    assert ours.vehicle is not None
    ahead = session()
    ahead.receive(signer(stamp=NOW + TEN_MINUTES).heartbeat(), PEER, 0.0)
    assert stamp_of(ahead.encode(Heartbeat(6))) >= NOW + TEN_MINUTES


def test_port_change_needs_a_valid_signature() -> None:
    ours, vehicle = paired()
    other = (PEER[0], PEER[1] + 1)
    for key in (b"", OTHER_KEY):
        assert ours.receive(signer(key).position(2000), other, 5.0).events == []
    assert ours.receive(vehicle.position(2000), ("10.0.0.3", 1), 5.0).events == []
    moved = ours.receive(vehicle.position(2000), other, 5.0).events
    assert moved[0] == events.PeerChanged(other)
    assert len(moved) == 2  # its check did not use up the time stamp


def test_signing_stamps_always_increase_and_are_reserved_first() -> None:
    time_s, reserved = [100.0], []
    signing = Signing(KEY, NOW, lambda: time_s[0], reserved.append, NOW)
    stamps = []
    for elapsed_s in (0.0, 0.0, 10.0, -50.0, 0.0, 40.0, 40.0):
        time_s[0] += elapsed_s
        stamps.append(stamp_of(Session(SessionSettings(), signing).encode(Heartbeat(18))))
        assert stamps[-1] < reserved[-1]
    assert stamps == sorted(set(stamps))
    assert len(reserved) == 2
    assert reserved[0] == stamps[0] + RESERVED


def test_resumed_signing_continues_stamps_and_refuses_replays() -> None:
    ours, vehicle = paired()
    frame = vehicle.position(1000)
    ours.receive(frame, PEER, 0.0)
    assert ours._signing is not None
    signing = Signing.resumed(lambda: 0.0, ours._signing.state())
    later = Session(SessionSettings(), signing)
    later.senders.set_vehicle(events.VehicleFound(1, 1, "px4"), PEER)
    assert later.receive(frame, PEER, 0.0).events == []
    assert later.senders.forged[Refusal.REPLAYED] == 1
    assert later.receive(vehicle.position(1020), PEER, 0.0).events
    assert stamp_of(ours.encode(Heartbeat(6))) < stamp_of(later.encode(Heartbeat(6)))


def test_signing_key_is_not_logged_or_shown() -> None:
    setup = mavlink.MAVLink_setup_signing_message(1, 1, list(KEY), NOW)
    reception = Session(SessionSettings()).receive(Sender(255, 190).frame(setup), PEER, 0.0)
    assert reception.frames == []
    assert repr(KEY)[2:-1] not in repr(Signing(KEY))


# --- the simulated vehicle ------------------------------------------------------------------------


EPOCH = (VIRTUAL_EPOCH_US - 1_420_070_400_000_000) // 10
MINUTE = 6_000_000


def vehicle(firmware: Firmware = PX4, key: bytes = KEY) -> Instance:
    flyer = config.vehicle(firmware.vehicle)
    conditions = Conditions(boot_scale=0.05)
    return Instance(firmware, flyer, conditions, seed=1, signing_key=key)


def station(key: bytes = KEY, stamp: int = EPOCH) -> Sender:
    """A ground station whose frames pymavlink signs."""
    return Sender(255, 190, key, stamp)


def request(client: Sender, name: bytes = b"SYS_AUTOSTART") -> bytes:
    return client.frame(mavlink.MAVLink_param_request_read_message(1, 1, name, -1))


def heard(client: Sender, instance: Instance, steps: int = 5) -> list[str]:
    """Names of the messages that the vehicle sends and pymavlink accepts."""
    data = b"".join(b"".join(instance.step()) for _ in range(steps))
    found = [message.get_type() for message in client.codec.parse_buffer(data) or []]
    # pymavlink does not check messages that it does not know
    return [name for name in found if name != "BAD_DATA" and not name.startswith("UNKNOWN")]


def answers(client: Sender, instance: Instance) -> bool:
    return "PARAM_VALUE" in heard(client, instance)


@pytest.mark.parametrize("firmware", [PX4, ARDUPILOT], ids=["px4", "ardupilot"])
def test_simulated_vehicle_answers_only_signed_requests(firmware: Firmware) -> None:
    instance, client = vehicle(firmware), station()
    name = firmware.parameters[0].name.encode()
    instance.feed(request(client, name))
    assert answers(client, instance)
    asked = request(client, name)
    damaged = asked[:-10] + bytes((asked[-10] ^ 1,)) + asked[-9:]  # its time stamp
    instance.feed(asked)
    assert answers(client, instance)
    for refused in (
        request(station(b""), name), request(station(OTHER_KEY, EPOCH + MINUTE), name), damaged,
        asked,
    ):  # fmt: skip
        instance.feed(refused)
        assert not answers(station(stamp=0), instance)
    assert instance.refusals == {
        "message refused: unsigned": 1,
        "message refused: wrong signature": 2,
        "message refused: old time stamp": 1,
    }


@pytest.mark.parametrize(
    ("firmware", "accepted"),
    [(PX4, ["HEARTBEAT", "RADIO_STATUS", "COLLISION"]), (ARDUPILOT, ["RADIO_STATUS"])],
    ids=["px4", "ardupilot"],
)
def test_each_firmware_accepts_its_unsigned_messages(
    firmware: Firmware, accepted: list[str]
) -> None:
    messages: tuple[Any, ...] = (
        mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3),
        mavlink.MAVLink_radio_status_message(1, 1, 100, 0, 0, 0, 0),
        mavlink.MAVLink_collision_message(0, 1, 0, 0, 0.0, 0.0, 0.0),
        mavlink.MAVLink_set_mode_message(1, 1, 0),
    )
    taken = []
    for message in messages:
        instance = vehicle(firmware)
        instance.feed(station(b"").frame(message))
        if not instance.refusals:
            taken.append(message.get_type())
    assert taken == accepted


def test_stamp_older_than_a_minute_is_refused() -> None:
    for older, refused in ((1000, {"message refused: old time stamp": 1}), (-1000, {})):
        instance = vehicle(ARDUPILOT)
        instance.feed(request(station(stamp=EPOCH - MINUTE - older)))
        assert instance.refusals == refused


def test_px4_without_a_clock_follows_received_stamps() -> None:
    instance, client = vehicle(), station()
    assert heard(client, instance, 100) == []  # its stamps are years behind
    # signed, although a PX4 would take it unsigned
    instance.feed(client.frame(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)))
    assert heard(client, instance)


def test_setup_signing_changes_the_key_only_while_disarmed() -> None:
    instance, client = vehicle(key=b""), station(b"")

    def set_up(sender: Sender, key: bytes, stamp: int) -> None:
        instance.feed(sender.frame(mavlink.MAVLink_setup_signing_message(1, 1, list(key), stamp)))

    instance.autopilot.commander.armed = True
    set_up(client, KEY, EPOCH)
    assert not instance.keyring.key
    instance.autopilot.commander.armed = False
    set_up(client, KEY, EPOCH)
    instance.feed(request(client))
    assert instance.refusals == {"message refused: unsigned": 1}
    signed = station(stamp=EPOCH + 1000)
    instance.feed(request(signed))
    assert answers(signed, instance)
    set_up(signed, bytes(32), 0)
    instance.feed(request(client))
    assert answers(client, instance)
