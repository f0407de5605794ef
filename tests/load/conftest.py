"""A stand-in for a live server, on a real socket: it plays made-up volumes, and misbehaves as a test asks."""

import asyncio
import contextlib
import json
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from typing import Any

import numpy as np
import pytest
import uvicorn
from serving import running
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from server.encoding import half_scale, half_texels
from server.stream_header import StreamHeader
from server.volume_frames import VolumeEncoder

HEADER = StreamHeader(shape=(6, 4, 8, 8))
SLAB_TICKS = 10  # the volume moves by one voxel this often


@dataclass
class Behaviour:
    """What a stand-in does wrong, from tick ``since`` on and before tick ``until``: every ``every`` ticks."""

    since: int = 20
    until: int = 1 << 31
    every: int = 20
    pops: bool = False
    drops_frames: bool = False
    sends_garbage: bool = False
    closes: bool = False
    clock_jumps: bool = False
    is_late: bool = False
    skips: bool = False
    grows: bool = False
    misses: bool = False
    fails_volumes: bool = False
    has_no_live: bool = False
    starts_after: int = 0  # requests for players that it is not ready for
    loses_replies: bool = False  # it makes players and says that it failed
    token: str | None = None

    def strikes(self, tick: int) -> bool:
        """Whether this is a tick at which things go wrong."""
        return self.since <= tick < self.until and tick % self.every == 0


