"""`/metrics` for Prometheus and `/health`, from the newest snapshot."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily
from prometheus_client.registry import Collector

from offboard.link import clock

if TYPE_CHECKING:
    from prometheus_client import Metric

STALE_S = 2.0  # the loop hands over ten snapshots a second
HEALTHY_AGE_S = 2.0  # of telemetry
STATES = ("phase", "mode", "authority", "failsafe")  # texts of a snapshot that are labels
COUNTER = "flights"


class Metrics(Collector):
    """What a monitor reads. `show` hands over a snapshot as it is in JSON."""

    def __init__(self) -> None:
        self._newest: dict[str, Any] = {}
        self._shown_s = -math.inf
        self._registry = CollectorRegistry(auto_describe=False)
        self._registry.register(self)

    def show(self, snapshot: dict[str, Any]) -> None:
        self._newest, self._shown_s = snapshot, clock.monotonic_s()

    def text(self) -> bytes:
        """The metrics in the text format of Prometheus."""
        return generate_latest(self._registry)

    def health(self) -> dict[str, Any]:
        """`healthy` if the loop runs and the vehicle is heard, else the `reason`; the snapshot."""
        age_s, reason = self._newest.get("telemetry_age_s"), ""
        if clock.monotonic_s() - self._shown_s > STALE_S:
            reason = "the loop does not run"
        elif age_s is None or age_s > HEALTHY_AGE_S:
            reason = "no telemetry"
        return {"healthy": not reason, "reason": reason} | self._newest

    def collect(self) -> Iterator[Metric]:
        """The metrics of the newest snapshot, for Prometheus."""
        now = self._newest
        if not now:
            return
        age_s = clock.monotonic_s() - self._shown_s
        yield GaugeMetricFamily("offboard_snapshot_age_seconds", "Age of these values.", age_s)
        yield CounterMetricFamily("offboard_flights", "Flights begun.", now[COUNTER])
        for name, value in sorted(now.items()):
            if isinstance(value, int | float) and name != COUNTER:  # which are known
                told = f"{name} of the present flight."
                yield GaugeMetricFamily(f"offboard_{name}", told, float(value))
        states = {name: str(now[name]) for name in STATES}
        yield InfoMetricFamily("offboard_state", "State of the present flight.", states)
