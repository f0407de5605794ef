"""A server that is killed and started again: who walks from the start is back, and so are the city's lamps and edits that were kept."""

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest

COMMAND = [sys.executable, "-c", "from server.cli import main; main()", "serve"]
STREET = [20.0, 1.6, 8.0]
WORLD = """
[[source]]
path = "block.obj"

[[lamp]]
name = "corner"
position = [20.0, 5.0, 8.0]
lumens = 8000.0

[[lamp]]
name = "gate"
position = [40.0, 5.0, 8.0]
lumens = 4000.0
"""
PLAYERS = """
[[player]]
id = "guard"
speed = 0.0
path = [[20.0, 1.6, 8.0]]
"""


def box(low: tuple[float, float, float], high: tuple[float, float, float], first: int) -> str:
    """A box as .obj, its vertices numbered from ``first``."""
    corners = [f"v {x} {y} {z}" for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return "\n".join([*corners, *(" ".join(["f", *(str(first + corner) for corner in face)]) for face in faces), ""])


@pytest.fixture(scope="module")
def lit_city(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of a house on a plot, with a lamp that its world.toml authored."""
    from bake_jobs.runner import bake

    folder = tmp_path_factory.mktemp("lit_city")
    (folder / "block.obj").write_text(box((1, -1, 1), (63, 0, 63), 1) + box((10, 0, 20), (30, 12, 50), 9))
    (folder / "world.toml").write_text(WORLD)
    bake(str(folder / "world.toml"), folder / "city", "draft", 1, None, 0, False)
    return folder / "city"


@contextmanager
def killed_in_the_end(city: Path, options: list[str], wait_until_live: Callable[[httpx.Client], None]) -> Iterator[httpx.Client]:
    """A server in a process of its own, whose world ticks; killed without a word when the block ends."""
    command = [*COMMAND, str(city), "--port", "0", "--tick-rate", "10", *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        try:
            assert process.stdout is not None
            address = process.stdout.readline().split()[-1]
            with httpx.Client(base_url=address, timeout=60, transport=httpx.HTTPTransport(retries=10)) as client:
                wait_until_live(client)
                yield client
        finally:
            process.kill()  # SIGKILL: nothing of it can be caught
    assert process.returncode == -9


def lights(http: httpx.Client) -> dict[str, dict[str, Any]]:
    return {light["id"]: light for light in http.get("/v1/lights").json()["lights"]}


def players(http: httpx.Client) -> set[str]:
    return {player["id"] for player in http.get("/v1/players").json()["players"]}


def test_after_a_kill_all_is_back_that_was_given_or_kept(
    lit_city: Path, tmp_path: Path, wait_until_live: Callable[[httpx.Client], None]
) -> None:
    (tmp_path / "players.toml").write_text(PLAYERS)
    state = tmp_path / "state.json"
    options = ["--players", str(tmp_path / "players.toml"), "--state", str(state)]
    walker = {"path": [STREET], "speed": 0}
    lantern = {"kind": "point", "position": STREET, "lumens": 500}
    with killed_in_the_end(lit_city, options, wait_until_live) as http:
        assert players(http) == {"guard"}
        assert {name: light["lumens"] for name, light in lights(http).items()} == {"corner": 8000, "gate": 4000}
        assert http.post("/v1/players", json={**walker, "id": "kept", "keep": True}).status_code == 201
        assert http.post("/v1/players", json={**walker, "id": "passing"}).status_code == 201
        assert http.post("/v1/lights", json={**lantern, "id": "kept", "keep": True}).status_code == 201
        assert http.post("/v1/lights", json={**lantern, "id": "passing"}).status_code == 201
        assert http.post("/v1/players", json={**walker, "id": "deleted", "keep": True}).status_code == 201
        assert http.delete("/v1/players/deleted").status_code == 200
        # The city's own lamp, changed and kept, takes the authored one's place.
        assert http.patch("/v1/lights/gate", json={"lumens": 9000, "keep": True}).status_code == 200
        # The last reply is the last thing that it does: what it has said is kept is on the disk.
        assert http.patch("/v1/lights/kept", json={"lumens": 600}).status_code == 200
    # What a kill in the middle of a write leaves beside the file.
    (tmp_path / "state.json.x.partial").write_bytes(state.read_bytes()[:20])
    with killed_in_the_end(lit_city, options, wait_until_live) as http:
        assert players(http) == {"guard", "kept"}
        assert {name: light["lumens"] for name, light in lights(http).items()} == {"corner": 8000, "gate": 9000, "kept": 600}
        assert {name for name, light in lights(http).items() if light["keep"]} == {"gate", "kept"}
        for name in ("guard", "kept"):
            reply = http.get(f"/v1/players/{name}/volume", params={"format": "raw"})
            assert reply.status_code == 200
            assert any(reply.content)


def test_a_state_file_that_was_cut_off_is_refused_and_left_alone(lit_city: Path, tmp_path: Path) -> None:
    """Never a start without what was to be kept, which the first edit would then overwrite."""
    whole = json.dumps({"players": [], "lights": [{"id": "a", "kind": "point", "position": STREET, "lumens": 5.0}]}, indent=1)
    state = tmp_path / "state.json"
    for size in (0, 1, len(whole) // 2, len(whole) - 1):
        state.write_text(whole[:size])
        done = subprocess.run(
            [*COMMAND, str(lit_city), "--port", "0", "--state", str(state)], check=False, capture_output=True, text=True, timeout=60
        )
        assert done.returncode == 2, done.stderr
        assert done.stderr.count("\n") == 1
        assert str(state) in done.stderr
        assert "expected JSON that a server wrote" in done.stderr
        assert state.read_text() == whole[:size]
