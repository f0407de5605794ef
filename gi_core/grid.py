"""World frame, sector grid and voxel lattice. Metres, right-handed, Y up, X east, Z south (when north_degrees is 0).

A voxel of the world lattice with index (x, y, z) has its centre at ((x, y, z) + 0.5) * VOXEL_SIZE_M and belongs to the sector that
holds its centre. 64 m is 20.48 voxels, so a sector owns 20 or 21 voxel columns along each side; no centre ever lies on a border.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gi_core.arrays import Float64, Int64
from gi_core.constants import SECTOR_SIZE_M, VOLUME_SHAPE, VOXEL_SIZE_M

# Voxels along x, y and z on a volume's one side of its middle.
MAX_SECTOR_NUMBER = 1_000_000
_HALF_VOLUME = np.array([VOLUME_SHAPE[2], VOLUME_SHAPE[0], VOLUME_SHAPE[1]]) // 2


class SectorIndex(NamedTuple):
    """Sector (x, z) covers [64 x, 64 x + 64) by [64 z, 64 z + 64) m in world x and z."""

    x: int
    z: int

    @property
    def origin(self) -> Float64:
        """(3,) float64 [m]: the sector's north-west corner at y = 0; sector-local position + origin = world position."""
        return np.array([self.x * SECTOR_SIZE_M, 0.0, self.z * SECTOR_SIZE_M])

    def __str__(self) -> str:
        return f"{self.x}_{self.z}"


def sector_index(numbers: Sequence[object]) -> SectorIndex:
    """The sector that a file says it is: two whole numbers within MAX_SECTOR_NUMBER. Raises ValueError."""
    x, z = numbers
    # True is an int to Python.
    if type(x) is not int or type(z) is not int or max(abs(x), abs(z)) > MAX_SECTOR_NUMBER:
        raise ValueError("expected a sector of two whole numbers")
    return SectorIndex(x, z)


def sector_of(position: Float64) -> SectorIndex:
    """The sector that a world position (3,) [m] lies in."""
    return SectorIndex(int(np.floor(position[0] / SECTOR_SIZE_M)), int(np.floor(position[2] / SECTOR_SIZE_M)))


def voxel_columns(sector_coordinate: int, voxel_size_m: float = VOXEL_SIZE_M) -> tuple[int, int]:
    """First and past-the-last voxel index along x (or z) of the columns whose centres lie in a sector."""

    def first(edge_m: float) -> int:
        return math.ceil(edge_m / voxel_size_m - 0.5)

    return first(sector_coordinate * SECTOR_SIZE_M), first((sector_coordinate + 1) * SECTOR_SIZE_M)


def voxel_centre(index: Int64, voxel_size_m: float = VOXEL_SIZE_M) -> Float64:
    """World position [m] of the centre of voxel (..., 3) int64."""
    return (np.asarray(index, np.float64) + 0.5) * voxel_size_m


def volume_first_voxel(position: Float64, cascade: int = 0) -> Int64:
    """Lattice index (..., 3) of voxel (0, 0, 0) of the volume centred on world positions (..., 3) [m], snapped to the cascade's lattice.

    The centre of the volume lies within half a voxel of the position along each axis.
    """
    voxel_size = VOXEL_SIZE_M * 2.0**cascade
    return np.asarray(np.round(np.asarray(position, np.float64) / voxel_size) - _HALF_VOLUME, np.int64)