@dataclass
class StandIn:
    """One world with a clock that starts at 0 ticks with the first look at it."""

    behaviour: Behaviour
    started: float = field(default_factory=time.monotonic)
    players: dict[str, dict[str, Any]] = field(default_factory=dict)
    made: list[dict[str, Any]] = field(default_factory=list)
    asked_full: int = 0
    refused: int = 0

    @property
    def tick(self) -> int:
        return int((time.monotonic() - self.started) * HEADER.tick_rate)

    def volume(self, tick: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Light that depends on the place in the world, and, where it pops, on the tick."""
        first = np.array([tick // SLAB_TICKS, 0, 0])
        _, ny, nz, nx = HEADER.shape
        x = first[0] + np.arange(nx)
        values = np.ones((*HEADER.shape, 3), np.float32) * (1000 + 500 * np.sin(x))[:, None].astype(np.float32)
        if self.behaviour.pops and self.behaviour.strikes(tick):
            values[:, 1, 2, 3] *= 3
        return values, np.ones((ny, nz, nx), np.uint8), first

    def strikes_until(self, tick: int) -> int:
        return sum(self.behaviour.strikes(t) for t in range(tick + 1))

    def authorised(self, request: Request) -> bool:
        return self.behaviour.token in (None, request.headers.get("authorization", "").removeprefix("Bearer "))

    async def make_player(self, request: Request) -> Response:
        if not self.authorised(request):
            return JSONResponse({"status": 401}, 401)
        wish = await request.json()
        if self.behaviour.starts_after > self.refused:
            self.refused += 1
            return JSONResponse({"status": 503}, 503, {"Retry-After": "1"})
        self.made.append(wish)
        self.players[wish["id"]] = wish
        if self.behaviour.loses_replies:
            return JSONResponse({"status": 500}, 500)
        return JSONResponse({"id": wish["id"], "position": [0, 0, 0], "velocity": [0, 0, 0]}, 201)

    async def delete_player(self, request: Request) -> Response:
        if not self.authorised(request):
            return JSONResponse({"status": 401}, 401)
        return Response(status_code=204 if self.players.pop(request.path_params["id"], None) else 404)

    def took_ms(self, tick: int) -> float:
        if self.behaviour.is_late and self.behaviour.strikes(tick):
            return 50.0
        return 3.0 if tick % 10 == 0 else 1.5

    async def live(self, request: Request) -> Response:
        if self.behaviour.has_no_live:
            return JSONResponse({"status": 404}, 404)
        tick = self.tick
        wrong = self.strikes_until(tick)
        recent = None
        if "since" in request.query_params:
            later = range(int(request.query_params["since"]) + 1, tick)  # the last one is under way
            took_ms = [self.took_ms(t) for t in later]
            recent = {"tick": list(later), "ms": took_ms, "lateness_ms": [max(ms - 1000 / HEADER.tick_rate, 0.25) for ms in took_ms]}
        return JSONResponse(
            {
                "recent": recent,
                "tick": tick,
                "tick_rate": HEADER.tick_rate,
                # Of the last minute: nothing to tell a whole test by.
                "tick_ms": {"p50": 99.0, "p99": 99.0, "max": 99.0},
                "lateness_ms": {"p50": 99.0, "p99": 99.0, "max": 99.0},
                "late_ticks": 7 + wrong * self.behaviour.is_late,
                "skipped": 2 + wrong * self.behaviour.skips,
                "ticks": tick,
                "misses": 3 + wrong * self.behaviour.misses,
                "resident_sectors": 9,
                "resident_bytes": 9_000_000,
                "relit": 2 * tick,
                "players": len(self.players),
                "memory_bytes": 150_000_000 + 1_000_000 * wrong * self.behaviour.grows,
                "cache": {"hits": 5 * tick, "misses": 2, "player_volume_hits": 3 * tick, "player_volume_misses": 8 * tick},
            }
        )

    async def clock(self, _: Request) -> Response:
        jumped = 7200 * self.strikes_until(self.tick) if self.behaviour.clock_jumps else 0
        now = datetime(2024, 6, 21, 13) + timedelta(seconds=time.monotonic() - self.started + jumped)
        return JSONResponse({"time": now.isoformat(), "rate": 1.0, "paused": False})

    async def get_volume(self, request: Request) -> Response:
        tick, since = self.tick, int(request.query_params.get("since", -1))
        if self.behaviour.fails_volumes and self.behaviour.strikes(tick):
            return Response(status_code=500)
        if tick <= since:
            return Response(status_code=304)
        values, mask, first = self.volume(tick)
        scale = half_scale(values)
        facts = {"shape": [*values.shape[:-1], 4], "scale": scale, "basis": "cube", "origin": first.tolist()}
        return Response(half_texels(values, scale, mask), headers={"Gi-Volume": json.dumps(facts), "Gi-Tick": str(tick)})

    async def stream(self, socket: WebSocket) -> None:
        if socket.path_params["id"] not in self.players:
            await socket.close(4404)
            return
        await socket.accept()
        await socket.send_text(HEADER.to_text())
        encoder = VolumeEncoder(HEADER)
        asked = asyncio.create_task(self.listen(socket, encoder))
        tick = self.tick
        with contextlib.suppress(WebSocketDisconnect):
            while not asked.done():
                wrong, message = self.behaviour.strikes(tick), encoder.encode(tick, *self.volume(tick), time.time_ns() // 1000)
                if wrong and self.behaviour.sends_garbage:
                    await socket.send_bytes(b"garbage")
                if wrong and self.behaviour.closes:
                    await socket.close()
                    break
                if message is not None and not (wrong and self.behaviour.drops_frames):
                    await socket.send_bytes(message)
                tick += 1
                await asyncio.sleep(max(self.started + tick / HEADER.tick_rate - time.monotonic(), 0))
        asked.cancel()

    async def listen(self, socket: WebSocket, encoder: VolumeEncoder) -> None:
        with contextlib.suppress(WebSocketDisconnect, RuntimeError):
            while True:
                assert json.loads(await socket.receive_text()) == {"type": "full"}
                self.asked_full += 1
                encoder.forget()

    def app(self) -> Starlette:
        return Starlette(
            routes=[
                Route("/v1/players", self.make_player, methods=["POST"]),
                Route("/v1/players/{id}", self.delete_player, methods=["DELETE"]),
                Route("/v1/players/{id}/volume", self.get_volume),
                Route("/v1/live", self.live),
                Route("/v1/clock", self.clock),
                WebSocketRoute("/v1/players/{id}/stream", self.stream),
            ]
        )


@contextlib.contextmanager
def _standing_in(**faults: Any) -> Iterator[tuple[StandIn, str]]:
    world = StandIn(Behaviour(**faults))
    config = uvicorn.Config(world.app(), log_level="critical", ws_per_message_deflate=False, timeout_graceful_shutdown=2)
    with running(uvicorn.Server(config), socket.create_server(("127.0.0.1", 0))) as address:
        yield world, address


@pytest.fixture(scope="session")
def standing_in() -> Callable[..., AbstractContextManager[tuple[StandIn, str]]]:
    """Serves a stand-in with some faults (members of Behaviour) while a ``with`` block lasts: gives its world and its address."""
    return _standing_in
