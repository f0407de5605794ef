"""Arrays as bytes: ``npy`` is exact, ``raw`` is for GPUs, ``ktx2`` (server/ktx2.py) for those that want a file."""

import io
import json
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np

from gi_core.arrays import AnyArray, Float32, UInt8, UInt16

ArrayFormat = Literal["npy", "raw"]
VolumeFormat = Literal["npy", "raw", "ktx2"]
RawEncoding = Literal["f16", "rgb9e5"]

# Changes whenever the bytes of a reply change for the same data; part of every ETag.
REPLY_VERSION = 9

HALF_MAX = 65504.0
SHARED_EXPONENT_MAX = 65408.0  # 511 / 512 x 2^16
_MANTISSA_BITS, _EXPONENT_BIAS = 9, 15
_HALF_ONE = np.uint16(0x3C00)
_LEAST_NORMAL_HALF = (127 - 14) << 23  # bits of the float32 2^-14
MEDIA_TYPE: dict[VolumeFormat, str] = {"npy": "application/x-npy", "raw": "application/octet-stream", "ktx2": "image/ktx2"}


def npy(array: AnyArray) -> bytes:
    """An array as a version 1.0 .npy file, C order."""
    out = io.BytesIO()
    np.lib.format.write_array(out, np.ascontiguousarray(array), version=(1, 0), allow_pickle=False)
    return out.getvalue()


def half_scale(values: Float32) -> float:
    """The power of two by which lux are divided so that the largest fills, and does not overflow, a half float.

    A power of two leaves mantissas alone, so the error is the half's own (2^-11); the values then span 2^15 down to 2^-14, 29 stops
    below the brightest, before precision falls. A texture of zeros has scale 1.
    """
    peak = max(float(values.max(initial=0.0)), -float(values.min(initial=0.0)))  # harmonics have a sign
    if peak <= 0:
        return 1.0
    return float(2.0 ** np.ceil(np.log2(peak / HALF_MAX)))


def half_texels(values: Float32, scale: float, alpha: UInt8 | None = None) -> bytes:
    """Colours (..., 3) [lx] as little-endian RGBA half floats, colour / scale.

    alpha : (...) uint8, broadcast against values[..., 0]: 0 or 1; 1 everywhere when it is None. GPUs have no three-channel 16-bit format.
    """
    texels = np.empty((*values.shape[:-1], 4), "<u2")
    halves = _half_bits(np.asarray(values / np.float32(scale), np.float32))
    for channel in range(3):  # three long loops instead of a loop of three at each texel
        texels[..., channel] = halves[..., channel]
    texels[..., 3] = _HALF_ONE if alpha is None else alpha * _HALF_ONE
    return texels.tobytes()


def _half_bits(values: Float32) -> UInt16:
    """Bits of the nearest halves, ties to even, as NumPy's own conversion gives them in five times the time. None may overflow."""
    bits = values.view(np.uint32)
    magnitude = bits & np.uint32(0x7FFFFFFF)
    # The last bit kept decides ties; the carry of rounding up runs into the exponent, as it should.
    rounded = magnitude + (np.uint32(0xFFF) + ((magnitude >> np.uint32(13)) & np.uint32(1)))
    halves = ((rounded - np.uint32(112 << 23)) >> np.uint32(13)).astype(np.uint16)
    halves |= (bits >> np.uint32(16)).astype(np.uint16) & np.uint16(0x8000)
    tiny = magnitude < np.uint32(_LEAST_NORMAL_HALF)
    if tiny.any():
        halves[tiny] = values[tiny].astype(np.float16).view(np.uint16)
    return halves


def shared_exponent_scale(values: Float32) -> float:
    """As ``half_scale``, for ``shared_exponent_texels``."""
    peak = float(values.max(initial=0.0))
    return 1.0 if peak <= 0 else float(2.0 ** np.ceil(np.log2(peak / SHARED_EXPONENT_MAX)))


def shared_exponent_texels(values: Float32, scale: float) -> bytes:
    """Colours (..., 3) [lx], none negative, as little-endian RGB9E5 words (...), colour / scale: nine bits a channel, least significant
    red, and above them five of the exponent that the three share (OpenGL's EXT_texture_shared_exponent). Off by 2^-9 of the texel's
    brightest channel at most."""
    colour = np.maximum(values.astype(np.float64) / scale, 0.0)
    brightest = colour.max(axis=-1)
    # frexp has the brightest as 0.5..1 times 2 to this; rounding its mantissa up to 512 takes one more.
    exponent = np.where(brightest > 0, np.maximum(np.frexp(brightest)[1], -_EXPONENT_BIAS), -_EXPONENT_BIAS)
    exponent += np.rint(np.ldexp(brightest, _MANTISSA_BITS - exponent)) == 1 << _MANTISSA_BITS
    mantissa = np.rint(np.ldexp(colour, (_MANTISSA_BITS - exponent)[..., None])).astype(np.uint32)
    words = (exponent + _EXPONENT_BIAS).astype(np.uint32) << 3 * _MANTISSA_BITS
    for channel in range(3):
        words |= mantissa[..., channel] << channel * _MANTISSA_BITS
    return words.astype("<u4").tobytes()


def header_json(facts: Mapping[str, Any]) -> str:
    """Facts as one line of ASCII JSON, fit for a header."""
    return json.dumps(facts, separators=(",", ":"), ensure_ascii=True, allow_nan=False)
