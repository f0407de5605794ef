"""The live world over HTTP: what is told takes effect in the tick that the reply names, and bad input changes nothing."""

import io
import json
import time
from collections.abc import Callable, Iterator
from datetime import datetime
from typing import Any

import httpx
import numpy as np
import pytest
from fastapi import FastAPI
from serving import until

ProblemOf = Callable[[httpx.Response], dict[str, Any]]


@pytest.fixture
def still(live_http: httpx.Client) -> Iterator[None]:
    """The clock stands at noon of a clear day."""
    live_http.put("/v1/weather", json={"weather": "clear"})
    live_http.put("/v1/clock", json={"time": "12:00", "rate": 1, "paused": True})
    yield
    live_http.put("/v1/clock", json={"paused": False})


def light_at(http: httpx.Client, player: str) -> np.ndarray:
    reply = http.get(f"/v1/players/{player}/volume")
    assert reply.status_code == 200, reply.text
    return np.load(io.BytesIO(reply.content))


def test_a_command_holds_from_the_tick_that_its_reply_names(live_http: httpx.Client) -> None:
    before = live_http.get("/v1/clock").json()["tick"]
    jumped = live_http.put("/v1/clock", json={"time": "2024-03-01T06:00", "rate": 60, "paused": False}).json()
    assert jumped["time"].startswith("2024-03-01T06:00:00")
    assert jumped["tick"] > before
    later = until(lambda: (now := live_http.get("/v1/clock").json())["tick"] > jumped["tick"] + 5 and now)
    passed = datetime.fromisoformat(later["time"]) - datetime.fromisoformat(jumped["time"])
    # To the microsecond, however late ticks are: the clock is a law of the tick's number.
    assert passed.total_seconds() == pytest.approx((later["tick"] - jumped["tick"]) / 20 * 60, abs=1e-6)


def test_a_live_world_says_how_late_it_is(live_http: httpx.Client) -> None:
    said = live_http.get("/v1/live").json()
    late = said["lateness_ms"]
    assert 0 < late["p50"] <= late["p99"] <= late["max"]  # no thread is woken without a delay
    assert 0 <= said["late_ticks"] <= said["ticks"] <= said["tick"] + 1
    # Each number is a tick that was made, that failed or that was skipped, but for the one that is under way.
    assert said["tick"] <= said["ticks"] + said["failed_ticks"] + said["skipped"] <= live_http.get("/v1/live").json()["tick"] + 1
    metrics = live_http.get("/metrics").text
    assert {"sectorlight_late_ticks_total", "sectorlight_skipped_ticks_total"} <= {line.split()[0] for line in metrics.splitlines()}


def test_a_paused_clock_stands_and_goes_on(live_http: httpx.Client, still: None) -> None:
    first = live_http.get("/v1/clock").json()
    second = until(lambda: (now := live_http.get("/v1/clock").json())["tick"] > first["tick"] and now)
    assert (second["time"], second["paused"]) == (first["time"], True)
    assert live_http.put("/v1/clock", json={"paused": False}).json()["time"] == first["time"]
    until(lambda: live_http.get("/v1/clock").json()["time"] > first["time"])


def test_jumps_are_counted_and_gentle_changes_are_not(live_http: httpx.Client) -> None:
    def jumps() -> int:
        return live_http.get("/v1/live").json()["jumps"]

    start = jumps()
    live_http.put("/v1/clock", json={"rate": 2})
    live_http.put("/v1/weather", json={"weather": "fog", "blend_s": 60})
    assert jumps() == start
    live_http.put("/v1/clock", json={"time": "08:00", "rate": 1})
    live_http.put("/v1/weather", json={"weather": "clear"})
    live_http.put("/v1/settings", json={"sky_factor": 1.0})
    assert jumps() == start + 3


