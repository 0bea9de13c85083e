"""A server of the Foxglove WebSocket protocol that only sends (github.com/foxglove/ws-protocol, ``docs/spec.md``).

It lives in a thread of its own. Programs may watch, Foxglove's own pages, and pages and apps of this computer. A
browser names the origin of the page that connects; any other page is refused with 403.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import re
import struct
import threading
import time
from collections.abc import Callable, Iterable
from http import HTTPStatus
from typing import Any

from websockets.asyncio.server import ServerConnection, broadcast, serve
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response
from websockets.typing import Origin, Subprotocol

PROTOCOLS = [Subprotocol("foxglove.sdk.v1"), Subprotocol("foxglove.websocket.v1")]
"""What Foxglove has asked for since 2025, and what it asked for before and Lichtblick still does."""

WATCHING = [
    None,
    Origin("https://app.foxglove.dev"),
    Origin("https://studio.foxglove.dev"),
    re.compile(r"https?://(localhost|127\.0\.0\.1|\[::1\])(:\d+)?"),
    re.compile(r"(?!https?:)[a-z][a-z0-9+.-]*://.*"),
]
"""Origins that may watch: a program's, Foxglove's, this computer's, and those of desktop apps (``file://`` or a scheme
of their own, which no page from a network has). Not ``null``, which any page gets by a sandboxed frame."""

_MESSAGE_DATA = 1
_ERROR = 2
_MOST_UNSENT = 1 << 20  # bytes that wait for a viewer; while there are more it misses messages
_MOST_ASKED = 1 << 16  # bytes of a viewer's message
_CLOSING_S = 1.0

# With a handler that drops it, no scanner of ports writes on the terminal of a run.
_LOG = logging.getLogger(__name__)
_LOG.addHandler(logging.NullHandler())


class FoxgloveServer:
    """Listens on its ``port`` from the start (``OSError``); sends from any thread, without waiting for viewers."""

    def __init__(self, name: str, host: str, port: int, refused: Callable[[str], None]) -> None:
        self._hello = {"op": "serverInfo", "name": name, "capabilities": [], "sessionId": str(time.time_ns())}
        self._refused = refused
        self._channels: list[dict[str, Any]] = []
        self._wanted: dict[ServerConnection, dict[int, bytes]] = {}
        self._runner = asyncio.Runner()
        self._loop = self._runner.get_loop()
        try:
            self._server = self._runner.run(self._listen(host, port))
        except OSError:
            self._runner.close()
            raise
        self.port = int(next(iter(self._server.sockets)).getsockname()[1])
        self._thread = threading.Thread(target=self._loop.run_forever, name="frictid-hil-live", daemon=True)
        self._thread.start()

    async def _listen(self, host: str, port: int) -> Any:
        return await serve(
            self._view,
            host,
            port,
            origins=WATCHING,
            subprotocols=PROTOCOLS,
            process_response=self._tell_refused,
            compression=None,
            max_size=_MOST_ASKED,
            logger=_LOG,
        )

    def advertise(self, topics: Iterable[str], schema: dict[str, Any]) -> None:
        """Announce a channel of JSON messages per topic; they are numbered from 1 on, in order."""
        channels = [
            {
                "id": number,
                "topic": topic,
                "encoding": "json",
                "schemaName": schema["title"],
                "schemaEncoding": "jsonschema",
                "schema": json.dumps(schema),
            }
            for number, topic in enumerate(topics, 1)
        ]
        self._loop.call_soon_threadsafe(self._advertise, channels)

    def send(self, messages: list[tuple[int, int, dict[str, Any]]]) -> None:
        """Send messages (channel, log time in ns, content) to those who subscribed to their channel."""
        if self._wanted and messages:
            self._loop.call_soon_threadsafe(self._send, messages)

    def close(self) -> None:
        """Say goodbye to all viewers and stop listening; whoever does not answer is cut off."""
        with contextlib.suppress(TimeoutError):
            asyncio.run_coroutine_threadsafe(self._close(), self._loop).result(_CLOSING_S)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        for viewer in self._wanted:
            viewer.transport.abort()
        self._runner.close()

    # -- in the server's thread --

    async def _close(self) -> None:
        self._server.close()
        await self._server.wait_closed()

    def _tell_refused(self, _viewer: ServerConnection, request: Request, response: Response) -> None:
        if response.status_code == HTTPStatus.FORBIDDEN:
            self._refused(request.headers["Origin"])

    def _advertise(self, channels: list[dict[str, Any]]) -> None:
        self._channels = channels
        broadcast(self._wanted, self._advertisement())

    def _advertisement(self) -> str:
        return json.dumps({"op": "advertise", "channels": self._channels})

    def _send(self, messages: list[tuple[int, int, dict[str, Any]]]) -> None:
        for channel, log_ns, content in messages:
            data = struct.pack("<Q", log_ns) + json.dumps(content).encode()
            for viewer, wanted in self._wanted.items():
                if channel in wanted and viewer.transport.get_write_buffer_size() < _MOST_UNSENT:
                    broadcast([viewer], wanted[channel] + data)

    async def _view(self, viewer: ServerConnection) -> None:
        """Follow one viewer while it is connected."""
        wanted = self._wanted[viewer] = {}
        broadcast([viewer], json.dumps(self._hello))
        broadcast([viewer], self._advertisement())
        try:
            async for frame in viewer:
                try:
                    self._choose(wanted, json.loads(frame))
                except (ValueError, TypeError, KeyError, struct.error, RecursionError):
                    told = {"op": "status", "level": _ERROR, "message": "neither a subscription nor the end of one"}
                    broadcast([viewer], json.dumps(told))
        except ConnectionClosed:
            pass
        finally:
            del self._wanted[viewer]

    def _choose(self, wanted: dict[int, bytes], told: dict[str, Any]) -> None:
        """Take what a viewer subscribes to, as the head of its messages by channel."""
        match told["op"]:
            case "subscribe":
                for one in told["subscriptions"]:
                    if 1 <= one["channelId"] <= len(self._channels):
                        wanted[one["channelId"]] = _head(one["id"])
            case "unsubscribe":
                gone = {_head(one) for one in told["subscriptionIds"]}
                for channel in [channel for channel, head in wanted.items() if head in gone]:
                    del wanted[channel]
            case other:
                raise ValueError(other)


def _head(subscription: int) -> bytes:
    return struct.pack("<BI", _MESSAGE_DATA, subscription)
