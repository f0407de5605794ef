"""Ground under buildings whose map gives only their base heights: a gentle surface through them that a few wrong ones do not bend."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from bake_jobs.scene import Mesh
from gi_core.arrays import Bool, Float64, Int64
from gi_core.constants import SECTOR_SIZE_M

CELL_M = 32.0  # half a sector: finer than streets slope, and sector borders fall on cell borders
CELLS_PER_SECTOR = int(SECTOR_SIZE_M / CELL_M)
# A base this far from the median of its neighbours belongs to a bridge, a deck or a typing error, not to the street.
OUTLIER_M = 4.0
NEIGHBOURS = 24
SMOOTHING_M = 48.0  # the distance at which a base's weight has fallen to exp(-1/2)
GROUND_ALBEDO = (0.2, 0.2, 0.2)  # asphalt and paving mixed
MAX_CELLS = 4_000_000  # 64 km by 64 km


@dataclass(frozen=True, eq=False)
class Terrain:
    """Ground heights at the corners of a grid of CELL_M cells.

    first : (2,) int64, cell index along x and z of the grid's first corner; its world position is first * CELL_M
    height : (nx + 1, nz + 1) float64 [m]
    covered : (nx, nz) bool, cells that have ground
    """

    first: Int64
    height: Float64
    covered: Bool

    def lowest_below(self, low: Float64, high: Float64) -> Float64:
        """(n,) lowest ground [m] in the cells that boxes touch: low and high (n, 2), world x and z [m]."""
        shape = np.array(self.covered.shape)
        begin = np.clip(np.floor(low / CELL_M).astype(np.int64) - self.first, 0, shape - 1)
        end = np.clip(np.floor(high / CELL_M).astype(np.int64) - self.first, 0, shape - 1) + 2
        spans = zip(begin.tolist(), end.tolist(), strict=True)
        return np.array([self.height[x0:x1, z0:z1].min() for (x0, z0), (x1, z1) in spans]).reshape(len(low))

    def mesh(self) -> Mesh:
        """The covered cells as triangles that face up, two a cell."""
        nx, nz = self.height.shape
        x, z = np.meshgrid((self.first[0] + np.arange(nx)) * CELL_M, (self.first[1] + np.arange(nz)) * CELL_M, indexing="ij")
        vertices = np.stack([x, self.height, z], axis=-1).reshape(-1, 3)
        i, j = np.nonzero(self.covered)
        corner = i * nz + j
        a, b, c, d = corner, corner + 1, corner + nz + 1, corner + nz  # (0, 0) (0, 1) (1, 1) (1, 0) in (x, z): counter-clockwise from above
        triangles = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int64)
        return Mesh.of_colour(vertices, triangles, GROUND_ALBEDO)


def terrain_under(position: Float64, base: Float64, low: Float64, high: Float64) -> Terrain:
    """Ground through base heights, in every sector that a building touches and in the eight around it.

    Parameters
    ----------
    position : (n, 2) world x and z [m] of buildings, n >= 1
    base : (n,) [m], their ground heights
    low, high : (m, 2) world x and z [m], bounds of all parts that need ground under them
    """
    first_sector = np.floor(low / SECTOR_SIZE_M).astype(np.int64)
    last_sector = np.floor(high / SECTOR_SIZE_M).astype(np.int64)
    origin = first_sector.min(axis=0) - 1
    shape = last_sector.max(axis=0) + 2 - origin
    touched = np.zeros(tuple(shape), bool)
    for x0, z0, x1, z1 in np.unique(np.concatenate([first_sector - origin, last_sector - origin], axis=1), axis=0).tolist():
        touched[x0 - 1 : x1 + 2, z0 - 1 : z1 + 2] = True
    covered = np.repeat(np.repeat(touched, CELLS_PER_SECTOR, axis=0), CELLS_PER_SECTOR, axis=1)
    first = origin * CELLS_PER_SECTOR
    x, z = np.meshgrid(*((first[axis] + np.arange(covered.shape[axis] + 1)) * CELL_M for axis in range(2)), indexing="ij")
    corners = np.stack([x.ravel(), z.ravel()], axis=1)
    return Terrain(first, smooth_heights(corners, position, base).reshape(x.shape), covered)


def cells_needed(low: Float64, high: Float64) -> int:
    """How many cells ``terrain_under`` would allocate for bounds (m, 2), to be checked against MAX_CELLS before calling it."""
    extent = np.ceil((high.max(axis=0) - low.min(axis=0)) / CELL_M) + 4 * CELLS_PER_SECTOR
    return int(extent[0] * extent[1])


def smooth_heights(at: Float64, position: Float64, base: Float64) -> Float64:
    """Heights (k,) [m] at places (k, 2): Gaussian means of the bases (n,) at positions (n, 2) that agree with their neighbours."""
    if np.ptp(base) == 0:
        return np.full(len(at), float(base[0]))
    neighbours = _neighbours(cKDTree(position), position)
    good = np.abs(base - np.median(base[neighbours], axis=1)) <= OUTLIER_M
    if not good.any():
        good[:] = True
    position, base = position[good], base[good]
    tree = cKDTree(position)
    near = _neighbours(tree, at)
    squared = ((position[near] - at[:, None]) ** 2).sum(axis=2)
    # Less the smallest exponent, so that far from every building the nearest still counts instead of 0 / 0.
    weight = np.exp((squared.min(axis=1, keepdims=True) - squared) / (2 * SMOOTHING_M**2))
    return np.asarray((weight * base[near]).sum(axis=1) / weight.sum(axis=1), np.float64)


def _neighbours(tree: cKDTree, at: Float64) -> Int64:
    """(k, j) indices of the up to NEIGHBOURS nearest positions, nearest first."""
    count = min(NEIGHBOURS, tree.n)
    return np.asarray(tree.query(at, k=count)[1], np.int64).reshape(len(at), count)
