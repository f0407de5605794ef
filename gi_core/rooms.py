"""Light of rooms and light of the open air, kept apart: two volumes that clients blend by a stencil (slide "Interior volume").

Sectors store what each voxel blends, indoors and out. Sampled as one, light would cross every wall between a voxel in a room and one beside
it. So the outdoor volume takes for a voxel indoors what the nearest one outdoors has, and an interior volume, for every voxel outside
its room, what the nearest inside has: coordinates clamped to the room, worked out once.
"""

import re

import numpy as np

from gi_core.arrays import Bool, Float32, Float64, Int64, UInt16
from gi_core.constants import ROOM_OUTDOORS, VOXEL_INDOORS, VOXEL_OUTDOORS
from gi_core.errors import InputError
from gi_core.sector import Sector
from gi_core.world import Room


def outdoor_blend(sector: Sector) -> tuple[UInt16, Float32]:
    """What a sector's voxels blend in an outdoor volume: probes and weights (ny, nz, nx, K)."""
    outdoors = sector.voxel_class == VOXEL_OUTDOORS
    if not (sector.voxel_class == VOXEL_INDOORS).any() or not outdoors.any():
        return sector.voxel_probe, sector.voxel_weight
    # A solid voxel between the two may have been filled from either side.
    source = nearest(outdoors)
    return sector.voxel_probe[source], sector.voxel_weight[source]


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
    Transforms of Sampled Functions", 2012).
    """
    squared = np.where(wanted, np.int32(0), np.int32(1 << 24))
    index: list[Int64] = [np.asarray(place, np.int64) for place in np.indices(wanted.shape)]
    for axis, count in enumerate(wanted.shape):
        step = np.arange(count, dtype=np.int32)
        apart = (step[:, None] - step) ** 2
        lines = np.moveaxis(squared, axis, -1)
        best = (lines[..., None, :] + apart).argmin(axis=-1)
        squared = np.moveaxis(np.take_along_axis(lines, best, -1) + apart[step, best], -1, axis)
        index = [np.moveaxis(np.take_along_axis(np.moveaxis(place, axis, -1), best, -1), -1, axis) for place in index]
    y, z, x = index
    return y, z, x


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
