"""Sector <-> bytes of a ``.gisec`` file. FORMAT.md describes each array; the two functions here mirror each other."""

from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from gi_core import container, quantise, voxel_lists
from gi_core.arrays import AnyArray, Float32, Float64
from gi_core.constants import ALBEDO_MAX, BASIS_SIZES, BRICK_CELL_M, MAX_BRICK_LEVEL, MAX_SKY_PATCHES
from gi_core.container import Container
from gi_core.errors import CorruptFileError, FormatVersionError
from gi_core.factor_directions import brick_centres, expected_directions
from gi_core.factor_weights import Codes
from gi_core.grid import sector_index
from gi_core.sector import Sector, check_sector, counts, starts

KIND = "SECT"
# Such bakes take seconds: 5 % less for a twentieth more of them. Level 19 saves 1 % more and takes twice as long.
HARMONICS_LEVEL = 17
VERSION = 2
VERSIONS = (1, 2)
NO_PROBE = 0xFFFF
# Kernels are built for the number of probes that a surfel or voxel blends: a file must not choose how long a compiler runs.
MAX_BLENDED_PROBES = 32
# A brick's cell is divided into 256 steps: 1.6 cm of 4 m.
_CELL_STEPS = 256
# Along a surfel's surface an eighth of them will do: 12 cm of a cell of 1 m. Across it, shadows would begin below the surface.
_STEPS_ALONG = 8
# Lists are stored once, and a voxel's list may be any: this bounds what readers make of it.
MAX_VOXEL_PROBES = 1 << 26
_META = frozenset({"sector", "sky_patches", "voxel_first", "bake"})
# Fields that are stored under another name: starts as counts, positions within their brick's cell.
_RENAMED = {
    "factor_starts": "factor_count",
    "factor_code": "factor_weight",
    "brick_starts": "brick_count",
    "surfel_position": "surfel_in_cell",
}
_ARRAYS = frozenset(_RENAMED.get(f.name, f.name) for f in fields(Sector)) - {"index", "voxel_first"} | {"factor_direction", "voxel_list"}
_IN_HARMONICS = frozenset({"factor_direction", "factor_trim"})
_SINCE_2 = frozenset({"voxel_list"})


