"""The WebSocket stream of a player's volume: what a client holds, and what becomes of clients that misbehave."""

import asyncio
import contextlib
import gc
import io
import json
import os
import socket
import struct
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import httpx
import numpy as np
import pytest
from fastapi import FastAPI
from serving import PATIENCE_S, until
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from gi_core.live_world import TickReport
from server.app import create_app
from server.first_frames import FirstFrames
from server.frame_prefix import FrameKind
from server.live import LiveOptions
from server.player_streams import MAX_REASON_BYTES, Close, PlayerStreams, close, is_full_request
from server.routes.live import memory_bytes
from server.settings import Settings
from server.stream_header import parse_header
from server.tick_signal import TickSignal
from server.volume_frames import Frame, VolumeDecoder, VolumeEncoder

# What a thousand clients may leave in memory. Five thousand, a thousand at a time, left 5.4, 0.2, 0.1, 1.0 and 2.5 MB: what the allocator
# keeps. One encoder of ten that stayed would be 120 MB.
MOST_GROWTH_BYTES = 16 << 20
# A text frame of a client, masked with zeros.
ASK_FULL = b'\x81\x90\0\0\0\0{"type": "full"}'


class Follower:
    """A client that holds what it was sent."""

    def __init__(self, connection: ClientConnection) -> None:
        self.connection = connection
        self.header = parse_header(connection.recv(timeout=PATIENCE_S))
        self.decoder = VolumeDecoder(self.header)

    def next(self, timeout_s: float = PATIENCE_S) -> Frame:
        return self.decoder.decode(self.connection.recv(timeout=timeout_s))

    def close_code(self) -> int:
        """Reads until the server closes."""
        try:
            while True:
                self.connection.recv(timeout=PATIENCE_S)
        except ConnectionClosed as closed:
            return -1 if closed.rcvd is None else closed.rcvd.code

    def until_silent(self) -> None:
        """Reads until the world has settled, and nothing is worth a message."""
        with contextlib.suppress(TimeoutError):
            for _ in range(1000):
                self.next(1.0)
            raise AssertionError("the world does not settle")


@contextmanager
def following(http: httpx.Client, player: str) -> Iterator[Follower]:
    address = f"ws://{http.base_url.netloc.decode()}/v1/players/{player}/stream"
    with connect(address, compression=None, max_size=1 << 24, open_timeout=PATIENCE_S, close_timeout=2) as connection:
        yield Follower(connection)


def first_message_closes(http: httpx.Client, player: str) -> int:
    address = f"ws://{http.base_url.netloc.decode()}/v1/players/{player}/stream"
    with connect(address, open_timeout=PATIENCE_S) as connection:
        with pytest.raises(ConnectionClosed) as closed:
            connection.recv(timeout=PATIENCE_S)
        assert closed.value.rcvd is not None
        return closed.value.rcvd.code


@pytest.fixture
def streams(live_app: FastAPI, live_http: httpx.Client) -> PlayerStreams:
    found = live_app.state.service.streams
    until(lambda: found.clients == 0)
    return found


@pytest.fixture
def racing(live_http: httpx.Client) -> Iterator[None]:
    """The sun races: there is a frame in every tick."""
    live_http.put("/v1/weather", json={"weather": "clear"})
    live_http.put("/v1/clock", json={"time": "2024-06-21T09:00", "rate": 1200, "paused": False})
    yield
    live_http.put("/v1/clock", json={"time": "12:00", "rate": 1, "paused": True})


@pytest.fixture
def resting(live_http: httpx.Client) -> None:
    live_http.put("/v1/weather", json={"weather": "overcast:cloud_cover=1.0"})
    live_http.put("/v1/clock", json={"time": "2024-06-21T12:00", "rate": 1, "paused": True})


