"""Telemetry rates: requested, measured and requested again, with a vehicle in the loop."""

from __future__ import annotations

import random

import pytest
from vehicle_frames import PEER, Sender

from offboard.mavlink.dialects.base import WantedMessage
from offboard.mavlink.outgoing import CommandLong, Outgoing
from offboard.mavlink.session import Session, SessionSettings
from offboard.mavlink.telemetry import fitted
from offboard.mavlink.vehicle_time import Age, VehicleTime

POSITION = 32


def started(**settings: float) -> Session:
    session = Session(SessionSettings(**settings))  # type: ignore[arg-type]
    session.receive(Sender().heartbeat(), PEER, 0.0)
    return session


def asked_hz(session: Session) -> dict[int, float]:
    """Message ids and rates of the requests that are due."""
    asked = [m for m in session.poll(0.0) if isinstance(m, CommandLong)]
    return {int(m.parameters[0]): 1e6 / m.parameters[1] for m in asked}


class Vehicle:
    """Sends LOCAL_POSITION_NED at a given rate. `requested_s`: vehicle times of requests for it."""

    def __init__(self, speed: float = 1.0) -> None:
        self.sender = Sender()
        self.session = started()
        self.speed = speed
        self.ticks = 0
        self.requested_s: list[float] = []
        self._obey(self.session.poll(0.0))

    def _obey(self, messages: tuple[Outgoing, ...]) -> None:
        for message in messages:
            if isinstance(message, CommandLong) and message.parameters[0] == POSITION:
                self.requested_s.append(0.01 * self.ticks)

    def run(self, seconds: float, every_ticks: int) -> float:
        """Send it every `every_ticks` of 10 ms vehicle time (0: never). Return its rate in Hz."""
        for _ in range(round(seconds * 100)):
            self.ticks += 1
            now_s = 0.01 * self.ticks / self.speed
            if every_ticks and self.ticks % every_ticks == 0:
                self.session.receive(self.sender.position(10 * self.ticks), PEER, now_s)
            self.session.receive(self.sender.attitude(10 * self.ticks), PEER, now_s)
            self._obey(self.session.poll(now_s))
        return self.session.telemetry.rates_hz["LOCAL_POSITION_NED"]


@pytest.mark.parametrize(("speed", "every_ticks"), [(0.3, 1), (50.0, 10)])
def test_telemetry_rates_are_per_second_of_vehicle_time(speed: float, every_ticks: int) -> None:
    assert Vehicle(speed).run(5.0, every_ticks) == pytest.approx(100.0 / every_ticks, rel=0.1)


def test_rate_is_requested_again_only_after_a_change() -> None:
    vehicle = Vehicle()
    assert vehicle.run(30.0, 1) == pytest.approx(100.0, abs=1.0)
    assert len(vehicle.requested_s) == 1
    assert vehicle.run(75.0, 4) == pytest.approx(25.0, abs=1.0)  # a ground station has set 25 Hz
    gaps = [b - a for a, b in zip(vehicle.requested_s, vehicle.requested_s[1:], strict=False)]
    assert 30.0 < vehicle.requested_s[1] < 32.0
    assert gaps[1:] == pytest.approx([3.0, 6.0, 12.0, 24.0], abs=0.1)
    vehicle.run(60.0, 1)  # the interval of requests is reset
    vehicle.requested_s.clear()
    vehicle.run(8.0, 4)
    assert [t - 165.0 for t in vehicle.requested_s] == pytest.approx([1.0, 4.0], abs=0.7)
    vehicle.run(10.0, 1)
    vehicle.requested_s.clear()
    assert vehicle.run(40.0, 0) == 0.0  # one has stopped it: without it a flight ends after 0.5 s
    assert len(vehicle.requested_s) >= 2
    assert vehicle.requested_s[0] - 183.0 == pytest.approx(0.2, abs=0.03)


def test_one_that_a_ground_station_slows_every_few_seconds_is_slow_for_half_a_second() -> None:
    """As REQUEST_DATA_STREAM at 4 Hz does on ArduPilot."""
    vehicle = Vehicle()
    vehicle.run(10.0, 1)
    for _ in range(5):
        vehicle.requested_s.clear()
        vehicle.run(0.5, 25)
        assert len(vehicle.requested_s) == 1
        vehicle.run(1.5, 1)


