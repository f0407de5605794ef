"""A player's latest volume: the same layout as a query's, asked for again only when there is a later one."""

import io
import json
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import httpx
import numpy as np
import pytest

PATIENCE_S = 20.0
NOON = "2024-06-21T12:00"
# The live world's sunlight comes from a shadow map where a query's comes from baked directions: without a sun both are alike.
SUNLESS = "overcast:cloud_cover=1.0"


@pytest.fixture
def settled(live_http: httpx.Client, player: str) -> Iterator[str]:
    """A player in a world that stands still and whose light has settled: no new volume comes."""
    live_http.put("/v1/weather", json={"weather": SUNLESS})
    live_http.put("/v1/clock", json={"time": NOON, "paused": True})
    deadline, last, since = time.monotonic() + PATIENCE_S, "", time.monotonic()
    while time.monotonic() - since < 1.0:
        assert time.monotonic() < deadline, "the light did not settle"
        tick = live_http.get(f"/v1/players/{player}/volume", params={"mask": 1}).headers["gi-tick"]
        if tick != last:
            last, since = tick, time.monotonic()
        time.sleep(0.05)
    yield player
    live_http.put("/v1/clock", json={"paused": False})


def test_a_settled_volume_is_the_query_s(live_http: httpx.Client, settled: str, street: tuple[float, float, float]) -> None:
    x, y, z = street
    query = {"time": NOON, "weather": SUNLESS, "x": x, "y": y, "z": z}
    for parameters in ({}, {"mask": 1}, {"format": "raw"}, {"format": "ktx2"}, {"format": "ktx2", "encoding": "rgb9e5"}):
        live = live_http.get(f"/v1/players/{settled}/volume", params=parameters)
        asked = live_http.get("/v1/volume", params=query | parameters)
        facts, expected = json.loads(live.headers["gi-volume"]), json.loads(asked.headers["gi-volume"])
        assert (facts["origin"], facts["shape"], facts["dtype"]) == (expected["origin"], expected["shape"], expected["dtype"])
        assert live.headers["content-type"] == asked.headers["content-type"]
        assert live.content == asked.content


def test_nothing_newer_is_304(live_http: httpx.Client, settled: str) -> None:
    path = f"/v1/players/{settled}/volume"
    first = live_http.get(path)
    tick = int(first.headers["gi-tick"])
    for reply in (
        live_http.get(path, params={"since": tick}),
        live_http.get(path, params={"since": tick + 1}),
        live_http.get(path, headers={"If-None-Match": first.headers["etag"]}),
        live_http.get(path, headers={"If-None-Match": "*"}),
    ):
        assert (reply.status_code, reply.content, reply.headers["etag"]) == (304, b"", first.headers["etag"])
    assert live_http.get(path, params={"since": tick - 1}).content == first.content
    # A tick that is yet to come is one of another run of the server.
    assert live_http.get(path, params={"since": tick + 10**9}).status_code == 200
    live_http.put("/v1/clock", json={"time": "17:00"})
    deadline = time.monotonic() + PATIENCE_S
    while (later := live_http.get(path, params={"since": tick})).status_code == 304:
        assert time.monotonic() < deadline
    assert int(later.headers["gi-tick"]) > tick
    assert later.headers["etag"] != first.headers["etag"]


def test_many_readers_cost_one_encoding(live_http: httpx.Client, settled: str) -> None:
    def encoded() -> int:
        return live_http.get("/v1/live").json()["cache"]["player_volume_misses"]

    before = encoded()
    with ThreadPoolExecutor(8) as readers:
        replies = list(readers.map(lambda _: live_http.get(f"/v1/players/{settled}/volume", params={"format": "raw"}), range(24)))
    assert {reply.status_code for reply in replies} == {200}
    assert len({reply.content for reply in replies}) == 1
    assert encoded() == before + 1


def timing(reply: httpx.Response) -> dict[str, float]:
    """The parts of a reply's Server-Timing [ms], in their order."""
    parts = [part.partition(";dur=") for part in reply.headers["server-timing"].split(", ")]
    return {name: float(value) for name, _, value in parts}


def test_what_took_how_long_is_told_where_something_was_computed(live_http: httpx.Client, settled: str) -> None:
    assert list(timing(live_http.get(f"/v1/players/{settled}/volume"))) == ["wait", "encode", "total"]
    query = {"time": "12:34", "weather": "fog:0.123", "x": 32, "y": 5, "z": 32}
    first = live_http.get("/v1/volume", params=query)
    parts = timing(first)
    assert list(parts) == ["light", "relight", "encode", "total"]
    assert 0 < sum(parts.values()) - parts["total"] <= parts["total"]
    again = [live_http.get("/v1/volume", params=query) for _ in range(2)]
    # The second answer to be given from the same reply must not have the first one's line as well.
    assert all(reply.content == first.content and list(timing(reply)) == ["total"] for reply in again)
    assert list(timing(live_http.get("/v1/lighting", params={"time": "12:34", "weather": "fog:0.321"}))) == ["compute", "total"]


def test_every_reply_tells_its_total(live_http: httpx.Client, settled: str) -> None:
    paths = ["/", "/healthz", "/metrics", "/v1/world", "/v1/clock", "/v1/weather", "/v1/settings", "/v1/lights", "/v1/players", "/v1/live"]
    for path in (*paths, f"/v1/players/{settled}", "/v1/players/nobody", "/nowhere", "/v1/volume?x=a"):
        assert timing(live_http.get(path))["total"] >= 0, path
    etag = live_http.get("/v1/world").headers["etag"]
    for reply in (
        live_http.get("/v1/world", headers={"If-None-Match": etag}),
        live_http.head("/v1/clock"),
        live_http.put("/v1/clock", json={}),
        live_http.post("/v1/players", json={"id": settled}),
    ):
        assert timing(reply)["total"] > 0, reply.request


def test_voxels_that_a_box_belies_are_told(live_http: httpx.Client, settled: str, street: tuple[float, float, float]) -> None:
    path = f"/v1/players/{settled}/volume"
    assert "gi-boxes" not in live_http.get(path).headers
    free = live_http.get(path, params={"stale": 1})
    facts = json.loads(free.headers["gi-volume"])
    assert (facts["unit"], facts["dtype"], facts["boxes"], facts["shape"]) == ("share", "uint8", 0, [16, 32, 32])
    assert not read_npy(free).any()
    live_http.post("/v1/boxes", json={"id": "bus", "position": list(street), "half_size": [6, 2, 6]})
    try:
        assert live_http.get(path).headers["gi-boxes"] == "1"
        share = read_npy(live_http.get(path, params={"stale": 1}))
        assert share[8, 16, 16] == 255  # in the bus
        assert 0 < np.count_nonzero(share) < share.size
        raw = live_http.get(path, params={"stale": 1, "format": "raw"})
        assert (raw.content, raw.headers["cache-control"]) == (share.tobytes(), "no-store")
        refused = live_http.get(path, params={"stale": 1, "mask": 1})
        assert (refused.status_code, refused.headers["content-type"]) == (400, "application/problem+json")
    finally:
        live_http.delete("/v1/boxes/bus")
    assert "gi-boxes" not in live_http.get(path).headers


def read_npy(reply: httpx.Response) -> np.ndarray:
    return np.load(io.BytesIO(reply.content))
