"""Sector <-> bytes of a ``.gisec`` file. FORMAT.md describes each array; the two functions here mirror each other."""

from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from gi_core import container, quantise
from gi_core.arrays import AnyArray, Float32
from gi_core.basis import basis_of_size, factor_shares
from gi_core.constants import ALBEDO_MAX, BASIS_SIZES, BRICK_CELL_M, MAX_BRICK_LEVEL
from gi_core.container import Container
from gi_core.errors import CorruptFileError
from gi_core.grid import SectorIndex
from gi_core.sector import Sector, check_sector, counts, starts

KIND = "SECT"
VERSION = 1
NO_PROBE = 0xFFFF
# Kernels are built for the number of probes that a surfel or voxel blends: a file must not choose how long a compiler runs.
MAX_BLENDED_PROBES = 32
# A brick's cell is divided into 256 steps: 1.6 cm of 4 m.
_CELL_STEPS = 256
# Codes of harmonics' weights are multiples of these, by band: an eighth less of a file, for 0.2 % of a probe's light (MATH.md).
_BAND_STEPS = np.repeat([1, 3, 4], [1, 3, 5])
# One step brings a sum to within the smallest step that a weight of it can take.
_BALANCING_STEPS = 3
_META = frozenset({"sector", "sky_patches", "voxel_first", "bake"})
# Fields that are stored under another name: starts as counts, positions within their brick's cell.
_RENAMED = {"factor_starts": "factor_count", "brick_starts": "brick_count", "surfel_position": "surfel_in_cell"}
_ARRAYS = frozenset(_RENAMED.get(f.name, f.name) for f in fields(Sector)) - {"index", "voxel_first"} | {"factor_scale"}


def encode(sector: Sector, meta: dict[str, Any], sky_patches: int) -> bytes:
    """Bytes of a sector file. ``meta`` is any JSON object: the baker's fingerprint, counts and report."""
    s = sector
    weight_codes, weight_scales = _encode_weights(s)
    cell, size = _surfel_cells(s.brick_cell, s.brick_level, s.brick_starts)
    in_cell = np.floor((s.surfel_position / size - cell) * _CELL_STEPS)
    feedback = np.where(s.feedback_weight > 0, s.feedback_probe, NO_PROBE).astype(np.uint16)
    arrays: dict[str, AnyArray] = {
        "probe_position": quantise.encode_length(s.probe_position).T,
        "probe_flags": s.probe_flags,
        "probe_room": quantise.smallest_unsigned(s.probe_room),
        "factor_count": counts(s.factor_starts).astype(np.uint16),
        "factor_source": s.factor_source.astype(np.uint32),
        "factor_weight": weight_codes,
        "factor_scale": weight_scales,
        "brick_count": counts(s.brick_starts).astype(np.uint16),
        "brick_level": s.brick_level,
        "brick_cell": s.brick_cell.T.astype(np.int32),
        "brick_direction": s.brick_direction,
        "surfel_in_cell": np.clip(in_cell, 0, _CELL_STEPS - 1).astype(np.uint8).T,
        "surfel_normal": quantise.encode_unit(s.surfel_normal),
        "surfel_albedo": quantise.encode_root(s.surfel_albedo).T,
        "surfel_snow": quantise.encode_fraction(s.surfel_snow),
        "feedback_probe": feedback.T,
        "sun_visibility": s.sun_visibility,
        "voxel_class": s.voxel_class,
        "voxel_room": quantise.smallest_unsigned(s.voxel_room),
        "voxel_probe": np.moveaxis(s.voxel_probe, 3, 0),
        "voxel_weight": np.moveaxis(quantise.encode_fraction(s.voxel_weight), 3, 0),
    }
    if s.feedback_probe.shape[1] > 1:
        # Shares only count beside each other: the largest of a surfel has all of a byte.
        arrays["feedback_weight"] = quantise.encode_fraction(
            s.feedback_weight / np.maximum(s.feedback_weight.max(axis=1, keepdims=True), 1e-30)
        ).T
    if s.surfel_emission is not None:
        arrays["surfel_emission"] = s.surfel_emission.astype(np.float32).T
    full_meta = {
        "sector": [s.index.x, s.index.z],
        "sky_patches": sky_patches,
        "voxel_first": [int(v) for v in s.voxel_first],
        "bake": meta,
    }
    delta = frozenset({"probe_position", "factor_source", "brick_cell", "voxel_probe"})
    return container.encode(KIND, VERSION, full_meta, arrays, delta)


