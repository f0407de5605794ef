"""Where the air of rooms meets the open air or that of other rooms: doors and windows, as boxes."""

from dataclasses import replace

import numpy as np
from scipy.ndimage import find_objects, label, uniform_filter

from bake_jobs.rays import RayScene
from gi_core.arrays import Bool, Float64, Int32, Int64
from gi_core.constants import ROOM_CELL_M, ROOM_OUTDOORS
from gi_core.rooms import air_of, rooms_of
from gi_core.world import Opening, Room

# An author's box may end before its walls or in them: a way from this far inside it to this far outside it, past walls of common depth.
INSIDE_M, OUTSIDE_M = 0.3, 0.6
# A seam that follows cells may lie so far inside the room, and turn corners there.
SEAM_M = 2 * ROOM_CELL_M
# How finely a wall is looked through for where the room behind a door begins.
THROUGH_STEP_M = 0.01
# Rims are looked for so deep in a wall, of which the thinnest have 10 cm.
RIM_DEPTH_M = 0.05
# What begins lower above a room's floor is a door, whatever its sill.
SILL_M = 0.5
# Of a slanted wall's cells, those faces are looked through that it turns to; along the others one would look along it.
_FACING, _FACING_CELLS = 0.5, 5
# From a cell beside a wall to the wall.
_NEAR_CELLS = 1.5


def with_openings(rays: RayScene, rooms: tuple[Room, ...]) -> tuple[Room, ...]:
    """Rooms with their openings, what nothing closes: of a box in its six faces, of a mesh between cells. Found rooms have those to the
    open air already. A door between two rooms is among the openings of both, as one box from either's side to the other's."""
    seen = [
        _face_openings(rays, number, rooms) if room.cells is None else _cell_openings(rays, number, rooms)
        for number, room in enumerate(rooms, 1)
    ]
    doors: list[list[Opening]] = [[] for _ in rooms]
    for one in range(1, len(rooms) + 1):
        for other in sorted({opening.to for opening in seen[one - 1]} - {ROOM_OUTDOORS}):
            back = [opening for opening in seen[other - 1] if opening.to == one]
            if one < other or not back:
                through = [_through(opening, rooms) for opening in seen[one - 1] if opening.to == other]
                doors[one - 1] += through
                doors[other - 1] += [replace(door, to=one) for door in through]
    outdoors = [
        room.openings if room.is_found else tuple(opening for opening in openings if opening.to == ROOM_OUTDOORS)
        for room, openings in zip(rooms, seen, strict=True)
    ]
    return tuple(replace(room, openings=(*out, *within)) for room, out, within in zip(rooms, outdoors, doors, strict=True))


def _beyond(rays: RayScene, number: int, rooms: tuple[Room, ...], faces: tuple[Float64, float], way: Float64) -> Int64:
    """Which room, or 0, lies a little outside faces of a room's air; -1 of one that something closes, or that is in another room.

    faces : middles (n, 3) [m], and how far inside them to begin [m]; way : (3,) outward
    """
    middle, inward = faces
    starts = middle - inward * way
    blocked = rays.occluded(starts, np.tile(way, (len(middle), 1)), np.full(len(middle), inward + OUTSIDE_M))
    beyond = rooms_of(middle + OUTSIDE_M * way, rooms).astype(np.int64)
    # Where rooms overlap the earlier one ends at its own faces, the other at those.
    elsewhere = (beyond != ROOM_OUTDOORS) & (rooms_of(starts, rooms) != number)
    return np.where(blocked | elsewhere | (beyond == number), -1, beyond)


def _face_openings(rays: RayScene, number: int, rooms: tuple[Room, ...]) -> list[Opening]:
    room = rooms[number - 1]
    low, high = np.array(room.minimum), np.array(room.maximum)
    count = np.maximum(np.round((high - low) / ROOM_CELL_M), 1).astype(np.int64)
    found = []
    for axis in range(3):
        across = [other for other in range(3) if other != axis]
        at = np.stack(np.meshgrid(*(np.arange(count[other]) for other in across), indexing="ij"), axis=-1).reshape(-1, 2)
        face = np.zeros((len(at), 3))
        face[:, across] = low[across] + (at + 0.5) * ((high - low) / count)[across]
        for sign, plane in ((-1.0, low[axis]), (1.0, high[axis])):
            face[:, axis] = plane
            way = np.zeros(3)
            way[axis] = sign
            beyond = _beyond(rays, number, rooms, (face, min(INSIDE_M, (high[axis] - low[axis]) / 2)), way)
            for to in np.unique(beyond[beyond >= 0]).tolist():
                parts, _ = label((beyond == to).reshape(count[across]), np.ones((3, 3)))
                for part in find_objects(parts):
                    first, last = low.copy(), high.copy()
                    first[axis] = last[axis] = plane
                    size = ((high - low) / count)[across]
                    first[across] = low[across] + [part[0].start, part[1].start] * size
                    last[across] = low[across] + [part[0].stop, part[1].stop] * size
                    found.append(replace(_to_rim(rays, (first, last), (low, high), axis, sign), to=to))
    return found