def test_weather_turns_into_another_without_a_jump(live_http: httpx.Client) -> None:
    live_http.put("/v1/weather", json={"weather": "clear"})
    live_http.put("/v1/clock", json={"time": "12:00", "rate": 60, "paused": False})
    told = live_http.put("/v1/weather", json={"weather": "overcast", "blend_s": 120}).json()
    assert told["asked"] == {"weather": "overcast"}
    # It begins where it was, in the tick in which it was asked for: that has its light a few ticks later.
    assert 0 <= told["now"]["cloud_cover"] < 0.1
    covers, ticks = [told["now"]["cloud_cover"]], [told["tick"]]
    while covers[-1] < 1:
        time.sleep(0.01)  # the blend takes two seconds, in which a quick machine would ask a thousand times
        now = live_http.get("/v1/weather").json()
        covers.append(now["now"]["cloud_cover"])
        ticks.append(now["tick"])
        assert len(covers) < 1000
    steps = np.diff(covers)
    assert (steps >= 0).all()
    # 120 s of the world are 40 ticks; a smooth step is at most 1.5 times as steep as a straight line.
    assert (steps <= np.diff(ticks) * 1.5 / 40 + 1e-9).all()


def test_the_present_weather_s_text_gives_the_same_light_to_a_query(live_http: httpx.Client, still: None) -> None:
    live_http.put("/v1/weather", json={"script_seed": 3})
    now = live_http.get("/v1/weather").json()
    assert now["asked"] == {"script_seed": 3}
    reply = live_http.get("/v1/lighting", params={"time": "12:00", "weather": now["now"]["text"]})
    assert reply.json()["snow"] == now["now"]["snow"]


def test_settings_change_one_by_one(live_http: httpx.Client) -> None:
    changed = live_http.put("/v1/settings", json={"bounce_factor": 2, "sky_boost": [1, 2, 3]}).json()
    assert (changed["bounce_factor"], changed["sky_boost"], changed["sun_factor"]) == (2.0, [1.0, 2.0, 3.0], 1.0)
    kept = live_http.put("/v1/settings", json={"bounce_factor": 1}).json()
    assert (kept["bounce_factor"], kept["sky_boost"]) == (1.0, [1.0, 2.0, 3.0])
    live_http.put("/v1/settings", json={"sky_boost": [0, 0, 0]})


def test_a_light_that_moves_changes_what_a_player_sees(
    live_http: httpx.Client, still: None, player: str, street: tuple[float, ...]
) -> None:
    live_http.put("/v1/clock", json={"time": "23:30"})
    x, y, z = street
    lamp = {"id": "moving", "kind": "point", "position": [x, y, z], "lumens": 0, "range_m": 20, "dynamic": True}
    assert live_http.post("/v1/lights", json=lamp).status_code == 201
    before = until(lambda: (now := light_at(live_http, player).sum()) < 1e7 and now)  # the day's light is gone: a hundred times as much
    live_http.patch("/v1/lights/moving", json={"lumens": 1e7})
    bright = until(lambda: (now := light_at(live_http, player).sum()) > before * 1.5 and now)
    for step in range(5):
        moved = live_http.patch("/v1/lights/moving", json={"position": [x + step, y, z]}).json()
        assert moved["position"] == [x + step, y, z]
        assert moved["lumens"] == 1e7
    gone = live_http.delete("/v1/lights/moving").json()
    assert gone["id"] == "moving"
    until(lambda: light_at(live_http, player).sum() < bright * 0.8)
    assert live_http.get("/v1/lights/moving").status_code == 404


