"""Make a source's triangles safe to bake: nothing non-finite, degenerate, doubled or inside-out. Never fatal while anything is left."""

from collections.abc import Iterator

import numpy as np
import shapely
from scipy.ndimage import distance_transform_edt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from bake_jobs.scene import DroppedTriangles, Mesh
from gi_core.arrays import Bool, Float32, Float64, Int64
from gi_core.constants import ALBEDO_MAX
from gi_core.errors import SourceError
from gi_core.rooms import air_of
from gi_core.world import Room

MAX_TRIANGLES = 50_000_000  # about 5 GB of scene; a city is a few million
MAX_EXTENT_M = 1e6  # wider than this is a wrong unit or a stray vertex, not a city
# A triangle whose doubled area is below this share of its longest edge squared is a line: its normal is rounding noise.
DEGENERATE_RATIO = 1e-10
# Nested shells are looked for around this many inside-out ones at a time, to bound memory.
NESTING_CHUNK = 4096
# So many of a room's cells suffice to find a place deep inside it.
DEEP_CELLS = 1 << 18


def clean_mesh(mesh: Mesh, where: str, rooms: tuple[Room, ...] = ()) -> tuple[Mesh, DroppedTriangles]:
    """Drop what cannot be baked, merge equal vertices, turn inside-out solids; say what was dropped.

    Dropped are triangles with a NaN or infinite corner, colour or emission; with an index out of range or no area; and all but the
    first of those with the same three corners in the same sense. Two that run in opposite senses are both kept: they are the walls
    of two houses that touch, and each house is closed only with its own. The order of the rest is kept.
    Raises SourceError, naming ``where``, when nothing is left, or what is left is too large to be a city.
    """
    _refuse_too_many(len(mesh.triangles), where)
    in_range: Bool = np.all((mesh.triangles >= 0) & (mesh.triangles < len(mesh.vertices)), axis=1)
    safe = np.where(in_range[:, None], mesh.triangles, 0) if len(mesh.vertices) else mesh.triangles[:0]
    if not len(safe):
        raise SourceError(f"{where}: expected triangles, found none; check that the file holds a mesh of surfaces")
    finite_vertex = _finite_rows(mesh.vertices)
    finite = np.all(finite_vertex[safe], axis=1) & _finite_rows(mesh.albedo) & _finite_rows(mesh.emission) | ~in_range
    vertices = np.where(finite_vertex[:, None], mesh.vertices, 0.0) + 0.0  # + 0.0 turns -0.0 into 0.0, its equal in all but bits
    flat = ~in_range | _without_area(vertices, safe)
    kept = np.flatnonzero(finite & ~flat)
    if len(kept):
        _refuse_absurd(vertices[np.unique(safe[kept])], where)
    used, triangles = _merge_equal(vertices, safe[kept])
    first = _first_of_equal(triangles)
    kept, triangles = kept[first], triangles[first]
    dropped = DroppedTriangles(
        degenerate=int((finite & flat).sum()), duplicate=len(first) - int(first.sum()), non_finite=int((~finite).sum())
    )
    if not len(kept):
        raise SourceError(
            f"{where}: expected triangles with an area, found none among {len(mesh.triangles)}"
            f" ({dropped.degenerate} without one, {dropped.non_finite} with NaN or Inf)"
        )
    turn = _inside_out(used, triangles, rooms)
    triangles[turn] = triangles[turn][:, ::-1]
    albedo = np.clip(mesh.albedo[kept], 0, ALBEDO_MAX).astype(np.float32)
    return Mesh(used, triangles, albedo, np.maximum(mesh.emission[kept], 0).astype(np.float32)), dropped


def _finite_rows(values: Float64 | Float32) -> Bool:
    return np.asarray(np.all(np.isfinite(values), axis=1), np.bool_)


def _refuse_too_many(count: int, where: str) -> None:
    if count > MAX_TRIANGLES:
        raise SourceError(f"{where}: expected at most {MAX_TRIANGLES:,} triangles, found {count:,}; split the city into several bakes")


def _refuse_absurd(vertices: Float64, where: str) -> None:
    extent = np.ptp(vertices, axis=0)
    if extent.max() > MAX_EXTENT_M:
        raise SourceError(
            f"{where}: expected a city at most {MAX_EXTENT_M:.0e} m across, found {extent.max():.3g} m; "
            "check its unit and for stray vertices"
        )


def _without_area(vertices: Float64, triangles: Int64) -> Bool:
    """(m,) whether each triangle is a line or a point."""
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    with np.errstate(over="ignore", invalid="ignore"):
        doubled_area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        longest_squared = np.maximum(np.maximum(((b - a) ** 2).sum(1), ((c - a) ** 2).sum(1)), ((c - b) ** 2).sum(1))
        return ~(doubled_area > DEGENERATE_RATIO * longest_squared) & np.isfinite(longest_squared)


def _merge_equal(vertices: Float64, triangles: Int64) -> tuple[Float64, Int64]:
    """The vertices in use, each once, sorted by x, y, z; and the triangles over them. (np.unique over rows is ten times slower.)"""
    used, corner = np.unique(triangles, return_inverse=True)
    position = vertices[used]
    order = np.lexsort(position.T[::-1])
    is_new = np.r_[True, (position[order[1:]] != position[order[:-1]]).any(axis=1)][: len(order)]
    merged = np.empty(len(order), np.int64)
    merged[order] = np.cumsum(is_new) - 1
    return position[order[is_new]], merged[corner.reshape(-1, 3)]


