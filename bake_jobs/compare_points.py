"""Where a sector is compared with the path tracer: chosen by casting rays into the mesh, without asking the bake what it thinks.

A point counts as open air when it sees some of the sky, and something below it. Inside a solid there is no sky, however the mesh is
wound and whether or not it has a bottom; what an overlapping part buries drops out by the same test. Under the ground there is
nothing below, though sky may show past the edge of the world.
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import distance_transform_edt

from bake_jobs.rays import SURFACE_OFFSET_M, RayScene
from gi_core.arrays import Bool, Float64, Int64, UInt16
from gi_core.constants import ROOM_OUTDOORS, SECTOR_SIZE_M, VOLUME_SHAPE, VOXEL_SIZE_M
from gi_core.geometry_file import Geometry
from gi_core.grid import SectorIndex, volume_first_voxel, voxel_centre
from gi_core.rooms import EDGE_M, rooms_of
from gi_core.sector import PROBE_IN_MARGIN, Sector
from gi_core.world import Room

EYE_HEIGHT_M = 1.7
# A client reads the volume a quarter voxel off a surface: closer reads through it, farther reads other light.
CLIENT_OFFSET_M = 0.25 * VOXEL_SIZE_M
NEAR_M = 3.2  # about one voxel
MID_M = 6.0
LOOK_DIRECTIONS = 192
# Of the 96 upward rays. One may slip through the hair-wide cracks between sectors' cut geometries; two do not.
SKY_RAYS_MIN = 2
# Of the 96 downward rays. Above the very corner of the world's ground a quarter of them meets it; under the ground none does.
GROUND_RAYS_MIN = 10
# So far off a surface there is a room's air, or there is not.
IN_ROOM_M = 0.02
_POINTS_AT_ONCE = 2048


@dataclass(frozen=True, eq=False)
class Surroundings:
    """distance : (n,) [m] to the nearest surface met by the look-around rays; open_air : (n,) bool."""

    distance: Float64
    open_air: Bool


@dataclass(frozen=True, eq=False)
class SectorPoints:
    """Where one sector is compared. World frame, metres.

    eye : (3,) where a player stands; the volume is the one around it
    probe : (p,) indices of probes in open air; probe_position : (p, 3)
    near, mid : (k, 3) int64, indices (z, y, x) into the volume: open-air voxels, at most NEAR_M and at least MID_M from a surface
    surface, normal : (s, 3) points on surfaces and unit normals towards the open air that their light comes from
    open_voxel : (16, 32, 32) bool, voxels of the volume in open air
    """

    eye: Float64
    probe: Int64
    probe_position: Float64
    near: Int64
    mid: Int64
    surface: Float64
    normal: Float64
    open_voxel: Bool


def choose_points(
    rays: RayScene, geometry: Geometry, sector: Sector, count: int, rng: np.random.Generator, rooms: tuple[Room, ...] = ()
) -> SectorPoints:
    """At most ``count`` points of each kind in one sector, none in one of the ``rooms``: through windows these see the sky too."""
    eye = standing_eye(rays, sector.index, geometry)
    first = volume_first_voxel(eye)
    index = np.argwhere(np.ones(VOLUME_SHAPE, bool))  # (y, z, x)
    centre = voxel_centre(index[:, [2, 0, 1]] + first)
    seen = look_around(rays, centre)
    origin = sector.index.origin
    in_sector = ((centre >= origin) & (centre < origin + SECTOR_SIZE_M))[:, [0, 2]].all(axis=1)
    outside = seen.open_air & (rooms_of(centre, rooms) == ROOM_OUTDOORS)
    free = outside & in_sector
    probe_position = sector.probe_position.astype(np.float64) + origin
    outdoors = (sector.probe_room == ROOM_OUTDOORS) & (sector.probe_flags & PROBE_IN_MARGIN == 0)
    surface, normal = _surface_points(rays, geometry, voxel_centre(first), rooms, count, rng)
    near = index[_some(np.flatnonzero(free & (seen.distance <= NEAR_M)), count, rng)]
    mid = index[_some(np.flatnonzero(free & (seen.distance >= MID_M)), count, rng)]
    # Probes come last: all other points are the same for whatever was baked of a place.
    probe = _some(np.flatnonzero(outdoors & look_around(rays, probe_position).open_air), count, rng)
    return SectorPoints(
        eye=eye,
        probe=probe,
        probe_position=probe_position[probe],
        near=near,
        mid=mid,
        surface=surface,
        normal=normal,
        open_voxel=outside.reshape(VOLUME_SHAPE),
    )


def standing_eye(rays: RayScene, index: SectorIndex, geometry: Geometry) -> Float64:
    """(3,): above the middle of a sector, at the height of someone who stands on the lowest tenth of what rain would wet."""
    steps = (np.arange(16) + 0.5) / 16 * SECTOR_SIZE_M
    x, z = (grid.ravel() for grid in np.meshgrid(steps, steps))
    top = float(geometry.vertices[:, 1].max()) + 1.0 if len(geometry.vertices) else 0.0
    above = index.origin + np.stack([x, np.full_like(x, top), z], axis=1)
    hits = rays.closest(above, np.broadcast_to(np.array([0.0, -1.0, 0.0]), above.shape))
    ground = top - float(np.quantile(hits.distance[hits.hit], 0.9)) if hits.hit.any() else 0.0
    return np.asarray(index.origin + np.array([SECTOR_SIZE_M / 2, ground + EYE_HEIGHT_M, SECTOR_SIZE_M / 2]))


def look_around(rays: RayScene, points: Float64) -> Surroundings:
    """What surrounds points (n, 3) [m], by the same LOOK_DIRECTIONS directions from each."""
    directions = _fibonacci_sphere(LOOK_DIRECTIONS)
    upward = directions[:, 1] > 0
    distance, open_air = np.empty(len(points)), np.empty(len(points), bool)
    for start in range(0, len(points), _POINTS_AT_ONCE):
        some = slice(start, start + _POINTS_AT_ONCE)
        origins = np.repeat(points[some], LOOK_DIRECTIONS, axis=0)
        hits = rays.closest(origins, np.tile(directions, (len(points[some]), 1)))
        lengths = hits.distance.reshape(-1, LOOK_DIRECTIONS)
        distance[some] = lengths.min(axis=1)
        left = np.isinf(lengths)
        open_air[some] = (left[:, upward].sum(axis=1) >= SKY_RAYS_MIN) & ((~left[:, ~upward]).sum(axis=1) >= GROUND_RAYS_MIN)
    return Surroundings(distance, open_air)


def nearest_open_voxel(open_voxel: Bool) -> Int64:
    """For each voxel the index of the nearest open one, itself where it is open: (16, 32, 32) -> (3, 16, 32, 32), (y, z, x)."""
    return np.asarray(distance_transform_edt(~open_voxel, return_distances=False, return_indices=True), np.int64)


def corner_voxels(points: Float64, origin: Float64) -> Int64:
    """The eight voxels that trilinear sampling at points (n, 3) [m] mixes: (n, 8, 3) int64, (y, z, x), clamped to the volume.

    origin : (3,) [m], centre of voxel (0, 0, 0).
    """
    low = np.floor((points - origin) / VOXEL_SIZE_M).astype(np.int64)
    corner = low[:, None, :] + np.argwhere(np.ones((2, 2, 2), bool))
    return np.clip(corner[..., [1, 2, 0]], 0, np.array(VOLUME_SHAPE) - 1)


def _surface_points(
    rays: RayScene, geometry: Geometry, low: Float64, rooms: tuple[Room, ...], count: int, rng: np.random.Generator
) -> tuple[Float64, Float64]:
    """At most ``count`` points spread evenly over the sector's surface within the volume, whose first voxel's centre is ``low`` (3,) [m],
    and normals towards open air."""
    # Most of a tower's surface lies above the volume or faces another's inside: draw many and keep those that count.
    point, normal = _drawn_on(geometry.vertices[geometry.triangles], 64 * count, rng)
    high = low + VOXEL_SIZE_M * (np.array(VOLUME_SHAPE)[[2, 0, 1]] - 1)
    inside = ((point - CLIENT_OFFSET_M >= low) & (point + CLIENT_OFFSET_M <= high)).all(axis=1)
    some = np.flatnonzero(inside)[: 16 * count]
    point, normal = point[some], normal[some]
    in_front, behind = (_open_air_off(rays, point, side) & (_rooms_off(point, side, rooms) == ROOM_OUTDOORS) for side in (normal, -normal))
    normal = np.where(in_front[:, None], normal, -normal)
    found = np.flatnonzero(in_front | behind)[:count]
    return point[found], normal[found]


def points_in_rooms(geometry: Geometry, rooms: tuple[Room, ...], count: int, rng: np.random.Generator) -> tuple[Float64, Float64]:
    """At most ``count`` points spread evenly over a sector's surfaces in rooms, at any height, and normals into their air: (n, 3) each."""
    corners = geometry.vertices[geometry.triangles]
    low, high = corners.min(axis=1), corners.max(axis=1)
    may = np.zeros(len(corners), bool)
    for room in rooms:
        may |= ((high >= np.array(room.minimum) - EDGE_M) & (low <= np.array(room.maximum) + EDGE_M)).all(axis=1)
    point, normal = _drawn_on(corners[may], 16 * count, rng)
    sides = [_rooms_off(point, side, rooms) != ROOM_OUTDOORS for side in (normal, -normal)]
    found = np.flatnonzero(sides[0] | sides[1])[:count]
    return point[found], np.where(sides[0][found, None], normal[found], -normal[found])


