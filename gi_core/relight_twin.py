"""The relighter in NumPy, written to be read and to be trusted: twin of sun_on_surfels.cl, light_bricks.cl, bounce_bricks.cl,
gather_probes.cl and fill_volume.cl.

With dtype float64 it is also the solver that the kernels are judged by.
"""

from typing import Any

import numpy as np

from gi_core.arrays import AnyArray, Float32, Float64, UInt8
from gi_core.basis import FEEDBACK, basis_of_size, feedback_weights
from gi_core.constants import BASIS_SIZES, SNOW_ALBEDO
from gi_core.layout import NO_SAMPLE, WHOLE_SAMPLE
from gi_core.relight_input import RelightInput
from gi_core.sector import Sector, counts

MOST_PASSES = 10_000


def sun_bits(sector: Sector, plane: int) -> AnyArray:
    """(S,) uint8: the visibility bits of one plane."""
    octets = sector.sun_visibility[plane].astype("<u4").view(np.uint8)
    return np.unpackbits(octets, bitorder="little")[: sector.surfel_count]


def directional_irradiance(sector: Sector, given: RelightInput, dtype: Any = np.float32, sun_sample: UInt8 | None = None) -> AnyArray:
    """Sun and moon on each surfel: (S, 3) [lx]. It does not change from pass to pass.

    sun_sample : (S,) of the sun's shadow map, layout.NO_SAMPLE where a surfel has none
    """
    total = np.zeros((sector.surfel_count, 3), dtype)
    for number, light in enumerate(given.lights):
        cosine = np.maximum(np.einsum("sa,a->s", sector.surfel_normal.astype(dtype), light["direction"][:3].astype(dtype)), 0)
        visibility = np.zeros(sector.surfel_count, dtype)
        for plane, weight in zip(light["plane"], light["plane_weight"], strict=True):
            visibility += dtype(weight) * sun_bits(sector, int(plane))
        if sun_sample is not None and number == 0:
            visibility = np.where(sun_sample == NO_SAMPLE, visibility, sun_sample.astype(dtype) / dtype(WHOLE_SAMPLE))
        total += (cosine * visibility)[:, None] * light["irradiance"][:3].astype(dtype)
    return total


def snowed_albedo(sector: Sector, snow: float, dtype: Any = np.float32) -> AnyArray:
    """(S, 3): albedo blended to white where snow lies (slide "Procedural snow"). Without snow, the albedo itself."""
    albedo = sector.surfel_albedo.astype(dtype)
    cover = (dtype(snow) * sector.surfel_snow.astype(dtype))[:, None]
    return albedo + (dtype(SNOW_ALBEDO) - albedo) * cover


def brick_means(sector: Sector, exitance: AnyArray) -> AnyArray:
    """(N, 3): the mean over each brick's surfels of (S, 3)."""
    if not sector.brick_count:
        return exitance[:0]
    sums = np.add.reduceat(exitance, sector.brick_starts[:-1].astype(np.int64), axis=0)
    return np.asarray(sums / counts(sector.brick_starts)[:, None].astype(exitance.dtype))


def light_bricks(
    sector: Sector, given: RelightInput, lamps: AnyArray | None = None, dtype: Any = np.float32, sun_sample: UInt8 | None = None
) -> AnyArray:
    """(N, 3) [lx]: what bricks send out of the light of sun, moon, lamps (S, 3) [lx] and their own emission, before any bounce."""
    irradiance = directional_irradiance(sector, given, dtype, sun_sample) + (0 if lamps is None else lamps.astype(dtype))
    exitance = snowed_albedo(sector, given.snow, dtype) * irradiance
    if sector.surfel_emission is not None:
        exitance += dtype(np.pi) * sector.surfel_emission.astype(dtype)
    return brick_means(sector, exitance)


def brick_basis(sector: Sector) -> Float32:
    """(N, B) float32: the mean over each brick's surfels of what coefficients add to a bounce along their normals."""
    weights = feedback_weights(basis_of_size(sector.basis_size), sector.surfel_normal)
    return np.asarray(brick_means(sector, weights), np.float32)


