"""Light of rooms and light of the open air, kept apart: two volumes that clients blend by a stencil (slide "Interior volume").

Sectors store what each voxel blends, indoors and out. Sampled as one, light would cross every wall between a voxel in a room and one beside
it. So the outdoor volume takes for a voxel indoors what the nearest one outdoors has, and an interior volume, for every voxel outside
its room, what the nearest inside has: coordinates clamped to the room, worked out once.
"""

import re

import numpy as np

from gi_core.arrays import Bool, Float32, Float64, Int64, UInt8, UInt16
from gi_core.constants import ROOM_OUTDOORS, VOXEL_OUTDOORS
from gi_core.errors import InputError
from gi_core.sector import Sector
from gi_core.world import Room

_FAR = np.int32(1 << 12)  # voxels; no two are as far apart


def outdoor_blend(sector: Sector) -> tuple[UInt16, Float32]:
    """What a sector's voxels blend in an outdoor volume: probes and weights (ny, nz, nx, K)."""
    return without_rooms(sector.voxel_class, sector.voxel_probe, sector.voxel_weight, sector.probe_room)


def without_rooms(kind: UInt8, probe: UInt16, weight: Float32, probe_room: UInt16) -> tuple[UInt16, Float32]:
    """Probes and weights (ny, nz, nx, K) of voxels of classes (ny, nz, nx), none of a probe in a room; ``probe_room`` (P,).

    Whatever blends such a probe takes what the nearest voxel outdoors does that blends none: not only voxels in rooms, also solid ones and
    those outdoors that see no probe, which were filled from the nearest air, be it behind a wall. Voxels without weights stay so.
    """
    if not probe_room.any():
        return probe, weight
    has_light = np.asarray(weight.any(axis=3), np.bool_)
    in_room = np.asarray(((weight > 0) & (probe_room[probe] != ROOM_OUTDOORS)).any(axis=3), np.bool_)
    lends = (kind == VOXEL_OUTDOORS) & has_light & ~in_room
    if not lends.any():
        return probe, weight * ~in_room[..., None]
    source = nearest(lends)
    return probe[source], weight[source] * has_light[..., None]


def rooms_with_light(sector: Sector) -> UInt16:
    """Rooms (ny, nz, nx) of a sector's voxels, where they blend probes of that room alone; else 0.

    A room without a probe was baked to borrow from all, so its voxels may hold light of the street.
    """
    of_probe = sector.probe_room[sector.voxel_probe] if sector.probe_count else np.zeros_like(sector.voxel_probe)
    foreign = (sector.voxel_weight > 0) & (of_probe != sector.voxel_room[..., None])
    lit = sector.voxel_weight.any(axis=3) & ~foreign.any(axis=3)
    return np.where(lit, sector.voxel_room, np.uint16(ROOM_OUTDOORS))


def nearest(wanted: Bool) -> tuple[Int64, Int64, Int64]:
    """For each voxel the index (y, z, x) of the nearest that is wanted, itself where it is: three arrays of the shape of ``wanted``.

    Axis by axis: the best of a line, of the lines the best of a plane, of the planes the best (Felzenszwalb and Huttenlocher, "Distance
    Transforms of Sampled Functions", 2012). Columns, which may be high, are passed through up and down.
    """
    y = np.arange(len(wanted), dtype=np.int32)[:, None, None]
    below = np.maximum.accumulate(np.where(wanted, y, -_FAR), axis=0)
    above = np.minimum.accumulate(np.where(wanted, y, len(wanted) + _FAR)[::-1], axis=0)[::-1]
    best_y = np.where(y - below <= above - y, below, above)
    squared = np.minimum(np.abs(best_y - y), _FAR) ** 2
    best_y = np.clip(best_y, 0, len(wanted) - 1)
    index: list[Int64] = [np.asarray(best_y, np.int64), *(np.asarray(place, np.int64) for place in np.indices(wanted.shape)[1:])]
    for axis in (1, 2):
        step = np.arange(wanted.shape[axis], dtype=np.int32)
        apart = (step[:, None] - step) ** 2
        lines = np.moveaxis(squared, axis, -1)
        best = (lines[..., None, :] + apart).argmin(axis=-1)
        squared = np.moveaxis(np.take_along_axis(lines, best, -1) + apart[step, best], -1, axis)
        index = [np.moveaxis(np.take_along_axis(np.moveaxis(place, axis, -1), best, -1), -1, axis) for place in index]
    return index[0], index[1], index[2]


def find_room(rooms: tuple[Room, ...], wanted: str) -> int:
    """The number of a room by its name, or by that number as text. Raises InputError, naming those that there are."""
    names = [room.name for room in rooms]
    if wanted in names:
        return names.index(wanted) + 1
    if re.fullmatch(r"[1-9]\d{0,5}", wanted) and int(wanted) <= len(rooms):
        return int(wanted)
    if not names:
        raise InputError("room: this world has none")
    shown = ", ".join(repr(name[:40]) for name in names[:8]) + (f" and {len(names) - 8} more" if len(names) > 8 else "")
    raise InputError(f"room {wanted[:40]!r}: expected one of {shown}, or a number of 1 to {len(names)}")


def rooms_of(position: Float64, rooms: tuple[Room, ...]) -> UInt16:
    """Number of the first room that holds each world position (n, 3) [m], counting from 1; 0 outdoors."""
    room = np.full(len(position), ROOM_OUTDOORS, np.uint16)
    for number in range(len(rooms), 0, -1):
        box = rooms[number - 1]
        room[((position >= box.minimum) & (position <= box.maximum)).all(axis=1)] = number
    return room