def test_a_client_holds_the_server_s_volume(live_http: httpx.Client, player: str, resting: None, streams: PlayerStreams) -> None:
    with following(live_http, player) as follower:
        assert follower.header.tick_rate == 20
        assert follower.next().prefix.kind == FrameKind.FULL
        follower.until_silent()
        reply = live_http.get(f"/v1/players/{player}/volume")
        light = np.load(io.BytesIO(reply.content))
        facts = json.loads(reply.headers["gi-volume"])
        centre = (follower.decoder.first_voxel + 0.5) * follower.header.voxel_size
        assert centre.tolist() == facts["origin"]
        mask = np.load(io.BytesIO(live_http.get(f"/v1/players/{player}/volume", params={"mask": 1}).content))
        assert np.array_equal(follower.decoder.mask, mask)
        # 1 % of the voxel's largest coefficient, some of the volume's, and the half's rounding: STREAM.md.
        largest = light.max(axis=(0, 4))
        bound = 0.0105 * largest + 2.0**-15 * light.max()
        assert (np.abs(follower.decoder.values - light) <= bound[..., None]).all()
        sent = streams.counts.bytes
        live_http.put("/v1/clock", json={"time": "18:00"})
        assert follower.next().prefix.kind == FrameKind.DELTA
        assert until(lambda: streams.counts.bytes > sent)  # a frame is counted once it is sent, which its client may see first


def test_frames_come_with_ticks(live_http: httpx.Client, player: str, racing: None) -> None:
    with following(live_http, player) as follower:
        frames = [follower.next() for _ in range(10)]
        ticks = [frame.prefix.tick for frame in frames]
        assert ticks == sorted(set(ticks))
        assert [frame.prefix.kind for frame in frames] == [FrameKind.FULL] + [FrameKind.DELTA] * 9
        assert all(frame.prefix.base == before for frame, before in zip(frames[1:], ticks, strict=False))
        assert abs(frames[-1].prefix.time_us / 1e6 - time.time()) < PATIENCE_S
        assert live_http.get("/v1/live").json()["streams"]["clients"] >= 1


def test_first_frames_take_turns_in_the_order_of_arrival() -> None:
    """One in a tick; who has gone meanwhile takes no one's turn."""
    came: list[int] = []

    async def first_frame(frames: FirstFrames, number: int) -> None:
        await frames.turn()
        came.append(number)

    async def run() -> None:
        signal, ticker = TickSignal(), SimpleNamespace(listeners=[])
        signal.follow(ticker)

        async def tick(number: int) -> None:
            ticker.listeners[0](TickReport(number))
            for _ in range(10):  # until all that it woke have gone as far as they can
                await asyncio.sleep(0)

        frames = FirstFrames(signal)
        await tick(0)
        clients = [asyncio.create_task(first_frame(frames, number)) for number in range(6)]
        await asyncio.sleep(0)
        assert came == [0]
        clients[3].cancel()
        for number, expected in ((1, [0, 1]), (2, [0, 1, 2]), (3, [0, 1, 2, 4]), (4, [0, 1, 2, 4, 5])):
            await tick(number)
            assert came == expected
        # Nobody waits any more: the next tick is there to be had at once.
        await tick(5)
        await asyncio.wait_for(first_frame(frames, 10), 1.0)
        assert came[-1] == 10
        await asyncio.gather(*clients, return_exceptions=True)

    asyncio.run(run())


def test_clients_that_come_together_get_their_first_frames_one_tick_after_the_other(
    live_http: httpx.Client, player: str, resting: None
) -> None:
    together = threading.Barrier(12)

    def first_tick(_: int) -> int:
        with following(live_http, player) as follower:
            together.wait(PATIENCE_S)
            frame = follower.next()
            assert frame.prefix.kind == FrameKind.FULL
            return frame.prefix.tick

    with ThreadPoolExecutor(12) as clients:
        ticks = sorted(clients.map(first_tick, range(12)))
    assert ticks[-1] - ticks[0] >= 10


def test_a_full_frame_comes_on_request_also_when_nothing_changes(live_http: httpx.Client, player: str, resting: None) -> None:
    with following(live_http, player) as follower:
        follower.until_silent()
        follower.connection.send('{"type": "full"}')
        assert follower.next().prefix.kind == FrameKind.FULL


@pytest.mark.parametrize(
    ("message", "code"),
    [(b"\x00", 1003), ("hello", 1008), ("[]", 1008), ('{"type": "everything"}', 1008), ("[" * 900, 1008), ("x" * 5000, 1009)],
)
def test_garbage_ends_a_stream(live_http: httpx.Client, player: str, streams: PlayerStreams, message: str | bytes, code: int) -> None:
    with following(live_http, player) as follower:
        follower.connection.send(message)
        assert follower.close_code() == code
    until(lambda: streams.clients == 0)


def test_only_a_request_for_a_full_frame_is_one() -> None:
    assert is_full_request('{"type": "full"}')
    assert not any(map(is_full_request, ("", "full", '{"type": 1}', "{}", "null", "[" * 100_000)))


