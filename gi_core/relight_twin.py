"""The relighter in NumPy, written to be read and to be trusted: twin of relight_bricks.cl, gather_probes.cl and fill_volume.cl.

With dtype float64 it is also the solver that the kernels are judged by.
"""

from typing import Any

import numpy as np

from gi_core.ambient_cube import basis_weights
from gi_core.arrays import AnyArray, Float64
from gi_core.constants import SNOW_ALBEDO
from gi_core.relight_input import RelightInput
from gi_core.sector import Sector, counts


def sun_bits(sector: Sector, plane: int) -> AnyArray:
    """(S,) uint8: the visibility bits of one plane."""
    octets = sector.sun_visibility[plane].astype("<u4").view(np.uint8)
    return np.unpackbits(octets, bitorder="little")[: sector.surfel_count]


def directional_irradiance(sector: Sector, given: RelightInput, dtype: Any = np.float32) -> AnyArray:
    """Sun and moon on each surfel: (S, 3) [lx]. It does not change from pass to pass."""
    total = np.zeros((sector.surfel_count, 3), dtype)
    for light in given.lights:
        cosine = np.maximum(np.einsum("sa,a->s", sector.surfel_normal.astype(dtype), light["direction"][:3].astype(dtype)), 0)
        visibility = np.zeros(sector.surfel_count, dtype)
        for plane, weight in zip(light["plane"], light["plane_weight"], strict=True):
            visibility += dtype(weight) * sun_bits(sector, int(plane))
        total += (cosine * visibility)[:, None] * light["irradiance"][:3].astype(dtype)
    return total


def snowed_albedo(sector: Sector, snow: float, dtype: Any = np.float32) -> AnyArray:
    """(S, 3): albedo blended to white where snow lies (slide "Procedural snow"). Without snow, the albedo itself."""
    albedo = sector.surfel_albedo.astype(dtype)
    cover = (dtype(snow) * sector.surfel_snow.astype(dtype))[:, None]
    return albedo + (dtype(SNOW_ALBEDO) - albedo) * cover


def relight_bricks(sector: Sector, given: RelightInput, cubes: AnyArray, direct: AnyArray, dtype: Any = np.float32) -> AnyArray:
    """Exitance (N + patches, 3) [lx] of bricks and sky patches, from last pass's cubes (P, 6, 3) and ``directional_irradiance``."""
    irradiance = direct.copy()
    if sector.probe_count:
        face_weight = basis_weights(sector.surfel_normal).astype(dtype)
        for k in range(sector.feedback_probe.shape[1]):
            bounced = np.einsum("sb,sbc->sc", face_weight, cubes[sector.feedback_probe[:, k]])
            irradiance += sector.feedback_weight[:, k, None].astype(dtype) * bounced
    exitance = snowed_albedo(sector, given.snow, dtype) * irradiance
    if sector.surfel_emission is not None:
        exitance += dtype(np.pi) * sector.surfel_emission.astype(dtype)
    bricks = np.add.reduceat(exitance, sector.brick_starts[:-1].astype(np.int64), axis=0) if sector.brick_count else exitance[:0]
    bricks /= counts(sector.brick_starts)[:, None].astype(dtype)
    return np.concatenate([bricks, given.patch_exitance.astype(dtype)])


def gather_probes(sector: Sector, exitance: AnyArray, dtype: Any = np.float32) -> AnyArray:
    """Probe cubes (P, B, 3) [lx] from the exitance of all sources."""
    cubes = np.zeros((sector.probe_count, sector.basis_size, 3), dtype)
    has = np.flatnonzero(counts(sector.factor_starts))
    if len(has):
        gathered = sector.factor_weight.astype(dtype)[:, :, None] * exitance[sector.factor_source][:, None, :]
        cubes[has] = np.add.reduceat(gathered, sector.factor_starts[:-1][has].astype(np.int64), axis=0)
    return cubes


def relight(
    sector: Sector, given: RelightInput, cubes: AnyArray, passes: int, dtype: Any = np.float32, lamps: AnyArray | None = None
) -> AnyArray:
    """Cubes (P, B, 3) [lx] after some passes, starting from others; each pass adds a bounce. lamps : (S, 3) [lx] on each surfel."""
    direct = directional_irradiance(sector, given, dtype) + (0 if lamps is None else lamps.astype(dtype))
    for _ in range(passes):
        cubes = gather_probes(sector, relight_bricks(sector, given, cubes, direct, dtype), dtype)
    return cubes


def solve(
    sector: Sector, given: RelightInput, tolerance: float = 1e-10, max_passes: int = 10_000, lamps: AnyArray | None = None
) -> Float64:
    """The fixed point (P, B, 3) [lx] in float64: passes until none changes any value by more than tolerance times the peak."""
    cubes = np.zeros((sector.probe_count, sector.basis_size, 3))
    direct = directional_irradiance(sector, given, np.float64) + (0 if lamps is None else lamps.astype(np.float64))
    for _ in range(max_passes):
        after = gather_probes(sector, relight_bricks(sector, given, cubes, direct, np.float64), np.float64)
        change, cubes = np.abs(after - cubes).max(initial=0), after
        if change <= tolerance * np.abs(cubes).max(initial=0):
            break
    return cubes


def blend_voxels(sector: Sector, cubes: AnyArray) -> AnyArray:
    """Irradiance (ny, nz, nx, B, 3) [lx] at a sector's voxels."""
    return np.einsum("yzxk,yzxkbc->yzxbc", sector.voxel_weight, cubes[sector.voxel_probe])