def test_a_box_beside_a_lit_place_shades_it(
    live_app: FastAPI, live_http: httpx.Client, still: None, player: str, street: tuple[float, ...]
) -> None:
    residents = live_app.state.service.live.ticker.world.streamer.residents

    def brightness() -> float:
        """What arrives from below, a metre or two around the player: the sun's, off the street."""
        return float(light_at(live_http, player)[3, 7:9, 15:17, 15:17].mean())

    def settled() -> float | None:
        seen = [brightness()]
        for _ in range(4):
            time.sleep(0.2)
            seen.append(brightness())
        by_map = residents and all(sector.sampled_of for sector in residents.values())
        return seen[0] if by_map and max(seen) == min(seen) else None

    live_http.put("/v1/clock", json={"time": "2024-06-21T13:00"})  # high enough for the street
    before = until(settled)
    to_sun = np.array(live_http.get("/v1/lighting", params={"time": "2024-06-21T13:00", "weather": "clear"}).json()["sun"]["direction"])
    beside = np.array(street) + 25 * to_sun
    box = {"id": "truck", "position": beside.tolist(), "half_size": [12, 4, 12]}
    made = live_http.post("/v1/boxes", json=box)
    assert (made.status_code, made.headers["location"]) == (201, "/v1/boxes/truck")
    assert made.json() == {**box, "turned_degrees": 0.0, "keep": False, "tick": made.json()["tick"]}
    shaded = until(lambda: (now := brightness()) < 0.7 * before and now)
    assert live_http.get("/v1/live").json()["tick"] - made.json()["tick"] < 100  # five on a machine with nothing else to do
    # Driven away, it takes its shadow along.
    away = beside + np.array([0.0, 0.0, 300.0])
    moved = live_http.patch("/v1/boxes/truck", json={"position": away.tolist()}).json()
    assert (moved["half_size"], moved["position"]) == ([12, 4, 12], away.tolist())
    until(lambda: brightness() > shaded + 0.5 * (before - shaded))
    assert until(settled) == before
    assert [b["id"] for b in live_http.get("/v1/boxes").json()["boxes"]] == ["truck"]
    assert live_http.delete("/v1/boxes/truck").json()["id"] == "truck"
    assert live_http.get("/v1/boxes").json()["boxes"] == []


def test_lamps_of_the_dataset_are_there_and_can_be_changed(live_http: httpx.Client) -> None:
    lamps = live_http.get("/v1/lights").json()["lights"]
    assert lamps
    name = lamps[0]["id"]
    one = live_http.get(f"/v1/lights/{name}").json()
    one.pop("tick")
    assert one == lamps[0]
    assert live_http.patch(f"/v1/lights/{name}", json={"lumens": 1}).json()["lumens"] == 1
    live_http.patch(f"/v1/lights/{name}", json={"lumens": one["lumens"]})


def test_a_player_walks(live_http: httpx.Client, street: tuple[float, ...]) -> None:
    x, y, z = street
    made = live_http.post("/v1/players", json={"speed": 2, "path": [[x, y, z], [x + 100, y, z]]})
    assert made.status_code == 201
    first = made.json()
    assert made.headers["location"] == f"/v1/players/{first['id']}"
    assert (first["position"], first["velocity"], first["since_tick"]) == ([x, y, z], [2, 0, 0], first["tick"])
    later = until(lambda: (now := live_http.get(made.headers["location"]).json())["tick"] > first["tick"] + 3 and now)
    assert later["position"][0] - x == pytest.approx(2 * (later["tick"] - first["tick"]) / 20)
    assert later["path"] == [[x, y, z], [x + 100, y, z]]
    listed = live_http.get("/v1/players").json()["players"]
    assert "path" not in next(p for p in listed if p["id"] == first["id"])
    assert live_http.delete(made.headers["location"]).status_code == 200
    assert live_http.get(made.headers["location"]).status_code == 404


def test_a_player_without_a_path_walks_the_streets(live_http: httpx.Client) -> None:
    made = live_http.post("/v1/players", json={"id": "stroller", "seed": 5, "walk_m": 200}).json()
    assert made["path"] is None
    assert made["speed"] == 1.4
    live_http.delete("/v1/players/stroller")