def _cell_openings(rays: RayScene, number: int, rooms: tuple[Room, ...]) -> list[Opening]:
    """Openings of a room in cells, looked for as those of a box: from a little inside each face of its air to a little outside."""
    room = rooms[number - 1]
    assert room.cells is not None
    cell_m, margin = room.cells.size_m, _FACING_CELLS // 2 + 1
    air = np.pad(air_of(room.cells), margin)
    first = np.array(room.cells.first) - margin
    low, high = np.array(room.minimum), np.array(room.maximum)
    density = uniform_filter(air.astype(np.float32), _FACING_CELLS)
    links: list[tuple[int, Int64, Int64]] = []
    for axis in range(3):
        own, along = np.moveaxis(air, axis, 0), (1, 2, 0)[axis]
        for here, there, sign in ((slice(1, None), slice(None, -1), -1.0), (slice(None, -1), slice(1, None), 1.0)):
            face = np.moveaxis(np.zeros_like(air), axis, 0)
            face[here] = own[here] & ~own[there]
            at = np.argwhere(np.moveaxis(face, 0, axis))
            slope = [density[tuple((at + step).T)] - density[tuple((at - step).T)] for step in np.eye(3, dtype=np.int64)]
            at = at[-sign * slope[axis] > _FACING * np.linalg.norm(slope, axis=0)]
            middle = (at[:, [2, 0, 1]] + first + 0.5) * cell_m
            middle[:, along] = np.clip(middle[:, along] + sign * cell_m / 2, low[along], high[along])
            way = np.zeros(3)
            way[along] = sign
            # A link is as its lower cell.
            links.append((axis, at - (sign < 0) * np.eye(3, dtype=np.int64)[axis], _beyond(rays, number, rooms, (middle, INSIDE_M), way)))
    found = []
    for to in sorted({to for _, _, beyond in links for to in np.unique(beyond).tolist()} - {-1}):
        cuts = [np.ones(np.array(air.shape) - np.eye(3, dtype=np.int64)[axis], np.bool_) for axis in range(3)]
        for axis, link, beyond in links:
            cuts[axis][tuple(link[beyond == to].T)] = False
        boxes = opening_boxes(rays, np.where(air, np.int32(1), np.int32(2)), 1, {1}, tuple(cuts), first, low, high, cell_m)
        found += [replace(box, to=to) for box in boxes]
    return found


def _through(door: Opening, rooms: tuple[Room, ...]) -> Opening:
    """A door that was found on one room's side of a wall, through the wall to where the other room begins."""
    low, high = np.array(door.minimum), np.array(door.maximum)
    axis = int(np.argmin(high - low))
    middle = (low + high) / 2
    middle[1] = high[1] - (high[1] - low[1]) / 4  # above the floor, of a door that goes on below it
    for way in np.arange(0.0, OUTSIDE_M, THROUGH_STEP_M):
        for ends, sign in ((low, -1.0), (high, 1.0)):
            middle[axis] = ends[axis] + sign * way
            if rooms_of(middle[None], rooms)[0] == door.to:
                ends[axis] = round(middle[axis], 4)
                return Opening(point(low), point(high), door.to)
    return door


