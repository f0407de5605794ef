"""One baked sector as arrays: what the talk's slides "Sector layout", "Surfel grid" and "Relighting" show.

Ragged lists are ``<x>_starts`` (one more than there are items) over flat arrays. Positions are sector-local metres: world position
minus ``SectorIndex.origin``, so that a world 50 km from its origin loses nothing in float32.

    probe p   reads factors factor_starts[p] .. factor_starts[p + 1]
    factor f  weighs source factor_source[f] in each of the B basis functions: factor_weight[f], which is what its code stands for
    source s  is brick s when s < bricks, otherwise sky patch s - bricks
    brick b   averages surfels brick_starts[b] .. brick_starts[b + 1]
    surfel s  is lit by sun and moon through sun_visibility, by feedback_probe[s] with feedback_weight[s], and by its emission
    voxel v   blends probes voxel_probe[v] with voxel_weight[v]

A factor's weight times its source's exitance [lx] is what it adds to a coefficient of the probe's irradiance [lx] (gi_core.basis). Of the
cube, weights are form factors: over one face they sum to at most one (sky included); so do the harmonics', times basis.factor_shares.
A sky patch's exitance is pi times its radiance.
"""

from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np

from gi_core import factor_weights
from gi_core.arrays import AnyArray, Float16, Float32, Int8, Int32, Int64, UInt8, UInt16, UInt32
from gi_core.constants import ALBEDO_MAX, BASIS_SIZES, MAX_BRICK_LEVEL, MAX_PROBES_PER_SECTOR, MAX_SKY_PATCHES
from gi_core.errors import CorruptFileError
from gi_core.factor_weights import DIRECTION_STEPS, FACE_STEPS, HARMONIC_CODES, Codes
from gi_core.grid import SectorIndex, voxel_columns

PROBE_ON_GROUND, PROBE_ON_WALL, PROBE_IN_MARGIN = 1, 2, 4  # bits of probe_flags


