"""Rooms that an author drew as meshes: the air inside a closed surface, in cells as that of found rooms is.

    the file's triangles, cleaned as a source's  ->  closed surfaces  ->  corners of cells that lie inside  ->  cells with such a corner

So cells hold all of the mesh, and reach at most their own width out of it: into walls of 0.1 m and no farther, where cells are as small.
Only the bake knows of the mesh. A dataset has the box around it, and the cells.
"""

from collections.abc import Iterator

import numpy as np

from bake_jobs.clean import clean_mesh, closed_components
from bake_jobs.ray_lines import cross
from bake_jobs.rays import RayScene
from bake_jobs.scene import Mesh
from gi_core.arrays import AnyArray, Bool, Float64, Int32, Int64
from gi_core.constants import ROOM_CELL_M
from gi_core.errors import SourceError
from gi_core.rooms import pack_cells
from gi_core.world import Room, is_found_name

# The finest that MAX_MESH_CELLS of them suffice for are taken: up to 25, 50 and 100 m each way.
MESH_CELLS_M = (ROOM_CELL_M / 4, ROOM_CELL_M / 2, ROOM_CELL_M)
# Of the box around a mesh. Looking for its openings takes some 20 bytes each.
MAX_MESH_CELLS = 1 << 24
# Lines through corners would run in walls that an author drew on the lattice; these ways off it are tried in turn [m].
_OFF_CORNER_M = ((0.00037, 0.00053), (-0.00059, 0.00029), (0.00023, -0.00071))
_BELOW_M = 1.0  # where lines start, under the mesh


def mesh_room(name: str, mesh: Mesh, where: str) -> Room:
    """The room that a mesh encloses, without openings. Where parts overlap it is all of them; a part inside another, turned inside out, is
    a hole in it. Which way the whole is wound does not matter.

    Raises SourceError, naming ``where``, for a mesh that is empty, open, too large, or too thin to hold the corner of a cell.
    """
    if is_found_name(name):
        raise SourceError(f"{where}: expected another name than {name!r}: rooms that are found are called so")
    surface, _ = clean_mesh(mesh, where)
    part, closed = closed_components(surface.triangles)
    if not closed.all():
        raise SourceError(
            f"{where}: expected a closed mesh, found holes in {int((~closed).sum())} of {len(closed)} parts; close them, and merge vertices"
        )
    low, high = np.round(surface.vertices.min(axis=0), 4) + 0.0, np.round(surface.vertices.max(axis=0), 4) + 0.0
    cell_m, first, shape = _lattice(low, high, where)
    inside = np.zeros((shape + 1)[[1, 2, 0]], np.int8)
    for triangles in _parts(surface.triangles, part, len(closed)):
        _add_winding(inside, first, cell_m, surface.vertices, triangles)
    at = np.argwhere(_any_corner(inside != 0))[:, [2, 0, 1]] + first
    if not len(at):
        raise SourceError(f"{where}: expected a mesh around air, found none of {cell_m:.2f} m each way in it")
    x, y, z = low.tolist()
    return Room(name, (x, y, z), (float(high[0]), float(high[1]), float(high[2])), cells=pack_cells(at, cell_m))


def _lattice(low: Float64, high: Float64, where: str) -> tuple[float, Int64, Int64]:
    """The width [m] of the cells of a box, the lattice index (3,) of its first one, and how many there are along x, y, z."""
    for cell_m in MESH_CELLS_M:
        first, last = np.floor(low / cell_m), np.floor(high / cell_m)
        if np.prod(last - first + 1) <= MAX_MESH_CELLS:
            return cell_m, first.astype(np.int64), (last - first + 1).astype(np.int64)
    raise SourceError(
        f"{where}: expected a room in a box of at most {MAX_MESH_CELLS * ROOM_CELL_M**3:.0f} m3, found one of "
        f"{np.prod(high - low):.0f} m3; check its unit"
    )


def _any_corner(inside: Bool) -> Bool:
    """Which cells have a corner inside; one fewer along each axis than corners."""
    for axis in range(3):
        along = np.moveaxis(inside, axis, 0)
        inside = np.moveaxis(along[:-1] | along[1:], 0, axis)
    return inside


def _parts(triangles: Int64, part: Int64, count: int) -> Iterator[Int32]:
    """The triangles of each part by themselves: of surfaces in one place a ray meets only one."""
    order = np.argsort(part, kind="stable")
    for some in np.split(order, np.cumsum(np.bincount(part, minlength=count))[:-1]):
        yield triangles[some].astype(np.int32)


def _add_winding(winding: AnyArray, first: Int64, cell_m: float, vertices: Float64, triangles: Int32) -> None:
    """Add to corners (ny, nz, nx) how often a closed surface goes around them; ``first`` (3,) is the index of corner (0, 0, 0)."""
    used, corner = np.unique(triangles, return_inverse=True)
    vertices, triangles = vertices[used], corner.reshape(-1, 3).astype(np.int32)
    low = np.maximum(np.floor(vertices.min(axis=0) / cell_m).astype(np.int64) - first, 0)
    high = np.floor(vertices.max(axis=0) / cell_m).astype(np.int64) - first + 2
    here = winding[low[1] : high[1], low[2] : high[2], low[0] : high[0]]
    ny, nz, nx = here.shape
    z, x = np.divmod(np.arange(nz * nx), nx)
    place, bottom = (np.stack([x, z], axis=1) + (low + first)[[0, 2]]) * cell_m, (low + first)[1] * cell_m
    rays = RayScene(vertices, triangles)
    left = np.arange(len(place))
    for off in _OFF_CORNER_M:
        start = np.full((len(left), 3), float(vertices[:, 1].min()) - _BELOW_M)
        start[:, [0, 2]] = place[left] + off
        found = cross(rays, start, 1, float(np.ptp(vertices[:, 1])) + 2 * _BELOW_M)
        height = start[found.line, 1] + found.distance
        change = np.zeros((ny + 1, len(left)), np.int8)
        above = np.clip(np.ceil((height - bottom) / cell_m), 0, ny).astype(np.int64)
        np.add.at(change, (above, found.line), np.where(found.from_back, -1, 1).astype(np.int8))
        # A line that does not end outside has slipped through an edge; it tries again beside it.
        ends = change.sum(axis=0) == 0
        here[:, z[left[ends]], x[left[ends]]] += np.cumsum(change[:-1, ends], axis=0, dtype=np.int8)
        left = left[~ends]
        if not len(left):
            break
