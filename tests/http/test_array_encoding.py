"""Half floats lose no more than they must, at any magnitude of light."""

import io
import json

import numpy as np
import pytest

from server.encoding import (
    HALF_MAX,
    SHARED_EXPONENT_MAX,
    half_scale,
    half_texels,
    header_json,
    npy,
    shared_exponent_scale,
    shared_exponent_texels,
)


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


def test_halves_are_those_that_numpy_makes() -> None:
    """Every finite half, what lies halfway to the next, and a little to both sides of that; and numbers of all sizes below."""
    halves = np.arange(0x7C00, dtype=np.uint16).view(np.float16).astype(np.float32)
    middles = (halves[:-1] + halves[1:]) / 2
    around = np.concatenate([halves, middles, np.nextafter(middles, np.float32(0)), np.nextafter(middles, np.float32(1e9))])
    sizes = np.exp2(np.random.default_rng(1).uniform(-140, 15.9, 100_000)).astype(np.float32)
    values = np.concatenate([around, sizes, -around, -sizes, np.zeros(1, np.float32)])
    values = values[: len(values) // 3 * 3].reshape(-1, 3)
    texels = np.frombuffer(half_texels(values, 1.0), "<u2").reshape(-1, 4)
    assert np.array_equal(texels[:, :3], values.astype(np.float16).view(np.uint16))
    assert (texels[:, 3].view(np.float16) == 1).all()


def shared_decoded(texels: bytes, shape: tuple[int, ...], scale: float) -> np.ndarray:
    """As the extension has it, written apart from the encoder: mantissa x 2^(exponent - 15 - 9)."""
    words = np.frombuffer(texels, "<u4").reshape(shape)
    mantissa = np.stack([words >> shift & 511 for shift in (0, 9, 18)], axis=-1)
    return mantissa * 2.0 ** ((words >> 27).astype(int) - 24)[..., None] * scale


@pytest.mark.parametrize("peak", [1e-3, 1.0, 65408.0, 65409.0, 1.2e5, 1e9, 1e30])
def test_shared_exponents_keep_nine_bits_of_a_texel_s_brightest_channel(peak: float) -> None:
    rng = np.random.default_rng(0)
    values = (peak * rng.uniform(0, 1, (500, 3)) * 10.0 ** rng.uniform(-6, 0, (500, 1))).astype(np.float32)
    values[0] = peak
    scale = shared_exponent_scale(values)
    assert SHARED_EXPONENT_MAX / 2 < peak / scale <= SHARED_EXPONENT_MAX
    off = np.abs(shared_decoded(shared_exponent_texels(values, scale), (500,), scale) - values)
    # Half a step: the brightest mantissa is 256 or more, so a step is at most 1/256 of it.
    assert (off <= values.max(axis=1, keepdims=True) / 512 * (1 + 1e-6)).all()


def test_a_known_word_has_a_known_colour() -> None:
    # 1, 0.5 and 0: exponent 16, since a mantissa stays below 512; 256 and 128.
    assert shared_exponent_texels(np.array([[1.0, 0.5, 0.0]], np.float32), 1.0) == (16 << 27 | 128 << 9 | 256).to_bytes(4, "little")
    assert shared_exponent_texels(np.zeros((1, 3), np.float32), 1.0) == bytes(4)


def test_a_mantissa_that_rounds_up_to_512_takes_the_next_exponent() -> None:
    values = np.array([[1023.9, 0.0, 0.0]], np.float32)
    np.testing.assert_allclose(shared_decoded(shared_exponent_texels(values, 1.0), (1,), 1.0), [[1024, 0, 0]])