@dataclass(frozen=True, eq=False)
class Sector:
    """A sector's arrays. P probes, F factors, B basis functions, N bricks, S surfels, k feedback probes, D sun planes, K probes a voxel.

    probe_position : (P, 3) float32 [m], sector-local
    probe_flags : (P,) uint8, bits PROBE_ON_GROUND, PROBE_ON_WALL, PROBE_IN_MARGIN (it lies beyond the border, so that there is no seam)
    probe_room : (P,) uint16, 0 outdoors
    factor_starts : (P + 1,) uint32
    factor_source : (F,) uint32, < N a brick, otherwise sky patch source - N; a probe's bricks come first
    factor_code : (F, 6) uint8 of the cube, (F, 4) int8 of harmonics (gi_core.factor_weights)
    factor_scale : (P, 2, 6) float16 of the cube, (P, 2, 1) of harmonics: of each probe's bricks, and of its sky
    factor_trim : (P, 2, B - 1) int8, of harmonics; None of the cube
    brick_starts : (N + 1,) uint32; no brick is empty
    brick_level : (N,) uint8; a brick's cell is BRICK_CELL_M * 2 ** level wide, its surfels' cells SURFEL_CELL_M * 2 ** level
    brick_cell : (N, 3) int32, which cell of that size in sector-local space
    brick_direction : (N,) uint8, principal normal direction of its surfels, an ambient cube face
    surfel_position : (S, 3) float32 [m], sector-local
    surfel_normal : (S, 3) float32, unit, towards the side that probes see
    surfel_albedo : (S, 3) float32, linear sRGB, 0..ALBEDO_MAX
    surfel_snow : (S,) float32, 0..1: how much of fallen snow lies here
    surfel_emission : (S, 3) float32 [cd m^-2], or None when nothing in the sector shines by itself
    feedback_probe : (S, k) uint16
    feedback_weight : (S, k) float32, rows sum to 1, or to 0 where no probe sees the surfel
    sun_visibility : (D, ceil(S / 32)) uint32; bit s % 32 of word s // 32 of plane d: surfel s sees the sun of plane d
    voxel_first : (3,) int32, world lattice index (x, y, z) of voxel (0, 0, 0)
    voxel_class : (ny, nz, nx) uint8, VOXEL_SOLID, VOXEL_OUTDOORS or VOXEL_INDOORS
    voxel_room : (ny, nz, nx) uint16
    voxel_probe : (ny, nz, nx, K) uint16
    voxel_weight : (ny, nz, nx, K) float32, sums to 1 at every voxel (solid ones: what the nearest air does, or surfaces need), or to 0
        everywhere when the sector has no probe
    """

    index: SectorIndex
    probe_position: Float32
    probe_flags: UInt8
    probe_room: UInt16
    factor_starts: UInt32
    factor_source: UInt32
    factor_code: UInt8 | Int8
    factor_scale: Float16
    factor_trim: Int8 | None
    brick_starts: UInt32
    brick_level: UInt8
    brick_cell: Int32
    brick_direction: UInt8
    surfel_position: Float32
    surfel_normal: Float32
    surfel_albedo: Float32
    surfel_snow: Float32
    surfel_emission: Float32 | None
    feedback_probe: UInt16
    feedback_weight: Float32
    sun_visibility: UInt32
    voxel_first: Int32
    voxel_class: UInt8
    voxel_room: UInt16
    voxel_probe: UInt16
    voxel_weight: Float32

    @property
    def probe_count(self) -> int:
        return len(self.probe_position)

    @property
    def factor_count(self) -> int:
        return len(self.factor_source)

    @property
    def brick_count(self) -> int:
        return len(self.brick_direction)

    @property
    def surfel_count(self) -> int:
        return len(self.surfel_position)

    @property
    def basis_size(self) -> int:
        return BASIS_SIZES["cube"] if self.factor_trim is None else 1 + int(self.factor_trim.shape[2])

    @cached_property
    def sky_starts(self) -> UInt32:
        """(P,): where each probe's sky patches begin among its factors."""
        return factor_weights.sky_starts(self.factor_starts, self.factor_source >= self.brick_count)

    @cached_property
    def factor_weight(self) -> Float32:
        """(F, B) float32: what the codes stand for. Kernels read the codes; this is for the twin, and for looking."""
        return factor_weights.decode(self.factor_codes, self.factor_starts, self.sky_starts)

    @property
    def factor_codes(self) -> Codes:
        return Codes(self.factor_code, self.factor_scale, self.factor_trim)

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays in memory."""
        arrays = (getattr(self, field.name) for field in fields(self))
        return sum(a.nbytes for a in arrays if isinstance(a, np.ndarray))


def counts(list_starts: AnyArray) -> Int64:
    """Items of each list, from its ``starts``: (n + 1,) -> (n,) int64."""
    wide = list_starts.astype(np.int64)
    return wide[1:] - wide[:-1]


def starts(list_counts: AnyArray) -> UInt32:
    """``starts`` of lists of these lengths: (n,) -> (n + 1,) uint32."""
    return np.concatenate([[0], np.cumsum(list_counts, dtype=np.int64)]).astype(np.uint32)


def check_sector(sector: Sector, sky_patches: int) -> None:
    """Raise CorruptFileError unless every count, range and index of a sector holds; what it accepts cannot read out of bounds."""
    s = sector

    def expect(ok: bool | np.bool_, what: str) -> None:
        if not ok:
            raise CorruptFileError(f"sector {s.index}: expected {what}")

    def expect_starts(values: AnyArray, items: int, total: int, name: str) -> None:
        expect(values.shape == (items + 1,), f"{name} to have {items + 1} entries, got {values.shape}")
        expect(values[0] == 0 and values[-1] == total, f"{name} to run from 0 to {total}")
        expect((counts(values) >= 0).all(), f"{name} to be non-decreasing")

    expect(s.probe_count <= MAX_PROBES_PER_SECTOR, f"at most {MAX_PROBES_PER_SECTOR} probes, got {s.probe_count}")
    expect(1 <= sky_patches <= MAX_SKY_PATCHES, f"1 to {MAX_SKY_PATCHES} sky patches, got {sky_patches}")
    is_cube, trims = s.factor_trim is None, s.basis_size - 1
    codes, scales = (trims + 1, trims + 1) if is_cube else (HARMONIC_CODES, 1)
    expect(is_cube or s.basis_size in BASIS_SIZES.values(), f"factor_trim of a basis {BASIS_SIZES}")
    expect(s.factor_code.dtype == (np.uint8 if is_cube else np.int8), "codes with a sign, but for the cube's")
    expect_starts(s.factor_starts, s.probe_count, s.factor_count, "factor_starts")
    expect_starts(s.brick_starts, s.brick_count, s.surfel_count, "brick_starts")
    expect((counts(s.brick_starts) > 0).all(), "no empty brick")
    for items, name, shape in (
        (s.probe_count, "probe_position", (3,)),
        (s.probe_count, "probe_flags", ()),
        (s.probe_count, "probe_room", ()),
        (s.factor_count, "factor_code", (codes,)),
        (s.probe_count, "factor_scale", (2, scales)),
        (s.probe_count, "factor_trim", (2, trims)),
        (s.brick_count, "brick_cell", (3,)),
        (s.brick_count, "brick_level", ()),
        (s.surfel_count, "surfel_normal", (3,)),
        (s.surfel_count, "surfel_albedo", (3,)),
        (s.surfel_count, "surfel_snow", ()),
        (s.surfel_count, "surfel_emission", (3,)),
        (s.surfel_count, "feedback_probe", s.feedback_probe.shape[1:2]),
    ):
        values = getattr(s, name)
        expect(values is None or values.shape == (items, *shape), f"{name} of shape {(items, *shape)}, got {np.shape(values)}")
    expect(s.feedback_probe.shape == s.feedback_weight.shape, "as many feedback weights as probes")
    expect(s.sun_visibility.shape[1] == (s.surfel_count + 31) // 32, f"sun visibility planes of {s.surfel_count} bits")
    expect(s.voxel_class.ndim == 3 and s.voxel_room.shape == s.voxel_class.shape, "one class and one room per voxel")
    (x0, x1), (z0, z1) = voxel_columns(s.index.x), voxel_columns(s.index.z)
    ny, nz, nx = s.voxel_class.shape
    expect(s.voxel_first.shape == (3,) and s.voxel_first[0] == x0 and s.voxel_first[2] == z0, f"voxels from column ({x0}, {z0})")
    expect(ny > 0 and (nz, nx) == (z1 - z0, x1 - x0), f"{z1 - z0} by {x1 - x0} voxel columns with a layer, got {(ny, nz, nx)}")
    expect(s.voxel_probe.shape[:3] == s.voxel_class.shape, "one probe list per voxel")
    expect(s.voxel_probe.shape == s.voxel_weight.shape, "as many voxel weights as probes")
    if s.factor_count:
        expect(int(s.factor_source.max()) < s.brick_count + sky_patches, f"factors of {s.brick_count} bricks and {sky_patches} patches")
    if s.probe_count:
        expect(not s.feedback_probe.size or int(s.feedback_probe.max()) < s.probe_count, f"feedback from {s.probe_count} probes")
        expect(not s.voxel_probe.size or int(s.voxel_probe.max()) < s.probe_count, f"voxels of {s.probe_count} probes")
    else:
        expect(not s.feedback_weight.any() and not s.voxel_weight.any(), "no weights in a sector without probes")
    expect(s.brick_direction.max(initial=0) < 6, "brick directions below 6")
    expect(s.brick_level.max(initial=0) <= MAX_BRICK_LEVEL, f"brick levels up to {MAX_BRICK_LEVEL}")
    expect(s.voxel_class.max(initial=0) <= 2, "voxel classes 0..2")
    for field in fields(s):
        values = getattr(s, field.name)
        if isinstance(values, np.ndarray) and values.dtype.kind == "f":
            expect(np.isfinite(values).all(), f"finite {field.name}")
    expect((s.factor_scale >= 0).all() and (s.factor_scale <= 1).all(), "factor_scale within 0..1")
    # Float32 may round 0.95 up by 6e-8.
    expect((s.surfel_albedo >= 0).all() and (s.surfel_albedo <= ALBEDO_MAX + 1e-6).all(), f"surfel_albedo within 0..{ALBEDO_MAX}")
    if s.factor_count:
        is_sky, starts_sky = s.factor_source >= s.brick_count, np.zeros(s.factor_count + 1, bool)
        starts_sky[s.factor_starts] = True
        expect((is_sky[1:] | ~is_sky[:-1] | starts_sky[1:-1]).all(), "each probe's bricks before its sky patches")
        totals = factor_weights.share_sums(s.factor_codes, s.factor_starts, s.sky_starts)
        # Rounded weights; 1 % leaves each bounce losing 4 % even where every albedo is at its bound.
        expect((totals <= 1.01).all(), f"a probe's factor weights to sum to at most 1 in each basis function, got {totals.max():.3f}")
        if not is_cube:
            expect((s.factor_code[:, 0] >= 0).all(), "no negative factor weights")
            longest = factor_weights.longest_direction(s.factor_code)
            expect(longest <= FACE_STEPS, f"directions of at most {FACE_STEPS} steps, {DIRECTION_STEPS} of them a unit, got {longest:.1f}")
    expect(s.surfel_emission is None or (s.surfel_emission >= 0).all(), "no negative surfel_emission")
