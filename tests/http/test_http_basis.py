"""A volume in the basis that is asked for: harmonics as they are, the cube made of them, and what cannot be had."""

import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from bake_jobs import runner
from bake_jobs.config import settings_for
from gi_core.basis import convert, evaluate, evaluation_weights
from gi_core.constants import VOLUME_SHAPE
from server.app import create_app
from server.settings import Settings

PLACE = {"x": "40", "y": "3", "z": "20", "time": "12:00", "weather": "clear"}


@pytest.fixture(scope="module")
def angled(tmp_path_factory: pytest.TempPathFactory, serving: Any) -> Iterator[httpx.Client]:
    """A dataset in harmonics, as coarse as a draft."""
    from dataclasses import replace

    output: Path = tmp_path_factory.mktemp("angled") / "block"
    coarse = replace(settings_for("draft"), basis="sh2", sky="patches", sky_patches=24, feedback_probes=3)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runner, "settings_for", lambda name: coarse)
        runner.bake("procedural:midtown?blocks=1x1&seed=1", output, "draft", 1, None, 0, False)
    with serving(create_app(output, Settings())) as client:
        yield client


def volume(http: httpx.Client, **query: str) -> tuple[np.ndarray, dict[str, Any]]:
    reply = http.get("/v1/volume", params={**PLACE, **query})
    assert reply.status_code == 200, reply.text
    return np.load(io.BytesIO(reply.content)), json.loads(reply.headers["Gi-Volume"])


def test_each_basis_has_its_shape_and_the_cube_is_the_default(angled: httpx.Client) -> None:
    assert angled.get("/v1/world").json()["bases"] == ["cube", "sh1", "sh2"]
    for query, basis, size in (({}, "cube", 6), ({"basis": "cube"}, "cube", 6), ({"basis": "sh1"}, "sh1", 4), ({"basis": "sh2"}, "sh2", 9)):
        values, facts = volume(angled, **query)
        assert values.shape == (size, *VOLUME_SHAPE, 3) == tuple(facts["shape"])
        assert facts["basis"] == basis
        assert np.isfinite(values).all()


def test_bases_say_the_same_of_the_same_light(angled: httpx.Client) -> None:
    harmonics, linear, cube = (volume(angled, basis=basis)[0] for basis in ("sh2", "sh1", "cube"))
    np.testing.assert_array_equal(linear, harmonics[:4])
    assert cube.min() >= 0
    voxels = np.moveaxis(harmonics.reshape(9, -1, 3), 0, 1)
    faces = np.moveaxis(cube.reshape(6, -1, 3), 0, 1)
    # Faces are cut off at 0 probe by probe, before voxels blend them: never below, and hardly above, what harmonics say of the blend.
    blended = convert(voxels, "sh2", "cube")
    assert (faces >= blended * (1 - 1e-4) - 1e-3 * blended.max()).all()
    assert np.median(np.abs(faces - blended) / blended.mean()) < 1e-4
    down = np.broadcast_to(np.array([0.0, -1.0, 0.0], np.float32), (len(voxels), 3))
    assert evaluate("sh2", voxels, down).min() >= 0


def test_raw_halves_keep_the_sign_of_harmonics(angled: httpx.Client) -> None:
    values, _ = volume(angled, basis="sh2")
    assert values.min() < 0
    raw = angled.get("/v1/volume", params={**PLACE, "basis": "sh2", "format": "raw"})
    facts = json.loads(raw.headers["Gi-Volume"])
    texels = np.frombuffer(raw.content, "<f2").reshape(facts["shape"])[..., :3]
    # rtol 2^-11: rounding of a half; atol: half of the smallest subnormal half
    np.testing.assert_allclose(texels * np.float32(facts["scale"]), values, rtol=2**-11, atol=2**-25 * facts["scale"])


