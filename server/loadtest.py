"""Players on paths, and a client for each: what a running server does under them. Talks to it by HTTP and WebSocket only."""

import asyncio
import contextlib
import signal
import time
from collections.abc import AsyncIterator, Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from ipaddress import ip_address
from secrets import token_hex
from typing import Any, Literal
from urllib.parse import urlsplit

import httpx

from gi_core.errors import InputError, SectorlightError
from server.json_input import identifier
from server.loadtest_clients import Watch, fetch, stream
from server.loadtest_record import Live, Recorder, Setting, report_of

POLL_S = 1.0
REQUEST_S = 30.0
# Kernels that are new to a machine take half a minute, or two on a slow one.
STARTUP_S, ASK_AGAIN_S = 180.0, 0.5
DEFAULT_TICK_RATE = 30.0
# A world's clock that is this far from where its rate should have brought it was set, not late.
JUMP_S = 2.0
JUMP_SHARE = 0.25
PARALLEL_REQUESTS = 8

Path3 = Sequence[tuple[float, float, float]]


class LoadTestError(SectorlightError, RuntimeError):
    """The server did not do what a load test needs before it can begin."""

    code = "loadtest"


@dataclass(frozen=True)
class Stage:
    """How far a test is: ``done`` of ``whole``, players made or seconds. recorder : what clients have seen so far, once they are there"""

    name: str
    done: float
    whole: float
    recorder: Recorder | None = None


Progress = Callable[[Stage], None]


@dataclass(frozen=True)
class Options:
    """What to run.

    url : of the server, without a path
    paths : world metres; player k walks number k modulo their count, round and round where it ends at its beginning, else back and
        forth; without any the server makes up a walk for each
    speed : [m/s]
    warm_up_s : how long players walk before clients follow and anything is counted
    token : bearer token of writes
    pop_bound : relative change of a voxel between two ticks beyond which it pops
    """

    url: str
    players: int = 1
    seconds: float = 30.0
    mode: Literal["stream", "fetch"] = "stream"
    speed: float = 5.0
    paths: Sequence[Path3] = ()
    seed: int = 0
    token: str | None = None
    pop_bound: float = 0.2
    warm_up_s: float = 0.0


def run(options: Options, progress: Progress) -> dict[str, Any]:
    """Run a test and return its report; Ctrl-C ends it early, and the report says so.

    Raises InputError when there is no such server or it refuses the players, LoadTestError when it fails before the test begins. The
    players it made are deleted whatever happens.
    """
    return asyncio.run(_run(options, progress))


async def _run(options: Options, progress: Progress) -> dict[str, Any]:
    stop = asyncio.Event()
    headers = {} if options.token is None else {"Authorization": f"Bearer {options.token}"}
    limits = httpx.Limits(max_connections=options.players + PARALLEL_REQUESTS, max_keepalive_connections=None)
    async with (
        httpx.AsyncClient(base_url=options.url, headers=headers, timeout=REQUEST_S, limits=limits, trust_env=False) as http,
        _interruptible(stop),
        _players(http, options, stop, progress) as players,
    ):
        recorder = Recorder()
        await _warm_up(options.warm_up_s, stop, progress)
        started = time.perf_counter()
        watch = Watch(recorder, lambda: time.perf_counter() - started, options.pop_bound)
        await _ask_live(http, watch)
        rate = recorder.last("tick_rate") or DEFAULT_TICK_RATE
        cpu_before = time.process_time()
        if options.mode == "stream":
            clients = [asyncio.create_task(stream(options.url, player, watch)) for player in players]
        else:
            clients = [asyncio.create_task(fetch(http, player, watch, 1.0 / rate)) for player in players]
        await _watch_server(http, watch, options.seconds, stop, progress, clients)
        seconds = watch.now()
        cpu_share = (time.process_time() - cpu_before) / seconds
        for client in clients:
            client.cancel()
        for ended in await asyncio.gather(*clients, return_exceptions=True):
            if ended is not None and not isinstance(ended, asyncio.CancelledError):
                raise ended
        setting = Setting(len(players), options.mode, options.speed, options.pop_bound, _is_this_machine(options.url))
        return report_of(recorder, setting, seconds, cpu_share, stop.is_set())


async def _warm_up(seconds: float, stop: asyncio.Event, progress: Progress) -> None:
    started = time.perf_counter()
    while (passed := time.perf_counter() - started) < seconds and not stop.is_set():
        progress(Stage("warm-up", passed, seconds))
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(stop.wait(), min(POLL_S, seconds - passed))


@contextlib.asynccontextmanager
async def _interruptible(stop: asyncio.Event) -> AsyncIterator[None]:
    """While it lasts, the first Ctrl-C sets ``stop``; the second interrupts as ever."""
    loop = asyncio.get_running_loop()

    def interrupt() -> None:
        stop.set()
        loop.remove_signal_handler(signal.SIGINT)

    try:
        loop.add_signal_handler(signal.SIGINT, interrupt)
    except (NotImplementedError, RuntimeError, ValueError):  # no such signals here, or not the main thread: Ctrl-C interrupts as ever
        yield
        return
    try:
        yield
    finally:
        loop.remove_signal_handler(signal.SIGINT)


