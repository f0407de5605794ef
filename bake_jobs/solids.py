"""Closed solids of flat pieces: boxes, and prisms over polygons with holes. Triangles run counter-clockwise seen from outside."""

from collections.abc import Sequence
from typing import Any

import mapbox_earcut
import numpy as np

from gi_core.arrays import AnyArray, Float64, Int64, UInt32
from gi_core.errors import SourceError

# Of one polygon: ear clipping looks for each hole's bridge among all points, so 2 000 holes take 2 s and 10 000 a minute and a half.
MAX_RINGS = 2000

# Corner i of a box is the maximum along axis a where bit a of i is set.
_BOX_QUADS = ((0, 4, 6, 2), (1, 3, 7, 5), (0, 1, 5, 4), (2, 6, 7, 3), (0, 2, 3, 1), (4, 5, 7, 6))
BOX_TRIANGLES: Int64 = np.array([t for a, b, c, d in _BOX_QUADS for t in ((a, b, c), (a, c, d))], np.int64)


def boxes(minimum: Float64, maximum: Float64) -> tuple[Float64, Int64]:
    """Solid axis-aligned boxes: corners (n, 3) [m] -> vertices (8 n, 3), triangles (12 n, 3); each box's follow one another."""
    minimum, maximum = np.atleast_2d(minimum).astype(np.float64), np.atleast_2d(maximum).astype(np.float64)
    bits = np.array([[i >> axis & 1 for axis in range(3)] for i in range(8)], bool)
    vertices = np.where(bits[None], maximum[:, None], minimum[:, None])
    triangles = BOX_TRIANGLES[None] + 8 * np.arange(len(minimum))[:, None, None]
    return vertices.reshape(-1, 3), triangles.reshape(-1, 3)


def expect_few_rings(rings: Sequence[Any], where: str) -> None:
    """Raise SourceError for a polygon that would take too long to triangulate."""
    if len(rings) > MAX_RINGS:
        raise SourceError(f"{where}: expected a polygon of at most {MAX_RINGS} rings, found {len(rings)}; cut it into several")


def triangulate(points: Float64, ring_ends: UInt32) -> Int64:
    """Triangles (t, 3) over the points (n, 2) of a polygon's rings (outer first, holes after), all with positive signed area.

    ``ring_ends`` are the past-the-last indices of the rings, as mapbox_earcut takes them. A polygon that touches itself gives
    what ear clipping makes of it.
    """
    found = np.asarray(mapbox_earcut.triangulate_float64(points, ring_ends), np.int64).reshape(-1, 3)
    corner = points[found]
    edge, other = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    clockwise = edge[:, 0] * other[:, 1] - edge[:, 1] * other[:, 0] < 0
    found[clockwise] = found[clockwise][:, ::-1]
    return found


def prism(rings: Sequence[Float64], bottom: float, top: float) -> tuple[Float64, Int64, AnyArray]:
    """A closed upright prism.

    Parameters
    ----------
    rings : the outer ring, then holes, each (n, 2) world x and z [m], not closed, in either sense
    bottom, top : heights y [m], bottom < top

    Returns
    -------
    vertices : (2 n, 3) float64, those at the bottom first
    triangles : (t, 3) int64
    is_wall : (t,) bool, otherwise a cap
    """
    # Seen from above (+Y), x to the right and z down the page: a ring that runs counter-clockwise has negative signed area in (x, z).
    turned = [ring[::-1] if (signed_area(ring) > 0) == (i == 0) else ring for i, ring in enumerate(rings)]
    points = np.concatenate(turned)
    n = len(points)
    ends = np.cumsum([len(ring) for ring in turned])
    following = np.arange(1, n + 1)
    following[ends - 1] = np.r_[0, ends[:-1]]
    here = np.arange(n)
    walls = np.concatenate([np.stack([here, following, following + n], 1), np.stack([here, following + n, here + n], 1)])
    bottom_cap = triangulate(points, ends.astype(np.uint32))  # positive in (x, z) faces down
    top_cap = bottom_cap[:, ::-1] + n
    vertices = np.empty((2 * n, 3))
    vertices[:, 0], vertices[:, 2] = np.tile(points[:, 0], 2), np.tile(points[:, 1], 2)
    vertices[:n, 1], vertices[n:, 1] = bottom, top
    is_wall = np.arange(len(walls) + 2 * len(bottom_cap)) < len(walls)
    return vertices, np.concatenate([walls, bottom_cap, top_cap]), is_wall


def signed_area(ring: Float64) -> float:
    """Area [m^2] of a ring (n, 2), not closed; positive when the second axis is 90 degrees counter-clockwise of the first along it."""
    local = ring - ring[0]
    following = np.roll(local, -1, axis=0)
    return float((local[:, 0] * following[:, 1] - following[:, 0] * local[:, 1]).sum() / 2)
