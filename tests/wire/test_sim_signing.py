"""Signing of the simulated vehicle beside pymavlink, for both firmwares.

FORGED_FRAMES=100000 is the long form of the test with forged and replayed frames.
"""

from __future__ import annotations

import os
import random
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from simulator import config
from simulator.firmware.ardupilot import ARDUPILOT
from simulator.firmware.base import Firmware
from simulator.firmware.px4 import PX4
from simulator.instance import VIRTUAL_EPOCH_US, Instance
from simulator.vehicle.conditions import Conditions

KEY, OTHER_KEY = bytes(range(32)), bytes(range(1, 33))
EPOCH = (VIRTUAL_EPOCH_US - 1_420_070_400_000_000) // 10
COUNT = int(os.environ.get("FORGED_FRAMES", "2000"))
MINUTE = 6_000_000


def vehicle(firmware: Firmware = PX4, key: bytes = KEY) -> Instance:
    flyer = config.vehicle(firmware.vehicle)
    conditions = Conditions(boot_scale=0.05)
    return Instance(firmware, flyer, conditions, seed=1, signing_key=key)


class Client:
    """A ground station that pymavlink signs for."""

    def __init__(self, key: bytes | None = KEY, stamp: int = EPOCH, system: int = 255) -> None:
        self.codec = mavlink.MAVLink(None, srcSystem=system, srcComponent=190)
        self.codec.signing.secret_key = key
        self.codec.signing.sign_outgoing = key is not None
        self.codec.signing.timestamp = stamp
        self.codec.robust_parsing = True

    def pack(self, message: Any) -> bytes:
        return bytes(message.pack(self.codec))

    def request(self, name: bytes = b"SYS_AUTOSTART") -> bytes:
        return self.pack(mavlink.MAVLink_param_request_read_message(1, 1, name, -1))

    def heard(self, instance: Instance, steps: int = 5) -> list[Any]:
        """What the vehicle sends, as far as pymavlink accepts it."""
        data = b"".join(b"".join(instance.step()) for _ in range(steps))
        found = [(m, m.get_type()) for m in self.codec.parse_buffer(data) or []]
        # pymavlink does not check what it does not know
        return [m for m, name in found if name != "BAD_DATA" and not name.startswith("UNKNOWN")]


def answers(client: Client, instance: Instance) -> bool:
    return any(m.get_type() == "PARAM_VALUE" for m in client.heard(instance))


@pytest.mark.parametrize("firmware", [PX4, ARDUPILOT], ids=["px4", "ardupilot"])
def test_it_answers_what_is_signed_and_signs_the_answer(firmware: Firmware) -> None:
    instance, client = vehicle(firmware), Client()
    name = firmware.parameters[0].name.encode()
    instance.feed(client.request(name))
    assert answers(client, instance)
    for other in (Client(None), Client(OTHER_KEY, EPOCH + MINUTE)):
        instance.feed(other.request(name))
        assert not answers(Client(stamp=0), instance)
    assert instance.complaints == {
        "message refused: unsigned": 1,
        "message refused: wrong signature": 1,
    }


def test_none_of_many_forged_and_replayed_requests_is_answered() -> None:
    instance, client, chance = vehicle(), Client(), random.Random(5)
    real = [client.request() for _ in range(20)]
    for frame in real:
        instance.feed(frame)
    assert answers(client, instance)
    instance.feed(b"")
    before = instance.autopilot.parameters["COM_OF_LOSS_T"]
    attackers = [Client(None), Client(OTHER_KEY, EPOCH + MINUTE), Client(None, system=1)]
    for _ in range(COUNT):
        attacker = chance.choice(attackers)
        change = mavlink.MAVLink_param_set_message(1, 1, b"COM_OF_LOSS_T", 5.0, 9)
        forged = attacker.pack(change)
        replayed = chance.choice(real)
        damaged = bytearray(replayed)
        damaged[-13 + chance.randrange(13)] ^= 1 << chance.randrange(8)
        instance.feed(chance.choice((forged, replayed, bytes(damaged))))
    assert sum(instance.complaints.values()) == COUNT
    assert instance.autopilot.parameters["COM_OF_LOSS_T"] == before
    assert not answers(client, instance)


@pytest.mark.parametrize(
    ("firmware", "accepted"),
    [(PX4, {"HEARTBEAT", "RADIO_STATUS", "COLLISION"}), (ARDUPILOT, {"RADIO_STATUS"})],
    ids=["px4", "ardupilot"],
)
def test_what_is_accepted_unsigned(firmware: Firmware, accepted: set[str]) -> None:
    messages = (
        mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3),
        mavlink.MAVLink_radio_status_message(1, 1, 100, 0, 0, 0, 0),
        mavlink.MAVLink_collision_message(0, 1, 0, 0, 0.0, 0.0, 0.0),
        mavlink.MAVLink_set_mode_message(1, 1, 0),
    )
    taken = set()
    for message in messages:
        instance = vehicle(firmware)
        instance.feed(Client(None).pack(message))
        if not instance.complaints:
            taken.add(message.get_type())
    assert taken == accepted


def test_a_stamp_that_is_a_minute_old_is_refused_until_a_newer_one_comes() -> None:
    instance = vehicle(ARDUPILOT)
    instance.feed(Client(stamp=EPOCH - MINUTE - 1000).request(b"SYSID_MYGCS"))
    assert instance.complaints == {"message refused: old time stamp": 1}
    instance.feed(Client(stamp=EPOCH - MINUTE + 1000).request(b"SYSID_MYGCS"))
    assert sum(instance.complaints.values()) == 1


def test_a_px4_without_clock_follows_the_stamps_that_it_hears() -> None:
    instance, client = vehicle(), Client(stamp=EPOCH)
    assert client.heard(instance, 100) == []  # years behind
    # signed, although a PX4 would take it unsigned
    instance.feed(client.pack(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)))
    assert client.heard(instance)


def test_setup_signing_sets_and_removes_the_key_but_not_while_armed() -> None:
    instance, client = vehicle(key=b""), Client(None)

    def set_up(key: bytes, stamp: int) -> None:
        message = mavlink.MAVLink_setup_signing_message(1, 1, list(key), stamp)
        instance.feed(client.pack(message))

    instance.autopilot.commander.armed = True
    set_up(KEY, EPOCH)
    assert not instance.keyring.on
    instance.autopilot.commander.armed = False
    set_up(KEY, EPOCH)
    instance.feed(client.request())
    assert instance.complaints == {"message refused: unsigned": 1}
    client = Client(stamp=EPOCH + 1000)
    instance.feed(client.request())
    assert answers(client, instance)
    set_up(bytes(32), 0)
    unsigned = Client(None)
    instance.feed(unsigned.request())
    assert answers(unsigned, instance)
