"""Half floats lose no more than they must, at any magnitude of light."""

import io
import json

import numpy as np
import pytest

from server.encoding import HALF_MAX, half_scale, half_texels, header_json, npy


def decoded(values: np.ndarray) -> np.ndarray:
    scale = half_scale(values)
    texels = np.frombuffer(half_texels(values, scale), "<f2").reshape(*values.shape[:-1], 4)
    return texels[..., :3].astype(np.float32) * np.float32(scale)


@pytest.mark.parametrize("peak", [1e-3, 0.1, 1.0, 65504.0, 65505.0, 1.2e5, 1e9, 1e30])
def test_half_texels_keep_eleven_bits_of_the_brightest_29_stops(peak: float) -> None:
    values = (peak * np.logspace(0, -7, 96)).astype(np.float32).reshape(-1, 1, 3)
    # rtol 2^-11: half a unit in the last place of a half's 11-bit significand
    np.testing.assert_allclose(decoded(values), values, rtol=2**-11, atol=0)


def test_the_scale_is_a_power_of_two_that_fills_the_half() -> None:
    for peak in (0.02, 7.0, 65504.0, 65504.1, 3.3e8):
        scale = half_scale(np.array([peak], np.float32))
        assert np.log2(scale) == int(np.log2(scale))
        assert HALF_MAX / 2 < peak / scale <= HALF_MAX


def test_darkness_has_a_scale() -> None:
    dark = np.zeros((2, 2, 3), np.float32)
    assert half_scale(dark) == 1.0
    assert not decoded(dark).any()


def test_alpha_is_the_class_and_is_not_scaled() -> None:
    values = np.full((6, 2, 2, 2, 3), 1e6, np.float32)
    free = np.array([[[0, 1], [1, 1]], [[1, 0], [0, 0]]], np.uint8)
    texels = np.frombuffer(half_texels(values, half_scale(values), free), "<f2").reshape(6, 2, 2, 2, 4)
    assert (texels[..., 3] == free).all()


def test_npy_is_readable_and_repeatable() -> None:
    array = np.arange(24, dtype=np.float32).reshape(2, 3, 4)[:, ::-1]
    assert npy(array) == npy(array.copy())
    assert (np.load(io.BytesIO(npy(array)), allow_pickle=False) == array).all()


def test_header_json_is_one_ascii_line_and_refuses_nan() -> None:
    line = header_json({"name": "Zürich\n", "size": [1, 2.5]})
    assert line.isascii()
    assert "\n" not in line
    assert json.loads(line)["name"] == "Zürich\n"
    with pytest.raises(ValueError, match="JSON"):
        header_json({"valid": float("nan")})