def test_a_reason_that_a_close_frame_has_no_room_for_is_cut_between_letters() -> None:
    said: list[tuple[int, str]] = []

    async def note(code: int, reason: str) -> None:
        said.append((code, reason))

    asyncio.run(close(SimpleNamespace(close=note), Close(1013, "x" + "ä" * 100)))
    assert said == [(1013, "x" + "ä" * 61)]
    assert len(said[0][1].encode()) == MAX_REASON_BYTES


def test_a_player_that_is_not_there(live_http: httpx.Client, player: str) -> None:
    assert first_message_closes(live_http, "nobody") == 4404
    with following(live_http, player) as follower:
        follower.next()
        live_http.delete(f"/v1/players/{player}")
        assert follower.close_code() == 4404


def test_there_is_a_limit_of_streams(live_http: httpx.Client, player: str, streams: PlayerStreams, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("server.player_streams.MAX_CLIENTS", 1)
    with following(live_http, player) as follower:
        follower.next()
        assert first_message_closes(live_http, player) == 1013
    until(lambda: streams.clients == 0)
    with following(live_http, player) as follower:
        follower.next()


def raw_stream(http: httpx.Client, player: str) -> socket.socket:
    """A connection that has shaken hands, and reads no further."""
    connection = socket.socket()
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 14)
    connection.settimeout(PATIENCE_S)
    connection.connect((http.base_url.host, http.base_url.port))
    connection.sendall(
        f"GET /v1/players/{player}/stream HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n\r\n".encode()
    )
    assert connection.recv(12) == b"HTTP/1.1 101"
    return connection


def received(connection: socket.socket, seconds: float) -> int:
    """Bytes that come off a socket in some seconds, whatever they are."""
    count, end = 0, time.monotonic() + seconds
    while (left := end - time.monotonic()) > 0:
        connection.settimeout(left)
        with contextlib.suppress(TimeoutError):
            data = connection.recv(1 << 16)
            assert data, "the server closed it"
            count += len(data)
    return count


def test_a_stream_of_a_world_that_stands_still_is_silent(live_http: httpx.Client, player: str, resting: None) -> None:
    with following(live_http, player) as follower:
        follower.until_silent()
    with raw_stream(live_http, player) as connection:
        assert received(connection, 2.0) > 10_000  # header and first frame
        # Not even pings, which come every 20 s: one of them is two bytes.
        assert received(connection, 3.0) <= 2


@pytest.mark.slow
def test_a_stream_of_a_world_at_its_own_pace_takes_next_to_nothing(live_http: httpx.Client, player: str) -> None:
    """For who stands under a clear sky at noon whose sun moves as the sun does: 0.0004 Mbit/s were seen."""
    live_http.put("/v1/weather", json={"weather": "clear"})
    live_http.put("/v1/clock", json={"time": "2024-06-21T12:00", "rate": 1, "paused": False})
    try:
        with raw_stream(live_http, player) as connection:
            received(connection, 5.0)  # the first frame, and what follows a jump of the clock
            assert 8e-6 * received(connection, 8.0) / 8.0 < 0.1
    finally:
        live_http.put("/v1/clock", json={"time": "12:00", "rate": 1, "paused": True})


def test_a_client_that_stops_reading_costs_a_message_and_holds_up_nobody(
    live_http: httpx.Client, player: str, racing: None, streams: PlayerStreams
) -> None:
    with raw_stream(live_http, player) as deaf:
        # Full frames, as many as it can be sent: what the system buffers is soon full.
        stalled, since = -1, time.monotonic()
        deadline = since + PATIENCE_S
        while time.monotonic() - since < 1.0:
            assert time.monotonic() < deadline, "it was sent more and more"
            deaf.sendall(ASK_FULL)
            if streams.counts.bytes != stalled:
                stalled, since = streams.counts.bytes, time.monotonic()
            time.sleep(0.05)
        assert stalled < 8 << 20  # the system's own buffers on a loopback
        with following(live_http, player) as follower:
            first = follower.next().prefix.tick
            last = [follower.next() for _ in range(20)][-1].prefix.tick
            assert last - first < 60  # 20 of at most 60 ticks: nobody waits for the one that does not read
    until(lambda: streams.clients == 0)


