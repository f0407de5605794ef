"""Clusters what probes see into surfels and bricks (slides "Surfel sharing", "Surfel grid"): a two-level hash grid.

A hit's key names its brick's cell, its room, its principal normal direction, and its own cell inside the brick, in that order of
significance. Sorting by the key therefore sorts surfels by brick, and a brick is a run of surfels:

    key = [level | brick y | brick z | brick x | room  | direction | cell in brick]
           3 bit    13 bit    16 bit    16 bit   6 bit     3 bit        6 bit

The direction keeps the two faces of a thin wall apart, the room what stands on the floor at either side of it: a brick of 4 m that
lay under the wall between two rooms would carry the light of one into the other.

What then lies in one brick but is seen together by no probe, as the front of a house and the wall of its light well that looks the same
way, becomes bricks of their own: otherwise the well would get the street's light. That costs no factor, since each probe sees one of them.

Cells are 1 m and bricks 4 m wide at level 0, and twice as wide at each next level. A 1 m cell goes to the level that the distance of
the closest probe which sees it asks for: beyond some 10 m, the rays of a 16 x 16 face fall further apart than 1 m, and every hit
would become a surfel of its own.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from bake_jobs.distinct import distinct, least
from bake_jobs.gbuffer import GBuffer
from gi_core.arrays import Float32, Float64, Int32, Int64, UInt8, UInt16
from gi_core.constants import BRICK_CELL_M, MAX_BRICK_LEVEL, ROOM_OUTDOORS, SURFEL_CELL_M
from gi_core.errors import SourceError
from gi_core.rooms import holds
from gi_core.world import Room

CELLS_PER_BRICK = round(BRICK_CELL_M / SURFEL_CELL_M)
# Walls and floors love whole metres. Moved this far off the surface, all their hits fall into one layer of cells, and the two faces
# of a thin wall into different ones.
KEY_OFFSET_M = 0.02
# An author's box of a room may end this far before its walls.
ROOM_SLACK_M = 0.1
# Weights of several feedback probes, in steps of the largest.
FEEDBACK_STEPS = 15
_HALF_RANGE = 1 << 15
_HALF_HEIGHT = 1 << 12
_ROOM_KEYS = 63  # of rooms that a sector sees more, some share a key, and share light where one brick reaches into both
_CELL_SHIFT = CELLS_PER_BRICK.bit_length() - 1
_BRICK_SHIFT = 6  # of a surfel's key: what is left names its brick


@dataclass(frozen=True, eq=False)
class Surfels:
    """Surfels in brick order; gi_core.sector describes the arrays.

    of_hit : (h,) int64, the surfel of each hit, and hit : (h,) int64, the G-buffer entry of each
    """

    position: Float64
    normal: Float32
    albedo: Float32
    emission: Float32
    brick_starts: Int64
    brick_level: UInt8
    brick_cell: Int32
    brick_direction: UInt8
    of_hit: Int64
    hit: Int64

    @property
    def count(self) -> int:
        return len(self.position)

    @property
    def brick_of_surfel(self) -> Int64:
        """(S,) int64."""
        return np.repeat(np.arange(len(self.brick_cell)), np.diff(self.brick_starts))


def principal_direction(normal: Float32) -> UInt8:
    """Ambient cube face (n,) that each normal (n, 3) is closest to."""
    axis = np.argmax(np.abs(normal), axis=1)
    negative = np.take_along_axis(normal, axis[:, None], axis=1)[:, 0] < 0
    return (2 * axis + negative).astype(np.uint8)


def rooms_of_hits(gbuffer: GBuffer, probe_room: UInt16, rooms: tuple[Room, ...]) -> UInt16:
    """The room that the air before each G-buffer entry belongs to: (P * r,) uint16, 0 outdoors and where nothing was hit.

    probe_room : (P,) uint16, numbers of ``rooms`` from 1. Only rooms with a probe count: a room that no probe stands in has no light
    of its own to protect.
    """
    room = np.full(len(gbuffer.position), ROOM_OUTDOORS, np.uint16)
    present = np.unique(probe_room[probe_room != ROOM_OUTDOORS])
    if not len(present):
        return room
    air = gbuffer.position + gbuffer.hits.normal * KEY_OFFSET_M
    seen_from = np.repeat(probe_room, gbuffer.rays)
    for slack, of_own_probes in ((ROOM_SLACK_M, True), (0.0, False)):
        for number in present[::-1]:
            inside = holds(rooms[number - 1], air, slack, grown=slack > 0)
            room[inside & (seen_from == number) if of_own_probes else inside] = number
    room[~gbuffer.hits.hit] = ROOM_OUTDOORS
    return room


def cluster(gbuffer: GBuffer, room: UInt16, origin: Float64, albedo: Float32, emission: Float32, double_beyond_m: float) -> Surfels:
    """Group a sector's hits into surfels and bricks.

    room : (P * r,) as ``rooms_of_hits`` gives it
    origin : (3,) the sector's; albedo, emission : (m, 3) of the scene's triangles
    double_beyond_m : cells are 1 m where some probe is closer than this, and double with every doubling of that distance
    """
    hit = np.flatnonzero(gbuffer.hits.hit)
    local = gbuffer.position[hit] - origin
    normal = gbuffer.hits.normal[hit]
    direction = principal_direction(normal)
    # Of the sector's own rooms: a city has hundreds.
    _, room_key = np.unique(np.append(room[hit], np.uint16(ROOM_OUTDOORS)), return_inverse=True)
    room_key = np.where(room_key[:-1] == 0, 0, (room_key[:-1] - 1) % _ROOM_KEYS + 1)
    cell = np.floor((local + normal * KEY_OFFSET_M) / SURFEL_CELL_M).astype(np.int64)
    for axis, half in enumerate((_HALF_RANGE, _HALF_HEIGHT, _HALF_RANGE)):
        if len(cell) and np.abs(cell[:, axis]).max() >= half * CELLS_PER_BRICK:
            raise SourceError(
                f"a probe sees a surface more than {half * BRICK_CELL_M:.0f} m away along {'xyz'[axis]}; split the world into parts"
            )
    fine_key, fine_of_hit = distinct(_key(cell, room_key, direction, np.zeros(len(cell), np.int64)))
    closest = np.full(len(fine_key), np.inf, np.float32)
    np.minimum.at(closest, fine_of_hit, gbuffer.hits.distance[hit])
    level = np.clip(np.floor(np.log2(np.maximum(closest, 1e-6) / double_beyond_m)) + 1, 0, MAX_BRICK_LEVEL).astype(np.int64)
    of_fine_cell = np.empty(len(fine_key), np.int64)
    of_fine_cell[fine_of_hit] = np.arange(len(hit))  # any hit of a fine cell knows its place and direction
    coarse_cell = cell[of_fine_cell] >> level[:, None]
    surfel_key, surfel_of_fine = distinct(_key(coarse_cell, room_key[of_fine_cell], direction[of_fine_cell], level))
    of_hit = surfel_of_fine[fine_of_hit]
    _, cell_of_surfel = np.unique(surfel_key >> _BRICK_SHIFT, return_inverse=True)
    part = _seen_together(cell_of_surfel, of_hit, hit // gbuffer.rays)
    by_part = np.argsort(part, kind="stable")
    surfel_key, part = surfel_key[by_part], part[by_part]
    of_hit = np.argsort(by_part)[of_hit]
    count = len(surfel_key)
    hits_of_surfel = np.bincount(of_hit, minlength=count)

    def mean(values: Float64 | Float32) -> Float64:
        columns = [np.bincount(of_hit, values[:, c], count) for c in range(3)]
        return np.stack(columns, axis=1) / hits_of_surfel[:, None]

    triangle = gbuffer.hits.triangle[hit]
    mean_normal = mean(normal)
    mean_normal /= np.maximum(np.linalg.norm(mean_normal, axis=1, keepdims=True), 1e-12)
    position = _on_surface(mean(local), mean_normal, local, of_hit)
    first = np.flatnonzero(np.diff(part, prepend=-1))
    brick_key = surfel_key[first] >> _BRICK_SHIFT
    brick_cell = np.stack([brick_key >> 9 & 0xFFFF, brick_key >> 41 & 0x1FFF, brick_key >> 25 & 0xFFFF], axis=1)
    brick_cell -= np.array([_HALF_RANGE, _HALF_HEIGHT, _HALF_RANGE])
    return Surfels(
        position=position,
        normal=mean_normal.astype(np.float32),
        albedo=mean(albedo[triangle]).astype(np.float32),
        emission=mean(emission[triangle]).astype(np.float32) if emission.any() else np.zeros((count, 3), np.float32),
        brick_starts=np.append(first, count).astype(np.int64),
        brick_level=(brick_key >> 54).astype(np.uint8),
        brick_cell=brick_cell.astype(np.int32),
        brick_direction=(brick_key & 7).astype(np.uint8),
        of_hit=of_hit,
        hit=hit,
    )


def _seen_together(brick: Int64, of_hit: Int64, probe: Int64) -> Int64:
    """The first surfel (S,) of the part of its brick that each belongs to: a probe that sees two surfels of a brick makes them one part.

    brick : (S,) numbers, ascending; of_hit, probe : (h,) which surfel each hit is of, and which probe's
    """
    views, view_of_hit = distinct(brick[of_hit] << 10 | probe)
    count = len(brick)
    links = coo_array((np.ones(len(of_hit), bool), (of_hit, count + view_of_hit)), shape=(count + len(views),) * 2)
    _, part = connected_components(links, directed=False)
    _, first, of_surfel = np.unique(part[:count], return_index=True, return_inverse=True)
    return np.asarray(first[of_surfel], np.int64)


def _on_surface(mean: Float64, normal: Float64, hits: Float64, of_hit: Int64) -> Float64:
    """Positions (S, 3): the means of hits (h, 3) where these lie in a plane, elsewhere the hits nearest to the means.

    Where walls step back, as at cornices and between piers, the mean of a cell is inside the wall, where neither sun nor lamps come.
    """
    off = hits - mean[of_hit]
    uneven = np.zeros(len(mean), bool)
    uneven[of_hit[np.abs(np.einsum("ha,ha->h", off, normal[of_hit])) > KEY_OFFSET_M]] = True
    some = np.flatnonzero(uneven[of_hit])
    nearest = least(np.einsum("ha,ha->h", off[some], off[some]), of_hit[some], len(mean))
    position = mean.copy()
    position[uneven] = hits[some[nearest[uneven]]]
    return position


def _key(cell: Int64, room: Int64, direction: UInt8, level: Int64) -> Int64:
    """Sort keys (n,) of surfel cells (n, 3) at their level's size; the module's docstring draws the bits."""
    x, y, z = np.ascontiguousarray(cell.T)
    # Shifted rather than divided, which takes four times as long.
    key = (level << 13 | (y >> _CELL_SHIFT) + _HALF_HEIGHT) << 16 | (z >> _CELL_SHIFT) + _HALF_RANGE
    key = key << 16 | (x >> _CELL_SHIFT) + _HALF_RANGE
    within = CELLS_PER_BRICK - 1
    return ((key << 6 | room) << 3 | direction) << _BRICK_SHIFT | ((y & within) << 4 | (z & within) << 2 | (x & within))


def feedback(surfels: Surfels, gbuffer: GBuffer, k: int) -> tuple[UInt16, Float32]:
    """The k closest probes among those that see each surfel (slide "Multiple bounces"), and their weights by inverse square distance.

    -> (S, k) uint16 and (S, k) float32, rows sum to 1. Seeing it is what keeps a probe behind a wall from lighting a surfel. Several
    weights are whole multiples of a fifteenth of the largest: finer ones say nothing, and take twice the bytes in a file.
    """
    probe = surfels.hit // gbuffer.rays
    # One integer orders by distance, then by probe: millimetres up to 2 ** 52 / 1024, probes below 1024.
    millimetres = np.minimum(gbuffer.hits.distance[surfels.hit].astype(np.float64) * 1000, 2.0**40).astype(np.int64)
    code = millimetres << 10 | probe
    taken = np.zeros((surfels.count, k), np.uint16)
    weight = np.zeros((surfels.count, k), np.float64)
    far = np.iinfo(np.int64).max
    for slot in range(k):
        best = np.full(surfels.count, far)
        np.minimum.at(best, surfels.of_hit, code)
        found = best != far
        taken[:, slot] = np.where(found, best & 0x3FF, 0)
        weight[:, slot] = np.where(found, 1 / np.maximum((best >> 10) / 1000.0, 0.25) ** 2, 0)
        if slot + 1 < k:
            code = np.where(probe == taken[surfels.of_hit, slot], far, code)
    if k > 1:
        weight = np.rint(weight / np.maximum(weight.max(axis=1, keepdims=True), 1e-30) * FEEDBACK_STEPS)
        taken[weight == 0] = 0
    weight /= np.maximum(weight.sum(axis=1, keepdims=True), 1e-30)
    return taken, weight.astype(np.float32)
