"""Asking for telemetry, measuring what comes, asking again: against a vehicle in a loop."""

from __future__ import annotations

from collections import Counter

import pytest
from vehicle_frames import PEER, Sender, pinned, understood

from offboard.mavlink.dialects.base import WantedMessage
from offboard.mavlink.session import Session
from offboard.mavlink.telemetry_rates import LinkTime, TelemetryRates

WANTED = (WantedMessage(32, "LOCAL_POSITION_NED", 100.0),)


class Vehicle:
    """Sends LOCAL_POSITION_NED at a rate that it lowers or raises as told."""

    def __init__(self, speed: float = 1.0) -> None:
        self.sender = Sender()
        self.session: Session = pinned(self.sender, wanted=WANTED)
        self.speed = speed
        self.ticks = 0
        self.asked_s: list[float] = []

    def run(self, seconds: float, every_ticks: int) -> None:
        """`every_ticks` of 10 ms of vehicle time between messages; 0: none."""
        for _ in range(round(seconds * 100)):
            self.ticks += 1
            time_s = 0.01 * self.ticks
            now_s = time_s / self.speed
            if every_ticks and self.ticks % every_ticks == 0:
                frame = self.sender.position(10 * self.ticks)
                self.session.receive(frame, PEER, now_s)
            for frame in self.session.poll(now_s):
                if understood(frame).get_type() == "COMMAND_LONG":
                    self.asked_s.append(time_s)


@pytest.mark.parametrize("speed", [0.3, 1.0, 50.0])
@pytest.mark.parametrize(("every_ticks", "rate_hz"), [(1, 100.0), (2, 50.0), (10, 10.0)])
def test_rates_are_per_second_of_vehicle_time(
    speed: float, every_ticks: int, rate_hz: float
) -> None:
    vehicle = Vehicle(speed)
    vehicle.run(5.0, every_ticks)
    measured = vehicle.session.rates_hz["LOCAL_POSITION_NED"]
    assert measured == pytest.approx(rate_hz, rel=0.1)
    slow = [s.name for s in vehicle.session.shortfalls]
    assert slow == ([] if rate_hz == 100.0 else ["LOCAL_POSITION_NED"])


def test_served_means_asked_once() -> None:
    vehicle = Vehicle()
    vehicle.run(60.0, 1)
    assert len(vehicle.asked_s) == 1


def test_not_served_means_asked_again_and_more_patiently() -> None:
    vehicle = Vehicle()
    vehicle.run(200.0, 2)
    gaps = [b - a for a, b in zip(vehicle.asked_s, vehicle.asked_s[1:], strict=False)]
    assert gaps[:6] == pytest.approx([3.0, 6.0, 12.0, 24.0, 30.0, 30.0], abs=0.1)


def test_reset_by_somebody_else_is_noticed_within_seconds() -> None:
    vehicle = Vehicle()
    vehicle.run(30.0, 1)
    assert vehicle.session.shortfalls == []
    vehicle.run(3.5, 4)  # a ground station has set 25 Hz
    assert vehicle.session.shortfalls[0].measured_hz == pytest.approx(25.0, abs=1.0)
    assert len(vehicle.asked_s) == 2
    assert 30.0 < vehicle.asked_s[1] < 32.0


def test_patience_begins_anew_after_good_service() -> None:
    vehicle = Vehicle()
    vehicle.run(50.0, 4)
    vehicle.run(60.0, 1)
    vehicle.asked_s.clear()
    vehicle.run(8.0, 4)
    assert [t - 110.0 for t in vehicle.asked_s] == pytest.approx([1.0, 4.0], abs=0.7)


def test_silence_counts_in_our_time() -> None:
    vehicle = Vehicle()
    vehicle.run(10.0, 1)
    vehicle.run(10.0, 0)
    assert vehicle.session.rates_hz["LOCAL_POSITION_NED"] == 0.0
    assert len(vehicle.asked_s) >= 2


def test_optional_messages_are_not_insisted_on() -> None:
    rates = TelemetryRates([WantedMessage(115, "HIL_STATE_QUATERNION", 50.0, optional=True)], 0.0)
    asked = Counter(w.name for t in range(1000) for w in rates.due(0.1 * t))
    assert asked == {"HIL_STATE_QUATERNION": 2}
    assert rates.shortfalls(100.0) == []


def test_link_time_follows_the_vehicle_and_falls_back_to_ours() -> None:
    link = LinkTime()
    for i in range(11):  # 50 times faster, with a second stream that lags by 3 ms
        link.vehicle(100.0 + 0.1 * i, 0.002 * i)
        link.vehicle(99.997 + 0.1 * i, 0.002 * i)
        link.host(0.002 * i)
    assert link.seconds == pytest.approx(1.0)
    for i in range(1, 51):
        link.host(0.02 + 0.1 * i)
    before_s = link.seconds
    assert before_s == pytest.approx(5.0, abs=0.11)  # the first second was patience
    link.vehicle(0.5, 5.1)  # a reboot
    link.vehicle(0.7, 5.2)
    assert link.seconds - before_s == pytest.approx(0.2)
    link.vehicle(60.7, 65.2)  # a minute without telemetry has been counted by our own time
    assert link.seconds - before_s == pytest.approx(1.2)
