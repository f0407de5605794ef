"""A tiny baked city behind a real socket."""

import contextlib
import json
import secrets
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import pytest
from fastapi import FastAPI
from serving import STARTUP_S, running

from gi_core.constants import VOXEL_SIZE_M
from server.app import create_app
from server.cli import main
from server.cli_serve import bind, http_server
from server.live import LiveOptions
from server.settings import Settings

SOURCE = "procedural:midtown?blocks=1x1&seed=1"
LIVE_RATE_HZ = 20

Serving = Callable[[FastAPI], AbstractContextManager[httpx.Client]]


@pytest.fixture(scope="session")
def city(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of one block."""
    from bake_jobs.runner import bake

    output = tmp_path_factory.mktemp("city") / "block"
    bake(SOURCE, output, "draft", 1, None, 0, False)
    return output


@contextlib.contextmanager
def _serving(app: FastAPI) -> Iterator[httpx.Client]:
    with running(http_server(app, "critical"), bind("127.0.0.1", 0)) as address, httpx.Client(base_url=address, timeout=60) as client:
        yield client


@pytest.fixture(scope="session")
def serving() -> Serving:
    """Serves an application over a socket for as long as a ``with`` block lasts."""
    return _serving


@pytest.fixture(scope="session")
def app(city: Path) -> FastAPI:
    return create_app(city, Settings())


@pytest.fixture(scope="session")
def http(app: FastAPI) -> Iterator[httpx.Client]:
    """A client of a server of the tiny city."""
    with _serving(app) as client:
        yield client


@pytest.fixture(scope="session")
def live_app(city: Path, tmp_path_factory: pytest.TempPathFactory) -> FastAPI:
    """An application whose live world tests share: each uses players and lights of its own, and sets the clock that it needs."""
    state = tmp_path_factory.mktemp("live") / "kept.json"
    return create_app(city, Settings(live=LiveOptions(ticks_per_second=LIVE_RATE_HZ, state_file=state)))


@pytest.fixture(scope="session")
def live_http(live_app: FastAPI) -> Iterator[httpx.Client]:
    """A client of a server whose live world ticks."""
    with _serving(live_app) as client:
        _wait_until_live(client)
        yield client


def _wait_until_live(client: httpx.Client) -> None:
    deadline = time.monotonic() + STARTUP_S
    while (reply := client.get("/v1/live")).status_code == 503:
        assert time.monotonic() < deadline, reply.text
        time.sleep(0.05)
    assert reply.status_code == 200, reply.text


@pytest.fixture(scope="session")
def wait_until_live() -> Callable[[httpx.Client], None]:
    """Starts a server's live world, and returns once it ticks."""
    return _wait_until_live


@pytest.fixture(scope="session")
def street(live_app: FastAPI) -> tuple[float, float, float]:
    """Somewhere in the tiny city's streets where one can stand."""
    live = live_app.state.service.live
    columns = [c for index in live.dataset.world.sectors for c in live.lattice.columns_of(index)]
    x, z = columns[len(columns) // 2]
    level = live.lattice.level(x, z)
    assert level is not None
    return (x + 0.5) * VOXEL_SIZE_M, (level + 0.5) * VOXEL_SIZE_M, (z + 0.5) * VOXEL_SIZE_M


@pytest.fixture
def player(live_http: httpx.Client, street: tuple[float, float, float]) -> Iterator[str]:
    """The id of a player who stands in the street while a test lasts."""
    name = f"standing-{secrets.token_hex(4)}"
    assert live_http.post("/v1/players", json={"id": name, "path": [street], "speed": 0}).status_code == 201
    yield name
    live_http.delete(f"/v1/players/{name}")


@pytest.fixture(scope="session")
def moment() -> dict[str, Any]:
    return {"time": "12:00", "weather": "clear"}


@pytest.fixture(scope="session")
def place(http: httpx.Client) -> dict[str, Any]:
    """Query parameters of a point in the street, in the middle of the first probe's sector."""
    world = http.get("/v1/world").json()["bounds"]
    low, high = world["minimum"], world["maximum"]
    return {"x": (low[0] + high[0]) / 2, "y": low[1] + 10.0, "z": (low[2] + high[2]) / 2}


@pytest.fixture(scope="session")
def problem_of() -> Callable[[httpx.Response], dict[str, Any]]:
    """Checks that a reply is a whole problem document and returns it."""

    def check(reply: httpx.Response) -> dict[str, Any]:
        assert reply.headers["content-type"] == "application/problem+json", (reply.status_code, reply.text[:300])
        body: dict[str, Any] = json.loads(reply.content)
        assert body["status"] == reply.status_code
        assert all(body[name] for name in ("title", "code", "detail"))
        return body

    return check


@dataclass(frozen=True)
class Finished:
    """How a command ended."""

    returncode: int
    stdout: str
    stderr: str


@pytest.fixture
def sectorlight(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Callable[..., Finished]:
    """Runs the command line as its process would, in this one: starting Python for each refusal takes longer than the refusal."""

    def run(*arguments: str) -> Finished:
        monkeypatch.setattr(sys, "argv", ["sectorlight", *arguments])
        capfd.readouterr()
        with pytest.raises(SystemExit) as ended:
            main()
        out, err = capfd.readouterr()
        assert ended.value.code is None or isinstance(ended.value.code, int)
        return Finished(ended.value.code or 0, out, err)

    return run
