"""Where the air of rooms meets the open air: doors and windows, as boxes."""

from dataclasses import replace

import numpy as np
from scipy.ndimage import find_objects, label

from bake_jobs.rays import RayScene
from gi_core.arrays import Bool, Float64, Int32, Int64
from gi_core.constants import ROOM_CELL_M, ROOM_OUTDOORS
from gi_core.rooms import rooms_of
from gi_core.world import Opening, Room

# An author's box may end before its walls or in them: a way from this far inside it to this far outside it, past walls of common depth.
INSIDE_M, OUTSIDE_M = 0.3, 0.6
# A seam that follows cells may lie so far inside the room, and turn corners there.
SEAM_M = 2 * ROOM_CELL_M
# Rims are looked for so deep in a wall, of which the thinnest have 10 cm.
RIM_DEPTH_M = 0.05
# What begins lower above a room's floor is a door, whatever its sill.
SILL_M = 0.5
# From a cell beside a wall to the wall.
_NEAR_CELLS = 1.5


def authored_openings(rays: RayScene, rooms: tuple[Room, ...]) -> tuple[Room, ...]:
    """Rooms with the openings in the six faces of each one's box: rectangles that nothing closes and that lead to no other room."""
    return tuple(replace(room, openings=tuple(_face_openings(rays, room, rooms))) for room in rooms)


def _face_openings(rays: RayScene, room: Room, rooms: tuple[Room, ...]) -> list[Opening]:
    low, high = np.array(room.minimum), np.array(room.maximum)
    count = np.maximum(np.round((high - low) / ROOM_CELL_M), 1).astype(np.int64)
    found = []
    for axis in range(3):
        across = [other for other in range(3) if other != axis]
        at = np.stack(np.meshgrid(*(np.arange(count[other]) for other in across), indexing="ij"), axis=-1).reshape(-1, 2)
        face = np.zeros((len(at), 3))
        face[:, across] = low[across] + (at + 0.5) * ((high - low) / count)[across]
        for sign, plane in ((-1.0, low[axis]), (1.0, high[axis])):
            inward = min(INSIDE_M, (high[axis] - low[axis]) / 2)
            face[:, axis] = plane
            way = np.zeros(3)
            way[axis] = sign
            blocked = rays.occluded(face - inward * way, np.tile(way, (len(face), 1)), np.full(len(face), inward + OUTSIDE_M))
            is_open = ~blocked & (rooms_of(face + OUTSIDE_M * way, rooms) == ROOM_OUTDOORS)
            parts, _ = label(is_open.reshape(count[across]), np.ones((3, 3)))
            for part in find_objects(parts):
                first, last = low.copy(), high.copy()
                first[axis] = last[axis] = plane
                size = ((high - low) / count)[across]
                first[across] = low[across] + [part[0].start, part[1].start] * size
                last[across] = low[across] + [part[0].stop, part[1].stop] * size
                found.append(_to_rim(rays, (first, last), (low, high), axis, sign))
    return found


def _to_rim(rays: RayScene, ends: tuple[Float64, Float64], room: tuple[Float64, Float64], axis: int, outward: float) -> Opening:
    """An opening that was found in cells, as wide as it is: to what its middle meets, a little way into the wall, around it.

    ends, room : low and high (3,) [m] of what was found, and of the room; outward : which way along the axis is out of it, 1 or -1

    One that begins at the floor goes on below it, as far as it is high: so a floor sees as much of a door as who stands on it.
    """
    low, high = ends[0].copy(), ends[1].copy()
    side = room[1 if outward > 0 else 0][axis]
    if max(abs(low[axis] - side), abs(high[axis] - side)) <= SEAM_M:
        low[axis] = high[axis] = side
    middle = (low + high) / 2
    middle[axis] += outward * RIM_DEPTH_M
    for across in (other for other in range(3) if other != axis):
        for edge, sign in ((low, -1.0), (high, 1.0)):
            way = np.zeros((1, 3))
            way[0, across] = sign
            rim = middle[across] + sign * float(rays.closest(middle[None], way).distance[0])
            if abs(rim - edge[across]) <= ROOM_CELL_M:
                edge[across] = round(rim, 4)
    if axis != 1 and low[1] < room[0][1] + SILL_M:
        low[1] -= high[1] - low[1]
    return Opening(point(low), point(high))


def opening_boxes(
    rays: RayScene, basin: Int32, number: int, rooms: set[int], cuts: tuple[Bool, ...], first: Int64, low: Float64, high: Float64
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
                start, stop = (np.clip((end[[2, 0, 1]] + first) * ROOM_CELL_M, low, high) for end in (start, stop))
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
