"""The server of the live page: `python -m offboard.live.server HOST PORT`. It reads snapshots as
JSON lines from stdin.

The number of connections is limited, and so is the duration of each except those of /events, so
that slow or idle clients use up neither file descriptors nor memory.
"""

from __future__ import annotations

import asyncio
import json
import logging
import math
import os
import sys
from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import plotly.graph_objects as go
from aiohttp import web
from prometheus_client import CONTENT_TYPE_LATEST, Metric, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily
from prometheus_client.registry import Collector

from offboard.analysis.page import BLUE, INK, STYLE, Figure, curve, panels, render
from offboard.link import clock
from offboard.link.interface import peer_name
from offboard.live.display import line

STALE_S = 2.0  # age of the newest snapshot from which the loop counts as stopped; it sends 10 a s
HEALTHY_AGE_S = 2.0  # greatest age of telemetry of a healthy service
STATES = ("phase", "mode", "authority", "failsafe")  # texts of a snapshot, labels for Prometheus
COUNTER = "flights"
KEPT = 3000  # snapshots that a new client gets: five minutes
TEXTS_KEPT = 100  # announcements that a new client gets
CLIENTS_MAX = 20
CLIENT_QUEUE = 50  # snapshots that may wait for a client
CLIENT_S = 10.0  # time in which a client must accept a snapshot
CONNECTIONS_MAX = 60  # including those of clients that watch
CONNECTION_S = 5.0  # longest duration of a connection, except of a client that watches
_NICENESS = 5
_TRACE = ("time_s", "position_ned_m", "reference_ned_m", "position_error_m", "telemetry_age_s")


class Broadcast(Collector):
    """Sends each snapshot to all clients, and keeps those that a new client, /health and /metrics
    need. `newest` is the newest snapshot as a JSON object."""

    def __init__(self) -> None:
        self.newest: dict[str, Any] = {}
        self._shown_s = -math.inf
        self._clients: dict[asyncio.Queue[str | None], web.RequestHandler] = {}
        self._kept: deque[dict[str, Any]] = deque(maxlen=KEPT)
        self._texts: deque[dict[str, Any]] = deque(maxlen=TEXTS_KEPT)
        self._flight: dict[str, Any] = {}

    def health(self) -> dict[str, Any]:
        """Return `healthy` (whether the loop runs and telemetry arrives), the `reason` if not, and
        the newest snapshot."""
        age_s, reason = self.newest.get("telemetry_age_s"), ""
        if clock.monotonic_s() - self._shown_s > STALE_S:
            reason = "the control loop does not run"
        elif age_s is None or age_s > HEALTHY_AGE_S:
            reason = "no telemetry"
        return {"healthy": not reason, "reason": reason} | self.newest

    def collect(self) -> Iterator[Metric]:
        """Yield the metrics of the newest snapshot for Prometheus."""
        now = self.newest
        if not now:
            return
        age_s = clock.monotonic_s() - self._shown_s
        yield GaugeMetricFamily("offboard_snapshot_age_seconds", "Age of these values.", age_s)
        yield CounterMetricFamily("offboard_flights", "Flights begun.", now[COUNTER])
        for name, value in sorted(now.items()):
            if isinstance(value, int | float) and name != COUNTER:  # a known number
                told = f"{name} of the present flight."
                yield GaugeMetricFamily(f"offboard_{name}", told, float(value))
        states = {name: str(now[name]) for name in STATES}
        yield InfoMetricFamily("offboard_state", "State of the present flight.", states)

    def publish(self, text: str) -> None:
        """Send a JSON text to all clients: a snapshot, an announcement, or texts of the page."""
        message = json.loads(text)
        if message["type"] == "snapshot":
            self.newest, self._shown_s = message, clock.monotonic_s()
            self._kept.append({name: message[name] for name in _TRACE})
        elif message["type"] == "announcement":
            self._texts.append(message)
        else:
            self._flight |= message
        self._put(text)

    def end(self) -> None:
        """Tell all clients that the flight is over."""
        self._put(None)

    def _put(self, text: str | None) -> None:
        for queue in self._clients:
            if queue.full():
                queue.get_nowait()  # the oldest
            queue.put_nowait(text)

    async def events(self, request: web.Request) -> web.StreamResponse:
        """Serve the stream of one client until it disconnects or the flight ends."""
        if len(self._clients) >= CLIENTS_MAX:
            raise web.HTTPServiceUnavailable(text=f"{CLIENTS_MAX} clients are watching already")
        response = web.StreamResponse(
            headers={"Content-Type": "text/event-stream", "Cache-Control": "no-store"}
        )
        queue: asyncio.Queue[str | None] = asyncio.Queue(CLIENT_QUEUE)
        known = {"rows": list(self._kept), "texts": list(self._texts), "flight": self._flight}
        queue.put_nowait(line("history", newest=self.newest or None, **known))
        self._clients[queue] = request.protocol
        with suppress(ConnectionError, TimeoutError, asyncio.TimeoutError):
            await response.prepare(request)
            while (text := await queue.get()) is not None:
                await asyncio.wait_for(response.write(f"data: {text}\n\n".encode()), CLIENT_S)
            await asyncio.wait_for(response.write(b"event: end\ndata: {}\n\n"), CLIENT_S)
        del self._clients[queue]
        return response

    def connection(self, server: web.Server) -> asyncio.Protocol:
        """Return the protocol for a new connection to `server`; it closes the connection at once if
        there are too many."""
        if len(server.connections) >= CONNECTIONS_MAX:
            return _Refused()
        handler = server()
        asyncio.get_running_loop().call_later(CONNECTION_S, self._end, handler)
        return handler

    def _end(self, handler: web.RequestHandler) -> None:
        if handler not in self._clients.values() and handler.transport is not None:
            handler.transport.abort()


