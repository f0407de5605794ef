"""Factor weights in a byte each: what files store, kernels read and the twin sees.

    weight[f, b] = root ** 2, with the root's sign  *  scale[p, k, b] / basis.factor_shares[b]      root = code[f, b] / 255, of int8 / 127

for factor f of probe p, and basis function b; k is 0 where the source is a brick and 1 where it is a sky patch. The cube's codes are
uint8; spherical harmonics have a sign, and int8. A probe's brick factors come before its sky's, so that a sum of each takes its scale once.
"""

import numpy as np

from gi_core import quantise
from gi_core.arrays import AnyArray, Float32, Float64, Int64, UInt8, UInt32
from gi_core.basis import basis_of_size, factor_shares
from gi_core.constants import BASIS_SIZES

# Codes of harmonics' weights are multiples of these, by band: an eighth less of a file, for 0.2 % of a probe's light (MATH.md).
_BAND_STEPS = np.repeat([1, 3, 4], [1, 3, 5])
# One step brings a sum to within the smallest step that a weight of it can take.
_BALANCING_STEPS = 3


def encode(weight: AnyArray, factor_starts: AnyArray, is_sky: AnyArray) -> tuple[AnyArray, AnyArray]:
    """Weights (F, B) -> codes (F, B) and float16 scales (P, 2, B).

    A scale is chosen so that each probe's weights (their magnitudes) still sum to what they did: rounding moves light between a
    probe's bricks, but neither makes nor loses any.
    """
    basis, probes = weight.shape[1], len(factor_starts) - 1
    row = 2 * _probe_of_factor(factor_starts) + is_sky
    signed = basis != BASIS_SIZES["cube"]
    share = factor_shares(basis_of_size(basis))
    codes = np.zeros(weight.shape, np.int8 if signed else np.uint8)
    scales = np.zeros((2 * probes, basis), np.float16)
    for b in range(basis):
        shares = weight[:, b].astype(np.float64) * share[b]
        top = np.zeros(2 * probes)
        np.maximum.at(top, row, np.abs(shares))
        relative = shares / np.maximum(top[row], 1e-30)
        found = quantise.encode_signed_root(relative, int(_BAND_STEPS[b])) if signed else quantise.encode_root(relative)
        kept = np.bincount(row, np.abs(_decode_root(found).astype(np.float64)), 2 * probes)
        total = np.bincount(row, np.abs(shares), 2 * probes)
        scales[:, b] = quantise.half_below(total / np.maximum(kept, 1e-30))
        codes[:, b] = _balanced(found, shares, scales[:, b], row, int(_BAND_STEPS[b])) if b and signed else found
    return codes, scales.reshape(probes, 2, basis)


def decode(code: AnyArray, scale: AnyArray, factor_starts: AnyArray, sky_starts: AnyArray) -> Float32:
    """Codes (F, B) and scales (P, 2, B) -> weights (F, B) float32."""
    shares = _decode_root(code)
    shares *= np.repeat(scale.reshape(-1, scale.shape[2]).astype(np.float32), _run_lengths(factor_starts, sky_starts), axis=0)
    return np.asarray(shares / _shares(code.shape[1]), np.float32)


def device_code(code: AnyArray) -> UInt8:
    """Codes as gather_probes.cl reads them: of harmonics plus 128."""
    return code if code.dtype == np.uint8 else code.view(np.uint8) ^ np.uint8(128)


def device_scale(code: AnyArray, scale: AnyArray) -> Float32:
    """(P, 2, B) float32: a square of a code, with the code's sign, times these is a weight."""
    return np.asarray(scale.astype(np.float32) / (_shares(code.shape[1]) * np.float32(np.iinfo(code.dtype).max ** 2)), np.float32)


def share_sums(code: AnyArray, scale: AnyArray, factor_starts: AnyArray, sky_starts: AnyArray) -> Float64:
    """(P, B): each probe's shares summed, which must not exceed one; of one factor or more."""
    wide = np.ascontiguousarray(code.T).astype(np.int16 if code.dtype == np.int8 else np.uint16)
    first = np.stack([factor_starts[:-1], sky_starts], axis=1).astype(np.int64).reshape(-1)
    sums = np.zeros((code.shape[1], len(first)), np.int64)
    has = _run_lengths(factor_starts, sky_starts) > 0
    sums[:, has] = np.add.reduceat(wide * np.abs(wide), first[has], axis=1, dtype=np.int64)
    scaled = sums.T.reshape(scale.shape) * scale.astype(np.float64)
    return np.asarray(scaled.sum(axis=1) / np.iinfo(code.dtype).max ** 2)


def sky_starts(factor_starts: AnyArray, is_sky: AnyArray) -> UInt32:
    """(P,) uint32: where each probe's sky patches begin among the factors, if its bricks come before them."""
    before = np.concatenate([[0], np.cumsum(is_sky, dtype=np.uint32)])
    ends = factor_starts[1:]
    return (ends - (before[ends] - before[factor_starts[:-1]])).astype(np.uint32)


def _balanced(codes: AnyArray, shares: AnyArray, scale: AnyArray, row: AnyArray, step: int) -> AnyArray:
    """Codes (F,) of one harmonic of which some are a step higher or lower, so that the shares of each row sum to what they did.

    Light that is alike from everywhere has no direction, and rounding must not give it one: in a row the harmonic's signs cancel.
    """
    adjusted = codes.astype(np.int64)
    for _ in range(_BALANCING_STEPS):
        stored = _decode_root(adjusted.astype(np.int8)).astype(np.float64) * scale[row]
        lacks = np.bincount(row, shares - stored, len(scale))
        moved = np.clip(adjusted + step * np.sign(lacks[row]).astype(np.int64), -(127 // step * step), 127 // step * step)
        change = _decode_root(moved.astype(np.int8)).astype(np.float64) * scale[row] - stored
        left = np.abs(lacks[row] - change)
        best = np.abs(lacks)
        np.minimum.at(best, row, left)
        candidates = np.flatnonzero((left == best[row]) & (left < np.abs(lacks[row])))
        _, first = np.unique(row[candidates], return_index=True)
        adjusted[candidates[first]] = moved[candidates[first]]
    return adjusted.astype(np.int8)


def _decode_root(codes: AnyArray) -> Float32:
    return quantise.decode_signed_root(codes) if codes.dtype == np.int8 else quantise.decode_root(codes)


def _shares(basis_size: int) -> Float32:
    return factor_shares(basis_of_size(basis_size)).astype(np.float32)


def _probe_of_factor(factor_starts: AnyArray) -> Int64:
    wide = factor_starts.astype(np.int64)
    return np.repeat(np.arange(len(wide) - 1), wide[1:] - wide[:-1])


def _run_lengths(factor_starts: AnyArray, sky_starts: AnyArray) -> Int64:
    """(2 P,): how many factors of each probe are of bricks, and how many of sky."""
    ends: Int64 = np.stack([sky_starts, factor_starts[1:]], axis=1).astype(np.int64).reshape(-1)
    return ends - np.concatenate([[0], ends[:-1]])
