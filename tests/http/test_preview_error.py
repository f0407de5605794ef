"""Pictures of errors: right light is white, wrong light is red or blue, and the server goes on."""

import io
from dataclasses import replace

import httpx
import numpy as np
import pytest
from PIL import Image

from gi_core.engine import Engine
from server import preview_error
from server.camera import Camera
from server.preview_error import NO_SURFACE, RIGHT, TOO_BRIGHT, TOO_DARK, false_colour, relative_error

QUERY = {"time": "12:00", "weather": "overcast", "eye": "4,3,4", "look": "40,8,40", "gi": "error", "width": "64"}


def picture(content: bytes) -> np.ndarray:
    with Image.open(io.BytesIO(content)) as image:
        return np.asarray(image.convert("RGB")).astype(int)


def test_colours_run_from_too_dark_to_too_bright() -> None:
    colours = false_colour(np.array([-3.0, -0.5, 0.0, 0.25, 0.5, np.nan]))
    assert [tuple(c) for c in colours[[0, 1, 2, 4, 5]]] == [TOO_DARK, TOO_DARK, RIGHT, TOO_BRIGHT, NO_SURFACE]
    assert (np.abs(colours[3].astype(int) - (np.array(RIGHT) + TOO_BRIGHT) / 2) <= 1).all()


def test_errors_are_relative_but_not_to_the_dark() -> None:
    np.testing.assert_allclose(
        relative_error(np.array([110.0, 90.0, 3.0]), np.array([100.0, 100.0, 0.0])), [0.1, -0.1, 3 / (0.02 * 200 / 3)]
    )
    assert np.isfinite(relative_error(np.zeros(3), np.zeros(3))).all()


def test_the_grid_is_bounded_and_keeps_the_view() -> None:
    camera = Camera(np.zeros(3), np.array([1.0, 0.0, 0.0]), 60.0, 1920)
    coarse = preview_error._coarse(camera)
    assert 0.9 * preview_error.MAX_POINTS < coarse.width * coarse.height <= preview_error.MAX_POINTS
    assert coarse.rays()[0] == pytest.approx(camera.rays()[0], abs=0.02)
    small = replace(camera, width=64)
    assert preview_error._coarse(small).width == 64


def test_it_is_a_picture_of_small_errors_and_the_same_each_time(http: httpx.Client) -> None:
    reply = http.get("/v1/preview.png", params=QUERY)
    assert (reply.status_code, reply.headers["content-type"]) == (200, "image/png")
    shown = picture(reply.content)
    assert shown.shape == (36, 64, 3)
    view = shown[: 36 - preview_error.LEGEND_HEIGHT].reshape(-1, 3)
    seen = view[(view != NO_SURFACE).any(axis=1)]
    assert len(seen) > 50
    assert (seen.min(axis=1) > 60).mean() > 0.5  # most of it is nearer to white than to the ends of the scale
    again = {**QUERY, "look": "40.0,8,40"}
    assert http.get("/v1/preview.png", params=again).content == reply.content


def test_light_twice_as_bright_is_red(http: httpx.Client, monkeypatch: pytest.MonkeyPatch) -> None:
    volume = Engine.volume

    def doubled(*args: object, **options: object) -> object:
        found = volume(*args, **options)
        return replace(found, values=found.values * 2)

    monkeypatch.setattr(Engine, "volume", doubled)
    shown = picture(http.get("/v1/preview.png", params={**QUERY, "eye": "4,3,4.5"}).content)
    view = shown[: 36 - preview_error.LEGEND_HEIGHT].reshape(-1, 3)
    seen = view[(view != NO_SURFACE).any(axis=1)]
    assert (seen == TOO_BRIGHT).all(axis=1).mean() > 0.6


def test_a_view_of_the_sky_has_no_error(http: httpx.Client) -> None:
    shown = picture(http.get("/v1/preview.png", params={**QUERY, "eye": "4,300,4", "look": "4,400,5"}).content)
    assert (shown[: 36 - preview_error.LEGEND_HEIGHT] == NO_SURFACE).all()
