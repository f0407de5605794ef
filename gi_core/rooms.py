"""Light of rooms and light of the open air, kept apart: two volumes that clients blend by a stencil (slide "Interior volume").

Sectors store what each voxel blends, indoors and out. Sampled as one, light would cross every wall between a voxel in a room and one beside
it. So the outdoor volume takes for a voxel indoors what the nearest one outdoors has, and an interior volume, for every voxel outside
its room, what the nearest inside has: coordinates clamped to the room, worked out once.
"""

import re
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from gi_core.arrays import Bool, Float32, Float64, Int64, UInt8, UInt16
from gi_core.constants import OPENING_DEPTH_M, OPENING_LEAST_VIEW, ROOM_CELL_M, ROOM_OUTDOORS, VOLUME_SHAPE, VOXEL_OUTDOORS, VOXEL_SIZE_M
from gi_core.errors import InputError
from gi_core.sector import Sector
from gi_core.world import Opening, Room, RoomCells

# Cells of a weight lattice along a voxel: as long as the way off a surface at which clients sample light.
WEIGHT_CELLS = 4
# Rays that meet a wall where another one ends may do so this far behind the other: pixels there had the street's light.
EDGE_M = 0.003
_IN_DOORWAY = -1  # in no room, and not outdoors
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


def rooms_of(position: Float64, rooms: tuple[Room, ...], slack_m: float = 0.0) -> UInt16:
    """Number of the first room that holds each world position (n, 3) [m], or whose box is that near, counting from 1; 0 outdoors."""
    found = np.full(len(position), ROOM_OUTDOORS, np.uint16)
    for number in _reached(position, rooms, slack_m)[::-1]:
        near = _near(rooms[number - 1], position, slack_m)
        found[near[holds(rooms[number - 1], position[near], slack_m)]] = number
    return found


def holds(room: Room, position: Float64, slack_m: float = 0.0, grown: bool = False) -> Bool:
    """Which world positions (n, 3) [m] lie in a room, or up to ``slack_m`` outside its box, and if ``grown`` a cell outside its cells."""
    low, high = np.array(room.minimum) - slack_m, np.array(room.maximum) + slack_m
    inside: Bool = np.asarray(((position >= low) & (position <= high)).all(axis=1), np.bool_)
    if room.cells is not None and inside.any():
        # The box ends at walls, cells beside them: what lies between the two is the room's.
        last = np.array(room.cells.shape) - 1
        cell = np.clip(np.floor(position[inside] / room.cells.size_m).astype(np.int64) - room.cells.first, 0, last)
        steps = np.concatenate([np.eye(3, dtype=np.int64), -np.eye(3, dtype=np.int64)]) if grown else ()
        held = _is_air(room.cells, cell)
        for step in steps:
            held |= _is_air(room.cells, np.clip(cell + step, 0, last))
        inside[inside] = held
    return inside


def _is_air(cells: RoomCells, at: Int64) -> Bool:
    """Which cells (n, 3), x, y, z from the first, hold the room's air."""
    nx, _, nz = cells.shape
    index = (at[:, 1] * nz + at[:, 2]) * nx + at[:, 0]
    return np.asarray(np.frombuffer(cells.bits, np.uint8)[index >> 3] >> (index & 7).astype(np.uint8) & 1, np.bool_)


@dataclass(frozen=True, eq=False)
class Shares:
    """How light is mixed, of which room or of the open air: entries (m,), of each point at least one, in no order.

    point : (m,) int64, which of the positions; room : (m,) uint16, 0 outdoors; share : (m,) float32, above 0, summing to 1 for each point
    """

    point: Int64
    room: UInt16
    share: Float32

    def of(self, number: int, count: int) -> Float32:
        """(count,): the shares of one room, or of the open air, in the light of all positions."""
        chosen = self.room == number
        return np.bincount(self.point[chosen], self.share[chosen], count).astype(np.float32)


