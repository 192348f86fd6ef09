"""The live page: `python -m offboard.live.server HOST PORT`, snapshots as JSON lines on stdin.

Serves the page at / and server-sent events at /events: first what was kept of the flight so far,
then each snapshot. A client that does not read misses snapshots; it delays nobody.
"""

from __future__ import annotations

import asyncio
import json
import os
import sys
from collections import deque
from contextlib import suppress
from typing import Any

from aiohttp import web

from offboard.documents.arguments import join_address
from offboard.live.values import line

KEPT = 3000  # snapshots, five minutes
CLIENTS_MAX = 20
CLIENT_QUEUE = 50  # snapshots that a client may be late
CLIENT_S = 10.0  # in which a client must take one
LINE_MAX = 1 << 20
_NICENESS = 5
_TRACE = ("time_s", "position_ned_m", "reference_ned_m", "position_error_m", "telemetry_age_s")


class Broadcast:
    """Passes each snapshot on to all clients, and keeps what the curves of the page need."""

    def __init__(self) -> None:
        self._clients: set[asyncio.Queue[str | None]] = set()
        self._kept: deque[dict[str, Any]] = deque(maxlen=KEPT)
        self._newest: dict[str, Any] | None = None

    def publish(self, text: str) -> None:
        """A snapshot as JSON text."""
        self._newest = json.loads(text)
        self._kept.append({name: self._newest[name] for name in _TRACE})
        self._put(text)

    def end(self) -> None:
        """The flight is over."""
        self._put(None)

    def _put(self, text: str | None) -> None:
        for queue in self._clients:
            if queue.full():
                queue.get_nowait()  # the oldest
            queue.put_nowait(text)

    async def events(self, request: web.Request) -> web.StreamResponse:
        """The stream of one client, until it leaves or the flight ends."""
        if len(self._clients) >= CLIENTS_MAX:
            raise web.HTTPServiceUnavailable(text=f"{CLIENTS_MAX} clients are watching already")
        response = web.StreamResponse(
            headers={"Content-Type": "text/event-stream", "Cache-Control": "no-store"}
        )
        queue: asyncio.Queue[str | None] = asyncio.Queue(CLIENT_QUEUE)
        queue.put_nowait(line("history", rows=list(self._kept), newest=self._newest))
        self._clients.add(queue)
        with suppress(ConnectionError, TimeoutError, asyncio.TimeoutError):
            await response.prepare(request)
            while (text := await queue.get()) is not None:
                await asyncio.wait_for(response.write(f"data: {text}\n\n".encode()), CLIENT_S)
            await asyncio.wait_for(response.write(b"event: end\ndata: {}\n\n"), CLIENT_S)
        self._clients.discard(queue)
        return response


async def serve(host: str, port: int) -> None:
    """Serve until stdin closes."""
    from offboard.live.page import page

    broadcast, shown = Broadcast(), page()

    async def index(request: web.Request) -> web.Response:
        return web.Response(text=shown, content_type="text/html")

    application = web.Application()
    application.add_routes([web.get("/", index), web.get("/events", broadcast.events)])
    runner = web.AppRunner(application, access_log=None, shutdown_timeout=0.5)
    await runner.setup()
    try:
        site = web.TCPSite(runner, host, port)
        await site.start()
        bound = runner.addresses[0][1]
        print(json.dumps({"url": f"http://{join_address(host, bound)}"}), flush=True)
        await _read(broadcast)
        broadcast.end()
        await asyncio.sleep(0.1)  # the clients take their last event
    except OSError as error:
        number = error.errno or 0  # negative: of the name service
        why = os.strerror(number) if number >= 0 else error.strerror
        reason = f"{join_address(host, port)} cannot be listened on ({why})"
        print(json.dumps({"error": f"{reason}; choose another address"}), flush=True)
    finally:
        await runner.cleanup()


async def _read(broadcast: Broadcast) -> None:
    reader = asyncio.StreamReader(LINE_MAX)
    await asyncio.get_running_loop().connect_read_pipe(
        lambda: asyncio.StreamReaderProtocol(reader), sys.stdin
    )
    while text := await reader.readline():
        broadcast.publish(text.decode().rstrip("\n"))


if __name__ == "__main__":
    os.nice(_NICENESS)  # the controller goes first
    asyncio.run(serve(sys.argv[1], int(sys.argv[2])))
