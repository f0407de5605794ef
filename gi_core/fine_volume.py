"""Volumes of cascade -1: fine voxels where the dataset has them, near surfaces; elsewhere the coarse volume, interpolated."""

import numpy as np

from gi_core.arrays import Float32, Int64, UInt8
from gi_core.constants import FINE_VOXEL_SIZE_M, VOLUME_SHAPE
from gi_core.grid import voxel_centre
from gi_core.volume import SectorBox, Volume, box_slices, sample_coefficients
from gi_core.voxel_grid import ResidentGrid


def interpolated(coarse: Volume, first_voxel: Int64) -> tuple[Float32, UInt8]:
    """Light (B, 16, 32, 32, 3) [lx] and classes (16, 32, 32) of the fine volume from ``first_voxel`` (3,), as the coarse one has them."""
    ny, nz, nx = VOLUME_SHAPE
    y, z, x = np.meshgrid(np.arange(ny), np.arange(nz), np.arange(nx), indexing="ij")
    lattice = np.stack([x, y, z], axis=-1).reshape(-1, 3) + first_voxel
    light = sample_coefficients(coarse.values, coarse.origin, coarse.voxel_size, voxel_centre(lattice, FINE_VOXEL_SIZE_M))
    px, py, pz = (lattice // 2 - coarse.first_voxel).T
    return np.ascontiguousarray(light.transpose(1, 0, 2)).reshape(-1, ny, nz, nx, 3), coarse.mask[py, pz, px].reshape(ny, nz, nx)


def merge(grid: ResidentGrid, box: SectorBox, filled: Float32, values: Float32, mask: UInt8) -> None:
    """Take over into a volume (B, 16, 32, 32, 3) what was filled where there are fine voxels, and into its mask what they are."""
    (x, y, z), (nx, ny, nz) = np.subtract(box.lattice_first, grid.first).tolist(), box.size
    low, high = max(-y, 0), min(grid.kind.shape[0] - y, ny)
    if low >= high:
        return
    here = (slice(y + low, y + high), slice(z, z + nz), slice(x, x + nx))
    _, rows, columns = box_slices(box)
    there = (slice(box.volume_first[1] + low, box.volume_first[1] + high), rows, columns)
    mask[there] = grid.kind[here]
    has_light = grid.has_light[here]
    values[(slice(None), *there)][:, has_light] = filled[(slice(None), *there)][:, has_light]
