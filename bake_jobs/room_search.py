"""A world's rooms: its author's, and where the world file asks for them those found in it: enclosed air, with openings small against it.

    covered_air    columns with air under something, in regions
    cells          each region in cells of ROOM_CELL_M: walls, air, what is open to the sky
    air_basins     air cut at doors and windows
    here           basins that the sky or wide openings do not reach are rooms; a box and openings for each

Rooms are found once, in the whole world, before any sector is baked: all sectors that one reaches into know it by the same number.
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import find_objects

from bake_jobs.air_basins import contacts, find_basins
from bake_jobs.covered_air import COLUMN_CELLS, MAX_CEILING_M, AirColumns, CoveredRegion, covered_regions
from bake_jobs.ray_lines import cut_lattice
from bake_jobs.rays import RayScene
from bake_jobs.room_openings import SEAM_M, opening_boxes, point, walls_around, with_openings
from bake_jobs.scene import Scene, Search
from gi_core.arrays import Bool, Float64, Int32, Int64
from gi_core.constants import ROOM_CELL_M
from gi_core.errors import SourceError
from gi_core.rooms import pack_cells, rooms_of
from gi_core.world import Room

# Smaller air is part of what it opens into: a porch, a bay, a wardrobe. 2.5 m each way.
MIN_ROOM_M3 = 15.0
# A basin with more of its surface open to the outdoors is outdoors too, as an arcade is; so is one with more of its cells under the sky.
# Houses and shops have 2 to 7 % of their surface in doors and windows (counted in cells, which lack a rim of each).
MAX_OPEN_SHARE, MAX_SKY_SHARE = 0.08, 0.1
# Of a region, some 30 bytes each.
MAX_REGION_CELLS = 1 << 24


@dataclass(frozen=True, eq=False)
class Cells:
    """A region in cells of ROOM_CELL_M, (ny, nz, nx).

    first : (3,) lattice index (x, y, z) of cell (0, 0, 0)
    free : air with no surface near its centre; solid : centre in a solid; covered : something lies above within MAX_CEILING_M
    cuts : of each axis of the arrays, whether a surface lies between a cell and the next
    """

    first: Int64
    free: Bool
    solid: Bool
    covered: Bool
    cuts: tuple[Bool, Bool, Bool]

    def around(self, place: tuple[slice, ...]) -> tuple[tuple[slice, ...], Int64, tuple[Bool, ...]]:
        """A part of the cells and one more each way: where it is, the lattice index of its first cell, and the cuts in it."""
        y, z, x = near = tuple(slice(max(part.start - 1, 0), part.stop + 1) for part in place)
        cuts = [
            cut[tuple(slice(part.start, part.stop - (at == axis)) for at, part in enumerate(near))] for axis, cut in enumerate(self.cuts)
        ]
        return near, self.first + np.array([x.start, y.start, z.start]), tuple(cuts)


def world_rooms(scene: Scene, search: Search) -> tuple[Room, ...]:
    """The rooms of a scene's author, with their openings, and after them what ``search`` asks for. Raises SourceError for too many."""
    if not scene.rooms and search == "none":
        return ()
    rays = RayScene(scene.vertices, scene.triangles)
    if search == "none":
        return with_openings(rays, scene.rooms)
    columns = AirColumns(scene, rays)
    found = [room for region in covered_regions(columns) for room in rooms_in(region, columns, scene.rooms, search == "all")]
    found.sort(key=lambda room: (room.minimum[2], room.minimum[0], room.minimum[1]))
    named = (Room(f"found-{number}", room.minimum, room.maximum, room.openings, room.cells) for number, room in enumerate(found, 1))
    return with_openings(rays, (*scene.rooms, *named))


