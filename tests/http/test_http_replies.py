"""Every route's good answer, read as a client reads it."""

import io
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from PIL import Image

from gi_core import distant_file
from gi_core.constants import VOLUME_SHAPE, VOXEL_SIZE_M
from server.app import create_app
from server.live_state import MAX_BOXES, MAX_LAMPS
from server.players import MAX_PLAYERS
from server.settings import Settings

LIGHTS = {"": {}, "sky": {"light": "sky"}, "full": {"light": "full"}}
FROM_ABOVE = {"eye": "0,120,0", "look": "60,0,60", "width": 64, "distant": "client"}


def array(reply: httpx.Response) -> np.ndarray:
    assert reply.status_code == 200, reply.text[:300]
    return np.load(io.BytesIO(reply.content), allow_pickle=False)


def test_the_process_is_alive_and_ready(http: httpx.Client) -> None:
    assert http.get("/healthz").json() == {"status": "alive"}
    ready = http.get("/readyz")
    assert ready.status_code == 200
    assert ready.json()["status"] == "ready"
    assert ready.json()["device"]


def test_the_api_documents_every_route(http: httpx.Client) -> None:
    paths = set(http.get("/openapi.json").json()["paths"])
    assert paths >= {"/healthz", "/readyz", "/v1/world", "/v1/lighting", "/v1/sky", "/v1/volume", "/v1/distant", "/v1/sectors"}
    assert paths >= {"/v1/sectors/{x},{z}", "/v1/probes", "/v1/decals", "/v1/decals/gradient.png", "/v1/preview.png"}
    page = http.get("/docs").text
    assert all(f" {path}</h2>" in page for path in paths)


@pytest.mark.parametrize("path", ["/", "/docs"])
def test_pages_load_nothing_from_elsewhere(http: httpx.Client, path: str) -> None:
    """They work where there is no internet, and nobody else's script runs beside a token of writes."""
    page = http.get(path)
    assert page.headers["content-type"].startswith("text/html")
    assert not re.search(r"(src|href)=.?(https?:)?//", page.text)


def test_the_viewer_has_its_files(http: httpx.Client) -> None:
    page = http.get("/")
    for name in ("viewer.js", "viewer.css"):
        assert f'"viewer/{name}"' in page.text
        file = http.get(f"/viewer/{name}")
        assert (file.status_code, file.headers["cache-control"]) == (200, "no-cache")
        assert http.get(f"/viewer/{name}", headers={"If-None-Match": file.headers["etag"]}).status_code == 304


def test_the_world_says_what_may_be_asked(http: httpx.Client) -> None:
    world = http.get("/v1/world").json()
    assert {"clear", "partly_cloudy", "overcast"} <= set(world["weather"])
    assert (np.array(world["bounds"]["minimum"]) < world["bounds"]["maximum"]).all()
    assert world["sectors"]["count"] == len(http.get("/v1/sectors").json()["sectors"]) > 0
    assert world["sectors"]["size_m"] == 64
    assert world["dataset"]["digest"] == http.get("/readyz").json()["dataset"]
    limits = world["limits"]
    assert (limits["players"], limits["lights"], limits["boxes"]) == (MAX_PLAYERS, MAX_LAMPS, MAX_BOXES)
    too_long = http.put("/v1/clock", content=b" " * (limits["body_bytes"] + 1), headers={"Content-Type": "application/json"})
    assert too_long.status_code == 413


def test_every_weather_that_the_world_lists_gives_light(http: httpx.Client) -> None:
    for weather in http.get("/v1/world").json()["weather"]:
        light = http.get("/v1/lighting", params={"time": "12:00", "weather": weather})
        assert light.status_code == 200
        assert max(light.json()["sky_cube"][2]) > 100


def test_lighting_has_the_contract_s_fields(http: httpx.Client, moment: dict[str, Any]) -> None:
    light = http.get("/v1/lighting", params=moment).json()
    assert set(light) == {"time", "weather", "sun", "moon", "sky_cube", "snow", "fog", "exposure"}
    for name in ("sun", "moon"):
        assert np.linalg.norm(light[name]["direction"]) == pytest.approx(1, abs=1e-6)
        assert np.shape(light[name]["irradiance"]) == (3,)
    assert np.shape(light["sky_cube"]) == (6, 3)