REFUSED: list[tuple[str, str, Any, str]] = [
    ("PUT", "/v1/clock", {}, "time, rate, paused"),
    ("PUT", "/v1/clock", {"time": "25:99"}, "25:99"),
    ("PUT", "/v1/clock", {"rate": 1e9}, "rate"),
    ("PUT", "/v1/clock", {"rate": float("nan")}, "rate"),
    ("PUT", "/v1/clock", {"paused": 1}, "paused"),
    ("PUT", "/v1/clock", {"speed": 1}, "speed"),
    ("PUT", "/v1/weather", {"weather": "plague"}, "plague"),
    ("PUT", "/v1/weather", {"weather": "clear", "script_seed": 1}, "script_seed"),
    ("PUT", "/v1/weather", {"measured": True}, "--epw"),
    ("PUT", "/v1/weather", {"weather": "fog", "blend_s": -1}, "blend_s"),
    ("PUT", "/v1/settings", {}, "bounce_factor"),
    ("PUT", "/v1/settings", {"bounce_factor": None}, "bounce_factor"),
    ("PUT", "/v1/settings", {"sky_boost": [1, 2]}, "sky_boost"),
    ("PUT", "/v1/settings", {"sun_factor": -1}, "sun_factor"),
    ("POST", "/v1/lights", {"kind": "point"}, "position"),
    ("POST", "/v1/lights", {"kind": "moon", "position": [0, 0, 0], "lumens": 1}, "kind"),
    ("POST", "/v1/lights", {"id": "a b", "kind": "point", "position": [0, 0, 0], "lumens": 1}, "id"),
    ("POST", "/v1/boxes", {"position": [0, 0, 0]}, "half_size"),
    ("POST", "/v1/boxes", {"position": [0, 1e9, 0], "half_size": [1, 1, 1]}, "position"),
    ("POST", "/v1/boxes", {"position": [0, 0, 0], "half_size": [1, 0, 1]}, "half_size"),
    ("POST", "/v1/boxes", {"position": [0, 0, 0], "half_size": [1, 1, 1], "turned_degrees": float("nan")}, "turned_degrees"),
    ("POST", "/v1/boxes", {"id": "", "position": [0, 0, 0], "half_size": [1, 1, 1]}, "id"),
    ("POST", "/v1/players", {"path": []}, "path"),
    ("POST", "/v1/players", {"path": "players.json"}, "path"),
    ("POST", "/v1/players", {"speed": 1000}, "speed"),
    ("POST", "/v1/players", {"keep": "yes"}, "keep"),
]


@pytest.mark.parametrize(("method", "path", "body", "named"), REFUSED, ids=[f"{m} {p} {n}" for m, p, _, n in REFUSED])
def test_bad_bodies_are_named_alike_and_change_nothing(
    live_http: httpx.Client, problem_of: ProblemOf, still: None, method: str, path: str, body: Any, named: str
) -> None:
    def state() -> list[Any]:
        found = [live_http.get(f"/v1/{name}").json() for name in ("clock", "weather", "settings", "lights", "boxes", "players")]
        for reply in found:
            reply.pop("tick")
        return found

    before = state()
    content, headers = json.dumps(body), {"Content-Type": "application/json"}
    replies = [live_http.request(method, path, content=content, headers=headers) for _ in range(2)]
    assert [reply.status_code for reply in replies] == [400, 400]
    assert named in problem_of(replies[0])["detail"]
    assert problem_of(replies[0]) == problem_of(replies[1])
    assert state() == before


def test_ids_that_are_not_there_or_taken(live_http: httpx.Client, problem_of: ProblemOf, player: str, street: tuple[float, ...]) -> None:
    for method, path in (
        ("GET", "/v1/players/no"),
        ("DELETE", "/v1/players/no"),
        ("GET", "/v1/players/no/volume"),
        ("GET", "/v1/lights/no"),
        ("GET", "/v1/boxes/no"),
        ("DELETE", "/v1/boxes/no"),
    ):
        reply = live_http.request(method, path)
        assert (reply.status_code, problem_of(reply)["code"]) == (404, "no_such_id")
    reply = live_http.patch("/v1/lights/no", json={"lumens": 1})
    assert (reply.status_code, problem_of(reply)["code"]) == (404, "no_such_id")
    reply = live_http.patch("/v1/boxes/no", json={"position": [0, 0, 0]})
    assert (reply.status_code, problem_of(reply)["code"]) == (404, "no_such_id")
    reply = live_http.post("/v1/players", json={"id": player, "path": [street]})
    assert (reply.status_code, problem_of(reply)["code"]) == (409, "id_taken")


