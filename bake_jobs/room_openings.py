"""Where the air of rooms meets the open air or that of other rooms: doors and windows, as boxes."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy.ndimage import find_objects, label, uniform_filter

from bake_jobs.rays import RayScene
from gi_core.arrays import Bool, Float64, Int32, Int64
from gi_core.constants import ROOM_CELL_M, ROOM_OUTDOORS
from gi_core.rooms import air_of, holds, rooms_of
from gi_core.world import Opening, Room

# An author's box may end before its walls or in them: a way from this far inside it to this far outside it, past walls of common depth.
INSIDE_M, OUTSIDE_M = 0.3, 0.6
# Old masonry is thicker. So far outside another room is looked for, where the way there is lined by jambs; else the air between is the
# street's, as in a gap between two houses whose windows face each other.
THICKEST_M, THICK_STEP_M = 1.5, 0.1
# What closes a way that far out, with something so near all around it, is the back of a niche, or a door's own rebate or splayed jamb.
NICHE_M = 3.0
# Cells follow a wall to half of one: so near to its sides what lies around a way through it says nothing.
SIDE_M = 0.25
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
    open air already, in the wall's inner side. A door between two rooms is among the openings of both, as one box from either's side to the
    other's, and what leads to the open air ends in the wall's outer side."""
    seen: list[list[Opening]] = []
    for number, room in enumerate(rooms, 1):
        openings = (_face_openings if room.cells is None else _cell_openings)(rays, number, rooms)
        is_way = [not each.to or _is_lined(rays, each, _through(each, rooms)) for each in openings]
        seen.append([each if ok else replace(each, to=ROOM_OUTDOORS) for each, ok in zip(openings, is_way, strict=True)])
    doors: list[list[Opening]] = [[] for _ in rooms]
    for one in range(1, len(rooms) + 1):
        for other in sorted({opening.to for opening in seen[one - 1]} - {ROOM_OUTDOORS}):
            back = [opening for opening in seen[other - 1] if opening.to == one]
            if one < other or not back:
                through = [part for opening in seen[one - 1] if opening.to == other for part in _slices(opening, _through(opening, rooms))]
                doors[one - 1] += through
                doors[other - 1] += [replace(door, to=one) for door in through]
    outdoors = [
        [
            part
            for opening in (room.openings if room.is_found else openings)
            if not opening.to
            for part in _into_the_open(rays, opening, room)
        ]
        for room, openings in zip(rooms, seen, strict=True)
    ]
    return tuple(replace(room, openings=(*out, *within)) for room, out, within in zip(rooms, outdoors, doors, strict=True))


def _beyond(rays: RayScene, number: int, rooms: tuple[Room, ...], faces: tuple[Float64, float], way: Float64) -> Int64:
    """Which room lies outside faces of a room's air, a little or behind a thick wall, or 0; -1 of one that something closes, or that is
    in another room.

    faces : middles (n, 3) [m], and how far inside them to begin [m]; way : (3,) outward
    """
    middle, inward = faces
    starts = middle - inward * way
    clear = rays.closest(starts, np.tile(way, (len(middle), 1))).distance - inward
    beyond = rooms_of(middle + OUTSIDE_M * way, rooms).astype(np.int64)
    if len(rooms) > 1:
        for far in np.arange(OUTSIDE_M, THICKEST_M, THICK_STEP_M) + THICK_STEP_M:
            going = np.flatnonzero((beyond == ROOM_OUTDOORS) & (clear > far))
            there = rooms_of(middle[going] + far * way, rooms)
            beyond[going] = np.where(there == number, ROOM_OUTDOORS, there)
    ends = np.flatnonzero((beyond == ROOM_OUTDOORS) & (clear > OUTSIDE_M) & (clear <= THICKEST_M))
    beyond[ends[_is_niche(rays, middle[ends] + (clear[ends, None] - RIM_DEPTH_M) * way, way)]] = -1
    # Where rooms overlap the earlier one ends at its own faces, the other at those.
    elsewhere = (beyond != ROOM_OUTDOORS) & (rooms_of(starts, rooms) != number)
    return np.where((clear <= OUTSIDE_M) | elsewhere | (beyond == number), -1, beyond)


