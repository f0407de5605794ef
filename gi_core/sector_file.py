"""Sector <-> bytes of a ``.gisec`` file. FORMAT.md describes each array; the two functions here mirror each other."""

from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from gi_core import container, quantise
from gi_core.arrays import AnyArray
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
_META = frozenset({"sector", "sky_patches", "voxel_first", "bake"})
# Fields that are stored under another name: starts as counts, positions within their brick's cell.
_RENAMED = {
    "factor_starts": "factor_count",
    "factor_code": "factor_weight",
    "brick_starts": "brick_count",
    "surfel_position": "surfel_in_cell",
}
_ARRAYS = frozenset(_RENAMED.get(f.name, f.name) for f in fields(Sector)) - {"index", "voxel_first"}


def encode(sector: Sector, meta: dict[str, Any], sky_patches: int) -> bytes:
    """Bytes of a sector file. ``meta`` is any JSON object: the baker's fingerprint, counts and report."""
    s = sector
    cell, size = _surfel_cells(s.brick_cell, s.brick_level, s.brick_starts)
    in_cell = np.floor((s.surfel_position / size - cell) * _CELL_STEPS)
    feedback = np.where(s.feedback_weight > 0, s.feedback_probe, NO_PROBE).astype(np.uint16)
    arrays: dict[str, AnyArray] = {
        "probe_position": quantise.encode_length(s.probe_position).T,
        "probe_flags": s.probe_flags,
        "probe_room": quantise.smallest_unsigned(s.probe_room),
        "factor_count": counts(s.factor_starts).astype(np.uint16),
        "factor_source": s.factor_source.astype(np.uint32),
        "factor_weight": s.factor_code.T,
        "factor_scale": np.moveaxis(s.factor_scale, 0, 2),
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
        factor_code=container.interleaved(_weight_codes(found)),
        factor_scale=np.ascontiguousarray(np.moveaxis(take("factor_scale", "f2", 3), 2, 0)),
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
