"""A viewer of `--foxglove`, written from the protocol: WebSocket, and protobuf by the descriptors
that the server advertises. Shares no code with the SDK that serves."""

from __future__ import annotations

import asyncio
import base64
import json
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import aiohttp
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass

PROTOCOL = "foxglove.sdk.v1"
TOPICS = {"/snapshot", "/pose", "/reference", "/tf", "/log", "/path/flown", "/path/reference"}
MESSAGE = struct.Struct("<BIQ")  # opcode, subscription, log time in ns
Decoders = dict[int, tuple[str, Callable[[bytes], Any]]]  # topic and decoder by subscription


class Viewer:
    """All messages of all channels by topic, as (log time in ns, message), in order."""

    def __init__(self) -> None:
        self.channels: dict[str, dict[str, Any]] = {}
        self.received: dict[str, list[tuple[int, Any]]] = {topic: [] for topic in TOPICS}
        self.subscribed = threading.Event()
        self._news = threading.Condition()

    def wait_for(self, topic: str, accepts: Callable[[Any], bool]) -> None:
        """Until such a message of the topic has come."""
        with self._news:
            received = self.received[topic]
            assert self._news.wait_for(lambda: any(accepts(each) for _, each in received), 20)

    async def watch(self, url: str) -> None:
        """Subscribe to all channels, and decode until the server closes."""
        async with (
            aiohttp.ClientSession() as session,
            session.ws_connect(url, protocols=(PROTOCOL,), autoping=False) as client,
        ):
            decoders: Decoders = {}
            async for message in client:
                if message.type is aiohttp.WSMsgType.BINARY:
                    opcode, subscription, stamp_ns = MESSAGE.unpack_from(message.data)
                    assert opcode == 1
                    topic, decode = decoders[subscription]
                    with self._news:
                        data = message.data[MESSAGE.size :]
                        self.received[topic].append((stamp_ns, decode(data)))
                        self._news.notify()
                elif message.type is aiohttp.WSMsgType.PONG:
                    self.subscribed.set()  # the server answers in order
                elif message.type is aiohttp.WSMsgType.TEXT:
                    await self._subscribe(client, json.loads(message.data), decoders)

    async def _subscribe(
        self, client: aiohttp.ClientWebSocketResponse, told: dict[str, Any], decoders: Decoders
    ) -> None:
        for channel in told.get("channels", ()):
            self.channels[channel["topic"]] = channel
            decoders[channel["id"]] = channel["topic"], decoder(channel)
            wanted = [{"id": channel["id"], "channelId": channel["id"]}]
            await client.send_json({"op": "subscribe", "subscriptions": wanted})
        if set(self.channels) == TOPICS:
            await client.ping()


def decoder(channel: dict[str, Any]) -> Callable[[bytes], Any]:
    """What makes a message of the bytes, by the schema of the channel."""
    if channel["encoding"] == "json":
        return json.loads
    pool = DescriptorPool()
    for file in FileDescriptorSet.FromString(base64.b64decode(channel["schema"])).file:
        pool.Add(file)
    kind: Any = GetMessageClass(pool.FindMessageTypeByName(channel["schemaName"]))
    return lambda data: kind.FromString(data)


@contextmanager
def viewing(url: str) -> Iterator[Viewer]:
    """A viewer in a thread; ends when the server has closed the connection."""
    viewer, failed = Viewer(), []

    def run() -> None:
        try:
            asyncio.run(viewer.watch(url))
        except BaseException as error:
            failed.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    assert viewer.subscribed.wait(20)
    yield viewer
    thread.join(20)
    assert not thread.is_alive()
    assert failed == []
