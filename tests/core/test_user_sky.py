"""A sky of one's own: no light lost or made in resampling, the right way round, and hostile pictures refused."""

import builtins
import contextlib
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gi_core.errors import InputError
from gi_core.lighting_model import make_lighting
from gi_core.sky import ROWS, horizontal_illuminance
from gi_core.sky_image import decode_hdr, read_image
from gi_core.spectrum import LUMINANCE_FROM_RGB
from gi_core.user_sky import lighting_with_sky, sky_of_image, user_sky
from gi_core.world import Location, direction_from_azimuth


def uniform(rows: int, value: float = 1.0) -> np.ndarray:
    return np.full((rows, 2 * rows, 3), value, np.float32)


def hdr_bytes(rgbe: np.ndarray, coded: bool, header: bytes = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n") -> bytes:
    """A Radiance picture; coded scanlines as runs where a component repeats, else as literals."""
    rows, columns = rgbe.shape[:2]
    body = b""
    for line in rgbe if coded else ():
        body += bytes((2, 2, columns >> 8, columns & 255))
        for component in line.T:
            for start in range(0, columns, 100):
                part = component[start : start + 100]
                body += bytes((128 + len(part), part[0])) if (part == part[0]).all() else bytes((len(part), *part.tolist()))
    return header + f"\n-Y {rows} +X {columns}\n".encode() + (body or rgbe.tobytes())


@pytest.mark.parametrize("rows", [2, 4, 50, 64, 96, 257])
@pytest.mark.parametrize("centre", [0.0, 77.7])
def test_a_uniform_sky_gives_pi_times_its_radiance(rows: int, centre: float) -> None:
    sky = sky_of_image(uniform(rows, 1000.0), 13.0, centre, None)
    assert sky.illuminance_lx == pytest.approx(1000 * math.pi, rel=1e-3)  # midpoints of 32 rows: 4e-4
    np.testing.assert_allclose(sky.radiance[:ROWS], 1000.0, rtol=1e-6)
    assert (sky.radiance[ROWS:] == 0).all()
    assert sky.below_horizon == pytest.approx(0.5)


@given(st.integers(1, 40), st.floats(-720, 720), st.floats(-720, 720), st.integers(0, 1000))
@settings(max_examples=40, deadline=None)
def test_all_light_above_the_horizon_arrives(half: int, north: float, centre: float, seed: int) -> None:
    rows = 2 * half
    image = np.random.default_rng(seed).exponential(100, (rows, 2 * rows, 3)).astype(np.float32)
    sky = sky_of_image(image, north, centre, None)
    theirs = -np.diff(np.cos(np.pi * np.arange(rows + 1) / rows)) * 2 * np.pi / (2 * rows)
    ours = -np.diff(np.cos(np.pi * np.arange(65) / 64)) * 2 * np.pi / 128
    expected = (theirs[:half, None, None] * image[:half]).sum((0, 1))
    np.testing.assert_allclose((ours[:, None, None] * sky.radiance).sum((0, 1)), expected, rtol=1e-5)  # float32 texels


@pytest.mark.parametrize("azimuth", [0.0, 45.0, 90.0, 200.0, 359.0])
@pytest.mark.parametrize(("north", "centre"), [(0.0, 0.0), (29.0, 0.0), (29.0, 120.0), (-350.0, 500.0)])
def test_a_bright_spot_lands_at_its_azimuth(azimuth: float, north: float, centre: float) -> None:
    rows = 180
    image = uniform(rows, 0.001)
    # To the right of the picture's middle is clockwise; 30 degrees above the horizon.
    column = int(((azimuth - centre) % 360 + 180) % 360)
    image[60, column] = 1e5
    sky = sky_of_image(image, north, centre, None)
    row, found = np.unravel_index(np.argmax(sky.radiance[..., 1]), (64, 128))
    t, p = math.pi * (row + 0.5) / 64, 2 * math.pi * (found + 0.5) / 128
    towards = np.array([math.sin(t) * math.cos(p), math.cos(t), math.sin(t) * math.sin(p)])
    expected = direction_from_azimuth(azimuth + 0.5, 29.5, north)
    assert towards @ expected > math.cos(math.radians(2.9))  # half a texel each way


def test_scaling_to_an_illuminance_keeps_colour_and_pattern() -> None:
    image = np.random.default_rng(1).random((64, 128, 3)).astype(np.float32)
    plain, scaled = sky_of_image(image, 0.0, 0.0, None), sky_of_image(image, 0.0, 0.0, 20e3)
    assert scaled.illuminance_lx == pytest.approx(20e3)
    got = LUMINANCE_FROM_RGB @ horizontal_illuminance(scaled.radiance[:ROWS].astype(np.float64))
    assert got == pytest.approx(20e3, rel=1e-6)
    np.testing.assert_allclose(scaled.radiance, plain.radiance * (20e3 / plain.illuminance_lx), rtol=1e-5)


def test_the_models_own_sky_comes_back_unchanged() -> None:
    light = make_lighting(Location(), "10:00", "partly_cloudy")
    # Our maps start at +X, azimuth 90: the middle of the picture looks to 270.
    back = lighting_with_sky(light, sky_of_image(light.sky_radiance, 0.0, 270.0, None))
    np.testing.assert_allclose(back.sky_radiance, light.sky_radiance, rtol=1e-6)
    np.testing.assert_allclose(back.sky_cube, light.sky_cube, rtol=1e-6)
    assert back.exposure == pytest.approx(light.exposure, abs=1e-6)
    assert (back.sun, back.time, back.snow) == (light.sun, light.time, light.snow)


def test_a_picture_with_its_own_sun_turns_the_models_off() -> None:
    light = make_lighting(Location(), "12:00")
    sky = sky_of_image(uniform(8, 100.0), 0.0, 0.0, None)
    dark = lighting_with_sky(light, replace(sky, holds_sun=True))
    assert not dark.directional_lights
    assert dark.exposure < lighting_with_sky(light, sky).exposure
    assert dark.digest not in (light.digest, lighting_with_sky(light, sky).digest)
    assert light.sun.irradiance.any()  # the one given is untouched


@pytest.mark.parametrize(
    ("image", "complaint"),
    [
        (np.ones((4, 4, 3), np.float32), "(n, 2 n, 3)"),
        (np.ones((4, 8), np.float32), "(n, 2 n, 3)"),
        (uniform(4, math.nan), "32 pixels with infinity or NaN"),
        (uniform(4, math.inf), "infinity"),
        (uniform(4, 0.0), "above the horizon"),
        (uniform(4, -1.0), "above the horizon"),
        (uniform(4, 1e20), "beyond"),
    ],
)
def test_pictures_that_are_no_sky(image: np.ndarray, complaint: str) -> None:
    with pytest.raises(InputError) as refused:
        sky_of_image(image, 0.0, 0.0, None, "mine.hdr")
    assert str(refused.value).startswith("mine.hdr: ")
    assert complaint in str(refused.value)


@pytest.mark.parametrize("lux", [0.0, -1.0, math.nan, math.inf])
def test_illuminances_that_cannot_be(lux: float) -> None:
    with pytest.raises(InputError, match="illuminance"):
        sky_of_image(uniform(4), 0.0, 0.0, lux)


@pytest.mark.parametrize("coded", [False, True])
def test_hdr_pictures_are_read(tmp_path: Path, coded: bool) -> None:
    rgbe = np.random.default_rng(2).integers(0, 256, (20, 40, 4)).astype(np.uint8)
    rgbe[3:9] = (10, 20, 30, 130)
    rgbe[9:11] = 0
    path = tmp_path / "sky.hdr"
    path.write_bytes(hdr_bytes(rgbe, coded))
    image = read_image(path)
    assert image.shape == (20, 40, 3)
    np.testing.assert_allclose(image[4, 0], np.array([10.5, 20.5, 30.5]) / 256 * 4)  # exponent 130 is 2 ** 2
    assert (image[9:11] == 0).all()
    bright = decode_hdr(hdr_bytes(rgbe, coded, b"#?RADIANCE\nEXPOSURE=2.0\nEXPOSURE= 4\n"), "x")
    np.testing.assert_allclose(bright, image / 8)
    assert user_sky(path, illuminance_lx=500.0).illuminance_lx == pytest.approx(500.0)


def test_exr_pictures_are_read(tmp_path: Path) -> None:
    exr: Any = pytest.importorskip("OpenEXR", reason="the extra `sky` is not installed")
    image = np.random.default_rng(3).random((10, 20, 3)).astype(np.float32)
    header = {"compression": exr.ZIP_COMPRESSION, "type": exr.scanlineimage}
    path = tmp_path / "sky.exr"
    exr.File(header, {"RGB": image}).write(str(path))
    np.testing.assert_array_equal(read_image(path), image)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match=r"sky\.exr"):
        read_image(path)
    path.write_bytes(b"no picture")
    with pytest.raises(InputError, match="expected an OpenEXR file"):
        read_image(path)
    exr.File(header, {"Y": image[..., 0]}).write(str(path))
    with pytest.raises(InputError, match="channels R, G, B"):
        read_image(path)