def _is_niche(rays: RayScene, place: Float64, way: Float64) -> Bool:
    """(n,): around which places (n, 3) [m] something is near in all four directions across a way (3,) along an axis."""
    near = np.ones(len(place), np.bool_)
    for axis in np.flatnonzero(way == 0):
        for sign in (-1.0, 1.0):
            across = np.zeros(3)
            across[axis] = sign
            near &= rays.occluded(place, np.tile(across, (len(place), 1)), np.full(len(place), NICHE_M))
    return near


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
    way = np.arange(0.0, THICKEST_M + THROUGH_STEP_M / 2, THROUGH_STEP_M)
    places = np.tile(_in_door(low, high), (2, len(way), 1))
    places[0, :, axis], places[1, :, axis] = low[axis] - way, high[axis] + way
    met = (rooms_of(places.reshape(-1, 3), rooms) == door.to).reshape(2, -1)
    if met.any():
        side = int(np.argmin(np.where(met.any(axis=1), met.argmax(axis=1), len(way))))
        (low, high)[side][axis] = round(places[side, met[side].argmax(), axis], 4)
    return Opening(point(low), point(high), door.to)


def _is_lined(rays: RayScene, flat: Opening, door: Opening) -> bool:
    """Whether what goes ``through`` a wall is no deeper than walls are that no gap can be in, or has the wall around it all the way.

    flat : the opening in one room's side of the wall; door : through the wall
    """
    axis = int(np.argmin(np.subtract(flat.maximum, flat.minimum)))
    start, stop = door.minimum[axis], door.maximum[axis]
    return stop - start <= OUTSIDE_M or bool(_lined(rays, door, axis, np.arange(start + SIDE_M, stop - SIDE_M, THICK_STEP_M)).all())


def _lined(rays: RayScene, opening: Opening, axis: int, along: Float64) -> Bool:
    """At which places (n,) [m] along an axis the wall is all around the way through an opening, to ROOM_CELL_M off its rim."""
    low, high = np.array(opening.minimum), np.array(opening.maximum)
    places = np.tile(_in_door(low, high), (len(along), 1))
    places[:, axis] = along
    lined = np.ones(len(along), np.bool_)
    for across in (other for other in range(3) if other != axis):
        for edge, sign in ((low, -1.0), (high, 1.0)):
            way = np.zeros(3)
            way[across] = sign
            distance = rays.closest(places, np.tile(way, (len(along), 1))).distance
            lined &= distance <= abs(edge[across] - places[0, across]) + ROOM_CELL_M
    return lined


def _into_the_open(rays: RayScene, flat: Opening, room: Room) -> list[Opening]:
    """A flat opening in the wall's inner side, or a little before it, through the wall to where nothing lines it any more: ``_slices``. As
    it is where no wall of up to THICKEST_M begins, or one that goes on farther, as those around a porch or a passage do."""
    low, high = np.array(flat.minimum), np.array(flat.maximum)
    axis = int(np.argmin(high - low))
    across = np.zeros((2, 3))
    across[:, axis] = [-INSIDE_M, INSIDE_M]
    is_room = holds(room, _in_door(low, high) + across)
    if high[axis] > low[axis] or is_room[0] == is_room[1]:
        return [flat]
    way = np.arange(0.0, THICKEST_M + THROUGH_STEP_M / 2, THROUGH_STEP_M)
    lined = _lined(rays, flat, axis, low[axis] + way * (1 if is_room[0] else -1))
    begins = int(lined.argmax())
    if way[begins] > OUTSIDE_M or lined[begins:].all() or not lined.any():
        return [flat]
    deep = way[begins + int(lined[begins:].argmin())]
    (high if is_room[0] else low)[axis] += deep if is_room[0] else -deep
    return _slices(flat, Opening(point(low.round(4)), point(high.round(4)), flat.to))


def _slices(flat: Opening, door: Opening) -> list[Opening]:
    """A door as boxes one behind the other, of which each is shortest the way through, as readers tell which way that is.

    flat : the opening in one room's side of the wall; door : through the wall
    """
    sides = np.subtract(door.maximum, door.minimum)
    axis = int(np.argmin(np.subtract(flat.maximum, flat.minimum)))
    count = int(sides[axis] / np.delete(sides, axis).min()) + 1
    ends = np.linspace(door.minimum[axis], door.maximum[axis], count + 1).round(4)
    parts = []
    for start, stop in pairwise(ends):
        low, high = np.array(door.minimum), np.array(door.maximum)
        low[axis], high[axis] = start, stop
        parts.append(Opening(point(low), point(high), door.to))
    return parts


def _in_door(low: Float64, high: Float64) -> Float64:
    """The middle (3,) of a door, but above the floor, of one that goes on below it."""
    middle = (low + high) / 2
    middle[1] = high[1] - (high[1] - low[1]) / 4
    return middle


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