def test_the_sky_integrates_to_the_sky_cube(http: httpx.Client, moment: dict[str, Any]) -> None:
    sky = array(http.get("/v1/sky", params=moment))
    assert sky.shape == (64, 128, 3)
    assert sky.dtype == np.float32
    assert (sky[:32] > 0).all()
    assert not sky[32:].any()
    polar = np.pi * (np.arange(64) + 0.5) / 64
    weight = np.sin(polar) * np.maximum(np.cos(polar), 0) * (np.pi / 64) * (2 * np.pi / 128)
    up = http.get("/v1/lighting", params=moment).json()["sky_cube"][2]
    # rtol 1e-3: midpoint rule over rows of 2.8 degrees
    np.testing.assert_allclose((sky * weight[:, None, None]).sum((0, 1)), up, rtol=1e-3)


def test_a_volume_is_where_its_header_says(http: httpx.Client, moment: dict[str, Any], place: dict[str, Any]) -> None:
    reply = http.get("/v1/volume", params={**moment, **place})
    values, facts = array(reply), json.loads(reply.headers["Gi-Volume"])
    assert values.shape == (6, *VOLUME_SHAPE, 3) == tuple(facts["shape"])
    assert values.dtype == np.float32
    assert np.isfinite(values).all()
    assert (values >= 0).all()
    assert (facts["basis"], facts["unit"], facts["scale"]) == ("cube", "lx", 1.0)
    assert facts["voxel_size"] == [VOXEL_SIZE_M] * 3
    assert facts["sectors"]
    assert 0 < facts["valid"] <= 1
    assert 0 <= float(reply.headers["Gi-Residual"]) <= 1e-5
    origin = np.array(facts["origin"])
    centre = origin + VOXEL_SIZE_M * (np.array([32, 16, 32]) - 1) / 2
    assert (np.abs(centre - [place["x"], place["y"], place["z"]]) <= VOXEL_SIZE_M).all()
    # The lattice's centres are at (i + 0.5) voxels; 3.125 and these indices are exact in binary.
    assert ((origin / VOXEL_SIZE_M - 0.5) % 1 == 0).all()


def test_the_mask_counts_what_the_header_calls_valid(http: httpx.Client, moment: dict[str, Any], place: dict[str, Any]) -> None:
    reply = http.get("/v1/volume", params={**moment, **place, "mask": 1})
    mask, facts = array(reply), json.loads(reply.headers["Gi-Volume"])
    assert mask.dtype == np.uint8
    assert mask.shape == VOLUME_SHAPE == tuple(facts["shape"])
    assert set(np.unique(mask)) <= {0, 1, 2, 3}
    # abs 1e-6: the header rounds to six digits
    assert facts["valid"] == pytest.approx(np.isin(mask, (1, 2)).mean(), abs=1e-6)
    raw = http.get("/v1/volume", params={**moment, **place, "mask": 1, "format": "raw"})
    assert raw.content == mask.tobytes()


def test_noon_lights_the_street_from_above(http: httpx.Client, moment: dict[str, Any], place: dict[str, Any]) -> None:
    values = array(http.get("/v1/volume", params={**moment, **place}))
    free = np.isin(array(http.get("/v1/volume", params={**moment, **place, "mask": 1})), (1, 2))
    assert 100 < np.median(values[2][free]) < 200e3
    # At midnight the same street has less than a thousandth: no sun, no lamps.
    night = array(http.get("/v1/volume", params={**place, "time": "00:30", "weather": "clear"}))
    assert np.median(night[2][free]) < 1e-3 * np.median(values[2][free])


