"""All that lies along straight lines: every surface that they cross, and a lattice of cells that such lines cut."""

from dataclasses import dataclass

import numpy as np

from bake_jobs.rays import RayScene
from gi_core.arrays import Bool, Float64, Int64

# Past a surface before the next is looked for: above float32's step 2 km from the origin, below anything a city models.
STEP_M = 2e-3
# Beyond as many surfaces a line is left alone; overlapping parts of a tower have some ten.
MAX_SURFACES = 256
# Lines cast at once: some 100 MB.
LINES_AT_ONCE = 1 << 19


@dataclass(frozen=True, eq=False)
class Crossings:
    """Where lines meet surfaces, line by line and along each.

    line : (n,) int64; distance : (n,) float64 [m] from the line's start; triangle : (n,) int64; from_back : (n,) bool
    """

    line: Int64
    distance: Float64
    triangle: Int64
    from_back: Bool


def cross(rays: RayScene, starts: Float64, axis: int, length_m: float) -> Crossings:
    """Every surface along lines from starts (n, 3) [m] towards +axis, up to a length."""
    direction = np.zeros(3, np.float32)
    direction[axis] = 1
    parts = []
    for first in range(0, len(starts), LINES_AT_ONCE):
        going = np.arange(first, min(first + LINES_AT_ONCE, len(starts)))
        along = np.zeros(len(going))
        for _ in range(MAX_SURFACES):
            origin = starts[going].copy()
            origin[:, axis] += along
            hits = rays.closest(origin, np.broadcast_to(direction, (len(going), 3)))
            along = along + hits.distance
            met = np.flatnonzero(hits.hit & (along <= length_m))
            if not len(met):
                break
            going, along = going[met], along[met]
            parts.append((going, along, hits.triangle[met].astype(np.int64), hits.from_back[met]))
            along = along + STEP_M
    if not parts:
        return Crossings(np.zeros(0, np.int64), np.zeros(0), np.zeros(0, np.int64), np.zeros(0, bool))
    line, distance, triangle, back = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    order = np.lexsort((distance, line))
    return Crossings(line[order], distance[order], triangle[order], back[order])


def cut_lattice(rays: RayScene, first: Int64, shape: tuple[int, int, int], cell_m: float, axis: int) -> tuple[Bool, Bool]:
    """Where surfaces cut the lines between cells' centres along an axis (0 is x).

    first : (3,) lattice index (x, y, z) of cell (0, 0, 0); shape : (ny, nz, nx), each at least 2

    Returns whether anything lies between a cell and the next, one shorter along the axis than the cells, and which cells are nearest to
    such a surface.
    """
    at = (2, 0, 1)[axis]
    count = shape[at]
    axes = [first[0] + np.arange(shape[2]), first[1] + np.arange(shape[0]), first[2] + np.arange(shape[1])]
    axes[axis] = axes[axis][:1]
    y, z, x = np.meshgrid(axes[1], axes[2], axes[0], indexing="ij")
    starts = (np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1) + 0.5) * cell_m
    found = cross(rays, starts, axis, (count - 1) * cell_m)
    link = np.minimum((found.distance / cell_m).astype(np.int64), count - 2)
    nearest = np.minimum(np.round(found.distance / cell_m).astype(np.int64), count - 1)
    cut, wall = np.zeros((len(starts), count - 1), bool), np.zeros((len(starts), count), bool)
    cut[found.line, link] = True
    wall[found.line, nearest] = True
    across = [n for i, n in enumerate(shape) if i != at]
    return np.moveaxis(cut.reshape(*across, -1), -1, at), np.moveaxis(wall.reshape(*across, count), -1, at)