def test_exr_without_its_package_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "sky.exr"
    path.write_bytes(b"\x76\x2f\x31\x01")
    real = builtins.__import__

    def without(name: str, *rest: Any, **more: Any) -> Any:
        if name == "OpenEXR":
            raise ImportError(name)
        return real(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(InputError, match=r"install sectorlight\[sky\]"):
        read_image(path)


def test_files_that_are_no_pictures(tmp_path: Path) -> None:
    for name, complaint in (("sky.png", "expected a sky as .exr or .hdr"), ("gone.hdr", "cannot read")):
        with pytest.raises(InputError, match=complaint):
            read_image(tmp_path / name)


FLAT = np.full((4, 8, 4), 130, np.uint8)


@pytest.mark.parametrize(
    "data",
    [
        b"", b"\n\n", b"#?RADIANCE\n", b"#?RADIANCE\n\n", b"#?RADIANCE\n\n-Y 4 +X 8", b"#?RADIANCE\n\n+Y 4 +X 8\n" + FLAT.tobytes(),
        b"#?RADIANCE\nFORMAT=32-bit_rle_xyze\n\n-Y 4 +X 8\n" + FLAT.tobytes(), b"#?RADIANCE\nEXPOSURE=0\n\n-Y 4 +X 8\n" + FLAT.tobytes(),
        b"#?RADIANCE\nEXPOSURE=many\n\n-Y 4 +X 8\n" + FLAT.tobytes(), b"#?RADIANCE\n\n-Y 9999999 +X 9999999\n",
        b"#?RADIANCE\n\n-Y 8192 +X 16384\n\x02\x02", b"#?RADIANCE\n\n-Y 4 +X 4\n" + FLAT[:, :4].tobytes(),
        hdr_bytes(FLAT, False)[:-1], hdr_bytes(FLAT, False) + b"x", hdr_bytes(FLAT, True)[:-1],
        b"#?RADIANCE\n\n-Y 4 +X 8\n\x02\x02\x00\x08\x00", b"#?RADIANCE\n\n-Y 4 +X 8\n\x02\x02\x00\x08\xff\x01",
        b"#?RADIANCE\n\n-Y 4 +X 8\n\x02\x02\x00\x09\x88\x01",
    ],
)  # fmt: skip
def test_damaged_hdr_pictures_are_refused_in_one_line(data: bytes) -> None:
    with pytest.raises(InputError) as refused:
        decode_hdr(data, "bad.hdr")
    assert str(refused.value).startswith("bad.hdr: ")
    assert "\n" not in str(refused.value)


@given(st.binary(max_size=200).map(lambda tail: b"#?RADIANCE\n\n-Y 4 +X 8\n\x02\x02\x00\x08" + tail) | st.binary(max_size=100))
def test_no_bytes_do_anything_but_read_or_be_refused(data: bytes) -> None:
    with contextlib.suppress(InputError):
        assert decode_hdr(data, "x").shape[2] == 3