def light_shares(position: Float64, rooms: tuple[Room, ...], surface: Float64 | None = None) -> Shares:
    """How light sampled at world positions (n, 3) [m] is mixed from the volumes of rooms and of the open air.

    surface : (n, 3) [m], of what is lit, and 2 cm off it: volumes are sampled farther off. None: the positions themselves

    Walls part rooms sharply, whatever is how near. In an opening what lies on its two sides are halves, from one side of the wall to the
    other; farther off the other side's share falls as the opening does from view. From a wall beside an opening nothing is seen of it, so
    no bright or dark seam surrounds windows.
    """
    surface = position if surface is None else surface
    own = rooms_of(position, rooms).astype(np.int64)
    outside = np.flatnonzero(own == ROOM_OUTDOORS)
    own[outside] = rooms_of(position[outside], rooms, EDGE_M)
    reached = _reached(surface, rooms, OPENING_DEPTH_M + max((_reach(each) for each in rooms), default=0.0))
    parts: list[tuple[Int64, int, Float32]] = []
    for number in reached:
        room = rooms[number - 1]
        close = [some[own[some] == ROOM_OUTDOORS] for some in (_near(room, position, _reach(room)), _near(room, surface, _reach(room)))]
        there = position[close[0]], surface[close[1]]
        for opening in room.openings:
            between = np.unique(np.concatenate([some[_in_box(opening, place)] for some, place in zip(close, there, strict=True)]))
            between = between[own[between] == ROOM_OUTDOORS]
            own[between] = _IN_DOORWAY
            parts += [(between, beyond, np.full(len(between), 0.5, np.float32)) for beyond in (number, opening.to)]
    for number in reached:
        room = rooms[number - 1]
        near = _near(room, surface, OPENING_DEPTH_M + _reach(room))
        for other in sorted({opening.to for opening in room.openings}):
            # Doors between rooms are among those of both.
            here = near[(own[near] == number) | ((own[near] == ROOM_OUTDOORS) & (other == ROOM_OUTDOORS))]
            half = opening_nearness(room, surface[here], other) / 2
            for inside, lends in ((number, other), (other, number)):
                seen = (half > 0) & (own[here] == inside)
                parts.append((here[seen], lends, half[seen]))
    lent = np.zeros(len(position))
    for at, _, share in parts:
        np.add.at(lent, at, share)
    rest = np.flatnonzero((lent < 1) & (own != _IN_DOORWAY))
    point = np.concatenate([at for at, _, _ in parts] + [rest])
    lender = np.concatenate([np.full(len(at), lends) for at, lends, _ in parts] + [own[rest]])
    share = np.concatenate([share / np.maximum(lent[at], 1) for at, _, share in parts] + [1 - lent[rest]])
    return Shares(point, lender.astype(np.uint16), share.astype(np.float32))


def _near(room: Room, position: Float64, reach_m: float) -> Int64:
    """Which positions (n, 3) [m] lie within a way of a room's box, along each axis."""
    near = np.arange(len(position))
    for axis in range(3):  # one after another: most are far along the first
        along = position[near, axis]
        near = near[(along >= room.minimum[axis] - reach_m) & (along <= room.maximum[axis] + reach_m)]
    return near


def _in_box(opening: Opening, position: Float64) -> Bool:
    return np.asarray(((position >= opening.minimum) & (position <= opening.maximum)).all(axis=1), np.bool_)


def opening_nearness(room: Room, position: Float64, to: int = ROOM_OUTDOORS, nearer_m: float = 0.0) -> Float32:
    """(n,) 0..1 at positions (n, 3) [m]: 1 in the openings of a room to another, or to the open air, 0 where each fills less than
    OPENING_LEAST_VIEW of half the view.

    nearer_m : from so much nearer they are seen, at most OPENING_DEPTH_M

    An opening is the rectangle across the shortest side of its box, seen from as much nearer as that is deep; from x and y off its
    corners, at a distance d, it has a solid angle of the sum of +- atan(x y / (d sqrt(x^2 + y^2 + d^2))).
    """
    nearness = np.zeros(len(position), np.float32)
    for opening in (each for each in room.openings if each.to == to):
        low, high = np.array(opening.minimum), np.array(opening.maximum)
        reach = OPENING_DEPTH_M + _reach_of(opening)
        near = np.flatnonzero(((position >= low - reach) & (position <= high + reach)).all(axis=1))
        axis = int(np.argmin(high - low))
        depth = np.abs(position[near, axis] - (low[axis] + high[axis]) / 2) - (high[axis] - low[axis]) / 2 - nearer_m
        depth = np.maximum(depth, 1e-9)
        u, v = (across for across in range(3) if across != axis)
        angle = np.zeros(len(near))
        for x, sign_x in ((high[u] - position[near, u], 1), (low[u] - position[near, u], -1)):
            for y, sign_y in ((high[v] - position[near, v], 1), (low[v] - position[near, v], -1)):
                angle += sign_x * sign_y * np.arctan2(x * y, depth * np.sqrt(x * x + y * y + depth * depth))
        view = (angle / (2 * np.pi) - OPENING_LEAST_VIEW) / (1 - OPENING_LEAST_VIEW)
        nearness[near] = np.maximum(nearness[near], np.clip(view, 0, 1).astype(np.float32))
    return nearness