@contextlib.asynccontextmanager
async def _players(http: httpx.AsyncClient, options: Options, stop: asyncio.Event, progress: Progress) -> AsyncIterator[list[str]]:
    """The names of new players of the server, which are deleted in the end; no more of them once ``stop`` is set. Raises InputError or
    LoadTestError."""
    run_name, made, asked, turns = f"loadtest-{token_hex(4)}", [], set(), asyncio.Semaphore(PARALLEL_REQUESTS)

    async def make(number: int) -> None:
        wish: dict[str, Any] = {"id": f"{run_name}-{number}", "speed": options.speed, "seed": options.seed + number}
        if options.paths:
            path = options.paths[number % len(options.paths)]
            # One that ends elsewhere has no way back but its own.
            wish |= {"path": [list(point) for point in path], "loop": path[0] == path[-1]}
        async with turns:
            if stop.is_set():
                return
            # One whose reply is lost is there all the same.
            asked.add(wish["id"])
            reply = await _send(http, "POST", "/v1/players", options.url, json=wish)
        made.append(_player_name(reply))
        progress(Stage("new players", len(made), options.players))

    async def delete(name: str) -> None:
        async with turns:
            with contextlib.suppress(httpx.HTTPError):  # the server is gone, and its players with it
                await http.delete(f"/v1/players/{name}")

    try:
        for ended in await asyncio.gather(*(make(number) for number in range(options.players)), return_exceptions=True):
            if ended is not None:
                raise ended
        yield sorted(made, key=lambda name: (len(name), name))
    finally:
        await asyncio.gather(*(delete(name) for name in asked.union(made)))


def _player_name(reply: httpx.Response) -> str:
    try:
        return identifier(_object(reply).get("id"), "id")
    except ValueError as error:
        raise LoadTestError(f"POST /v1/players: expected a reply with an id, found {reply.text[:200]!r}") from error


def _object(reply: httpx.Response) -> dict[str, Any]:
    """The JSON object that a reply is. Raises ValueError."""
    try:
        record = reply.json()
    except RecursionError as error:
        raise ValueError("expected a JSON object, found one too deep to read") from error
    if not isinstance(record, dict):
        raise ValueError(f"expected a JSON object, found a {type(record).__name__}")
    return record


async def _send(http: httpx.AsyncClient, method: str, target: str, url: str, **content: Any) -> httpx.Response:
    """A reply of success. InputError for a 4xx and for no server at all, LoadTestError for a 5xx; a server that is not ready yet is asked
    again for STARTUP_S."""
    give_up_at = time.perf_counter() + STARTUP_S
    while True:
        try:
            reply = await http.request(method, target, **content)
        except httpx.HTTPError as error:
            raise InputError(f"{url}: expected a Sectorlight server, found {error or type(error).__name__}") from error
        if reply.status_code != 503 or "retry-after" not in reply.headers or time.perf_counter() > give_up_at:
            break
        await asyncio.sleep(ASK_AGAIN_S)
    if reply.status_code in (401, 403):
        raise InputError(f"{url}: {method} {target}: it wants its bearer token for that: give --token-file FILE")
    if reply.is_server_error:
        raise LoadTestError(f"{url}: {method} {target}: status {reply.status_code}: {reply.text[:300]}")
    if not reply.is_success:
        raise InputError(f"{url}: {method} {target}: status {reply.status_code}: {reply.text[:300]}")
    return reply


async def _watch_server(
    http: httpx.AsyncClient, watch: Watch, seconds: float, stop: asyncio.Event, progress: Progress, clients: list[asyncio.Task[None]]
) -> None:
    """Ask the server how it does until the time is up, ``stop`` is set, or a client broke, which none may."""
    clock = await _ask_clock(http, watch, None)
    while (left := seconds - watch.now()) > 0 and not stop.is_set() and not any(client.done() for client in clients):
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(stop.wait(), min(POLL_S, left))
        await _ask_live(http, watch)
        clock = await _ask_clock(http, watch, clock)
        progress(Stage(f"{len(clients)} players", min(watch.now(), seconds), seconds, watch.recorder))


async def _ask_live(http: httpx.AsyncClient, watch: Watch) -> None:
    known = watch.recorder.known_tick
    try:
        reply = await http.get("/v1/live", params={} if known is None else {"since": known})
        if reply.status_code == 200:
            watch.recorder.server(Live(watch.now(), _object(reply)))
        else:
            watch.error(f"GET /v1/live: status {reply.status_code}")
    except (httpx.HTTPError, ValueError) as error:
        watch.error(f"GET /v1/live: {type(error).__name__}")


async def _ask_clock(http: httpx.AsyncClient, watch: Watch, last: tuple[float, float, float] | None) -> tuple[float, float, float] | None:
    """The world's clock: (asked at [s], its time [s], its rate); tells the recorder when it was set since ``last``."""
    try:
        members = _object(await http.get("/v1/clock"))
        rate = 0.0 if members["paused"] else float(members["rate"])
        found = watch.now(), datetime.fromisoformat(members["time"]).timestamp(), rate
    except (httpx.HTTPError, ValueError, KeyError, TypeError, OverflowError):
        return last  # without a clock no jump is known, and pops count
    if last is not None:
        low, high = sorted(r * (found[0] - last[0]) for r in (last[2], rate))
        slack = JUMP_S + JUMP_SHARE * max(abs(low), abs(high))
        if not low - slack <= found[1] - last[1] <= high + slack:
            watch.recorder.jump(watch.now())
    return found


def _is_this_machine(url: str) -> bool:
    host = urlsplit(url).hostname or ""
    try:
        return host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        return False
