"""The clients of a load test: each follows one player, by WebSocket or by fetching, and takes in every volume as an engine would."""

import asyncio
import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import httpx
import numpy as np
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import WebSocketException

from gi_core.arrays import Float32, UInt8
from gi_core.basis import brightness
from gi_core.constants import BASIS_SIZES, VOXEL_INDOORS, VOXEL_OUTDOORS
from server.frame_prefix import FrameKind
from server.loadtest_record import Recorder
from server.stream_header import FrameLostError, StreamError, parse_header
from server.volume_frames import Frame, VolumeDecoder

OPEN_S = 10.0
CLOSE_S = 1.0
RETRY_S = 0.5
MAX_MESSAGE_BYTES = 1 << 24
ASK_FULL = json.dumps({"type": "full"})
# Beside light a hundred times as bright nobody sees a voxel change.
POP_FLOOR_OF_MEAN = 0.01


@dataclass(frozen=True)
class Watch:
    """What all clients of a test share. ``now`` gives seconds since the start."""

    recorder: Recorder
    now: Callable[[], float]
    pop_bound: float

    def error(self, text: str) -> None:
        self.recorder.error(self.now(), text)


async def stream(url: str, player: str, watch: Watch) -> None:
    """Follow a player's WebSocket until cancelled; a stream that ends or makes no sense is an error, and is opened again."""
    address = f"ws{url.removeprefix('http')}/v1/players/{player}/stream"
    while True:
        try:
            # Frames are compressed already, and a proxy between would be what is measured.
            async with connect(
                address, compression=None, max_size=MAX_MESSAGE_BYTES, open_timeout=OPEN_S, close_timeout=CLOSE_S, proxy=None
            ) as socket:
                await _follow(socket, watch)
        except (OSError, WebSocketException, StreamError) as error:
            watch.error(f"stream: {_reason(error)}")
        await asyncio.sleep(RETRY_S)


async def _follow(socket: ClientConnection, watch: Watch) -> None:
    decoder = VolumeDecoder(header := parse_header(await socket.recv()))
    asked = False
    async for message in socket:
        if isinstance(message, str):
            continue  # later versions may say more in words
        at, wall_us = watch.now(), time.time() * 1e6
        try:
            frame = decoder.decode(message, compare=True)
        except FrameLostError as error:
            if not asked:
                watch.error(f"stream: {_reason(error)}")
                await socket.send(ASK_FULL)
            asked = True
            continue
        asked = False
        watch.recorder.message(at, len(message), (wall_us - frame.prefix.time_us) / 1e3)
        if frame.prefix.kind == FrameKind.FULL:
            watch.recorder.full_frames += 1
        elif frame.prefix.elapsed != 1:
            watch.recorder.unjudged_frames += 1
        else:
            watch.recorder.pops(at, _pops_of(frame, decoder, header.basis, watch.pop_bound))
    raise StreamError("the server closed it")


def _pops_of(frame: Frame, decoder: VolumeDecoder, basis: str, bound: float) -> int:
    assert frame.before is not None
    flat = decoder.values.reshape(decoder.values.shape[0], -1, 3)
    # The mean does not need to be exact, and summing all voxels for each of thousands of frames would be what is measured.
    floor = POP_FLOOR_OF_MEAN * float(brightness(flat[:, ::16], basis).mean())
    after = np.take(flat, frame.chosen, axis=1)
    return count_pops(frame.before, after, decoder.mask.reshape(-1)[frame.chosen], floor, basis, bound)


def count_pops(before: Float32, after: Float32, classes: UInt8, floor: float, basis: str, bound: float) -> int:
    """How many voxels in free air changed in brightness by more than ``bound`` of the greater of two values, and by more than ``floor``.

    before, after : (B, n, 3) [lx]; before is NaN for voxels that were not there, which never count. classes : (n,)
    """
    old, new = brightness(before, basis), brightness(after, basis)
    change = np.abs(new - old)
    free = (classes == VOXEL_OUTDOORS) | (classes == VOXEL_INDOORS)
    return int(np.count_nonzero(free & (change > bound * np.fmax(old, new)) & (change > floor)))


@dataclass(frozen=True, eq=False)
class Fetched:
    """A reply of ``GET /v1/players/{id}/volume?format=raw``: values (B, n, 3) [lx], classes (n,) 1 in free air, else 0."""

    tick: int
    origin: tuple[float, ...]
    basis: str
    values: Float32
    classes: UInt8


async def fetch(http: httpx.AsyncClient, player: str, watch: Watch, period_s: float) -> None:
    """Ask for a player's volume once every period until cancelled, telling the tick that is known."""
    last: Fetched | None = None
    due = watch.now()
    while True:
        due = max(due + period_s, watch.now())
        parameters = {"format": "raw", "encoding": "f16"} | ({} if last is None else {"since": str(last.tick)})
        started = time.perf_counter()
        try:
            reply = await http.get(f"/v1/players/{player}/volume", params=parameters)
            taken_ms = (time.perf_counter() - started) * 1e3
            if reply.status_code == 200:
                watch.recorder.message(watch.now(), len(reply.content), taken_ms)
                last = _compare(last, read_reply(reply), watch)
            elif reply.status_code != 304:
                watch.error(f"GET volume: status {reply.status_code}")
                await asyncio.sleep(RETRY_S)
        except (httpx.HTTPError, StreamError) as error:
            watch.error(f"GET volume: {_reason(error)}")
            await asyncio.sleep(RETRY_S)
        await asyncio.sleep(max(due - watch.now(), 0))


def _compare(last: Fetched | None, found: Fetched, watch: Watch) -> Fetched:
    if last is None or found.tick != last.tick + 1 or found.origin != last.origin or found.values.shape != last.values.shape:
        watch.recorder.unjudged_frames += 1
        return found
    floor = POP_FLOOR_OF_MEAN * float(brightness(found.values, found.basis).mean())
    watch.recorder.pops(watch.now(), count_pops(last.values, found.values, found.classes, floor, found.basis, watch.pop_bound))
    return found


def read_reply(reply: httpx.Response) -> Fetched:
    """The volume in a reply. Raises StreamError when headers and bytes do not fit together."""
    try:
        facts, tick = json.loads(reply.headers["Gi-Volume"]), int(reply.headers["Gi-Tick"])
        shape, scale, basis = tuple(map(int, facts["shape"])), float(facts["scale"]), str(facts["basis"])
        origin = tuple(map(float, facts["origin"]))
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
        raise StreamError(f"expected headers Gi-Volume and Gi-Tick, found {_reason(error)}") from error
    if len(shape) != 5 or shape[4] != 4 or min(shape) < 1 or len(reply.content) != 2 * math.prod(shape):
        raise StreamError(f"expected {shape} halves, found {len(reply.content)} bytes")
    if shape[0] != BASIS_SIZES.get(basis) or not 0 < scale < math.inf:
        raise StreamError(f"expected a basis of {shape[0]} coefficients and a scale above 0, found {basis[:20]!a} and {scale:g}")
    texels = np.frombuffer(reply.content, "<f2").reshape(shape[0], -1, 4)
    values = texels[..., :3].astype(np.float32) * np.float32(scale)
    return Fetched(tick, origin, basis, values, texels[0, :, 3].astype(np.uint8))


def _reason(error: Exception) -> str:
    """One line that is the same for the same cause, so that errors can be counted."""
    return f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
