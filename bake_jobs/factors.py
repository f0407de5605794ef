"""Brick factors and sky factors of probes (slides "Brick factors", "Sky visibility").

A factor is a form factor: the cosine-weighted share of what a probe's cube face sees that one brick, or one patch of sky, fills.
"""

from dataclasses import dataclass

import numpy as np

from bake_jobs.gbuffer import GBuffer, RayPattern
from bake_jobs.surfels import Surfels
from gi_core.arrays import Float32, UInt32
from gi_core.sector import starts


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
    return (sees_sky.astype(np.float32) @ pattern.weight).astype(np.float32)


def gather(gbuffer: GBuffer, pattern: RayPattern, surfels: Surfels) -> Factors:
    """Factor lists from what probes see: bricks, then the six sky faces (each feeding only its own cube face)."""
    bricks = len(surfels.brick_cell)
    probe, ray = np.divmod(surfels.hit, gbuffer.rays)
    pair, inverse = np.unique(probe * bricks + surfels.brick_of_surfel[surfels.of_hit], return_inverse=True)
    inverse = inverse.reshape(-1)
    brick_weight = np.stack([np.bincount(inverse, pattern.weight[ray, face], len(pair)) for face in range(6)], axis=1)
    pair_probe, pair_brick = np.divmod(pair, max(bricks, 1))

    sky = sky_factors(gbuffer, pattern)
    sky_probe, face = np.nonzero(sky)
    sky_weight = np.zeros((len(face), 6))
    sky_weight[np.arange(len(face)), face] = sky[sky_probe, face]

    probe_of_factor = np.concatenate([pair_probe, sky_probe])
    source = np.concatenate([pair_brick, bricks + face])
    weight = np.concatenate([brick_weight, sky_weight])
    order = np.lexsort((source, probe_of_factor))
    return Factors(
        starts=starts(np.bincount(probe_of_factor, minlength=gbuffer.probes)),
        source=source[order].astype(np.uint32),
        weight=weight[order].astype(np.float32),
        sky=sky,
    )
