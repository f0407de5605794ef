"""Factor weights in a byte each: what files store, kernels read and the twin sees. Two ways, by basis:

Of the cube every weight has a code: ``(code / 255) ** 2 * scale[p, k, b]`` for factor f of probe p and face b.

Harmonics of one factor hang together: they are those of a small patch of light, which has a size and a mean direction. So a factor has
four codes, of the first harmonic's root and of that direction (y, z, x), from which all nine follow:

    share[0] = (code[0] / 127) ** 2 * scale[p, k]               m = code[1:] / 16,  r = m . m,  g = r, or 32 / 45 of a face of the sky
    share[b] = share[0] * (gain[b] * polynomial[b] + trim[p, k, b])         gain: 2 for y z x; 15/4 g for xy yz xz, and so on
    (the products of share[0] and polynomials rounded to codes of a byte, ``expanded``, which is what kernels read)
    weight   = share / basis.factor_shares

A shorter mean direction is a wider patch, and the second band fades with the square of the first (r). ``trim`` is what this lacks in
all of a probe's factors together, so that light that is alike from everywhere is right. k is 0 where the source is a brick and 1 where it
is a sky patch: a probe's brick factors come before its sky's, so that a sum of each takes its scale once. MATH.md says what is lost.
"""

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np

from gi_core import quantise
from gi_core.arrays import AnyArray, Float16, Float32, Float64, Int8, Int64, UInt8, UInt32
from gi_core.background import give_way
from gi_core.basis import SH_COSINE, SH_NORM, basis_of_size, factor_shares
from gi_core.constants import BASIS_SIZES

# The code of a unit vector along an axis.
DIRECTION_STEPS = 16
# One face of six (sky_patches' scheme "faces") has three halves of a direction's first band, which no light that shines has, and these
# of its second (basis.from_axes).
FACE_STEPS = 24
# Between the two. Rounding makes some directions longer than a unit, by no more than a step.
LONGEST_STEPS = 20
FACE_GAIN = 32 / 45
HARMONIC_CODES = 4
# Shares of the second harmonic on, of a factor whose direction is the unit vector that the polynomial is taken at.
GAINS: Float64 = (SH_NORM / SH_NORM[0]) ** 2 * SH_COSINE / SH_COSINE[0]


class Codes(NamedTuple):
    """Weights as a sector holds them: gi_core.sector has the shapes. ``factor_trim`` is None of the cube."""

    factor_code: UInt8 | Int8
    factor_scale: Float16
    factor_trim: Int8 | None


def encode(weight: AnyArray, factor_starts: AnyArray, is_sky: AnyArray) -> Codes:
    """Weights (F, B) -> codes.

    A scale is chosen so that each probe's weights (of harmonics the first ones) still sum to what they did: rounding moves light between a
    probe's bricks, but neither makes nor loses any.
    """
    basis, probes = weight.shape[1], len(factor_starts) - 1
    row = 2 * _probe_of_factor(factor_starts) + is_sky
    shares = weight * factor_shares(basis_of_size(basis))
    if basis == BASIS_SIZES["cube"]:
        found = [_encode_roots(shares[:, b], row, 2 * probes, quantise.encode_root) for b in range(basis)]
        codes, scales = (np.stack(column, axis=1) for column in zip(*found, strict=True))
        return Codes(codes, scales.reshape(probes, 2, basis), None)
    root, scale = _encode_roots(np.maximum(shares[:, 0], 0), row, 2 * probes, quantise.encode_signed_root)
    mean = shares[:, 1:4] / (GAINS[1] * np.maximum(shares[:, :1], 1e-30))
    code = np.concatenate([root[:, None], _encode_direction(mean)], axis=1)
    modelled = _harmonic_shares(code, basis) * scale[row, None].astype(np.float32)
    total = np.maximum(np.bincount(row, modelled[:, 0], 2 * probes), 1e-30)
    trim = np.stack([np.bincount(row, shares[:, b] - modelled[:, b], 2 * probes) / total for b in range(1, basis)], axis=1)
    return Codes(code, scale.reshape(probes, 2, 1), quantise.encode_signed_root(trim).reshape(probes, 2, basis - 1))


