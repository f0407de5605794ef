"""How a server's live world starts, who may change it, and what of it is there again after a restart."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import pytest

from gi_core.errors import InputError
from server.app import create_app
from server.kept_edits import load_kept
from server.live import LiveOptions
from server.settings import Settings

Serving = Callable[..., Any]
ProblemOf = Callable[[httpx.Response], dict[str, Any]]
TOKEN = "a-token-of-some-length"


def running(http: httpx.Client) -> bool:
    return "sectorlight_live_running 1.0" in http.get("/metrics").text


def test_the_first_request_for_it_starts_the_live_world(
    city: Path, serving: Serving, problem_of: ProblemOf, wait_until_live: Callable[[httpx.Client], None]
) -> None:
    with serving(create_app(city, Settings(live=LiveOptions(ticks_per_second=10, start_time="09:30", start_weather="fog")))) as http:
        assert http.get("/v1/world").status_code == 200
        assert not running(http)
        reply = http.get("/v1/clock")
        assert (reply.status_code, problem_of(reply)["code"], reply.headers["retry-after"]) == (503, "live_unavailable", "1")
        wait_until_live(http)
        assert running(http)
        assert "T09:30:" in http.get("/v1/clock").json()["time"]
        assert http.get("/v1/weather").json()["now"]["text"] == "fog"


def test_a_write_waits_until_the_live_world_is_there(city: Path, serving: Serving) -> None:
    with serving(create_app(city, Settings())) as http:
        # On a machine that is slow to build kernels it is told to come back; it never fails.
        while (reply := http.put("/v1/clock", json={"rate": 2})).status_code == 503:
            assert reply.headers["retry-after"] == "1"
        assert reply.json()["rate"] == 2


def test_writes_want_the_token_and_reads_do_not(city: Path, tmp_path: Path, serving: Serving, problem_of: ProblemOf) -> None:
    (tmp_path / "token").write_text(TOKEN + "\n")
    with serving(create_app(city, Settings(token_file=tmp_path / "token"))) as http:
        writes = [
            ("PUT", "/v1/clock"),
            ("PUT", "/v1/weather"),
            ("PUT", "/v1/settings"),
            ("POST", "/v1/lights"),
            ("PATCH", "/v1/lights/a"),
            ("DELETE", "/v1/lights/a"),
            ("POST", "/v1/boxes"),
            ("PATCH", "/v1/boxes/a"),
            ("DELETE", "/v1/boxes/a"),
            ("POST", "/v1/players"),
            ("DELETE", "/v1/players/a"),
        ]
        for method, path in writes:
            for given in (None, "Bearer", "Bearer wrong", f"Basic {TOKEN}", f"Bearer {TOKEN}x", f"Bearer {TOKEN[:-1]}", "Bearer \xe9"):
                headers = {} if given is None else {"Authorization": given.encode("latin-1")}
                reply = http.request(method, path, headers=headers)
                assert (reply.status_code, problem_of(reply)["code"]) == (401, "unauthorized"), given
                assert reply.headers["www-authenticate"] == "Bearer"
        # A refused write has not even started the world.
        assert not running(http)
        right = {"Authorization": f"Bearer {TOKEN}"}
        assert http.put("/v1/clock", headers=right).status_code == 415
        assert http.put("/v1/clock", headers=right, content=b"[]").status_code == 415
        assert http.get("/v1/world").status_code == 200
        assert http.get("/metrics").status_code == 200
        assert http.get("/v1/clock").status_code in (200, 503)


def test_what_is_kept_is_there_after_a_restart(
    city: Path, tmp_path: Path, serving: Serving, street: tuple[float, ...], wait_until_live: Callable[[httpx.Client], None]
) -> None:
    options = LiveOptions(ticks_per_second=10, state_file=tmp_path / "state.json")
    kept = {"id": "kept", "path": [street], "speed": 0, "keep": True}
    lamp = {"id": "kept", "kind": "point", "position": list(street), "lumens": 500, "keep": True}
    box = {"id": "kept", "position": list(street), "half_size": [2, 1, 1], "keep": True}
    with serving(create_app(city, Settings(live=options))) as http:
        wait_until_live(http)
        authored = http.get("/v1/lights").json()["lights"][0]["id"]
        assert http.post("/v1/players", json=kept).status_code == 201
        assert http.post("/v1/players", json=kept | {"id": "passing", "keep": False}).status_code == 201
        assert http.post("/v1/players", json=kept | {"id": "deleted"}).status_code == 201
        assert http.delete("/v1/players/deleted").status_code == 200
        assert http.post("/v1/boxes", json=box).status_code == 201
        assert http.post("/v1/boxes", json=box | {"id": "passing", "keep": False}).status_code == 201
        assert http.patch("/v1/boxes/kept", json={"turned_degrees": 45}).status_code == 200
        assert http.post("/v1/lights", json=lamp).status_code == 201
        assert http.post("/v1/lights", json=lamp | {"id": "passing", "keep": False}).status_code == 201
        assert http.patch("/v1/lights/kept", json={"lumens": 600}).status_code == 200
        assert http.patch(f"/v1/lights/{authored}", json={"lumens": 7, "keep": True}).status_code == 200
    with serving(create_app(city, Settings(live=options))) as http:
        assert http.get("/v1/players").status_code in (200, 503)  # it started at once: somebody walks
        wait_until_live(http)
        assert [p["id"] for p in http.get("/v1/players").json()["players"]] == ["kept"]
        assert http.get("/v1/boxes").json()["boxes"] == [{**box, "turned_degrees": 45.0}]
        lights = {light["id"]: light["lumens"] for light in http.get("/v1/lights").json()["lights"]}
        assert lights["kept"] == 600
        assert lights[authored] == 7
        assert "passing" not in lights
        assert http.patch("/v1/lights/kept", json={"keep": False}).status_code == 200
        assert http.delete("/v1/players/kept").status_code == 200
    record = json.loads(options.state_file.read_text())
    assert record["players"] == []
    assert [light["id"] for light in record["lights"]] == [authored]
    # A file from before there were boxes is read as well.
    del record["boxes"]
    options.state_file.write_text(json.dumps(record))
    assert load_kept(options.state_file, None).boxes == ()


def test_clock_weather_and_settings_are_kept_where_they_ask_for_it(
    city: Path, tmp_path: Path, serving: Serving, wait_until_live: Callable[[httpx.Client], None]
) -> None:
    options = LiveOptions(ticks_per_second=10, state_file=tmp_path / "state.json", start_time="09:00")
    app = create_app(city, Settings(live=options))
    with serving(app) as http:
        wait_until_live(http)
        kept = http.put("/v1/clock", json={"time": "2026-03-01T21:30", "paused": True, "keep": True}).json()
        assert kept["keep"]
        assert http.put("/v1/weather", json={"weather": "rain"}).json()["keep"] is False
        assert http.put("/v1/weather", json={"keep": True}).json()["asked"] == {"weather": "rain"}
        assert http.put("/v1/weather", json={"weather": "fog:0.5", "blend_s": 600}).json()["keep"], "as it was"
        assert http.put("/v1/settings", json={"bounce_factor": 2.0, "keep": True}).status_code == 200
        assert http.put("/v1/settings", json={"keep": False}).json()["bounce_factor"] == 2.0
        assert http.put("/v1/settings", json={"sky_boost": [1, 2, 3], "keep": 1}).status_code == 400
        assert http.put("/v1/clock", json={"keep": False, "rate": 1e9}).status_code == 400
        assert http.put("/v1/clock", json={}).status_code == 400
    assert "settings" not in json.loads(options.state_file.read_text())
    app = create_app(city, Settings(live=options))
    with serving(app) as http:
        wait_until_live(http)
        clock, weather = http.get("/v1/clock").json(), http.get("/v1/weather").json()
        assert {**clock, "tick": 0} == {**kept, "tick": 0}
        assert (weather["asked"]["weather"], weather["keep"]) == (weather["now"]["text"], True)
        assert weather["now"]["fog_density"] > 0
        assert http.get("/v1/settings").json()["bounce_factor"] == 1.0
        assert http.put("/v1/settings", json={"sky_boost": [1, 2, 3], "keep": True}).status_code == 200
    with serving(create_app(city, Settings(live=options))) as http:
        wait_until_live(http)
        assert http.get("/v1/settings").json()["sky_boost"] == [1, 2, 3]


def test_a_state_file_that_would_be_too_large_to_read_again_is_left_as_it_was(
    city: Path, tmp_path: Path, serving: Serving, problem_of: ProblemOf, wait_until_live: Any, monkeypatch: pytest.MonkeyPatch, street: Any
) -> None:
    monkeypatch.setattr("server.kept_edits.MAX_FILE_BYTES", 2000)
    options = LiveOptions(ticks_per_second=10, state_file=tmp_path / "state.json")
    with serving(create_app(city, Settings(live=options))) as http:
        wait_until_live(http)
        player = {"id": "a", "path": [street], "speed": 0, "keep": True}
        assert http.post("/v1/players", json=player).status_code == 201
        before = options.state_file.read_bytes()
        reply = http.post("/v1/players", json=player | {"id": "b", "path": 100 * [street]})
        assert (reply.status_code, problem_of(reply)["code"]) == (507, "not_kept")
        assert options.state_file.read_bytes() == before


def test_nothing_is_kept_without_a_file_and_that_is_said(city: Path, serving: Serving, problem_of: ProblemOf, street: Any) -> None:
    with serving(create_app(city, Settings())) as http:
        replies = [http.post("/v1/players", json={"id": "a", "path": [street], "keep": True})]
        replies += [http.put(f"/v1/{part}", json={"keep": True}) for part in ("clock", "weather", "settings")]
        for reply in replies:
            assert reply.status_code == 400
            assert "--state" in problem_of(reply)["detail"]


def test_players_of_a_file_walk_from_the_start(city: Path, tmp_path: Path, serving: Serving, wait_until_live: Any, street: Any) -> None:
    players = tmp_path / "players.toml"
    players.write_text(f'[[player]]\nid = "guard"\nspeed = 0.0\npath = [{list(street)}]\n')
    app = create_app(city, Settings(live=LiveOptions(ticks_per_second=10, players_file=players)))
    with serving(app) as http:
        assert app.state.service.live.is_started
        wait_until_live(http)
        assert [p["id"] for p in http.get("/v1/players").json()["players"]] == ["guard"]
        assert http.get("/v1/players/guard/volume").status_code == 200


BAD_OPTIONS: list[tuple[list[str], str]] = [
    (["--players", "FOLDER/none.json"], "none.json"),
    (["--players", "FOLDER/bad.json"], "bad.json"),
    (["--state", "FOLDER"], "--state"),
    (["--state", "FOLDER/nowhere/state.json"], "--state"),
    (["--state", "FOLDER/bad.json"], "bad.json"),
    (["--epw", "FOLDER/bad.json"], "bad.json"),
    (["--time", "25:99"], "25:99"),
    (["--weather", "plague"], "plague"),
]


@pytest.mark.parametrize(("options", "named"), BAD_OPTIONS, ids=[" ".join(options) for options, _ in BAD_OPTIONS])
def test_a_bad_option_is_one_clear_line(
    city: Path, tmp_path: Path, sectorlight: Callable[..., Any], options: list[str], named: str
) -> None:
    (tmp_path / "bad.json").write_text("{")
    done = sectorlight("serve", str(city), "--port", "0", *(part.replace("FOLDER", str(tmp_path)) for part in options))
    assert done.returncode == 2
    line = done.stderr.strip()
    assert "\n" not in line
    assert named in line


def test_options_out_of_range_are_refused(city: Path, sectorlight: Callable[..., Any]) -> None:
    ranges = {"--tick-rate": ("0", "1000", "fast"), "--budget-mb": ("1",), "--sectors-per-tick": ("1", "65")}
    for options in ((name, value) for name, values in ranges.items() for value in values):
        assert sectorlight("serve", str(city), "--port", "0", *options).returncode == 2


def test_options_come_from_the_environment_too(city: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "server.cli", "serve", str(city), "--port", "0"],
        check=False,
        env={**os.environ, "SECTORLIGHT_WEATHER": "plague"},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 2
    assert "plague" in done.stderr


def test_a_state_file_that_cannot_be_written_is_known_at_the_start(tmp_path: Path, city: Path) -> None:
    with pytest.raises(InputError, match="--state"):
        create_app(city, Settings(live=LiveOptions(state_file=tmp_path / "none" / "state.json")))
