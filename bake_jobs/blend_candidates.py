"""Which probes a voxel may blend: those that it sees, and towards a border of sectors those that both sectors hold, so that at the border
line both choose among the same (gi_core/MATH.md, "Steps across borders")."""

import numpy as np

from bake_jobs.rays import SURFACE_OFFSET_M, RayScene
from gi_core.arrays import Bool, Float64
from gi_core.constants import SECTOR_SIZE_M, VOXEL_SIZE_M

# Over the last two voxels before a border.
FADE_M = 2 * VOXEL_SIZE_M
# Probes nearer than this weigh no more than at this distance.
LEAST_DISTANCE_M = 0.25


def to_border(position: Float64) -> Float64:
    """(..., 2) [m]: how far positions (..., 3) [m] are from the nearest border line across x, and across z."""
    place = position[..., [0, 2]] / SECTOR_SIZE_M
    return np.asarray(np.abs(place - np.round(place)) * SECTOR_SIZE_M)


def kept_at_border(centre: Float64, probes: Float64, margin_m: float) -> Float64:
    """(V, c), 0 to 1: what voxels (V, 3) keep of the weights of candidates (V, c, 3).

    All of it where both sectors at a voxel's nearest border line hold the probe, otherwise a share that falls with the way to the line.
    """
    line = np.round(centre[:, [0, 2]] / SECTOR_SIZE_M) * SECTOR_SIZE_M
    held_by_both = np.abs(probes[:, :, [0, 2]] - line[:, None]) < margin_m
    share = np.minimum(to_border(centre) / FADE_M, 1)[:, None]
    return np.asarray(np.where(held_by_both, 1, share).prod(axis=2))


def held_at_border(centre: Float64, probes: Float64, margin_m: float) -> Bool:
    """(V, c) bool: whether all sectors at border lines within the margin of voxels (V, 3) hold candidates (V, c, 3)."""
    line = np.round(centre[:, [0, 2]] / SECTOR_SIZE_M) * SECTOR_SIZE_M
    held = np.abs(probes[:, :, [0, 2]] - line[:, None]) < margin_m
    return np.asarray((held | (to_border(centre) >= margin_m)[:, None]).all(axis=2))


def visible(ray_scene: RayScene, centre: Float64, probes: Float64, distance: Float64) -> Bool:
    """(V, c) bool: nothing lies between each voxel centre (V, 3) and its candidates (V, c, 3)."""
    voxels, candidates = distance.shape
    reach = distance.reshape(-1)
    offset = (probes - centre[:, None]).reshape(-1, 3)
    direction = offset / np.maximum(reach, 1e-6)[:, None]
    blocked = ray_scene.occluded(np.repeat(centre, candidates, axis=0), direction, reach - SURFACE_OFFSET_M)
    return ~blocked.reshape(voxels, candidates)
