"""What share of a surfel's cell the sun really reaches: shadow rays from points of the cell, on the dataset's own triangles."""

from dataclasses import dataclass

import numpy as np

from bake_jobs.rays import SURFACE_OFFSET_M, RayScene
from gi_core.arrays import Bool, Float32, Float64, Int64
from gi_core.constants import SURFEL_CELL_M
from gi_core.sector import Sector, counts

# Points along each side of a square of 1.5 cells about the surfel: sixteen to a cell's area, wherever in its cell the surfel lies.
_SIDE_POINTS, _SIDE_CELLS = 6, 1.5
# The bake keys hits by where they are this far off their surface.
_KEY_OFFSET_M = 0.02
# A point whose surface is turned further than this from the surfel's normal lies on another surfel's surface.
_LEAST_COSINE = 0.7
_RAYS_AT_ONCE = 1 << 20


@dataclass(frozen=True, eq=False)
class CellPoints:
    """Points on the surfaces that surfels stand for, world frame.

    surfel : (n,) whose cell; position : (n, 3) [m]; normal : (n, 3), unit, of the surface there, towards the surfel's side
    """

    surfel: Int64
    position: Float64
    normal: Float32


def surfel_sizes(sector: Sector) -> Float32:
    """(S,) [m]: the size of each surfel's cell."""
    return np.repeat(SURFEL_CELL_M * 2.0 ** sector.brick_level.astype(np.float32), counts(sector.brick_starts))


def cell_points(rays: RayScene, sector: Sector) -> CellPoints:
    """Points of a tangent square about each surfel, within its cell, pushed onto the surface by a short ray along -normal.

    Those that meet no surface of the surfel's direction within half a cell are left out.
    """
    normal, size = sector.surfel_normal.astype(np.float64), surfel_sizes(sector).astype(np.float64)
    level = np.abs(normal[:, 1]) > 0.9
    aside = np.cross(normal, np.where(level[:, None], (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    up = np.cross(aside, normal)
    cell = np.floor((sector.surfel_position + _KEY_OFFSET_M * normal) / size[:, None])
    step = ((np.arange(_SIDE_POINTS) + 0.5) / _SIDE_POINTS - 0.5) * _SIDE_CELLS
    found = []
    for a in step:
        for b in step:
            point = sector.surfel_position + size[:, None] * (a * aside + b * up)
            inside = (np.floor((point + _KEY_OFFSET_M * normal) / size[:, None]) == cell).all(axis=1)
            which = np.flatnonzero(inside)
            start = point[which] + 0.5 * size[which, None] * normal[which] + sector.index.origin
            hits = rays.closest(start, -normal[which])
            on_it = (hits.distance <= size[which]) & (np.einsum("ij,ij->i", hits.normal, normal[which]) > _LEAST_COSINE)
            position = start[on_it] - hits.distance[on_it, None].astype(np.float64) * normal[which[on_it]]
            found.append((which[on_it], position, hits.normal[on_it]))
    surfel, position, surface_normal = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return CellPoints(surfel, position, surface_normal)


def true_share(rays: RayScene, points: CellPoints, surfel_count: int, to_sun: Float64) -> tuple[Float64, Bool]:
    """Share of each surfel's points that the sun reaches (S,), and whether it has any point (S,)."""
    lit = points.normal.astype(np.float64) @ to_sun > 0
    facing = np.flatnonzero(lit)
    direction = to_sun.astype(np.float32)
    for first in range(0, len(facing), _RAYS_AT_ONCE):
        some = facing[first : first + _RAYS_AT_ONCE]
        start = points.position[some] + SURFACE_OFFSET_M * points.normal[some]
        lit[some] = ~rays.occluded(start, np.broadcast_to(direction, (len(some), 3)))
    of_each = np.bincount(points.surfel, minlength=surfel_count)
    return np.bincount(points.surfel, lit, surfel_count) / np.maximum(of_each, 1), of_each > 0