def decode(codes: Codes, factor_starts: AnyArray, sky_starts: AnyArray) -> Float32:
    """Codes -> weights (F, B) float32."""
    code, scale, trim = codes
    runs = _run_lengths(factor_starts, sky_starts)
    scales = np.repeat(scale.reshape(len(runs), -1).astype(np.float32), runs, axis=0)
    if trim is None:
        return np.asarray(quantise.decode_root(code) * scales, np.float32)
    basis = 1 + trim.shape[2]
    shares = _harmonic_shares(code, basis) * scales
    shares[:, 1:] += shares[:, :1] * np.repeat(quantise.decode_signed_root(trim).reshape(-1, basis - 1), runs, axis=0)
    return np.asarray(shares / factor_shares(basis_of_size(basis)).astype(np.float32), np.float32)


def device_scale(codes: Codes) -> Float32:
    """(P, 2, B) float32. Of the cube: a square of a code times these is a weight. Of harmonics the first takes squares of codes to shares,
    and the others, times the first harmonic's squares, are what ``factor_trim`` adds to weights."""
    scale = codes.factor_scale.astype(np.float32) / np.float32(np.iinfo(codes.factor_code.dtype).max ** 2)
    if codes.factor_trim is None:
        return scale
    norms = factor_shares(basis_of_size(1 + codes.factor_trim.shape[2]))[1:].astype(np.float32)
    return np.concatenate([scale, scale * quantise.decode_signed_root(codes.factor_trim) / norms], axis=2)


def share_sums(codes: Codes, factor_starts: AnyArray, sky_starts: AnyArray) -> Float64:
    """(P, 6), of harmonics (P, 1), the first: each probe's shares summed, which must not exceed one; of one factor or more."""
    code, scale = codes.factor_code[:, : codes.factor_scale.shape[2]], codes.factor_scale
    first = np.stack([factor_starts[:-1], sky_starts], axis=1).astype(np.int64).reshape(-1)
    sums = np.zeros((code.shape[1], len(first)), np.int64)
    has = _run_lengths(factor_starts, sky_starts) > 0
    for b in range(code.shape[1]):
        give_way()
        # Squares of the most factors that a probe may have, 65 535, add up to less than 2^32.
        square = np.square(code[:, b].astype(np.int32)).view(np.uint32)
        sums[b, has] = np.add.reduceat(square, first[has], dtype=np.uint32)
    scaled = sums.T.reshape(scale.shape) * scale.astype(np.float64)
    return np.asarray(scaled.sum(axis=1) / np.iinfo(code.dtype).max ** 2)


def longest_direction(code: AnyArray) -> float:
    """Of harmonics' codes (F, 4) the greatest length of a direction, in steps."""
    y, z, x = (code[:, k].astype(np.int16) for k in (1, 2, 3))
    return float(np.sqrt(np.max(x * x + y * y + z * z, initial=0)))


def sky_starts(factor_starts: AnyArray, is_sky: AnyArray) -> UInt32:
    """(P,) uint32: where each probe's sky patches begin among the factors, if its bricks come before them."""
    before = np.searchsorted(np.flatnonzero(is_sky), factor_starts)
    return (factor_starts[1:] - (before[1:] - before[:-1])).astype(np.uint32)


def _encode_roots(shares: AnyArray, row: AnyArray, rows: int, encode_root: Callable[[AnyArray], AnyArray]) -> tuple[AnyArray, AnyArray]:
    """Shares (F,) >= 0 -> codes (F,) and float16 scales (rows,)."""
    shares = shares.astype(np.float64)
    top = np.zeros(rows)
    np.maximum.at(top, row, shares)
    codes = encode_root(shares / np.maximum(top[row], 1e-30))
    decode_root = quantise.decode_root if codes.dtype == np.uint8 else quantise.decode_signed_root
    kept = np.bincount(row, decode_root(codes).astype(np.float64), rows)
    return codes, quantise.half_below(np.bincount(row, shares, rows) / np.maximum(kept, 1e-30))