def encode(sector: Sector, meta: dict[str, Any], sky_patches: int) -> bytes:
    """Bytes of a sector file. ``meta`` is any JSON object: the baker's fingerprint, counts and report."""
    s = sector
    cell, size = _surfel_cells(s.brick_cell, s.brick_level, s.brick_starts)
    in_cell = np.clip(np.floor((s.surfel_position / size - cell) * _CELL_STEPS), 0, _CELL_STEPS - 1).astype(np.uint8).T
    across = np.repeat(s.brick_direction // 2, counts(s.brick_starts)) == np.arange(3)[:, None]
    in_cell = np.where(across, in_cell, in_cell // _STEPS_ALONG * _STEPS_ALONG + _STEPS_ALONG // 2).astype(np.uint8)
    voxel_list, voxel_probe, voxel_weight = voxel_lists.pack(s.voxel_probe, s.voxel_weight)
    probe_position = quantise.encode_length(s.probe_position).T
    weight, direction = np.split(s.factor_code, [s.factor_scale.shape[2]], axis=1)
    feedback = np.where(s.feedback_weight > 0, s.feedback_probe, NO_PROBE).astype(np.uint16)
    arrays: dict[str, AnyArray] = {
        "probe_position": probe_position,
        "probe_flags": s.probe_flags,
        "probe_room": quantise.smallest_unsigned(s.probe_room),
        "factor_count": counts(s.factor_starts).astype(np.uint16),
        "factor_source": quantise.smallest_unsigned(s.factor_source),
        "factor_weight": weight.T,
        "factor_scale": np.moveaxis(s.factor_scale, 0, 2),
        "brick_count": counts(s.brick_starts).astype(np.uint16),
        "brick_level": s.brick_level,
        "brick_cell": s.brick_cell.T.astype(np.int32),
        "brick_direction": s.brick_direction,
        "surfel_in_cell": in_cell,
        "surfel_normal": quantise.encode_unit(s.surfel_normal),
        "surfel_albedo": quantise.encode_root(s.surfel_albedo),
        "surfel_snow": quantise.encode_fraction(s.surfel_snow),
        "feedback_probe": feedback.T,
        "sun_visibility": np.ascontiguousarray(s.sun_visibility, "<u4").view(np.uint8),
        "voxel_class": s.voxel_class,
        "voxel_room": quantise.smallest_unsigned(s.voxel_room),
        "voxel_list": quantise.smallest_unsigned(voxel_list),
        "voxel_probe": voxel_probe,
        "voxel_weight": voxel_weight,
    }
    if s.factor_trim is not None:
        centres = brick_centres(s.brick_cell, s.brick_level, s.brick_starts, in_cell)
        expected = expected_directions(probe_position, centres, s.factor_starts, s.factor_source, sky_patches)
        arrays["factor_direction"] = direction - expected.T  # wraps
        arrays["factor_trim"] = np.moveaxis(s.factor_trim, 0, 2)
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
    return container.encode(
        KIND, VERSION, full_meta, arrays, delta, container.ZSTD_LEVEL if s.basis_size == BASIS_SIZES["cube"] else HARMONICS_LEVEL
    )


def decode(data: bytes, where: str) -> tuple[Sector, dict[str, Any]]:
    """A sector and its baker's meta, every count, range and index checked. Raises CorruptFileError or FormatVersionError."""
    found = container.decode(data, KIND, VERSIONS, where)
    weights = found.arrays.get("factor_weight")
    if found.version == 1 and weights is not None and weights.shape[:1] != (BASIS_SIZES["cube"],):
        raise FormatVersionError(
            f"{where}: format version 1 in harmonics, this program reads version {VERSION}; bake the dataset again with this program"
        )
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


def _surfel_positions(brick_cell: AnyArray, brick_level: AnyArray, brick_starts: AnyArray, in_cell: AnyArray) -> Float32:
    """(S, 3) [m]: the middles of the steps (3, S) that surfels stand on. Rounded once, at the end: until then all digits are kept."""
    number = counts(brick_starts)
    step = BRICK_CELL_M / _CELL_STEPS * 2.0**brick_level
    first = step[:, None] * (_CELL_STEPS * brick_cell.astype(np.float64) + 0.5)
    step_of_surfel = np.repeat(step, number)
    found = np.empty((in_cell.shape[1], 3), np.float32)
    for axis in range(3):
        found[:, axis] = np.repeat(first[:, axis], number) + step_of_surfel * in_cell[axis]
    return found


def _sector(found: Container) -> Sector:
    take = found.take
    absent = _IN_HARMONICS if "factor_trim" not in found.arrays or found.version == 1 else frozenset()
    found.refuse_unknown(_META, _ARRAYS - absent - (_SINCE_2 if found.version == 1 else frozenset()))
    factor_starts, brick_starts = starts(take("factor_count", "u2", 1)), starts(take("brick_count", "u2", 1))
    brick_cell = np.ascontiguousarray(take("brick_cell", "i4", 2).T)
    brick_level = take("brick_level", "u1", 1)
    source = _unsigned(found, "factor_source", 1, 1 << 32).astype(np.uint32)
    in_cell = take("surfel_in_cell", "u1", 2)
    # A wrong count would otherwise size the arrays that np.repeat makes.
    if int(factor_starts[-1]) != len(source) or in_cell.shape != (3, int(brick_starts[-1])) or len(brick_cell) != len(brick_starts) - 1:
        raise CorruptFileError("counts per probe or brick do not add up")
    if brick_level.max(initial=0) > MAX_BRICK_LEVEL:
        raise CorruptFileError(f"expected brick levels up to {MAX_BRICK_LEVEL}, got {brick_level.max()}")
    if (counts(brick_starts) <= 0).any() or brick_cell.shape[1:] != (3,):
        raise CorruptFileError("expected no empty brick, and three coordinates of each")
    probe_position = take("probe_position", "i4", 2)
    codes = _codes(found, probe_position, lambda: brick_centres(brick_cell, brick_level, brick_starts, in_cell), factor_starts, source)
    albedo = take("surfel_albedo", "u1", 2)
    feedback = take("feedback_probe", "u2", 2).T
    voxel_class = take("voxel_class", "u1", 3)
    voxel_probe, voxel_weight = _voxels(found, voxel_class)
    if not 1 <= feedback.shape[1] <= MAX_BLENDED_PROBES or not 1 <= voxel_weight.shape[3] <= MAX_BLENDED_PROBES:
        raise CorruptFileError(f"expected 1 to {MAX_BLENDED_PROBES} probes for each surfel and voxel")
    lit = feedback != NO_PROBE
    if feedback.shape[1] > 1:
        share = take("feedback_weight", "u1", 2).T * lit
        feedback_weight = share / np.maximum(share.sum(axis=1, keepdims=True), 1)
    else:
        feedback_weight = lit
    emission = take("surfel_emission", "f4", 2).T if "surfel_emission" in found.arrays else None
    return Sector(
        index=sector_index(found.meta["sector"]),
        probe_position=np.ascontiguousarray(quantise.decode_length(probe_position.T), np.float32),
        probe_flags=take("probe_flags", "u1", 1),
        probe_room=_unsigned(found, "probe_room", 1).astype(np.uint16),
        factor_starts=factor_starts,
        factor_source=source,
        **codes._asdict(),
        brick_starts=brick_starts,
        brick_level=brick_level,
        brick_cell=brick_cell,
        brick_direction=take("brick_direction", "u1", 1),
        surfel_position=_surfel_positions(brick_cell, brick_level, brick_starts, in_cell),
        surfel_normal=quantise.decode_unit(take("surfel_normal", "u1", 2)),
        # The code next to 0.95 stands for 0.9535, and the bounces' convergence rests on the bound.
        surfel_albedo=np.minimum(quantise.decode_root(albedo.T if found.version == 1 else albedo), np.float32(ALBEDO_MAX)),
        surfel_snow=take("surfel_snow", "u1", 1).astype(np.float32) / np.float32(255),
        surfel_emission=None if emission is None else np.ascontiguousarray(emission),
        feedback_probe=np.ascontiguousarray(np.where(lit, feedback, 0), np.uint16),
        feedback_weight=np.ascontiguousarray(feedback_weight, np.float32),
        sun_visibility=take("sun_visibility", "u4", 2) if found.version == 1 else _words(take("sun_visibility", "u1", 2)),
        voxel_first=np.array([int(v) for v in found.meta["voxel_first"]], np.int32),
        voxel_class=voxel_class,
        voxel_room=_unsigned(found, "voxel_room", 3).astype(np.uint16),
        voxel_probe=voxel_probe,
        voxel_weight=voxel_weight,
    )


def _codes(found: Container, probe_position: AnyArray, centres: Callable[[], Float64], factor_starts: AnyArray, source: AnyArray) -> Codes:
    """The cube's are all stored; harmonics' directions beside what their bricks' ``centres`` let expect."""
    scale = np.ascontiguousarray(np.moveaxis(found.take("factor_scale", "f2", 3), 2, 0))
    if "factor_trim" not in found.arrays:
        return Codes(container.interleaved(found.take("factor_weight", "u1", 2)), scale, None)
    weight, difference = found.take("factor_weight", "i1", 2), found.take("factor_direction", "i1", 2)
    patches = int(found.meta["sky_patches"])
    if weight.shape != (1, len(source)) or difference.shape != (len(source), 3) or probe_position.shape != (3, len(factor_starts) - 1):
        raise CorruptFileError(f"expected a weight and a direction of {len(source)} factors, and three coordinates a probe")
    if not 1 <= patches <= MAX_SKY_PATCHES:
        raise CorruptFileError(f"expected 1 to {MAX_SKY_PATCHES} sky patches, got {patches}")
    expected = expected_directions(probe_position, centres(), factor_starts, source, patches)
    for row, column in zip(expected, difference.T, strict=True):
        row += column  # wraps
    trim = np.ascontiguousarray(np.moveaxis(found.take("factor_trim", "i1", 3), 2, 0))
    # As four rows in memory: so they are checked, and so a device takes them.
    return Codes(np.concatenate([weight, expected]).T, scale, trim)


def _words(octets: AnyArray) -> AnyArray:
    """Bytes (D, 4 n) -> uint32 (D, n). Raises CorruptFileError where no words come of them."""
    if octets.shape[1] % 4:
        raise CorruptFileError(f"expected whole words of sun visibility, got {octets.shape[1]} bytes")
    return octets.view("<u4").astype(np.uint32, copy=False)


def _voxels(found: Container, voxel_class: AnyArray) -> tuple[AnyArray, Float32]:
    """Probes (ny, nz, nx, K) uint16 and weights float32 of each voxel."""
    rank = 4 if found.version == 1 else 2
    stored, code = found.take("voxel_probe", "u2", rank), found.take("voxel_weight", "u1", rank)
    if stored.shape != code.shape or code.shape[0] * voxel_class.size > MAX_VOXEL_PROBES:
        raise CorruptFileError(f"expected as many weights as probes, and at most {MAX_VOXEL_PROBES} of all voxels")
    share = code.astype(np.float32)
    share /= np.maximum(share.sum(axis=0), 1)
    probe, weight = (np.ascontiguousarray(np.moveaxis(values, 0, -1)) for values in (stored, share))
    if found.version > 1:
        codes = _unsigned(found, "voxel_list", 3)
        if codes.shape != voxel_class.shape:
            raise CorruptFileError(f"expected a list of probes for each of {voxel_class.shape} voxels, got {codes.shape}")
        number = voxel_lists.numbers(codes, len(probe))
        probe, weight = probe.take(number, axis=0), weight.take(number, axis=0)
    return probe, weight


def _unsigned(found: Container, name: str, ndim: int, below: int = 1 << 16) -> AnyArray:
    values = found.arrays.get(name)
    if values is None or values.dtype.kind != "u" or values.ndim != ndim or values.max(initial=0) >= below:
        raise CorruptFileError(f"array {name!r} of unsigned integers below {below} is missing")
    return values
