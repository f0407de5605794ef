"""Which voxels are solid."""

import numpy as np

from bake_jobs.inside import Solids
from bake_jobs.rays import RayScene
from gi_core.arrays import Bool, Float64
from gi_core.constants import VOXEL_SIZE_M


def solid_voxels(ray_scene: RayScene, solids: Solids, centre: Float64, voxel_size_m: float = VOXEL_SIZE_M) -> Bool:
    """(ny, nz, nx) bool: which voxel centres (ny, nz, nx, 3), ``voxel_size_m`` apart, lie in a solid.

    Voxels of a column with nothing between them are alike, so the middle one of each run is tested: a seventh of them, in midtown.
    """
    ny, nz, nx = centre.shape[:3]
    below = centre[:-1].reshape(-1, 3)
    up = np.tile(np.array([[0, 1, 0]], np.float32), (len(below), 1))
    cut = ray_scene.occluded(below, up, np.full(len(below), voxel_size_m)).reshape(ny - 1, nz, nx)
    run_in_column = np.concatenate([np.zeros((1, nz, nx), np.int64), np.cumsum(cut, axis=0)])
    run = run_in_column + ny * np.arange(nz * nx).reshape(nz, nx)
    _, first, of_voxel, length = np.unique(run, return_index=True, return_inverse=True, return_counts=True)
    middle = first + length // 2 * (nz * nx)
    return solids.contain(centre.reshape(-1, 3)[middle])[of_voxel.reshape(ny, nz, nx)]