def _encode_direction(mean: AnyArray) -> Int8:
    """Mean directions (F, 3), of a face of the sky three halves of one -> codes (F, 3)."""
    length = np.linalg.norm(mean, axis=1, keepdims=True)
    most = np.where(length > LONGEST_STEPS / DIRECTION_STEPS, FACE_STEPS / DIRECTION_STEPS, 1)
    # A harmonic that no light has would be cut off here.
    return np.rint(mean * np.minimum(most / np.maximum(length, 1e-30), 1) * DIRECTION_STEPS).astype(np.int8)


def _harmonic_shares(code: AnyArray, basis: int) -> Float32:
    """Codes (F, 4) -> shares (F, basis) float32, without scale and trim."""
    return np.asarray(quantise.decode_signed_root(expanded(code, basis)) * AMPLITUDES[:basis].astype(np.float32), np.float32)


def _polynomials(direction: Float64) -> Float64:
    """(n, 3) y, z, x -> (n, 9): what shares are of the first one, as the module's docstring says it."""
    y, z, x = direction.T
    r = y * y + z * z + x * x
    g = np.where(r > (LONGEST_STEPS / DIRECTION_STEPS) ** 2, FACE_GAIN, r)
    bands = [np.ones_like(x), y, z, x, g * (x * y), g * (y * z), g * (3 * z * z - r), g * (x * z), g * (x * x - y * y)]
    return np.stack(bands, axis=1) * GAINS


# The most of each that a code of 127 stands for, of the first one's square. Faces of the sky have three in the first band.
AMPLITUDES: Float64 = np.array([1, 3, 3, 3, 2, 2, 1, 2, 1.5])


@cache
def _roots_of_directions() -> Int8:
    """(49 ** 3, 8): by y, z and x from -24 to 24 steps, 127 times the signed root of each other share over its amplitude."""
    steps = np.arange(-FACE_STEPS, FACE_STEPS + 1) / DIRECTION_STEPS
    direction = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=3).reshape(-1, 3)
    return quantise.encode_signed_root(_polynomials(direction)[:, 1:] / AMPLITUDES[1:])


@cache
def device_roots() -> UInt8:
    """``_roots_of_directions`` plus 128, as expand_factors.cl reads them."""
    return _roots_of_directions().view(np.uint8) ^ np.uint8(128)


def expanded(code: AnyArray, basis: int) -> Int8:
    """Codes (F, 4) -> codes (F, basis) int8, one of each harmonic: the first, and that times the root of what its direction makes of it.

    Twin of ``kernels_cl/expand_factors.cl``. To work them out in each relight instead took half as long again.
    """
    edge, offset = 2 * FACE_STEPS + 1, FACE_STEPS
    y, z, x = (code[:, k].astype(np.int32) + offset for k in (1, 2, 3))
    roots = _roots_of_directions()[(y * edge + z) * edge + x, : basis - 1]
    found = np.empty((len(code), basis), np.int8)
    found[:, 0] = code[:, 0]
    found[:, 1:] = np.rint(roots * (code[:, :1].astype(np.float32) / np.float32(127)))
    return found


def _probe_of_factor(factor_starts: AnyArray) -> Int64:
    wide = factor_starts.astype(np.int64)
    return np.repeat(np.arange(len(wide) - 1), wide[1:] - wide[:-1])


def _run_lengths(factor_starts: AnyArray, sky_starts: AnyArray) -> Int64:
    """(2 P,): how many factors of each probe are of bricks, and how many of sky."""
    ends: Int64 = np.stack([sky_starts, factor_starts[1:]], axis=1).astype(np.int64).reshape(-1)
    return ends - np.concatenate([[0], ends[:-1]])