def rooms_in(region: CoveredRegion, columns: AirColumns, authored: tuple[Room, ...], closed_too: bool) -> list[Room]:
    """Rooms whose first column is the region's own; without names. Raises SourceError for a region that is too large to be searched."""
    cells = region_cells(region, columns)
    basin = find_basins(cells.free)
    chosen = enclosed_basins(basin, cells.covered, closed_too)
    if not chosen:
        return []
    basin = _with_walls(basin, cells)
    own = {(x, z) for x, z in region.columns.tolist()}
    rooms = []
    for number, place in enumerate(find_objects(basin), 1):
        if number not in chosen or place is None:
            continue
        at = np.argwhere(basin[place] == number)[:, [2, 0, 1]] + cells.first
        at += [place[2].start, place[0].start, place[1].start]
        column = at[np.lexsort((at[:, 1], at[:, 0], at[:, 2]))[0]] // COLUMN_CELLS
        centre = np.asarray((at + 0.5) * ROOM_CELL_M, np.float64)
        if (column[0], column[2]) in own and np.count_nonzero(rooms_of(centre, authored)) <= len(at) / 2:
            low, high = walls_around(columns.rays, centre, ROOM_CELL_M)
            near, corner, cuts = cells.around(place)
            openings = opening_boxes(columns.rays, basin[near], number, chosen, cuts, corner, low, high)
            air = _to_box(basin[near], number, cuts, corner, low, high)
            rooms.append(Room("", point(low), point(high), openings, pack_cells(air)))
    return rooms


def _to_box(basin: Int32, number: int, cuts: tuple[Bool, ...], first: Int64, low: Float64, high: Float64) -> Int64:
    """Lattice indices (n, 3), x, y, z, of a room's cells, to the sides of its box and no farther: a seam may leave a doorway to the
    room, or some of the floor before it to what lies beyond, the outdoors or another room.

    basin : (ny, nz, nx) with ``cuts`` between cells; first : lattice index of cell (0, 0, 0); low, high : (3,) [m]
    """
    y, z, x = np.meshgrid(*(np.arange(count) for count in basin.shape), indexing="ij")
    at = np.stack([x, y, z], axis=-1) + first
    centre = (at + 0.5) * ROOM_CELL_M
    beside = ((centre - low < SEAM_M) | (high - centre < SEAM_M))[..., [0, 2]].any(axis=-1)
    lost = (basin > 0) & (basin != number) & beside
    air = basin == number
    for _ in range(round(SEAM_M / ROOM_CELL_M)):
        air = air | (lost & (_next_to(air.astype(np.int32), cuts) == 1))
    return np.asarray(at[air & ((centre >= low) & (centre <= high)).all(axis=-1)], np.int64)


def region_cells(region: CoveredRegion, columns: AirColumns) -> Cells:
    """The region in cells, from beneath its covered air to above it. Raises SourceError for one that is too large."""
    (x0, z0), (x1, z1) = region.columns.min(axis=0), region.columns.max(axis=0) + 1
    y0, y1 = int(np.floor(region.low / ROOM_CELL_M)) - 2, int(np.ceil(region.high / ROOM_CELL_M)) + 3
    first = np.array([x0 * COLUMN_CELLS, y0, z0 * COLUMN_CELLS])
    shape = (y1 - y0, int(z1 - z0) * COLUMN_CELLS, int(x1 - x0) * COLUMN_CELLS)
    if np.prod(shape) > MAX_REGION_CELLS:
        raise SourceError(
            f"[rooms] find: expected covered air in parts of at most {MAX_REGION_CELLS * ROOM_CELL_M**3:.0f} m3, found one of "
            f"{np.prod(shape) * ROOM_CELL_M**3:.0f} m3; leave find out and author the rooms"
        )
    (cut_x, wall_x), (cut_y, wall_y), (cut_z, wall_z) = (cut_lattice(columns.rays, first, shape, ROOM_CELL_M, axis) for axis in range(3))
    ny, nz, nx = shape
    z, x = np.divmod(np.arange(nz * nx), nx)
    gaps = columns.gaps((np.stack([x, z], axis=1) + first[[0, 2]] + 0.5) * ROOM_CELL_M, ROOM_CELL_M)
    edge = [np.clip(np.ceil(height / ROOM_CELL_M - 0.5) - y0, 0, ny).astype(np.int64) for height in (gaps.bottom, gaps.top, gaps.sky)]
    # Of the cells with centres in a gap the first counts one more than that below, and the one past the last one less.
    change = np.zeros((2, ny + 1, nz * nx), np.int32)
    low = gaps.top - gaps.bottom <= MAX_CEILING_M
    for of_what, chosen in ((0, np.ones(len(low), bool)), (1, low)):
        np.add.at(change[of_what], (edge[0][chosen], gaps.line[chosen]), 1)
        np.add.at(change[of_what], (edge[1][chosen], gaps.line[chosen]), -1)
    known = np.isfinite(gaps.sky)
    change[0, edge[2][known], np.flatnonzero(known)] += 1
    air, covered = (np.cumsum(change, axis=1)[:, :-1] > 0).reshape(2, *shape)
    return Cells(first, air & ~(wall_x | wall_y | wall_z), ~air, covered, (cut_y, cut_z, cut_x))


