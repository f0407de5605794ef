"""Decals from the world.toml to the reply and into the picture, by way of a bake and a socket."""

import io
from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest
from PIL import Image

from bake_jobs.runner import bake
from gi_core.dataset import Dataset
from gi_core.decals import gradient_texels
from server.app import create_app
from server.settings import Settings

WORLD = """
[[source]]
path = "ground.ply"
[[decal]]
name = "far"
position = [30.0, 0.25, 10.0]
size = [1.8, 1.25, 4.6]
[[decal]]
name = "near"
position = [10.0, 0.25, 10.0]
size = [1.8, 1.25, 4.6]
yaw_degrees = 90.0
"""
VIEW = {"time": "12:00", "weather": "overcast", "eye": "10,12,18", "look": "10,0,10", "fov": "60", "width": "128"}


@pytest.fixture(scope="module")
def parked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of bare ground with two decals."""
    import trimesh

    folder = tmp_path_factory.mktemp("parked")
    corners = np.array([[0, 0, 0], [0, 0, 64], [64, 0, 64], [64, 0, 0]], float)
    trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]]).export(folder / "ground.ply")
    (folder / "world.toml").write_text(WORLD)
    bake(str(folder / "world.toml"), folder / "city", "draft", 1)
    return folder


@pytest.fixture(scope="module")
def client(parked: Path, serving) -> Iterator[httpx.Client]:
    with serving(create_app(parked / "city", Settings())) as opened:
        yield opened


def test_those_near_a_point_are_listed_with_where_they_stand(client: httpx.Client) -> None:
    reply = client.get("/v1/decals", params={"x": 12, "y": 0.25, "z": 10, "radius": 50}).json()
    assert [(decal["name"], decal["distance"]) for decal in reply["decals"]] == [("near", 2), ("far", 18)]
    near = reply["decals"][0]
    assert (near["position"], near["size"], near["yaw_degrees"]) == ([10, 0.25, 10], [1.8, 1.25, 4.6], 90)
    # Its front, 2.3 m along its own z, looks to the world's +X.
    np.testing.assert_allclose(np.array(near["world_from_box"]) @ [0, 0, 2.3, 1], [12.3, 0.25, 10, 1], atol=1e-9)
    closer = client.get("/v1/decals", params={"x": 12, "y": 0.25, "z": 10, "radius": 5}).json()
    assert [decal["name"] for decal in closer["decals"]] == ["near"]


def test_a_world_without_any_lists_none(http: httpx.Client) -> None:
    assert http.get("/v1/decals", params={"x": 0, "y": 0, "z": 0}).json()["decals"] == []


def test_the_gradient_is_a_picture_of_one_row(client: httpx.Client) -> None:
    gradient = client.get("/v1/decals", params={"x": 0, "y": 0, "z": 0}).json()["gradient"]
    picture = Image.open(io.BytesIO(client.get(gradient["href"]).content))
    assert (picture.mode, gradient["low"], gradient["high"]) == ("L", -4, 4)
    np.testing.assert_array_equal(np.asarray(picture), gradient_texels()[None])


def grey(client: httpx.Client, **change: str) -> np.ndarray:
    reply = client.get("/v1/preview.png", params=VIEW | change)
    assert reply.status_code == 200, reply.text
    return np.asarray(Image.open(io.BytesIO(reply.content)).convert("L"), np.int64)


def test_a_picture_has_the_contact_shadow_where_it_asks_for_occlusion(client: httpx.Client) -> None:
    plain, dimmed = grey(client), grey(client, ao="on")
    rows, columns = plain.shape
    darker = plain - dimmed
    # The look is at the decal: nearly all light is gone below it, and some beside, but none in the picture's corners: they are a little
    # brighter, all alike, since the meter sees less light.
    assert dimmed[rows // 2, columns // 2] < 0.3 * plain[rows // 2, columns // 2]
    corners = darker[[0, 0, -1, -1], [0, -1, 0, -1]]
    assert corners.max() <= 0
    assert np.ptp(corners) <= 2
    darker -= corners.min()
    assert 0.02 < (darker > 10).mean() < 0.5
    # Turned by 90 degrees it lies across the picture: longer than wide.
    deep = darker > darker.max() / 2
    assert deep.any(axis=0).sum() > 1.5 * deep.any(axis=1).sum()


def test_decals_that_move_need_no_sector_baked_anew(parked: Path) -> None:
    before = Dataset.open(parked / "city").world
    (parked / "moved.toml").write_text(WORLD.replace("30.0, 0.25", "40.0, 0.25"))
    baked: list[float] = []
    after = bake(str(parked / "moved.toml"), parked / "city", "draft", 1, on_baked=baked.append)
    assert (baked, after.bake_id) == ([], before.bake_id)
    assert Dataset.open(parked / "city").world.decals[0].position == (40.0, 0.25, 10.0)
    assert before.decals[0].position == (30.0, 0.25, 10.0)