def _rooms_off(point: Float64, normal: Float64, rooms: tuple[Room, ...]) -> UInt16:
    """(n,): the rooms right in front of surfaces."""
    return rooms_of(point + IN_ROOM_M * normal, rooms)


def _drawn_on(corners: Float64, count: int, rng: np.random.Generator) -> tuple[Float64, Float64]:
    """``count`` points spread evenly over triangles (n, 3, 3) [m], and normals, each of either sign; none where there is no area."""
    a, edges_b, edges_c = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    chosen, normal = drawn_by_area(corners, count, rng)
    if not len(chosen):
        return np.zeros((0, 3)), np.zeros((0, 3))
    u, v = rng.random((2, len(chosen), 1))
    folded = u + v > 1
    u, v = np.where(folded, 1 - u, u), np.where(folded, 1 - v, v)
    normal[rng.random(len(normal)) < 0.5] *= -1
    return a[chosen] + u * edges_b[chosen] + v * edges_c[chosen], normal


def drawn_by_area(corners: Float64, count: int, rng: np.random.Generator) -> tuple[Int64, Float64]:
    """``count`` of triangles (n, 3, 3) [m], drawn by area, and their unit normals (count, 3); none where there is no area."""
    doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(doubled, axis=1)
    if not length.sum() > 0 or count == 0:
        return np.zeros(0, np.int64), np.zeros((0, 3))
    chosen = rng.choice(len(length), count, p=length / length.sum())
    return chosen, doubled[chosen] / length[chosen, None]


def _open_air_off(rays: RayScene, point: Float64, normal: Float64) -> Bool:
    """Whether there is open air in front of surfaces: looked at where a client samples, or halfway to what stands closer."""
    start = point + 2 * SURFACE_OFFSET_M * normal
    free = rays.closest(start, normal).distance.astype(np.float64)
    off = np.minimum(CLIENT_OFFSET_M, free / 2)
    return look_around(rays, start + off[:, None] * normal).open_air


def _some(indices: Int64, count: int, rng: np.random.Generator) -> Int64:
    """At most ``count`` of the indices, ascending."""
    return np.sort(rng.choice(indices, count, replace=False)) if len(indices) > count else indices


def _fibonacci_sphere(count: int) -> Float64:
    """(count, 3) unit vectors, evenly spread; half of them look up."""
    y = 1 - (2 * np.arange(count) + 1) / count
    turn = np.arange(count) * np.pi * (3 - np.sqrt(5))
    level = np.sqrt(1 - y * y)
    return np.stack([level * np.cos(turn), y, level * np.sin(turn)], axis=1)