def enclosed_basins(basin: Int32, covered: Bool, closed_too: bool) -> set[int]:
    """Which numbers of basins (ny, nz, nx) are rooms; small ones are joined to their neighbours first, in place."""
    count = int(basin.max(initial=0))
    size = np.bincount(basin.reshape(-1), minlength=count + 1)
    sky = np.bincount(basin.reshape(-1), ~covered.reshape(-1), minlength=count + 1)
    outside = set(np.flatnonzero(sky > MAX_SKY_SHARE * size).tolist()) | set(_at_sides(basin))
    outside.discard(0)
    _join_small(basin, size, outside)
    faces = contacts(basin)
    rooms = set(np.unique(basin).tolist()) - outside - {0}
    while True:
        exposed = {
            room
            for room in rooms
            if sum(n for other, n in faces[room].items() if other in outside) > MAX_OPEN_SHARE * sum(faces[room].values())
        }
        if not exposed:
            break
        rooms, outside = rooms - exposed, outside | exposed
    # Where a player may come to: through an opening, or through another room.
    reached, new = set(), {room for room in rooms if any(other in outside for other in faces[room])}
    while new:
        reached |= new
        new = {other for room in new for other in faces[room] if other in rooms} - reached
    return rooms if closed_too else reached


def _at_sides(basin: Int32) -> list[int]:
    """Numbers that reach the region's sides, and so go on beyond them."""
    sides = (basin[:, 0], basin[:, -1], basin[:, :, 0], basin[:, :, -1])
    return np.unique(np.concatenate([side.reshape(-1) for side in sides])).tolist()


def _join_small(basin: Int32, size: Int64, outside: set[int]) -> None:
    """Give each basin that is too small for a room to the neighbour that it shares most faces with, the smallest basin first."""
    faces = contacts(basin)
    sizes, now = size.tolist(), np.arange(len(size))
    least = MIN_ROOM_M3 / ROOM_CELL_M**3
    for number in sorted((n for n in range(1, len(sizes)) if sizes[n] < least), key=lambda n: (sizes[n], n)):
        beside = {other: n for other, n in faces.get(number, {}).items() if other}
        if number in outside or sizes[number] >= least or not beside:
            if number not in outside and sizes[number] < least:
                now[number] = 0  # a cavity that no one is in
            continue
        most = max(beside.items(), key=lambda item: (item[1], -item[0]))[0]
        now[now == number] = most
        sizes[most] += sizes[number]
        for other, n in faces.pop(number).items():
            del faces[other][number]
            if other != most:
                faces[other][most] = faces[most][other] = faces[most].get(other, 0) + n
    basin[...] = now[basin]


def _with_walls(basin: Int32, cells: Cells) -> Int32:
    """Basins with the cells beside walls: each goes to that of a neighbour which nothing parts it from, the lowest number of several."""
    basin = basin.copy()
    for _ in range(2):  # twice: a corner of two walls
        nearest = _next_to(basin, cells.cuts)
        found = (basin == 0) & ~cells.solid & (nearest > 0)
        basin[found] = nearest[found]
    return basin


def _next_to(basin: Int32, cuts: tuple[Bool, ...]) -> Int32:
    """Of each cell the lowest number above 0 of the neighbours that nothing parts it from; 0 where none has one."""
    none = np.iinfo(np.int32).max
    nearest = np.full(basin.shape, none, np.int32)
    for axis, cut in enumerate(cuts):
        along, to, open_ = np.moveaxis(basin, axis, 0), np.moveaxis(nearest, axis, 0), ~np.moveaxis(cut, axis, 0)
        for here, there in ((slice(None, -1), slice(1, None)), (slice(1, None), slice(None, -1))):
            to[here] = np.where(open_ & (along[there] > 0), np.minimum(to[here], along[there]), to[here])
    return np.where(nearest == none, np.int32(0), nearest)
