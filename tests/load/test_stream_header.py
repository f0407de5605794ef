"""The stream's first message, and the halves its frames are made of."""

import json

import numpy as np
import pytest

from server.half_floats import HALF_MAX, all_finite, floats_from_half, half_bits
from server.stream_header import StreamError, StreamHeader, parse_header

ALL_HALVES = np.arange(1 << 16, dtype=np.uint16)
EXPONENT = ALL_HALVES >> 10 & 31
NORMAL = ALL_HALVES[(EXPONENT > 0) & (EXPONENT < 31)]


def test_a_header_survives_the_way() -> None:
    header = StreamHeader(threshold=0.02, tick_rate=60.0)
    assert parse_header(header.to_text()) == header
    assert parse_header(header.to_text().encode()) == header


def test_unknown_members_are_ignored() -> None:
    assert parse_header(json.dumps(json.loads(StreamHeader().to_text()) | {"player": "a"})) == StreamHeader()


@pytest.mark.parametrize(
    ("member", "value"),
    [
        ("protocol", "other"),
        ("version", 2),
        ("unit", "cd"),
        ("basis", "wavelet"),
        ("basis", ["cube"]),
        ("encoding", "f8"),
        ("shape", [6, 16, 32, 32]),
        ("shape", [6, 16, 32, 65, 3]),
        ("shape", [6, 16, 0, 32, 3]),
        ("shape", [4, 16, 32, 32, 3]),
        ("shape", [6, 16, 32, True, 3]),
        ("shape", None),
        ("threshold", -0.1),
        ("threshold", "0.1"),
        ("tick_rate", 0),
        ("tick_rate", True),
        ("voxel_size", float("nan")),
        ("floor", float("inf")),
    ],
)
def test_a_wrong_member_is_named(member: str, value: object) -> None:
    with pytest.raises(StreamError, match=member if member not in ("protocol", "version") else "sectorlight-stream"):
        parse_header(json.dumps(json.loads(StreamHeader().to_text()) | {member: value}))


@pytest.mark.parametrize("text", ["", "{", "[]", "null", "[" * 100_000, "x" * 100_000, b"\xff\xfe"])
def test_what_is_no_header_is_refused(text: str | bytes) -> None:
    with pytest.raises(StreamError):
        parse_header(text)


def test_every_half_comes_back() -> None:
    for scale in (1.0, 2.0**-40, 2.0**5, 2.0**112):
        values = floats_from_half(NORMAL, scale)
        assert np.array_equal(values, NORMAL.view(np.float16).astype(np.float32) * np.float32(scale))
        assert np.array_equal(half_bits(values, scale), NORMAL)


def test_rounding_is_to_the_nearest_and_the_smallest_are_zero() -> None:
    rng = np.random.default_rng(1)
    values = (rng.choice([-1, 1], 100_000) * 2.0 ** rng.uniform(-14, 16, 100_000)).astype(np.float32)
    values = values[np.abs(values) <= HALF_MAX]
    error = np.abs(floats_from_half(half_bits(values, 1.0), 1.0) - values)
    assert (error <= 2.0**-11 * np.abs(values)).all()
    assert not half_bits(np.array([2.0**-15, -(2.0**-15), 0.0, -0.0, 1e-38, 1e-45], np.float32), 1.0).any()
    assert half_bits(np.array([HALF_MAX], np.float32), 1.0) == 0x7BFF


def test_infinite_and_undefined_halves_are_seen() -> None:
    assert all_finite(NORMAL)
    for bits in (0x7C00, 0xFC00, 0x7E00, 0xFFFF):
        assert not all_finite(np.array([0, bits], np.uint16))