class _Refused(asyncio.Protocol):
    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        transport.abort()


def page() -> str:
    """Return the live page as HTML. Its figures are empty; its script adds points from events."""
    return render(
        "live/templates/live.html", title="Live flight",
        figures={"plan": _plan(), "curves": _curves()},
    )  # fmt: skip


def _plan() -> Figure:
    figure = go.Figure()
    lines: tuple[tuple[str, dict[str, Any]], ...] = (
        ("reference", {"color": INK, "dash": "dash", "width": 1.4}),
        ("estimated", {"color": BLUE, "width": 2}),
    )
    for name, style in lines:
        figure.add_trace(go.Scatter(x=[], y=[], mode="lines", name=name, line=style))
    figure.add_trace(
        go.Scatter(x=[], y=[], mode="markers", showlegend=False, marker={"color": BLUE, "size": 10})
    )
    # invisible points keep the axes at least 2 m long, so that a vehicle at rest shows no noise
    unseen = {"mode": "markers", "opacity": 0, "hoverinfo": "skip", "showlegend": False}
    figure.add_trace(go.Scatter(x=[-1, 1], y=[-1, 1], **unseen))
    figure.update_layout(template=STYLE, height=560)
    figure.update_xaxes(title_text="east, m")
    figure.update_yaxes(title_text="north, m", scaleanchor="x")
    return Figure("Path from above", figure)


def _curves() -> Figure:
    figure = panels(
        ("height, m", "distance from the reference, m", "link age, ms"), "vehicle time, s"
    )
    for place in (1, 2, 3):
        curve(figure, place, [], [], "estimated", BLUE, showlegend=False)
    figure.update_yaxes(rangemode="tozero", row=3)
    return Figure("Curves", figure)


def application(broadcast: Broadcast) -> web.Application:
    """Create the web application with its routes."""
    shown = page()

    async def index(request: web.Request) -> web.Response:
        return web.Response(text=shown, content_type="text/html")

    async def metrics(request: web.Request) -> web.Response:
        text = generate_latest(broadcast)
        return web.Response(body=text, headers={"Content-Type": CONTENT_TYPE_LATEST})

    async def health(request: web.Request) -> web.Response:
        answer = broadcast.health()
        return web.json_response(answer, status=200 if answer["healthy"] else 503)

    made = web.Application()
    made.add_routes(
        [
            web.get("/", index),
            web.get("/events", broadcast.events),
            web.get("/metrics", metrics),
            web.get("/health", health),
        ]
    )
    return made


async def serve(host: str, port: int) -> None:
    """Serve until stdin closes."""
    broadcast = Broadcast()
    runner = web.AppRunner(application(broadcast), access_log=None, shutdown_timeout=0.5)
    await runner.setup()
    serves = runner.server
    assert serves is not None
    try:
        server = await asyncio.get_running_loop().create_server(
            lambda: broadcast.connection(serves), host, port, backlog=CONNECTIONS_MAX
        )
        bound = server.sockets[0].getsockname()[1]
        print(json.dumps({"url": f"http://{peer_name((host, bound))}"}), flush=True)
        while text := await asyncio.to_thread(sys.stdin.readline):
            broadcast.publish(text.rstrip("\n"))
        server.close()
        broadcast.end()
        await asyncio.sleep(0.1)  # time to send the last event to the clients
    except OSError as error:
        number = error.errno or 0  # negative for errors of the name service (getaddrinfo)
        why = os.strerror(number) if number >= 0 else error.strerror
        reason = f"{peer_name((host, port))} cannot be listened on ({why})"
        print(json.dumps({"error": f"{reason}; choose another address"}), flush=True)
    finally:
        await runner.cleanup()


if __name__ == "__main__":
    os.nice(_NICENESS)  # lower priority than the controller
    logging.disable()  # errors of clients are not printed on the terminal
    asyncio.run(serve(sys.argv[1], int(sys.argv[2])))
