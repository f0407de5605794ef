"""The WebSocket streams of players' volumes: a task for each client, woken by ticks, slowed down by whoever reads slowly.

A task encodes the volume as it is when the last message has gone out, so that a slow reader gets fewer frames and never a queue of them:
beyond the socket's own buffer a client costs one message, one more that is ready, and what the encoder remembers (1.2 MB). First frames
take turns (first_frames.py), so that many who come at once do not hold up ticks.
STREAM.md describes the messages and the codes that end a stream.
"""

import asyncio
import contextlib
import json
import logging
from collections.abc import Coroutine
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, NamedTuple

from starlette.websockets import WebSocket, WebSocketDisconnect

from gi_core.live_volume import PublishedVolume
from server.first_frames import FirstFrames
from server.stream_header import StreamHeader
from server.tick_signal import Published, TickSignal
from server.ticker import Ticker
from server.volume_frames import VolumeEncoder

log = logging.getLogger("sectorlight.streams")

MAX_CLIENTS = 512  # 0.6 GB of encoders' memory
MAX_MESSAGE_BYTES = 1024  # from a client
PING_S = 20.0
# Encoding holds Python's lock half of the time: more threads would take it from the ticks.
ENCODERS = 2
# For the last word to a client that may not be reading.
CLOSE_S = 1.0
MAX_REASON_BYTES = 123  # what a WebSocket's close frame has room for (RFC 6455, 5.5)


class Close(NamedTuple):
    """How a stream ends: a WebSocket close code, and why."""

    code: int
    reason: str


STOPPING = Close(1001, "the server stops")
NOT_TEXT = Close(1003, "expected text")
BAD_MESSAGE = Close(1008, 'expected {"type": "full"}')
FAILED = Close(1011, "our failure; the server's log says more")
TOO_MANY = Close(1013, f"expected at most {MAX_CLIENTS} streams; try again later")
NO_PLAYER = Close(4404, "no such player")


@dataclass
class StreamCounts:
    """Since the start."""

    clients: int = 0
    refused: int = 0
    frames: int = 0
    bytes: int = 0


class PlayerStreams:
    """All streams of a server. On the event loop alone, but for encoding."""

    def __init__(self, ticks: TickSignal) -> None:
        self.counts = StreamCounts()
        self._ticks = ticks
        self._first_frames = FirstFrames(ticks)
        self._closing: set[asyncio.Future[Close]] = set()
        self._ended = asyncio.Event()
        self._is_closed = False
        self._encoders = ThreadPoolExecutor(ENCODERS, thread_name_prefix="stream-encoder")

    @property
    def clients(self) -> int:
        """How many there are now."""
        return len(self._closing)

    async def serve(self, socket: WebSocket, ticker: Ticker, player: str) -> None:
        """Follow a player for a client that was accepted, until either has gone."""
        if player not in ticker.state.players:
            await close(socket, NO_PLAYER)
        elif self.clients >= MAX_CLIENTS:
            self.counts.refused += 1
            await close(socket, TOO_MANY)
        elif self._is_closed:
            await close(socket, STOPPING)
        else:
            self.counts.clients += 1
            told: asyncio.Future[Close] = asyncio.get_running_loop().create_future()
            self._closing.add(told)
            try:
                stream = _Stream(socket, ticker, player, self._ticks, self._first_frames, self._encoders, self.counts)
                ending = await first_of(stream.send(), stream.listen(), _result(told))
                if ending is not None:
                    await close(socket, ending)
            finally:
                self._closing.discard(told)
                if not self._closing:
                    self._ended.set()

    async def close(self) -> None:
        """Tell every client that the server stops; returns once they know, or after two seconds."""
        self._is_closed = True
        self._ended.clear()
        for told in self._closing:
            if not told.done():
                told.set_result(STOPPING)
        if self._closing:
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._ended.wait(), 2 * CLOSE_S)

    def stop_encoding(self) -> None:
        """End the threads, once no stream is left."""
        self._encoders.shutdown(wait=False, cancel_futures=True)


class _Stream:
    """One client's."""

    def __init__(
        self,
        socket: WebSocket,
        ticker: Ticker,
        player: str,
        ticks: TickSignal,
        first_frames: FirstFrames,
        encoders: ThreadPoolExecutor,
        counts: StreamCounts,
    ) -> None:
        self._socket, self._ticker, self._player = socket, ticker, player
        self._ticks, self._first_frames, self._encoders, self._counts = ticks, first_frames, encoders, counts
        self._wants_full = False

    async def send(self) -> Close | None:
        """Frames, until there is no such player any more."""
        header = StreamHeader(tick_rate=float(self._ticker.rate_hz))
        encoder = VolumeEncoder(header)
        await self._socket.send_text(header.to_text())
        seen: PublishedVolume | None = None
        now = Published(-1, 0)
        while True:
            now = await self._ticks.after(now.tick)
            if self._player not in self._ticker.state.players:
                return NO_PLAYER
            volume = self._ticker.world.published(self._player)
            if volume is None:
                continue
            if volume is seen and not self._wants_full:
                _encode(encoder, now, volume)  # costs nothing, but the encoder counts the ticks it looked at
                continue
            if seen is None:
                await self._first_frames.turn()
                # Meanwhile there were ticks, and perhaps a later volume.
                now, volume = self._ticks.latest, self._ticker.world.published(self._player) or volume
            if self._wants_full:
                self._wants_full = False
                encoder.forget()
            message = await asyncio.get_running_loop().run_in_executor(self._encoders, _encode, encoder, now, volume)
            seen = volume
            if message is not None:
                await self._socket.send_bytes(message)
                self._counts.frames += 1
                self._counts.bytes += len(message)

    async def listen(self) -> Close | None:
        """What the client says, until it says something wrong or goes away (None)."""
        while True:
            message = await self._socket.receive()
            if message["type"] == "websocket.disconnect":
                return None
            text = message.get("text")
            if text is None:
                return NOT_TEXT
            if not is_full_request(text):
                return BAD_MESSAGE
            self._wants_full = True


def _encode(encoder: VolumeEncoder, now: Published, volume: PublishedVolume) -> bytes | None:
    return encoder.encode(now.tick, volume.values, volume.mask, volume.first_voxel, now.time_us)


def is_full_request(text: str) -> bool:
    """Whether a client's message asks for a full frame: the only thing that it may say."""
    try:
        message = json.loads(text)
    except (ValueError, RecursionError):
        return False
    return isinstance(message, dict) and message.get("type") == "full"


async def first_of(*parts: Coroutine[Any, Any, Close | None]) -> Close | None:
    """What the first of some coroutines to end gives; the others are cancelled. One that fails is our failure, a lost client nobody's."""
    tasks = [asyncio.ensure_future(part) for part in parts]
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
        ended = await asyncio.gather(*tasks, return_exceptions=True)
    assert done
    for result in ended:
        if isinstance(result, WebSocketDisconnect):
            return None
        if isinstance(result, Exception):
            log.error("a player's stream failed", exc_info=result)
            return FAILED
    return next((task.result() for task in done if task.result() is not None), None)


async def _result(told: "asyncio.Future[Close]") -> Close:
    return await told


async def close(socket: WebSocket, ending: Close) -> None:
    """End a stream with a word, cut to what fits, if the client still takes it."""
    reason = ending.reason.encode()[:MAX_REASON_BYTES].decode(errors="ignore")
    with contextlib.suppress(TimeoutError, WebSocketDisconnect, RuntimeError):
        await asyncio.wait_for(socket.close(ending.code, reason), CLOSE_S)
