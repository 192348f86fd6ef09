"""Signing of the simulated vehicle beside pymavlink, for both firmwares."""

from __future__ import annotations

from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from vehicle_frames import Sender

from simulator import config
from simulator.firmware.ardupilot import ARDUPILOT
from simulator.firmware.base import Firmware
from simulator.firmware.px4 import PX4
from simulator.instance import VIRTUAL_EPOCH_US, Instance
from simulator.vehicle.conditions import Conditions

KEY, OTHER_KEY = bytes(range(32)), bytes(range(1, 33))
EPOCH = (VIRTUAL_EPOCH_US - 1_420_070_400_000_000) // 10
MINUTE = 6_000_000


def vehicle(firmware: Firmware = PX4, key: bytes = KEY) -> Instance:
    flyer = config.vehicle(firmware.vehicle)
    conditions = Conditions(boot_scale=0.05)
    return Instance(firmware, flyer, conditions, seed=1, signing_key=key)


def station(key: bytes = KEY, stamp: int = EPOCH) -> Sender:
    """A ground station that pymavlink signs for."""
    return Sender(255, 190, key, stamp)


def request(client: Sender, name: bytes = b"SYS_AUTOSTART") -> bytes:
    return client.frame(mavlink.MAVLink_param_request_read_message(1, 1, name, -1))


def heard(client: Sender, instance: Instance, steps: int = 5) -> list[str]:
    """What the vehicle sends, as far as pymavlink accepts it."""
    data = b"".join(b"".join(instance.step()) for _ in range(steps))
    found = [message.get_type() for message in client.codec.parse_buffer(data) or []]
    # pymavlink does not check what it does not know
    return [name for name in found if name != "BAD_DATA" and not name.startswith("UNKNOWN")]


def answers(client: Sender, instance: Instance) -> bool:
    return "PARAM_VALUE" in heard(client, instance)


@pytest.mark.parametrize("firmware", [PX4, ARDUPILOT], ids=["px4", "ardupilot"])
def test_it_answers_what_is_signed_and_signs_the_answer(firmware: Firmware) -> None:
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
    assert instance.complaints == {
        "message refused: unsigned": 1,
        "message refused: wrong signature": 2,
        "message refused: old time stamp": 1,
    }


@pytest.mark.parametrize(
    ("firmware", "accepted"),
    [(PX4, ["HEARTBEAT", "RADIO_STATUS", "COLLISION"]), (ARDUPILOT, ["RADIO_STATUS"])],
    ids=["px4", "ardupilot"],
)
def test_what_is_accepted_unsigned(firmware: Firmware, accepted: list[str]) -> None:
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
        if not instance.complaints:
            taken.append(message.get_type())
    assert taken == accepted


def test_a_stamp_that_is_a_minute_old_is_refused() -> None:
    for older, refused in ((1000, {"message refused: old time stamp": 1}), (-1000, {})):
        instance = vehicle(ARDUPILOT)
        instance.feed(request(station(stamp=EPOCH - MINUTE - older)))
        assert instance.complaints == refused


def test_a_px4_without_clock_follows_the_stamps_that_it_hears() -> None:
    instance, client = vehicle(), station()
    assert heard(client, instance, 100) == []  # years behind
    # signed, although a PX4 would take it unsigned
    instance.feed(client.frame(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)))
    assert heard(client, instance)


def test_setup_signing_sets_and_removes_the_key_but_not_while_armed() -> None:
    instance, client = vehicle(key=b""), station(b"")

    def set_up(sender: Sender, key: bytes, stamp: int) -> None:
        instance.feed(sender.frame(mavlink.MAVLink_setup_signing_message(1, 1, list(key), stamp)))

    instance.autopilot.commander.armed = True
    set_up(client, KEY, EPOCH)
    assert not instance.keyring.key
    instance.autopilot.commander.armed = False
    set_up(client, KEY, EPOCH)
    instance.feed(request(client))
    assert instance.complaints == {"message refused: unsigned": 1}
    signed = station(stamp=EPOCH + 1000)
    instance.feed(request(signed))
    assert answers(signed, instance)
    set_up(signed, bytes(32), 0)
    instance.feed(request(client))
    assert answers(client, instance)