def test_each_basis_has_an_etag_of_its_own(angled: httpx.Client) -> None:
    tags = {angled.get("/v1/volume", params={**PLACE, "basis": basis}).headers["etag"] for basis in ("cube", "sh1", "sh2")}
    assert len(tags) == 3


def test_a_cube_dataset_says_that_it_has_no_harmonics(http: httpx.Client) -> None:
    assert http.get("/v1/world").json()["bases"] == ["cube"]
    reply = http.get("/v1/volume", params={**PLACE, "basis": "sh2"})
    assert reply.status_code == 400
    assert "baked in cube" in reply.json()["detail"]


def test_probes_and_pictures_are_served_from_harmonics_too(angled: httpx.Client) -> None:
    place = {name: PLACE[name] for name in ("time", "weather", "x", "y", "z")}
    probes = angled.get("/v1/probes", params={**place, "radius": "40"}).json()["probes"]
    assert probes
    assert all(np.shape(probe["cube"]) == (6, 3) and np.min(probe["cube"]) >= 0 for probe in probes)
    picture = angled.get(
        "/v1/preview.png", params={"time": "12:00", "weather": "clear", "eye": "40,3,20", "look": "60,5,24", "width": "32"}
    )
    assert picture.status_code == 200
    distant = np.load(io.BytesIO(angled.get("/v1/distant", params={"time": "12:00", "weather": "clear"}).content))
    assert distant.shape[2:] == (6, 3)


def test_texels_without_a_sign_are_the_cube_s_alone(angled: httpx.Client) -> None:
    raw = {**PLACE, "format": "raw", "encoding": "rgb9e5"}
    cube = angled.get("/v1/volume", params=raw)
    facts = json.loads(cube.headers["Gi-Volume"])
    assert (facts["shape"], facts["dtype"], len(cube.content)) == ([6, *VOLUME_SHAPE], "rgb9e5", 4 * 6 * 16 * 32 * 32)
    refused = angled.get("/v1/volume", params={**raw, "basis": "sh2"})
    assert (refused.status_code, "rgb9e5" in refused.json()["detail"]) == (400, True)


def test_fog_of_harmonics_is_their_mean_over_directions(angled: httpx.Client) -> None:
    harmonics, _ = volume(angled, basis="sh2")
    fog, facts = volume(angled, kind="fog")
    assert (facts["basis"], facts["shape"]) == ("average", [*VOLUME_SHAPE, 3])
    rng = np.random.default_rng(5)
    voxels = [tuple(rng.integers(0, VOLUME_SHAPE)) for _ in range(4)]
    directions = rng.normal(size=(100_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for place in voxels:
        found = evaluation_weights("sh2", directions) @ harmonics[(slice(None), *place)].astype(float)
        # Monte Carlo: four standard errors
        np.testing.assert_allclose(fog[place], found.mean(axis=0), atol=4 * found.std() / np.sqrt(len(directions)))


def test_cascades_are_had_in_every_basis(angled: httpx.Client) -> None:
    harmonics, facts = volume(angled, basis="sh2", cascade="1")
    assert (harmonics.shape, facts["voxel_size"], facts["basis"]) == ((9, *VOLUME_SHAPE, 3), [6.25] * 3, "sh2")
    np.testing.assert_array_equal(volume(angled, basis="sh1", cascade="1")[0], harmonics[:4])
    np.testing.assert_allclose(volume(angled, kind="fog", cascade="1")[0], harmonics[0] * np.float32(np.sqrt(1 / (4 * np.pi))), rtol=1e-6)
    cube, _ = volume(angled, basis="cube", cascade="1")
    faces = convert(np.moveaxis(harmonics.reshape(9, -1, 3), 0, 1), "sh2", "cube")
    blended = np.moveaxis(cube.reshape(6, -1, 3), 0, 1)
    # As of cascade 0: faces are cut off at 0 before they are blended.
    assert (blended >= faces * (1 - 1e-4) - 1e-3 * faces.max()).all()
    assert np.median(np.abs(blended - faces) / faces.mean()) < 1e-4