def test_a_client_that_reads_slowly_gets_fewer_frames_and_ends_up_with_the_same(
    live_http: httpx.Client, player: str, racing: None, streams: PlayerStreams
) -> None:
    """What it gets is whole and in order, and never a queue of what has been: it sees the present within what the system buffers."""
    narrow = socket.socket()
    narrow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 14)
    narrow.connect((live_http.base_url.host, live_http.base_url.port))
    address = f"ws://{live_http.base_url.netloc.decode()}/v1/players/{player}/stream"
    with connect(address, sock=narrow, compression=None, max_size=1 << 24, max_queue=1) as connection:
        follower, gaps = Follower(connection), []
        deadline = time.monotonic() + PATIENCE_S
        while sum(gap > 1 for gap in gaps) < 3:
            assert time.monotonic() < deadline, "it was sent every frame"
            gaps.append(follower.next().prefix.elapsed)
            time.sleep(0.2)
        live_http.put("/v1/clock", json={"time": "2024-06-21T12:00", "rate": 1, "paused": True})
        follower.until_silent()
        light = np.load(io.BytesIO(live_http.get(f"/v1/players/{player}/volume").content))
        bound = 0.0105 * light.max(axis=(0, 4)) + 2.0**-15 * light.max()  # as above
        assert (np.abs(follower.decoder.values - light) <= bound[..., None]).all()


def test_a_client_that_vanishes_is_forgotten(live_http: httpx.Client, player: str, racing: None, streams: PlayerStreams) -> None:
    connection = raw_stream(live_http, player)
    until(lambda: streams.clients == 1)
    # A reset, as when its machine was switched off and on again.
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    connection.close()
    until(lambda: streams.clients == 0)


@pytest.mark.parametrize("clients", [150, pytest.param(1000, marks=pytest.mark.slow)])
def test_a_thousand_clients_come_and_go_without_a_trace(
    live_http: httpx.Client, player: str, racing: None, streams: PlayerStreams, clients: int
) -> None:
    """They connect, take something and leave, in turns politely and not; no encoder, descriptor or memory of theirs is left."""

    def come(times: int) -> None:
        for number in range(times):
            if number % 3:
                with raw_stream(live_http, player):
                    pass
            else:
                with following(live_http, player) as follower:
                    follower.next()
        until(lambda: streams.clients == 0)

    def left() -> tuple[int, int]:
        gc.collect()
        encoders = sum(isinstance(found, VolumeEncoder) for found in gc.get_objects())
        return encoders, len(os.listdir("/proc/self/fd"))

    come(30)  # what threads and the allocator keep for the next client is there after some
    time.sleep(0.5)
    _, descriptors = left()
    memory = memory_bytes()
    assert memory is not None
    come(clients)
    # A connection or two of the test's own client may come or go meanwhile.
    until(lambda: left()[0] == 0 and left()[1] <= descriptors + 2)
    assert (memory_bytes() or 0) - memory < MOST_GROWTH_BYTES


@pytest.mark.skipif(not hasattr(socket, "TCP_USER_TIMEOUT"), reason="the system has no such option")
def test_a_client_that_takes_no_byte_is_cut_off_in_the_end(
    city: Any, serving: Any, wait_until_live: Any, street: tuple[float, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("server.cli_serve.UNSENT_MS", 1000)
    app = create_app(city, Settings(live=LiveOptions(ticks_per_second=20)))
    with serving(app) as http:
        wait_until_live(http)
        http.post("/v1/players", json={"id": "a", "path": [street], "speed": 0})
        http.put("/v1/clock", json={"time": "09:00", "rate": 1200})
        deaf = raw_stream(http, "a")
        until(lambda: app.state.service.streams.clients == 1)
        until(lambda: app.state.service.streams.clients == 0)
        deaf.close()


def test_a_server_that_stops_says_so(city: Any, serving: Any, wait_until_live: Any, street: tuple[float, ...]) -> None:
    app = create_app(city, Settings(live=LiveOptions(ticks_per_second=10)))
    with contextlib.ExitStack() as clients:
        with serving(app) as http:
            wait_until_live(http)
            http.post("/v1/players", json={"id": "a", "path": [street], "speed": 0})
            follower = clients.enter_context(following(http, "a"))
            follower.next()
            clients.enter_context(raw_stream(http, "a"))  # and one that does not hear it
            stopping = time.monotonic()
        assert time.monotonic() - stopping < 15
        assert follower.close_code() == 1001
    assert app.state.service.live.started_ticker.is_stopped