@pytest.mark.parametrize(
    ("loop_hz", "default_hz", "position_from_s", "loss", "asked_hz"),
    [
        (100, 0, 0.0, 0.0, [100, 50]),  # was not flown before
        (100, 4, 0.0, 0.0, [100, 50]),  # a ground station has set 4 Hz
        (100, 0, 25.0, 0.0, [100, 50]),  # its estimator has no origin yet
        (400, 0, 25.0, 0.0, [100]),
        (400, 0, 0.0, 0.4, [100]),
    ],
)
def test_a_rate_that_arducopter_denies_is_halved(
    loop_hz: int, default_hz: int, position_from_s: float, loss: float, asked_hz: list[int]
) -> None:
    """ArduCopter denies rates above 0.8 of SCHED_LOOP_RATE, with a text, and messages that it does
    not know, as SIM_STATE on a real vehicle. If a message is missing for another reason, its rate
    is not halved."""
    sender, session, chance = Sender(), Session(SessionSettings()), random.Random(1)
    session.receive(sender.heartbeat(autopilot=3), PEER, 0.0)
    granted_hz, asked = {31: default_hz, POSITION: default_hz}, []
    for tick in range(1, 6000):
        now_s, sent = 0.01 * tick, []
        for message in session.poll(now_s):
            if isinstance(message, CommandLong):
                kind, asks_hz = int(message.parameters[0]), round(1e6 / message.parameters[1])
                too_fast = asks_hz > 0.8 * loop_hz
                sent.append(sender.ack(511, 2 if too_fast or kind == 108 else 0))
                if too_fast:
                    said = (
                        f"Requested rate for message ID {kind} too fast. Increase SCHED_LOOP_RATE"
                    )
                    sent += [
                        sender.text(said[:50].encode(), 1),
                        sender.text(said[50:].encode(), 1, 1),
                    ]
                elif kind in granted_hz:
                    granted_hz[kind] = asks_hz
                asked += [asks_hz] if kind == POSITION and asked[-1:] != [asks_hz] else []
        for kind, frame in ((31, sender.attitude), (POSITION, sender.position)):
            every = 100 // granted_hz[kind] if granted_hz[kind] else 0
            silent = kind == POSITION and now_s < position_from_s
            sent += [frame(10 * tick)] if every and tick % every == 0 and not silent else []
        for data in sent:
            if chance.random() >= loss:
                session.receive(data, PEER, now_s)
    assert asked == asked_hz
    arrives_hz = session.telemetry.rates_hz["LOCAL_POSITION_NED"]
    assert arrives_hz == pytest.approx(asked_hz[-1] * (1.0 - loss), rel=0.15)


def test_link_time_follows_the_vehicle_or_host_time() -> None:
    link = VehicleTime()
    for i in range(11):  # 50 times faster, with a second stream that lags by 3 ms
        link.on_telemetry(100.0 + 0.1 * i, 0.002 * i)
        link.on_telemetry(99.997 + 0.1 * i, 0.002 * i)
        link.on_host(0.002 * i)
    assert link.seconds == pytest.approx(1.0)
    for i in range(1, 51):
        link.on_host(0.02 + 0.1 * i)
    before_s = link.seconds
    assert before_s == pytest.approx(6.0, abs=0.01)  # all of the silence, once it is recognised
    link.on_telemetry(0.5, 5.1)  # a reboot
    link.on_telemetry(0.7, 5.2)
    assert link.seconds - before_s == pytest.approx(0.2)
    link.on_host(65.0)
    assert link.seconds - before_s == pytest.approx(0.2 + 59.8)
    link.on_telemetry(60.7, 65.2)  # host time has counted the minute without telemetry
    assert link.seconds - before_s == pytest.approx(60.0)


def test_alternating_clocks_are_two_vehicles_but_a_reboot_is_not() -> None:
    """Each vehicle sends two messages at 100 Hz. The clock of the second one is 5 s ahead."""

    def feed(began_s: float, stamps: int, *others_s: float) -> bool:
        mixed = False
        for number in range(stamps):
            for clock_s in (began_s, *(began_s + other for other in others_s)):
                for message_id in (31, 32):
                    time_s = clock_s + 0.01 * number
                    if link.check(message_id, time_s) is Age.FRESH:
                        link.on_telemetry(time_s, 0.0)
                    mixed |= link.mixed
        return mixed

    link = VehicleTime()
    assert not feed(50.0, 100)
    assert not feed(0.0, 100)  # rebooted
    assert feed(1.0, 100, 5.0)
    feed(2.0, 300)  # the twin was switched off
    assert not link.mixed


@pytest.mark.parametrize(
    ("baud", "attitude_hz"),
    # (0.68 of 5,760 bytes/s - 1,042 for slow messages) / 138 per pair and half HIL_STATE_QUATERNION
    [(57_600, 20.8), (115_200, 49.2), (921_600, 100.0)],
)
def test_rates_fit_a_serial_line(baud: int, attitude_hz: float) -> None:
    """CURRENT_MODE, which is sent when it changes, takes little of the capacity."""
    rates_hz = asked_hz(started(stream=True, capacity_bytes_ps=baud / 10))
    assert rates_hz[31] == rates_hz[32] == pytest.approx(attitude_hz, rel=0.02)
    assert rates_hz[436] == pytest.approx(50.0)
    sizes = {31: 60, 32: 40, 83: 49, 436: 21, 245: 14, 1: 55, 115: 76, 24: 64, 230: 54}  # extended
    rates_hz[436] = 2.0  # while the mode does not change
    assert sum(rate * sizes[number] for number, rate in rates_hz.items()) < 0.81 * baud / 10
    mode = WantedMessage("CURRENT_MODE", 50.0, optional=True, unchanged_hz=2.0)
    assert fitted([mode], 3000.0) == (mode,)


def test_rates_on_saturated_link_are_halved_down_to_20_hz() -> None:
    session, rates_hz = started(), []
    session.poll(0.0)
    while session.telemetry.thin():
        rates_hz.append(asked_hz(session)[31])
    assert rates_hz[0] == pytest.approx(47.0, abs=4.0)
    assert rates_hz[-1] == pytest.approx(20.0, abs=0.5)
    assert len(rates_hz) <= 3
    assert asked_hz(session) == {}  # no new requests, which would load the link further