@pytest.mark.parametrize("time", ["12:00", "00:30"])
def test_raw_halves_are_the_exact_volume_rounded(http: httpx.Client, place: dict[str, Any], time: str) -> None:
    query = {**place, "time": time, "weather": "clear"}
    values = array(http.get("/v1/volume", params=query))
    raw = http.get("/v1/volume", params={**query, "format": "raw", "encoding": "f16"})
    facts = json.loads(raw.headers["Gi-Volume"])
    texels = np.frombuffer(raw.content, "<f2").reshape(facts["shape"])
    # rtol 2^-11: rounding of a half; atol: half of the smallest subnormal half
    np.testing.assert_allclose(texels[..., :3] * np.float32(facts["scale"]), values, rtol=2**-11, atol=2**-25 * facts["scale"])
    mask = array(http.get("/v1/volume", params={**query, "mask": 1}))
    assert (texels[..., 3] == (mask == 1)).all()


def test_distant_covers_the_sector_grid(http: httpx.Client, moment: dict[str, Any]) -> None:
    reply = http.get("/v1/distant", params=moment)
    values, facts = array(reply), json.loads(reply.headers["Gi-Distant"])
    grid = http.get("/v1/world").json()["sectors"]
    columns, rows = (np.array(grid["maximum"]) - grid["minimum"] + 1).tolist()
    assert values.shape == (rows, columns, 6, 3)
    assert facts["origin_sector"] == grid["minimum"]
    assert facts["origin"] == [64 * grid["minimum"][0], 0, 64 * grid["minimum"][1]]
    assert values.max() > 100
    raw = http.get("/v1/distant", params={**moment, "format": "raw"})
    raw_facts = json.loads(raw.headers["Gi-Distant"])
    texels = np.frombuffer(raw.content, "<f2").reshape(raw_facts["shape"])
    np.testing.assert_allclose(texels[..., :3] * np.float32(raw_facts["scale"]), values, rtol=2**-11, atol=2**-25 * raw_facts["scale"])


def test_distant_light_is_the_best_that_was_baked_unless_a_request_says(http: httpx.Client, moment: dict[str, Any]) -> None:
    world = http.get("/v1/world").json()
    assert world["distant"] == ["sky", "full"]
    assert world["dataset"]["distant_bytes"] > 0
    replies = {light: http.get("/v1/distant", params={**moment, **asked}) for light, asked in LIGHTS.items()}
    said = {light: json.loads(reply.headers["Gi-Distant"])["light"] for light, reply in replies.items()}
    assert said == {"": "full", "sky": "sky", "full": "full"}
    assert replies[""].content == replies["full"].content
    assert replies[""].headers["ETag"] == replies["full"].headers["ETag"] != replies["sky"].headers["ETag"]
    sky, full = array(replies["sky"]), array(replies["full"])
    # Nothing of the sky is below, and bounces only add to what comes from it.
    assert not sky[:, :, 3].any()
    assert full[:, :, 3].max() > 100
    assert (full >= 0.99 * sky).all()


def test_distant_light_that_was_not_baked_is_refused(serving: Any, city: Path, tmp_path: Path, moment: dict[str, Any]) -> None:
    older = tmp_path / "older"
    shutil.copytree(city, older)
    texels, bake_id = distant_file.read(older / "distant.gidist")
    (older / "distant.gidist").write_bytes(distant_file.encode(replace(texels, transfer=None), bake_id))
    with serving(create_app(older, Settings())) as client:
        assert client.get("/v1/world").json()["distant"] == ["sky"]
        reply = client.get("/v1/distant", params=moment)
        assert json.loads(reply.headers["Gi-Distant"])["light"] == "sky"
        refused = client.get("/v1/distant", params={**moment, "light": "full"})
        assert refused.status_code == 400
        assert "bake it again" in refused.json()["detail"]
        refused = client.get("/v1/preview.png", params={**moment, **FROM_ABOVE, "distant_light": "full"})
        assert (refused.status_code, "bake it again" in refused.json()["detail"]) == (400, True)


def test_a_picture_shows_the_distant_light_that_it_is_asked_for(http: httpx.Client, moment: dict[str, Any]) -> None:
    """From 120 m up no ground lies in the eye's one volume: all of it reads the texture."""
    pictures = {}
    for light, asked in {"": {}, "sky": {"distant_light": "sky"}, "full": {"distant_light": "full"}}.items():
        reply = http.get("/v1/preview.png", params={**moment, **FROM_ABOVE, **asked})
        pictures[light] = np.asarray(Image.open(io.BytesIO(reply.content)).convert("L"), np.float64)
    np.testing.assert_array_equal(pictures[""], pictures["full"])
    assert (pictures["full"] >= pictures["sky"]).all()
    assert (pictures["full"] > pictures["sky"]).mean() > 0.2
    reply = http.get("/v1/preview.png", params={**moment, **FROM_ABOVE, "distant": "off", "distant_light": "sky"})
    assert (reply.status_code, "distant_light with distant=on, client or cascades only" in reply.text) == (400, True)