def _to_rim(rays: RayScene, ends: tuple[Float64, Float64], room: tuple[Float64, Float64], axis: int, outward: float) -> Opening:
    """An opening that was found in cells, as wide as it is: to what its middle meets, a little way into the wall, around it.

    ends, room : low and high (3,) [m] of what was found, and of the room; outward : which way along the axis is out of it, 1 or -1

    One that begins at the floor goes on below it, as far as it is high: so a floor sees as much of a door as who stands on it.
    """
    low, high = ends[0].copy(), ends[1].copy()
    side = room[1 if outward > 0 else 0][axis]
    if max(abs(low[axis] - side), abs(high[axis] - side)) <= SEAM_M:
        low[axis] = high[axis] = side
    # Of faces between cells the wall that they stand for begins up to half a cell to either side.
    depths = np.array([RIM_DEPTH_M] if low[axis] == side else [-0.15, -0.05, RIM_DEPTH_M, 0.15, 0.25])
    middle = np.tile((low + high) / 2, (len(depths), 1))
    middle[:, axis] += outward * depths
    for across in (other for other in range(3) if other != axis):
        for edge, sign in ((low, -1.0), (high, 1.0)):
            way = np.zeros(3)
            way[across] = sign
            distance = rays.closest(middle, np.tile(way, (len(depths), 1))).distance
            rim = middle[0, across] + sign * float(distance.min())
            if abs(rim - edge[across]) <= ROOM_CELL_M:
                edge[across] = round(rim, 4)
    if axis != 1 and low[1] < room[0][1] + SILL_M:
        low[1] -= high[1] - low[1]
    return Opening(point(low), point(high))


def opening_boxes(
    rays: RayScene,
    basin: Int32,
    number: int,
    rooms: set[int],
    cuts: tuple[Bool, ...],
    first: Int64,
    low: Float64,
    high: Float64,
    cell_m: float = ROOM_CELL_M,
) -> tuple[Opening, ...]:
    """Where cells (ny, nz, nx) of a number meet, with nothing between, those of others that are no rooms: a box for each group of faces.

    cuts : of each axis of the arrays, what lies between cells; first : lattice index (x, y, z) of cell (0, 0, 0); low, high : (3,) [m]
    of the room, which boxes do not leave but below its floor
    """
    outdoors = (basin > 0) & ~np.isin(basin, list(rooms))
    boxes: list[Opening] = []
    for axis in range(3):
        own, out = np.moveaxis(basin == number, axis, 0), np.moveaxis(outdoors, axis, 0)
        open_ = ~np.moveaxis(cuts[axis], axis, 0)
        for here, there, outward in ((slice(1, None), slice(None, -1), -1.0), (slice(None, -1), slice(1, None), 1.0)):
            # Each way by itself, so that windows around a corner make two flat boxes and not one of the whole room.
            groups, _ = label(np.moveaxis(own[here] & out[there] & open_, 0, axis), np.ones((3, 3, 3)))
            for group in find_objects(groups):
                start, stop = (np.array([getattr(part, end) for part in group], np.float64) for end in ("start", "stop"))
                start[axis] += 1  # the face between cells i and i + 1 lies at i + 1
                start, stop = (np.clip((end[[2, 0, 1]] + first) * cell_m, low, high) for end in (start, stop))
                boxes.append(_to_rim(rays, (start, stop), (low, high), (1, 2, 0)[axis], outward))
    return _outermost(boxes)


def _outermost(boxes: list[Opening]) -> tuple[Opening, ...]:
    """Openings but those that lie in, or within two cells of, a larger one: the sides of a seam that is not flat."""
    kept: list[Opening] = []
    for box in sorted(boxes, key=lambda box: -float(np.linalg.norm(np.subtract(box.maximum, box.minimum)))):
        low, high = np.array(box.minimum) + SEAM_M, np.array(box.maximum) - SEAM_M
        if not any((low >= other.minimum).all() and (high <= other.maximum).all() for other in kept):
            kept.append(box)
    return tuple(kept)


def walls_around(rays: RayScene, centre: Float64, cell_m: float) -> tuple[Float64, Float64]:
    """The box (3,), (3,) [m] of a room's cells (n, 3) [m]: each side ends at the outermost wall beside a cell, where there is one."""
    low, high = centre.min(axis=0) - cell_m / 2, centre.max(axis=0) + cell_m / 2
    for axis in range(3):
        for ends, sign in ((low, -1.0), (high, 1.0)):
            way = np.zeros((len(centre), 3), np.float32)
            way[:, axis] = sign
            distance = rays.closest(centre, way).distance
            near = distance <= _NEAR_CELLS * cell_m
            if near.any():
                ends[axis] = sign * (sign * centre[near, axis] + distance[near]).max()
    # To a tenth of a millimetre: rays are rounded. No zero has a sign.
    return np.round(low, 4) + 0.0, np.round(high, 4) + 0.0


def point(position: Float64) -> tuple[float, float, float]:
    """A position (3,) as worlds hold it."""
    x, y, z = position.tolist()
    return x, y, z
