"""Monitoring over HTTP: `/metrics` for Prometheus and `/health`, from the newest snapshot.

The loop hands over a value (`Monitor.show`); the server's threads read only that.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, fields
from socketserver import ThreadingMixIn
from typing import TYPE_CHECKING, Any
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer, make_server

from prometheus_client import CollectorRegistry, make_wsgi_app
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily
from prometheus_client.registry import Collector

from offboard.documents.arguments import split_address
from offboard.documents.errors import UserError, shown
from offboard.documents.plain import plain
from offboard.flight.snapshot import Snapshot
from offboard.io import clock

if TYPE_CHECKING:
    from prometheus_client import Metric

STALE_S = 2.0  # the loop hands over four snapshots a second
HEALTHY_AGE_S = 2.0  # of telemetry
STATES = ("phase", "mode", "authority", "rung")  # texts of a snapshot that are labels
NUMBERS = tuple(f.name for f in fields(Snapshot) if f.type in ("float", "int", "bool"))


class MonitorError(UserError):
    """An address that cannot be served: one sentence for the user."""


class MonitorUnavailable(MonitorError):
    """An address that cannot be served now: another program has it, for example."""

    is_usage = False


@dataclass(frozen=True, slots=True)
class Shown:
    """What the monitor shows. `at_s`: monotonic time when it was handed over."""

    at_s: float
    snapshot: Snapshot
    engagements: int


class _Server(ThreadingMixIn, WSGIServer):
    daemon_threads = True


class _Silent(WSGIRequestHandler):
    timeout = 5.0

    def log_message(self, format: str, *args: object) -> None:
        """Requests are not logged."""


class Monitor(Collector):
    """Serves `HOST:PORT` from threads of its own. Raises UserError."""

    def __init__(self, address: str) -> None:
        self._shown: Shown | None = None
        registry = CollectorRegistry(auto_describe=False)
        registry.register(self)
        self._metrics = make_wsgi_app(registry)
        host, port = split_address("--metrics", address)
        try:
            self._server = make_server(
                host, port, self._answer, server_class=_Server, handler_class=_Silent
            )
        except (OSError, UnicodeError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or error
            sentence = f"--metrics {shown(address)} cannot be served: {reason}"
            raise MonitorUnavailable(sentence) from None
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()

    @property
    def port(self) -> int:
        """The local port."""
        return int(self._server.server_port)

    def show(self, snapshot: Snapshot, engagements: int, now_s: float) -> None:
        """Hand over what is to be served from now on."""
        self._shown = Shown(now_s, snapshot, engagements)

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()

    # ------------------------------------------------------------------ in the server's threads

    def _answer(self, environ: dict[str, Any], begin: Callable[..., Any]) -> Any:
        path = environ.get("PATH_INFO")
        if path == "/metrics":
            return self._metrics(environ, begin)
        if path == "/health":
            status, health = self._health()
        else:
            status, health = "404 Not Found", {"paths": ["/metrics", "/health"]}
        body = json.dumps(health).encode() + b"\n"
        begin(status, [("Content-Type", "application/json"), ("Content-Length", str(len(body)))])
        return [body]

    def _health(self) -> tuple[str, dict[str, object]]:
        """200 if the loop runs and the vehicle is heard, else 503 with the reason."""
        now, reason = self._shown, ""
        if now is None or clock.monotonic_s() - now.at_s > STALE_S:
            reason = "the loop does not run"
        elif not now.snapshot.telemetry_age_s <= HEALTHY_AGE_S:
            reason = "no telemetry"
        described = asdict(now.snapshot) if now else {}
        health = {"healthy": not reason, "reason": reason, **plain(described)}
        return ("503 Service Unavailable" if reason else "200 OK"), health

    def collect(self) -> Iterator[Metric]:
        """The metrics of the newest snapshot, for Prometheus."""
        now = self._shown
        if now is None:
            return
        age_s = clock.monotonic_s() - now.at_s
        yield GaugeMetricFamily("offboard_snapshot_age_seconds", "Age of these values.", age_s)
        yield CounterMetricFamily("offboard_flights", "Flights begun.", now.engagements)
        for name in NUMBERS:
            value = float(getattr(now.snapshot, name))
            yield GaugeMetricFamily(f"offboard_{name}", f"{name} of the present flight.", value)
        states = {name: str(getattr(now.snapshot, name)) for name in STATES}
        yield InfoMetricFamily("offboard_state", "State of the present flight.", states)