def _feedback_weights(sector: Sector) -> Float32:
    """(S, B): how each surfel reads its probes' light. A cube's faces along its own normal, harmonics along its brick's mean basis."""
    if sector.basis_size == BASIS_SIZES["cube"]:
        return feedback_weights("cube", sector.surfel_normal)
    return np.repeat(brick_basis(sector), counts(sector.brick_starts), axis=0)


def bounce_bricks(sector: Sector, given: RelightInput, cubes: AnyArray, dtype: Any = np.float32) -> AnyArray:
    """(N, 3) [lx]: what bricks send on of last pass's light (P, B, 3), surfel by surfel. Its kernel sums by brick and probe beforehand.

    Of harmonics it may lie below 0: ``relight`` cuts off what a brick then lacks in all.
    """
    irradiance = np.zeros((sector.surfel_count, 3), dtype)
    if sector.probe_count:
        weight = _feedback_weights(sector).astype(dtype)
        for k in range(sector.feedback_probe.shape[1]):
            bounced = np.einsum("sb,sbc->sc", weight, cubes[sector.feedback_probe[:, k]])
            irradiance += sector.feedback_weight[:, k, None].astype(dtype) * bounced
    albedo = np.minimum(snowed_albedo(sector, given.snow, dtype), dtype(FEEDBACK[basis_of_size(sector.basis_size)].albedo_max))
    return brick_means(sector, albedo * irradiance)


def brick_exitance(direct: AnyArray, bounced: AnyArray) -> AnyArray:
    """(N, 3) [lx]: what bricks send out of their own and of bounces; nothing is darker than black, though harmonics may say so."""
    return np.maximum(direct + bounced, 0)


def gather_probes(sector: Sector, exitance: AnyArray, dtype: Any = np.float32) -> AnyArray:
    """Probe cubes (P, B, 3) [lx] from the exitance of all sources."""
    cubes = np.zeros((sector.probe_count, sector.basis_size, 3), dtype)
    has = np.flatnonzero(counts(sector.factor_starts))
    if len(has):
        gathered = sector.factor_weight.astype(dtype)[:, :, None] * exitance[sector.factor_source][:, None, :]
        cubes[has] = np.add.reduceat(gathered, sector.factor_starts[:-1][has].astype(np.int64), axis=0)
    return cubes


def relight(
    sector: Sector,
    given: RelightInput,
    cubes: AnyArray,
    passes: int,
    lamps: AnyArray | None = None,
    sun_sample: UInt8 | None = None,
) -> AnyArray:
    """Cubes (P, B, 3) [lx] after some passes, starting from others; each pass adds a bounce.

    lamps : (S, 3) [lx] on each surfel; sun_sample : as ``directional_irradiance`` takes it
    """
    direct, patches = light_bricks(sector, given, lamps, sun_sample=sun_sample), given.patch_exitance.astype(np.float32)
    for _ in range(passes):
        exitance = np.concatenate([brick_exitance(direct, bounce_bricks(sector, given, cubes)), patches])
        cubes = gather_probes(sector, exitance)
    return cubes


def solve(sector: Sector, given: RelightInput, tolerance: float = 1e-10, lamps: AnyArray | None = None) -> Float64:
    """The fixed point (P, B, 3) [lx] in float64: passes until none changes any value by more than tolerance times the peak."""
    cubes = np.zeros((sector.probe_count, sector.basis_size, 3))
    direct = light_bricks(sector, given, lamps, np.float64)
    for _ in range(MOST_PASSES):
        bricks = brick_exitance(direct, bounce_bricks(sector, given, cubes, np.float64))
        after = gather_probes(sector, np.concatenate([bricks, given.patch_exitance.astype(np.float64)]), np.float64)
        change, cubes = np.abs(after - cubes).max(initial=0), after
        if change <= tolerance * np.abs(cubes).max(initial=0):
            break
    return cubes


def blend_voxels(sector: Sector, cubes: AnyArray) -> AnyArray:
    """Irradiance (ny, nz, nx, B, 3) [lx] at a sector's voxels."""
    return np.einsum("yzxk,yzxkbc->yzxbc", sector.voxel_weight, cubes[sector.voxel_probe])