def _first_of_equal(triangles: Int64) -> Bool:
    """(m,) whether each triangle is the first with its corners in its sense."""
    lowest = np.argmin(triangles, axis=1)[:, None]
    corners = np.take_along_axis(triangles, (lowest + np.arange(3)) % 3, axis=1)
    order = np.lexsort(corners.T)  # stable: equal ones stay in their order
    first = np.zeros(len(triangles), bool)
    first[order] = np.r_[True, (corners[order[1:]] != corners[order[:-1]]).any(axis=1)][: len(order)]
    return first


def _inside_out(vertices: Float64, triangles: Int64, rooms: tuple[Room, ...]) -> Bool:
    """(m,) whether each triangle belongs to a closed, consistently wound solid of negative volume that is meant to be solid.

    Negative on purpose, and left alone: a cavity (it lies inside another closed surface) and an enclosure such as a room seen from
    within (other geometry or an authored room lies inside it, or nothing lies outside it).
    """
    component, closed = closed_components(triangles)
    count = len(closed)
    middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2  # far from the origin, volumes of absolute positions would cancel
    a, b, c = (vertices[triangles[:, i]] - middle for i in range(3))
    volume = np.bincount(component, np.einsum("ij,ij->i", a, np.cross(b, c)), minlength=count)
    candidates = np.flatnonzero(closed & (volume < 0))
    if not len(candidates):
        return np.zeros(len(triangles), bool)
    low, high = _component_bounds(vertices, triangles, component, count)
    flip = np.zeros(count, bool)
    flip[candidates] = True
    around_all = np.all((low <= low.min(axis=0)) & (high >= high.max(axis=0)), axis=1)
    flip[around_all] = False
    tree = shapely.STRtree(shapely.box(low[:, 0], low[:, 2], high[:, 0], high[:, 2]))
    for inner, outer in _touching_pairs(tree, low, high, candidates):
        nested = np.all((low[outer] < low[inner]) & (high[outer] > high[inner]), axis=1)
        flip[outer[nested]] = False
        flip[inner[nested & closed[outer]]] = False
    for room in rooms:
        middle = _deep_in(room)
        flip[np.all((low < middle) & (high > middle), axis=1)] = False
    return np.asarray(flip[component], np.bool_)


def _deep_in(room: Room) -> Float64:
    """(3,) [m]: a place well inside a room, the middle of its box or of the cell that is farthest from what is not its air."""
    if room.cells is None:
        return np.asarray((np.array(room.minimum) + np.array(room.maximum)) / 2)
    air = air_of(room.cells)
    coarse = max(round((air.size / DEEP_CELLS) ** (1 / 3)), 1)
    depth = distance_transform_edt(np.pad(air[::coarse, ::coarse, ::coarse], 1))
    y, z, x = coarse * (np.array(np.unravel_index(np.argmax(depth), depth.shape)) - 1)
    return np.asarray((np.array([x, y, z]) + room.cells.first + 0.5) * room.cells.size_m)


def _touching_pairs(tree: shapely.STRtree, low: Float64, high: Float64, candidates: Int64) -> Iterator[tuple[Int64, Int64]]:
    """Pairs (a, b) of components whose bounds touch in plan, each with a candidate as one of the two, both ways round."""
    for start in range(0, len(candidates), NESTING_CHUNK):
        some = candidates[start : start + NESTING_CHUNK]
        index, other = tree.query(shapely.box(low[some, 0], low[some, 2], high[some, 0], high[some, 2]))
        yield some[index], other
        yield other, some[index]


def _component_bounds(vertices: Float64, triangles: Int64, component: Int64, count: int) -> tuple[Float64, Float64]:
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    for i in range(3):
        np.minimum.at(low, component, vertices[triangles[:, i]])
        np.maximum.at(high, component, vertices[triangles[:, i]])
    return low, high


def closed_components(triangles: Int64) -> tuple[Int64, Bool]:
    """(m,) component of each triangle and (n,) whether it is closed.

    Triangles connect where exactly two share an edge, in opposite senses; so solids that only touch stay apart. A component is
    closed when it walks every edge as often one way as the other.
    """
    m = len(triangles)
    start, end = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()
    key = np.minimum(start, end) * (int(triangles.max()) + 1) + np.maximum(start, end)
    edge = np.unique(key, return_inverse=True)[1]
    order = np.argsort(edge, kind="stable")
    first = np.r_[0, np.cumsum(np.bincount(edge))]
    pair = first[:-1][np.diff(first) == 2]
    one, other = order[pair], order[pair + 1]
    opposite = start[one] != start[other]
    one, other = one[opposite] // 3, other[opposite] // 3
    graph = coo_array((np.ones(len(one), np.int8), (one, other)), shape=(m, m))
    count, component = connected_components(graph, directed=False)
    owner = np.repeat(component.astype(np.int64), 3)
    edge_of_owner, slot = np.unique(edge * count + owner, return_inverse=True)
    balance = np.bincount(slot, np.where(start < end, 1.0, -1.0))
    closed = np.ones(count, bool)
    closed[edge_of_owner[balance != 0] % count] = False
    return component.astype(np.int64), closed