def test_probes_are_within_the_radius(http: httpx.Client, moment: dict[str, Any], place: dict[str, Any]) -> None:
    found = http.get("/v1/probes", params={**moment, **place, "radius": 40}).json()["probes"]
    assert found
    position = np.array([probe["position"] for probe in found])
    # abs 1e-3: positions are float32 metres
    assert (np.linalg.norm(position - [place["x"], place["y"], place["z"]], axis=1) <= 40 + 1e-3).all()
    assert np.array([probe["cube"] for probe in found]).shape[1:] == (6, 3)


def test_sector_files_are_the_baked_bytes(http: httpx.Client, city: Path) -> None:
    for entry in http.get("/v1/sectors").json()["sectors"]:
        x, z = entry["sector"]
        reply = http.get(entry["href"])
        assert reply.content == (city / "sectors" / f"{x}_{z}.gisec").read_bytes()
        assert len(reply.content) == entry["bytes"]


def test_head_is_get_without_the_body(http: httpx.Client, moment: dict[str, Any], place: dict[str, Any]) -> None:
    for path, query in (
        ("/healthz", {}),
        ("/v1/volume", {**moment, **place}),
        ("/v1/volume", {"time": "never"}),
        ("/viewer/viewer.js", {}),
    ):
        head, whole = http.head(path, params=query), http.get(path, params=query)
        assert (head.status_code, head.content) == (whole.status_code, b"")
        for name in ("content-length", "content-type", "etag", "gi-volume"):
            assert head.headers.get(name) == whole.headers.get(name)


def test_headers_statuses_and_media_types_are_described_as_they_are_sent(
    http: httpx.Client, moment: dict[str, Any], place: dict[str, Any]
) -> None:
    paths = http.get("/openapi.json").json()["paths"]
    asked = {
        "/v1/volume": {**moment, **place},
        "/v1/distant": moment,
        "/v1/sky": moment,
        "/v1/preview.png": {**moment, "eye": "30,20,90", "look": "30,5,30", "width": 16},
    }
    for path, query in asked.items():
        described = paths[path]["get"]["responses"]["200"]
        sent = http.get(path, params=query)
        ours = {name for name in sent.headers if name.startswith("gi-") or name == "etag"}
        assert ours == {name.lower() for name in described["headers"]}
        for name in paths[path]["get"]["parameters"]:
            for value in name["schema"].get("enum", []) if name["name"] == "format" else []:
                assert http.get(path, params={**query, "format": value}).headers["content-type"] in described["content"]
    for path, methods in paths.items():
        for method, operation in methods.items():
            assert "422" not in operation["responses"], f"{method} {path}"  # nothing answers so: what is wrong is a 400
            assert list(operation["responses"]["4XX"]["content"]) == ["application/problem+json"]
            assert all(parameter["description"] for parameter in operation.get("parameters", [])), f"{method} {path}"


def test_every_route_is_described(http: httpx.Client) -> None:
    """/docs is how most users meet the live world's bodies, which are read by hand."""
    description = http.get("/openapi.json").json()
    for path, methods in description["paths"].items():
        for method, operation in methods.items():
            assert operation.get("description"), f"{method} {path}"
            if method in ("put", "patch", "post"):
                body = operation["requestBody"]["content"]["application/json"]
                assert set(body["example"]) <= set(body["schema"]["properties"])
                assert all(member["description"] for member in body["schema"]["properties"].values())
            if method in ("put", "patch", "post", "delete"):
                assert operation["security"], f"{method} {path}"
    assert {"/v1/clock", "/v1/weather", "/v1/settings", "/v1/lights/{id}", "/v1/players/{id}/volume", "/v1/live"} <= set(
        description["paths"]
    )
