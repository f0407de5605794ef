"""Brick factors and sky factors of probes (slides "Brick factors", "Sky visibility").

A factor is a form factor: the cosine-weighted share of what a probe's cube face sees that one brick, or one patch of sky, fills.
"""

from dataclasses import dataclass

import numpy as np

from bake_jobs.distinct import distinct
from bake_jobs.gbuffer import GBuffer, RayPattern
from bake_jobs.surfels import Surfels
from gi_core.arrays import Float32, Float64, Int64, UInt32
from gi_core.basis import basis_of_size, from_axes
from gi_core.sector import starts
from gi_core.sky_patches import patch_of


@dataclass(frozen=True, eq=False)
class Factors:
    """Factor lists of all probes, as gi_core.sector describes them; within a probe, sources ascend.

    sky : (P, 6) float32, share of each face that sees the sky, also what ``distant`` averages
    """

    starts: UInt32
    source: UInt32
    weight: Float32
    sky: Float32


def sky_factors(gbuffer: GBuffer, pattern: RayPattern) -> Float32:
    """(P, 6) float32: the share of each cube face that sees sky. Below the horizon there is none, whatever rays miss."""
    sees_sky = ~gbuffer.hits.hit.reshape(gbuffer.probes, gbuffer.rays) & (pattern.direction[:, 1] > 0)
    return (sees_sky.astype(np.float32) @ pattern.face_weight).astype(np.float32)


def gather(gbuffer: GBuffer, pattern: RayPattern, surfels: Surfels, sky_patches: int | None = None) -> Factors:
    """Factor lists from what probes see: bricks, then the sky.

    sky_patches : patches of the dome (gi_core.sky_patches); None stands for the talk's six scalars, each of which feeds its own face only
    """
    bricks, size = len(surfels.brick_cell), pattern.weight.shape[1]
    probe, ray = np.divmod(surfels.hit, gbuffer.rays)
    pair, inverse = distinct(probe * bricks + surfels.brick_of_surfel[surfels.of_hit])
    columns = np.ascontiguousarray(pattern.weight.T)
    brick_weight = np.stack([np.bincount(inverse, column.take(ray), len(pair)) for column in columns], axis=1)
    pair_probe, pair_brick = np.divmod(pair, max(bricks, 1))

    sky = sky_factors(gbuffer, pattern)
    if sky_patches is None:
        sky_probe, patch = np.nonzero(sky)
        # A face's light is irradiance along its axis; harmonics are what has it there.
        sky_weight = sky[sky_probe, patch, None] * from_axes(basis_of_size(size)).T[patch]
    else:
        sky_probe, patch, sky_weight = _patch_factors(gbuffer, pattern, sky_patches)

    probe_of_factor = np.concatenate([pair_probe, sky_probe])
    source = np.concatenate([pair_brick, bricks + patch])
    weight = np.concatenate([brick_weight, sky_weight])
    order = np.lexsort((source, probe_of_factor))
    return Factors(
        starts=starts(np.bincount(probe_of_factor, minlength=gbuffer.probes)),
        source=source[order].astype(np.uint32),
        weight=weight[order].astype(np.float32),
        sky=sky,
    )


def _patch_factors(gbuffer: GBuffer, pattern: RayPattern, patches: int) -> tuple[Int64, Int64, Float64]:
    """Probe (n,), patch (n,) and weight (n, B) of the patches that each probe sees something of."""
    upward = np.flatnonzero(pattern.direction[:, 1] > 0)
    patch_of_ray = patch_of(pattern.direction[upward], patches)
    open_sky = ~gbuffer.hits.hit.reshape(gbuffer.probes, gbuffer.rays)[:, upward]
    of_patch = patch_of_ray[:, None] == np.arange(patches)
    seen = open_sky.astype(np.float32)
    probe, patch = np.nonzero(seen @ of_patch.astype(np.float32))
    size = pattern.weight.shape[1]
    weight = np.empty((gbuffer.probes, patches, size))
    for b in range(size):
        weight[:, :, b] = seen @ (of_patch * pattern.weight[upward, b, None]).astype(np.float32)
    return probe, patch, weight[probe, patch]
