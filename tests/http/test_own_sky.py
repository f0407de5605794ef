"""A sky of the operator's own: what every query and the live world are lit by, whatever the hour."""

import io
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from server.app import create_app
from server.live import LiveOptions
from server.settings import Settings, SkyFile

LUX = 5000.0


@pytest.fixture(scope="module")
def picture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A red sky, twice as bright in the half of its picture that lies left; so narrow that its pixels are stored as they are."""
    path = tmp_path_factory.mktemp("sky") / "own.hdr"
    pixels = np.full((2, 4, 4), (120, 60, 30, 130), np.uint8)
    pixels[:, 2:, :3] //= 2
    path.write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 2 +X 4\n" + pixels.tobytes())
    return path


def sky_of(http: httpx.Client, time: str) -> np.ndarray:
    reply = http.get("/v1/sky", params={"time": time, "weather": "clear", "format": "npy"}).raise_for_status()
    return np.load(io.BytesIO(reply.content))


def upward_light(http: httpx.Client) -> float:
    """The most that any voxel of the player's volume gets from above [lx]; 0 before there is one."""
    reply = http.get("/v1/players/one/volume")
    return float(np.load(io.BytesIO(reply.content))[2].max()) if reply.status_code == 200 else 0.0


def test_queries_and_the_live_world_are_lit_by_it(
    city: Path,
    picture: Path,
    street: tuple[float, float, float],
    serving: Callable[..., Any],
    wait_until_live: Callable[[httpx.Client], None],
) -> None:
    options = LiveOptions(ticks_per_second=30, start_time="00:00")
    with serving(create_app(city, Settings(sky=SkyFile(picture, 90.0, LUX, holds_sun=True), live=options))) as http:
        noon, night = sky_of(http, "12:00"), sky_of(http, "00:00")
        np.testing.assert_array_equal(noon, night)
        # The middle looks east: from there on columns and the picture's right half go by way of the south.
        np.testing.assert_allclose(noon[10, 100] / noon[10, 30], [120.5 / 60.5, 60.5 / 30.5, 30.5 / 15.5], rtol=1e-4)
        light = http.get("/v1/lighting", params={"time": "12:00", "weather": "clear"}).json()
        assert light["sun"]["irradiance"] == [0, 0, 0]
        assert np.dot(light["sky_cube"][2], [0.2126, 0.7152, 0.0722]) == pytest.approx(LUX, rel=1e-3)
        # At midnight the street is as bright as the picture, not as the moon.
        wait_until_live(http)
        assert http.post("/v1/players", json={"id": "one", "path": [street], "speed": 0}).status_code == 201
        deadline = time.monotonic() + 20
        while upward_light(http) < LUX / 20:
            assert time.monotonic() < deadline
            time.sleep(0.1)


def test_a_picture_that_cannot_be_read_is_named(city: Path, tmp_path: Path, sectorlight: Callable[..., Any]) -> None:
    (tmp_path / "sky.hdr").write_bytes(b"no picture")
    for given in (["--sky", str(tmp_path / "sky.hdr")], ["--sky", str(tmp_path / "none.exr")], ["--sky-lux", "100"]):
        done = sectorlight("serve", str(city), "--port", "0", *given)
        assert done.returncode == 2
        assert "sky" in done.stderr or "none.exr" in done.stderr
