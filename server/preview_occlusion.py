"""Ambient occlusion at the scale of pixels: what a volume's 3 m voxels cannot know of corners and reveals (slide "Ambient occlusion").

    open    how much of REACH_M cosine-distributed rays get on the mean: a surface counts less the farther it is, so that no step shows
    kept    open / (1 - NEAR_ALBEDO (1 - open)): what is near gives some of it back, bounce after bounce

Decals, which stand for vehicles that the mesh does not have, dim it besides (gi_core.decals).

The talk multiplies indirect light by probe sky visibility, a screen-space and a baked term; the first is in the served light already.
Against the path tracer it mends corners, and where served light is too dark it adds to that (MATH.md, "Pictures"): pictures leave it
out unless asked.
"""

from collections.abc import Sequence

import numpy as np

from gi_core.arrays import Float32, Float64
from gi_core.decals import hidden_share, reach_m
from gi_core.world import Decal
from server.preview_lamps import PixelCells
from server.raycast import RayCaster

# A voxel's edge: what is farther, probes and voxels have seen.
REACH_M = 3.0
RAYS = 12
NEAR_ALBEDO = 0.35  # a light facade's


def kept_share(rays: RayCaster, position: Float64, normal: Float32) -> Float32:
    """How much of the indirect light at surface points (n, 3) [m] with normals (n, 3) nearby surfaces leave: (n,) 0..1."""
    share = rays.free_share(position, normal, (cosine_way(normal, towards) for towards in sphere_lattice(RAYS)))
    return np.asarray(share / (1 - np.float32(NEAR_ALBEDO) * (1 - share)), np.float32)


def kept_by_decals(decals: Sequence[Decal], position: Float64, normal: Float32) -> Float32:
    """How much of the indirect light at surface points (n, 3) [m] with normals (n, 3) decals leave: (n,) 0..1."""
    kept = np.ones(len(position), np.float32)
    if not len(position) or not decals:
        return kept
    cells, (low, high) = PixelCells.of(position), (position.min(axis=0), position.max(axis=0))
    centres, reach = np.array([decal.position for decal in decals]), np.array([reach_m(decal, low[1]) for decal in decals])
    # A city has thousands; a street's picture needs dozens.
    for number in np.flatnonzero(np.linalg.norm(centres - np.clip(centres, low, high), axis=1) < reach).tolist():
        near = cells.order[cells.within(centres[number], float(reach[number]))]
        kept[near] *= 1 - hidden_share(decals[number], position[near], normal[near])
    return kept


def cosine_way(normal: Float32, towards: Float32) -> Float32:
    """Ways (n, 3) [m] of REACH_M: to a point of the unit sphere, ``towards`` (3,), that touches each surface with its normal (n, 3).

    For points that are uniform on the sphere their density is the cosine.
    """
    way = normal + towards
    length = np.sqrt(np.einsum("ij,ij->i", way, way))
    return np.asarray(way * (np.float32(REACH_M) / np.maximum(length, np.float32(1e-6)))[:, None], np.float32)


def sphere_lattice(count: int) -> Float32:
    """Unit vectors (count, 3), spread evenly over the sphere on a Fibonacci spiral (Swinbank and Purser 2006)."""
    number = np.arange(count) + 0.5
    height = 1 - 2 * number / count
    level, turn = np.sqrt(1 - height**2), np.pi * (3 - np.sqrt(5)) * number
    return np.stack([level * np.cos(turn), height, level * np.sin(turn)], axis=1).astype(np.float32)