def decode(data: bytes, where: str) -> tuple[Sector, dict[str, Any]]:
    """A sector and its baker's meta, every count, range and index checked. Raises CorruptFileError or FormatVersionError."""
    found = container.decode(data, KIND, VERSION, where)
    try:
        sector = _sector(found)
        check_sector(sector, int(found.meta["sky_patches"]))
        return sector, dict(found.meta["bake"])
    except CorruptFileError as error:
        raise CorruptFileError(f"{where}: {error}") from error
    except (KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
        raise CorruptFileError(f"{where}: inconsistent contents ({type(error).__name__}: {error}); bake it again") from error


def read(path: Path) -> tuple[Sector, dict[str, Any]]:
    """A sector file from disk, as ``decode``."""
    return decode(container.read_bytes(path), str(path))


def quantised(sector: Sector, sky_patches: int) -> Sector:
    """The sector as a reader will see it: what the file's precision leaves of it."""
    return decode(encode(sector, {}, sky_patches), f"sector {sector.index}")[0]


def _surfel_cells(brick_cell: AnyArray, brick_level: AnyArray, brick_starts: AnyArray) -> tuple[AnyArray, AnyArray]:
    """The cell (S, 3) of each surfel's brick, and its size (S, 1) [m]."""
    of_surfel = np.repeat(np.arange(len(brick_cell)), counts(brick_starts))
    return brick_cell[of_surfel], BRICK_CELL_M * 2.0 ** brick_level[of_surfel, None]


def _is_sky(s: Sector) -> AnyArray:
    return s.factor_source >= s.brick_count


def _probe_of_factor(factor_starts: AnyArray) -> AnyArray:
    return np.repeat(np.arange(len(factor_starts) - 1), counts(factor_starts))


def _encode_weights(s: Sector) -> tuple[AnyArray, AnyArray]:
    """Factor weights as (B, F) codes of their square root, and float16 (2, B, P) scales for bricks and sky.

    The cube's are uint8; spherical harmonics have a sign, and int8, and are stored as shares (basis.factor_shares).

    A scale is chosen so that each probe's weights (their magnitudes) still sum to what they did: rounding moves light between a
    probe's bricks, but neither makes nor loses any.
    """
    basis, probes = s.basis_size, s.probe_count
    row = _is_sky(s) * probes + _probe_of_factor(s.factor_starts)  # bricks first, then sky
    signed = basis != BASIS_SIZES["cube"]
    share = factor_shares(basis_of_size(basis))
    codes = np.zeros((basis, s.factor_count), np.int8 if signed else np.uint8)
    scales = np.zeros((2, basis, probes), np.float16)
    for b in range(basis):
        weight = s.factor_weight[:, b].astype(np.float64) * share[b]
        top = np.zeros(2 * probes)
        np.maximum.at(top, row, np.abs(weight))
        relative = weight / np.maximum(top[row], 1e-30)
        codes[b] = quantise.encode_signed_root(relative, int(_BAND_STEPS[b])) if signed else quantise.encode_root(relative)
        kept = np.bincount(row, np.abs(_decode_root(codes[b]).astype(np.float64)), 2 * probes)
        total = np.bincount(row, np.abs(weight), 2 * probes)
        scales[:, b] = quantise.half_below(total / np.maximum(kept, 1e-30)).reshape(2, probes)
        if b and signed:
            codes[b] = _balanced(codes[b], weight, scales[:, b].reshape(-1), row, int(_BAND_STEPS[b]))
    return codes, scales


def _balanced(codes: AnyArray, weight: AnyArray, scale: AnyArray, row: AnyArray, step: int) -> AnyArray:
    """Codes (F,) of one harmonic of which some are a step higher or lower, so that the weights of each row sum to what they did.

    Light that is alike from everywhere has no direction, and rounding must not give it one: in a row the harmonic's signs cancel.
    """
    adjusted = codes.astype(np.int64)
    for _ in range(_BALANCING_STEPS):
        stored = _decode_root(adjusted.astype(np.int8)).astype(np.float64) * scale[row]
        lacks = np.bincount(row, weight - stored, len(scale))
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


def _decode_weights(codes: AnyArray, scales: AnyArray, factor_starts: AnyArray, is_sky: AnyArray) -> Float32:
    if not np.isfinite(scales).all():
        raise CorruptFileError("factor_scale is not finite")
    signed = codes.dtype == np.int8
    # Most factors are of bricks: their scales are repeated row by row, a fifth of the time that indexing each takes, and the sky's put in.
    by_probe = np.ascontiguousarray(scales.astype(np.float32).transpose(0, 2, 1))
    scale = np.repeat(by_probe[0], counts(factor_starts), axis=0)
    sky = np.flatnonzero(is_sky)
    scale[sky] = by_probe[1][np.searchsorted(factor_starts, sky, side="right") - 1]
    weights = _decode_root(np.ascontiguousarray(codes.T))
    weights *= scale
    if signed:
        weights /= factor_shares(basis_of_size(len(codes))).astype(np.float32)
    return weights


def _sector(found: Container) -> Sector:
    take = found.take
    found.refuse_unknown(_META, _ARRAYS)
    factor_starts, brick_starts = starts(take("factor_count", "u2", 1)), starts(take("brick_count", "u2", 1))
    brick_cell = np.ascontiguousarray(take("brick_cell", "i4", 2).T)
    brick_level = take("brick_level", "u1", 1)
    source = take("factor_source", "u4", 1)
    in_cell = take("surfel_in_cell", "u1", 2).T
    # A wrong count would otherwise size the arrays that np.repeat makes.
    if int(factor_starts[-1]) != len(source) or int(brick_starts[-1]) != len(in_cell) or len(brick_cell) != len(brick_starts) - 1:
        raise CorruptFileError("counts per probe or brick do not add up")
    if brick_level.max(initial=0) > MAX_BRICK_LEVEL:
        raise CorruptFileError(f"expected brick levels up to {MAX_BRICK_LEVEL}, got {brick_level.max()}")
    cell, size = _surfel_cells(brick_cell, brick_level, brick_starts)
    position = (cell + (in_cell.astype(np.float64) + 0.5) / _CELL_STEPS) * size
    feedback = take("feedback_probe", "u2", 2).T
    voxel_share = np.moveaxis(take("voxel_weight", "u1", 4), 0, 3)
    if not 1 <= feedback.shape[1] <= MAX_BLENDED_PROBES or not 1 <= voxel_share.shape[3] <= MAX_BLENDED_PROBES:
        raise CorruptFileError(f"expected 1 to {MAX_BLENDED_PROBES} probes for each surfel and voxel")
    lit = feedback != NO_PROBE
    if feedback.shape[1] > 1:
        share = take("feedback_weight", "u1", 2).T * lit
        feedback_weight = share / np.maximum(share.sum(axis=1, keepdims=True), 1)
    else:
        feedback_weight = lit
    voxel_share = voxel_share.astype(np.float32)
    voxel_weight = voxel_share / np.maximum(voxel_share.sum(axis=3, keepdims=True), 1)
    emission = take("surfel_emission", "f4", 2).T if "surfel_emission" in found.arrays else None
    index = found.meta["sector"]
    return Sector(
        index=SectorIndex(int(index[0]), int(index[1])),
        probe_position=np.ascontiguousarray(quantise.decode_length(take("probe_position", "i4", 2).T), np.float32),
        probe_flags=take("probe_flags", "u1", 1),
        probe_room=_unsigned(found, "probe_room").astype(np.uint16),
        factor_starts=factor_starts,
        factor_source=source,
        factor_weight=_decode_weights(_weight_codes(found), take("factor_scale", "f2", 3), factor_starts, source >= len(brick_cell)),
        brick_starts=brick_starts,
        brick_level=brick_level,
        brick_cell=brick_cell,
        brick_direction=take("brick_direction", "u1", 1),
        surfel_position=np.ascontiguousarray(position, np.float32),
        surfel_normal=quantise.decode_unit(take("surfel_normal", "u1", 2)),
        # The code next to 0.95 stands for 0.9535, and the bounces' convergence rests on the bound.
        surfel_albedo=np.minimum(quantise.decode_root(take("surfel_albedo", "u1", 2)).T, np.float32(ALBEDO_MAX)),
        surfel_snow=take("surfel_snow", "u1", 1).astype(np.float32) / np.float32(255),
        surfel_emission=None if emission is None else np.ascontiguousarray(emission),
        feedback_probe=np.ascontiguousarray(np.where(lit, feedback, 0), np.uint16),
        feedback_weight=np.ascontiguousarray(feedback_weight, np.float32),
        sun_visibility=take("sun_visibility", "u4", 2),
        voxel_first=np.array([int(v) for v in found.meta["voxel_first"]], np.int32),
        voxel_class=take("voxel_class", "u1", 3),
        voxel_room=_unsigned(found, "voxel_room").astype(np.uint16),
        voxel_probe=np.ascontiguousarray(np.moveaxis(take("voxel_probe", "u2", 4), 0, 3)),
        voxel_weight=np.ascontiguousarray(voxel_weight, np.float32),
    )


def _weight_codes(found: Container) -> AnyArray:
    """factor_weight: (6, F) unsigned for the cube, (4, F) or (9, F) signed for spherical harmonics."""
    values = found.arrays.get("factor_weight")
    return found.take("factor_weight", "u1" if values is None or len(values) == BASIS_SIZES["cube"] else "i1", 2)


def _unsigned(found: Container, name: str) -> AnyArray:
    values = found.arrays.get(name)
    if values is None or values.dtype.kind != "u" or values.max(initial=0) > 0xFFFF:
        raise CorruptFileError(f"array {name!r} of unsigned integers below 65536 is missing")
    return values
