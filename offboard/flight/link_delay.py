"""How late the link is, by the vehicle's own clock.

A TIMESYNC answer gives back our stamp beside the vehicle's time. Stamped with the vehicle time of
the newest telemetry and sent with a setpoint, it says how old that telemetry was when the setpoint
arrived: what the link adds to the delay between telemetry and effect, both ways together. No clock
of ours is in it, and the answer's own way back is not either.
"""

from __future__ import annotations

import statistics
from collections import deque

from offboard.identification.uncertainty import Estimate
from offboard.mavlink.events import TimeAnswer
from offboard.mavlink.outgoing import Timesync

LEAST_ANSWERS, MOST_ANSWERS = 5, 40
LONGEST_S = 2.0  # an answer that is later tells of another clock
NORMAL = 1.4826  # sd of a normal distribution by its median absolute deviation


class LinkDelay:
    """The newest answers."""

    def __init__(self) -> None:
        self._asked: deque[int] = deque(maxlen=MOST_ANSWERS)
        self._delays_s: deque[float] = deque(maxlen=MOST_ANSWERS)

    def forget(self) -> None:
        """The vehicle's time is another."""
        self._asked.clear()
        self._delays_s.clear()

    def question(self, telemetry_s: float) -> Timesync:
        """To be sent with a setpoint; `telemetry_s`: vehicle time of the newest telemetry."""
        stamp_ns = round(telemetry_s * 1e9)
        self._asked.append(stamp_ns)
        return Timesync(0, stamp_ns)

    def note(self, answer: TimeAnswer) -> None:
        """An answer, to us or to anybody else."""
        if answer.asked_ns not in self._asked:
            return
        self._asked.remove(answer.asked_ns)  # duplicated on its way
        delay_s = (answer.vehicle_ns - answer.asked_ns) * 1e-9
        if 0.0 <= delay_s <= LONGEST_S:
            self._delays_s.append(delay_s)

    @property
    def estimate(self) -> Estimate | None:
        """Median and scatter (s); None while too few answers came."""
        if len(self._delays_s) < LEAST_ANSWERS:
            return None
        middle_s = statistics.median(self._delays_s)
        scatter_s = statistics.median(abs(each - middle_s) for each in self._delays_s)
        return Estimate(middle_s, NORMAL * scatter_s)