def test_bodies_that_are_no_small_json_objects(live_http: httpx.Client, problem_of: ProblemOf) -> None:
    def put(content: Any, kind: str | None = "application/json") -> str:
        reply = live_http.put("/v1/clock", content=content, headers={"Content-Type": kind} if kind else {})
        return f"{reply.status_code} {problem_of(reply)['code']}"

    def endless() -> Iterator[bytes]:
        for _ in range(1 << 12):
            yield b" " * 1024

    assert put(b"{}", "text/plain") == put(b"{}", None) == put(b"a=b", "application/x-www-form-urlencoded") == "415 not_json"
    assert put(b"{") == put(b"[]") == put(b"1") == put(b"") == put(b"\xff") == put(b"[" * 100_000) == "400 bad_input"
    assert put(b" " * (1 << 21)) == "413 body_too_large"
    assert put(endless()) == "413 body_too_large"
    assert live_http.put("/v1/clock", json={"rate": 1}, params={"x": 1}).status_code == 400


def test_live_says_how_ticks_go(live_http: httpx.Client, player: str) -> None:
    live_http.get(f"/v1/players/{player}/volume")
    first = live_http.get("/v1/live").json()
    later = until(lambda: (now := live_http.get("/v1/live").json())["tick"] > first["tick"] and now)
    assert later["tick_rate"] == 20
    assert later["ticks"] > first["ticks"] > 0
    assert later["failed_ticks"] == 0
    assert later["failure"] is None
    assert later["tick_ms"]["max"] >= later["tick_ms"]["p99"] >= later["tick_ms"]["p50"] > 0
    assert set(later["parts_ms"]) == {"light", "stream", "relight", "shadow_map", "volumes"}
    assert later["players"] >= 1
    assert later["memory_bytes"] > 1 << 20


def test_live_tells_of_each_tick_to_who_asks_again(live_http: httpx.Client, player: str) -> None:
    known = live_http.get("/v1/live").json()["tick"] - 1
    told: list[int] = []
    while len(told) < 20:
        recent = live_http.get("/v1/live", params={"since": told[-1] if told else known}).json()["recent"]
        assert len(recent["tick"]) == len(recent["ms"]) == len(recent["lateness_ms"])
        assert all(ms > 0 for ms in recent["ms"])
        assert all(ms >= 0 for ms in recent["lateness_ms"])
        told += recent["tick"]
        time.sleep(0.12)
    assert told[0] > known
    assert told == sorted(set(told))
    live = live_http.get("/v1/live", params={"since": told[0] - 1}).json()
    assert live["recent"]["tick"][: len(told)] == told  # none was left out between two answers
    assert live_http.get("/v1/live").json()["recent"] is None
    assert live_http.get("/v1/live", params={"since": -2}).status_code == 400


def test_metrics_say_the_same(live_http: httpx.Client, player: str) -> None:
    live_http.get(f"/v1/players/{player}/volume")
    live_http.get("/v1/players/nobody")
    live_http.request("BREW", "/v1/clock")
    for _ in range(3):  # the second and third are answered before any route is looked for
        live_http.get("/v1/sky", params={"time": "07:17", "weather": "haze"})
    text = live_http.get("/metrics")
    assert text.headers["content-type"].startswith("text/plain")
    found = {line.rpartition(" ")[0]: float(line.rpartition(" ")[2]) for line in text.text.splitlines() if not line.startswith("#")}
    assert found['sectorlight_http_requests_total{method="GET",route="/v1/players/{id}",status="404"}'] >= 1
    assert found['sectorlight_http_requests_total{method="GET",route="/v1/players/{id}/volume",status="200"}'] >= 1
    assert found['sectorlight_http_requests_total{method="GET",route="/v1/sky",status="200"}'] == 3
    assert not any("BREW" in name or "nobody" in name for name in found)
    assert found["sectorlight_live_running"] == 1
    assert found["sectorlight_players"] >= 1
    assert found['sectorlight_tick_seconds_bucket{le="+Inf"}'] == found["sectorlight_tick_seconds_count"] > 0
    assert found["sectorlight_tick_seconds_sum"] > 0
    assert abs(found["sectorlight_ticks_total"] - found["sectorlight_tick_seconds_count"]) <= 1
