"""What a client reads of each encoding, and how far that is from the light that was encoded."""

import numpy as np
import pytest

from server.encoded_light import ENCODINGS, unpack_shared_exponent
from server.encoding import shared_exponent_texels


@pytest.fixture
def light():
    """Six faces of a small volume, night to noon within it."""
    return (10.0 ** np.random.default_rng(0).uniform(-1, 5, (6, 4, 8, 8, 3))).astype(np.float32)


@pytest.mark.parametrize(("name", "bytes_a_colour"), [("npy", 12), ("f16", 8), ("rgb9e5", 4)])
def test_bytes_of_a_reply(light, name, bytes_a_colour):
    size, decoded = ENCODINGS[name](light)
    assert size - (128 if name == "npy" else 0) == bytes_a_colour * light.size // 3
    assert decoded.shape == light.shape
    assert decoded.dtype == np.float32


def test_npy_is_exact(light):
    assert np.array_equal(ENCODINGS["npy"](light)[1], light)


def test_halves_are_within_half_a_step(light):
    _, decoded = ENCODINGS["f16"](light)
    assert np.abs(decoded / light - 1).max() <= 2.0**-11 * 1.001
    _, signed = ENCODINGS["f16"](-light)
    assert np.array_equal(signed, -decoded)


def test_shared_exponents_are_within_half_a_step_of_the_brightest_channel(light):
    _, decoded = ENCODINGS["rgb9e5"](light)
    assert (np.abs(decoded - light).max(axis=-1) <= 2.0**-9 * 1.001 * light.max(axis=-1)).all()
    assert np.abs(decoded / light - 1).max() > 2.0**-9  # a dim channel beside a bright one


def test_a_texel_by_hand():
    # Mantissas 256, 128 and 1 of 512, exponent 16 - 15: the colour 1, 0.5 and 2 / 512.
    assert unpack_shared_exponent(np.array([256 | 128 << 9 | 1 << 18 | 16 << 27], "<u4").tobytes()).tolist() == [[1.0, 0.5, 2 / 512]]
    colours = np.array([[1.0, 0.5, 2 / 512], [0.0, 0.0, 0.0]], np.float32)
    assert np.array_equal(unpack_shared_exponent(shared_exponent_texels(colours, 1.0)), colours)