def _reach_of(opening: Opening) -> float:
    """How far [m] beyond OPENING_DEPTH_M from its box an opening may be near: a solid angle is at most area over squared distance."""
    sides = sorted(np.subtract(opening.maximum, opening.minimum).tolist())
    return float(np.sqrt(sides[1] * sides[2] / (2 * np.pi * OPENING_LEAST_VIEW)))


@lru_cache(maxsize=1024)
def _reach(room: Room) -> float:
    """How far [m] beyond OPENING_DEPTH_M from a room's box one of its openings, which go out of it through walls, may be near."""
    return max(
        (
            _reach_of(each) + max(0.0, *np.subtract(room.minimum, each.minimum), *np.subtract(each.maximum, room.maximum))
            for each in room.openings
        ),
        default=0.0,
    )


def weight_lattice(first_voxel: Int64, rooms: tuple[Room, ...], numbers: tuple[int, ...], to: int = ROOM_OUTDOORS) -> UInt8:
    """Where a volume's rooms are, and how near their openings, in a quarter of its voxels' size: (2, 64, 128, 128), y, z, x.

    Plane 0 is 255 in the rooms of those ``numbers`` and 0 outside them; plane 1 is 255 times ``opening_nearness`` of the closest of them,
    of openings to the open air or to the room ``to``, from OPENING_DEPTH_M nearer: cells lie up to so far from one. In doorways to that
    room plane 0 is 127.
    """
    shape = tuple(WEIGHT_CELLS * n for n in VOLUME_SHAPE)
    found = np.zeros((2, *shape), np.uint8)
    size = VOXEL_SIZE_M / WEIGHT_CELLS
    axes = [
        (first_voxel[axis] * WEIGHT_CELLS + np.arange(count) + 0.5) * size for axis, count in ((0, shape[2]), (1, shape[0]), (2, shape[1]))
    ]
    for number in numbers:
        room = rooms[number - 1]
        reach = OPENING_DEPTH_M + _reach(room)
        near = [
            slice(*np.searchsorted(axis, [low - reach, high + reach]).tolist())
            for axis, low, high in zip(axes, room.minimum, room.maximum, strict=True)
        ]
        part = (near[1], near[2], near[0])
        y, z, x = np.meshgrid(axes[1][near[1]], axes[2][near[2]], axes[0][near[0]], indexing="ij")
        position = np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)
        inside = holds(room, position).astype(np.float32)
        for door in (each for each in room.openings if each.to == to != ROOM_OUTDOORS):
            between = _in_box(door, position) & ~holds(rooms[to - 1], position)
            inside = np.where(between, np.maximum(inside, np.float32(127 / 255)), inside)
        for plane, value in enumerate((inside, opening_nearness(room, position, to, OPENING_DEPTH_M))):
            here = found[(plane, *part)]
            np.maximum(here, np.round(255 * value.reshape(here.shape)).astype(np.uint8), out=here)
    return found


def pack_cells(at: Int64, size_m: float = ROOM_CELL_M) -> RoomCells:
    """The cells of a room, at least one, by their lattice indices (n, 3), x, y, z; ``size_m`` is a cell's width [m]."""
    x, y, z = at.min(axis=0).tolist()
    nx, ny, nz = (np.ptp(at, axis=0) + 1).tolist()
    air = np.zeros((ny, nz, nx), np.bool_)
    air[tuple((at - [x, y, z]).T[[1, 2, 0]])] = True
    return RoomCells((x, y, z), (nx, ny, nz), np.packbits(air.reshape(-1), bitorder="little").tobytes(), size_m)


def air_of(cells: RoomCells) -> Bool:
    """Which cells (ny, nz, nx) hold the room's air."""
    nx, ny, nz = cells.shape
    bits = np.unpackbits(np.frombuffer(cells.bits, np.uint8), count=nx * ny * nz, bitorder="little")
    return np.asarray(bits.astype(np.bool_).reshape(ny, nz, nx))


def _reached(position: Float64, rooms: tuple[Room, ...], margin_m: float) -> list[int]:
    """Numbers of the rooms whose boxes, a margin wider, touch the box of some positions (n, 3): most of a city's do not."""
    if not rooms or not len(position):
        return []
    low, high = np.array([room.minimum for room in rooms]), np.array([room.maximum for room in rooms])
    touch = (low - margin_m <= position.max(axis=0)) & (high + margin_m >= position.min(axis=0))
    return (np.flatnonzero(touch.all(axis=1)) + 1).tolist()
