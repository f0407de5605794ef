"""Where probes go (slide "Probe placement"): on every hit of a ray-cast grid, and along building walls.

All positions come from world lattices, so two sectors place the same probes in the margin that they share.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from bake_jobs.config import BakeSettings
from bake_jobs.inside import Solids
from bake_jobs.rays import SURFACE_OFFSET_M, RayScene
from bake_jobs.scene import ProbeHint
from gi_core.arrays import AnyArray, Bool, Float64, Int64, UInt8, UInt16
from gi_core.constants import MAX_PROBES_PER_SECTOR, ROOM_OUTDOORS, SECTOR_SIZE_M, VOXEL_SIZE_M
from gi_core.grid import SectorIndex, voxel_centre
from gi_core.rooms import holds, rooms_of
from gi_core.sector import PROBE_IN_MARGIN, PROBE_ON_GROUND, PROBE_ON_WALL
from gi_core.world import Room

# A vertical ray meets at most this many surfaces: a tower of 100 storeys has 200.
MAX_LAYERS = 256
# Flatter than this (cosine from the vertical) is a floor; steeper than WALL_MAX_UP is a wall.
FLOOR_MIN_UP = 0.3
WALL_MAX_UP = 0.5
# A probe this close to a surface would see little else; it is pushed away from what stands at its side.
CLEARANCE_M = 0.5
PULL_M = (0.011, 0.007)
# A wall probe closer than this to a probe that stands already would tell nothing new.
WALL_MIN_DISTANCE_M = 3.0
SAME_PLACE_M = 1.0
# In rooms between voxels.
APART_IN_ROOMS_M = 2 * VOXEL_SIZE_M
# Cube-map rays run in ratios of odd numbers, and so do offsets from tidy walls: a ray from 0.5 m off a wall and 1.5 m up meets the very
# edge where wall and floor join, and may report the floor behind. A few millimetres, in no such ratio, and no ray does.
OFF_EDGES_M = (0.0037, 0.0053, 0.0029)


@dataclass(frozen=True, eq=False)
class Placement:
    """Probes of one sector and of the margin around it.

    position : (P, 3) float64 [m], world frame
    flags : (P,) uint8, bits of gi_core.sector
    room : (P,) uint16
    dead : candidates inside solids; dropped : probes beyond MAX_PROBES_PER_SECTOR
    """

    position: Float64
    flags: UInt8
    room: UInt16
    dead: int
    dropped: int


def place_probes(
    ray_scene: RayScene,
    solids: Solids,
    bounds: Float64,
    index: SectorIndex,
    settings: BakeSettings,
    rooms: tuple[Room, ...],
    hints: tuple[ProbeHint, ...],
) -> Placement:
    """Probes for a sector. ``bounds`` (2, 3) [m] are the whole scene's."""
    # Candidates come from further out than the margin: what thins its probes must stand there too, as it does for the neighbour.
    reach = settings.margin_m + WALL_MIN_DISTANCE_M
    low, high = index.origin[[0, 2]] - reach, index.origin[[0, 2]] + SECTOR_SIZE_M + reach
    ground = _ground_candidates(ray_scene, bounds, low, high, settings)
    wall = _wall_candidates(ray_scene, bounds, low, high, settings)
    asked = np.concatenate(
        [asked_positions(ray_scene, hints, low, high, settings.wall_offset_m), positions_between_voxels(rooms, low, high)]
    )
    position = np.concatenate([asked, ground, wall])
    flags = np.repeat(np.array([0, PROBE_ON_GROUND, PROBE_ON_WALL], np.uint8), [len(asked), len(ground), len(wall)])

    allowed = ~in_boxes(position, hints, "forbid")
    position, flags = position[allowed], flags[allowed]
    room = rooms_of(position, rooms)
    # An authored room is air, whatever way its walls were modelled.
    dead = solids.contain(position) & (room == ROOM_OUTDOORS)
    dead_count = int((dead & _in_sector(position, index, settings.margin_m)).sum())
    position, flags, room = position[~dead], flags[~dead], room[~dead]
    kept = _thin(ray_scene, position, flags) & _in_sector(position, index, settings.margin_m)
    position, flags, room = position[kept], flags[kept], room[kept]

    in_sector = _in_sector(position, index, 0.0)
    flags = np.where(in_sector, flags, flags | PROBE_IN_MARGIN).astype(np.uint8)
    # Within its own sector first, the ground before walls, low before high; then a fixed order of place.
    order = np.lexsort((position[:, 0], position[:, 2], position[:, 1], flags & PROBE_ON_WALL, flags & PROBE_IN_MARGIN))
    chosen = np.sort(order[:MAX_PROBES_PER_SECTOR])
    position, flags, room = position[chosen], flags[chosen], room[chosen]
    position = position + np.array(OFF_EDGES_M)
    order = stored_order(position)
    return Placement(position[order], flags[order], room[order], dead_count, max(0, len(in_sector) - MAX_PROBES_PER_SECTOR))


def stored_order(position: Float64) -> Int64:
    """Along a curve of place, so that neighbours in memory are neighbours in space: their factors compress and cache well."""
    return np.lexsort((position[:, 1], position[:, 0] // 8, position[:, 2] // 8))


def _in_sector(position: Float64, index: SectorIndex, margin_m: float) -> Bool:
    """(n,) bool: which positions lie in the sector's column, widened by a margin [m]."""
    local = position[:, [0, 2]] - index.origin[[0, 2]]
    return np.asarray(((local >= -margin_m) & (local < SECTOR_SIZE_M + margin_m)).all(axis=1), np.bool_)


def _lattice(low: float, high: float, spacing: float) -> Float64:
    """Multiples of the spacing plus one half of it within [low, high)."""
    first, last = (int(np.ceil(edge / spacing - 0.5)) for edge in (low, high))
    return np.asarray((np.arange(first, last) + 0.5) * spacing, np.float64)


def _points(x: AnyArray, y: AnyArray, z: AnyArray) -> AnyArray:
    """Points (n, 3) of a lattice whose lines stand at these places along each axis."""
    return np.stack([a.ravel() for a in np.meshgrid(x, y, z, indexing="ij")], axis=1)


def _march(ray_scene: RayScene, origins: Float64, direction: tuple[float, float, float], reach: float) -> tuple[Float64, Float64]:
    """All surfaces that rays meet within ``reach`` [m] of their origins: positions (n, 3) and face-forwarded normals (n, 3)."""
    ray = np.array(direction)
    position = np.array(origins, np.float64)
    left = np.full(len(position), reach)
    found: list[tuple[Float64, Float64]] = []
    for _ in range(MAX_LAYERS):
        if len(position) == 0:
            break
        hits = ray_scene.closest(position, np.tile(ray.astype(np.float32), (len(position), 1)))
        going = hits.hit & (hits.distance < left)
        distance = hits.distance[going].astype(np.float64)
        at = position[going] + ray * distance[:, None]
        found.append((at, hits.normal[going].astype(np.float64)))
        position = at + ray * SURFACE_OFFSET_M * 2
        left = left[going] - distance
    positions = np.concatenate([np.empty((0, 3)), *[p for p, _ in found]])
    return positions, np.concatenate([np.empty((0, 3)), *[n for _, n in found]])


def _ground_candidates(ray_scene: RayScene, bounds: Float64, low: Float64, high: Float64, settings: BakeSettings) -> Float64:
    x_line, z_line = (_lattice(low[a], high[a], settings.grid_spacing_m) for a in (0, 1))
    z, x = (a.ravel() for a in np.meshgrid(z_line, x_line, indexing="ij"))
    top = np.stack([x, np.full_like(x, bounds[1, 1] + 10.0), z], axis=1)
    at, normal = _march(ray_scene, top, (0.0, -1.0, 0.0), bounds[1, 1] - bounds[0, 1] + 20.0)
    at = at[normal[:, 1] >= FLOOR_MIN_UP]
    up = np.tile(np.array([[0, 1, 0]], np.float32), (len(at), 1))
    above = ray_scene.closest(at + np.array([0, SURFACE_OFFSET_M, 0]), up)
    free = np.minimum(above.distance, 1e6).astype(np.float64)
    roomy = free >= settings.head_room_m
    height = np.minimum(settings.probe_height_m, free[roomy] / 2)
    position = at[roomy].copy()
    position[:, 1] += height
    return _pushed_off(ray_scene, position, np.array([PULL_M[0], 0.0, PULL_M[1]]))


def _pushed_off(ray_scene: RayScene, position: Float64, pull: Float64) -> Float64:
    """Positions (n, 3) [m] moved sideways until CLEARANCE_M from what stands beside them, as far as there is room.

    Lattice and walls share whole metres: a point in a wall's own plane is first moved by ``pull`` (3,) or (n, 3) [m], to one side of it.
    """
    position = position + pull
    for azimuth in np.radians(np.arange(8) * 45.0):
        direction = np.array([np.cos(azimuth), 0.0, np.sin(azimuth)])
        ahead = ray_scene.closest(position, np.tile(direction.astype(np.float32), (len(position), 1)))
        behind = ray_scene.closest(position, np.tile(-direction.astype(np.float32), (len(position), 1)))
        push = np.maximum(CLEARANCE_M - ahead.distance, 0)
        room = np.maximum(np.minimum(behind.distance, 1e6) - CLEARANCE_M, 0)
        position = position - direction * np.minimum(push, room)[:, None]
    return position


def _wall_levels(bounds: Float64, settings: BakeSettings) -> Float64:
    """Heights [m] at which walls are searched: evenly spaced near the ground, then at doubling distances."""
    height, levels = settings.wall_spacing_m / 2, []
    while bounds[0, 1] + height < bounds[1, 1]:
        levels.append(bounds[0, 1] + height)
        near_ground = height + settings.wall_spacing_m <= settings.wall_doubling_m
        height += settings.wall_spacing_m if near_ground else max(height, settings.wall_spacing_m)
    return np.array(levels)


def _wall_candidates(ray_scene: RayScene, bounds: Float64, low: Float64, high: Float64, settings: BakeSettings) -> Float64:
    return _beside_walls(ray_scene, _wall_levels(bounds, settings), low, high, settings.wall_spacing_m, settings.wall_offset_m)


def _beside_walls(ray_scene: RayScene, levels: Float64, low: Float64, high: Float64, spacing_m: float, offset_m: float) -> Float64:
    """Positions (n, 3) [m] off walls at some heights (l,) [m], from ``low`` to ``high`` (2,), x and z [m]."""
    found = []
    for axis, other in ((0, 1), (1, 0)):
        y, line = (a.ravel() for a in np.meshgrid(levels, _lattice(low[other], high[other], spacing_m), indexing="ij"))
        for sign in (1.0, -1.0):
            start = np.empty((len(y), 3))
            start[:, 1] = y
            start[:, 2 * other] = line
            start[:, 2 * axis] = low[axis] if sign > 0 else high[axis]
            direction = (sign, 0.0, 0.0) if axis == 0 else (0.0, 0.0, sign)
            at, normal = _march(ray_scene, start, direction, high[axis] - low[axis])
            wall = np.abs(normal[:, 1]) < WALL_MAX_UP
            found.append((at[wall], normal[wall]))
    at = np.concatenate([p for p, _ in found])
    normal = np.concatenate([n for _, n in found])
    air = ray_scene.closest(at + normal * SURFACE_OFFSET_M, normal.astype(np.float32))
    # In a gap narrower than twice the offset the probe stands in the middle.
    offset = np.minimum(offset_m, np.minimum(air.distance, 1e6) / 2)
    fits = offset > 0.3
    along_wall = np.stack([-normal[fits, 2], np.zeros(int(fits.sum())), normal[fits, 0]], axis=1)
    position = _pushed_off(ray_scene, at[fits] + normal[fits] * offset[fits, None], PULL_M[0] * along_wall)
    # In an order of place, not of the rays, which start elsewhere for every sector. To the centimetre: rays are rounded.
    order = np.lexsort(np.round(position * 100).T[[0, 2, 1]])
    return position[order]


def asked_positions(ray_scene: RayScene, hints: tuple[ProbeHint, ...], low: Float64, high: Float64, wall_offset_m: float) -> Float64:
    """Positions (n, 3) [m] that hints ask for, and none forbids, from ``low`` to ``high`` (2,), x and z [m]: lattices in boxes, and places
    off whatever walls stand in boxes."""
    found = [np.empty((0, 3))]
    for hint in hints:
        # What thins places off walls stands a little farther out, as it does for the neighbour.
        reach = SAME_PLACE_M if hint.kind == "walls" else 0.0
        x, z = ((max(hint.minimum[a], low[i] - reach), min(hint.maximum[a], high[i] + reach)) for i, a in enumerate((0, 2)))
        y = hint.minimum[1], hint.maximum[1]
        if hint.kind == "add":
            lines = [_lattice(start, end, hint.spacing_m) for start, end in (x, y, z)]
            found.append(_points(*lines))
        elif hint.kind == "walls" and x[0] < x[1] and z[0] < z[1]:
            corners = np.array([x[0], z[0]]), np.array([x[1], z[1]])
            beside = _beside_walls(ray_scene, _lattice(*y, hint.spacing_m), *corners, hint.spacing_m, wall_offset_m)
            # A wall askew is met along x and along z.
            beside = beside[_thin(ray_scene, beside, np.zeros(len(beside), np.uint8))]
            found.append(beside[((beside[:, [0, 2]] >= low) & (beside[:, [0, 2]] < high)).all(axis=1)])
    position = np.concatenate(found)
    return position[~in_boxes(position, hints, "forbid")]


def positions_between_voxels(rooms: tuple[Room, ...], low: Float64, high: Float64) -> Float64:
    """Positions (n, 3) [m] in rooms that hold no voxel's centre, low storeys and closets, whose light probes alone can tell: every
    APART_IN_ROOMS_M along each axis, or in the middle; from ``low`` to ``high`` (2,), x and z [m]."""
    found = [np.empty((0, 3))]
    for number, room in enumerate(rooms, 1):
        box = np.array([room.minimum, room.maximum])
        if (box[1, [0, 2]] < low).any() or (box[0, [0, 2]] >= high).any() or has_voxels(room):
            continue
        lines = [_lattice(start, end, APART_IN_ROOMS_M) for start, end in box.T]
        lines = [line if len(line) else np.array([(start + end) / 2]) for line, (start, end) in zip(lines, box.T, strict=True)]
        position = _points(*lines)
        here = ((position[:, [0, 2]] >= low) & (position[:, [0, 2]] < high)).all(axis=1)
        found.append(position[here & (rooms_of(position, rooms) == number)])
    return np.concatenate(found)


def has_voxels(room: Room) -> bool:
    """Whether a room holds the centre of any voxel."""
    low, high = (np.array(corner) / VOXEL_SIZE_M for corner in (room.minimum, room.maximum))
    lines = [np.arange(int(np.ceil(start - 0.5)), int(np.floor(end - 0.5)) + 1) for start, end in zip(low, high, strict=True)]
    # Level by level: most rooms have one in their first.
    return any(holds(room, voxel_centre(_points(lines[0], level, lines[2]))).any() for level in lines[1][:, None])


def in_boxes(position: Float64, hints: tuple[ProbeHint, ...], kind: str) -> Bool:
    """(n,) bool: which positions (n, 3) [m] lie in a box of the hints of a kind."""
    inside = np.zeros(len(position), bool)
    for box in hints:
        if box.kind == kind:
            inside |= ((position >= box.minimum) & (position <= box.maximum)).all(axis=1)
    return inside


def _thin(ray_scene: RayScene, position: Float64, flags: UInt8) -> Bool:
    """Which probes stay: none stands in the place of an earlier one, no wall probe close to any that it sees."""
    kept = np.ones(len(position), bool)
    if len(position) < 2:
        return kept
    near = cKDTree(position).query_pairs(WALL_MIN_DISTANCE_M, output_type="ndarray")
    near = near[np.lexsort((near[:, 0], near[:, 1]))]
    offset = position[near[:, 1]] - position[near[:, 0]]
    distance = np.linalg.norm(offset, axis=1)
    too_close = distance < np.where(flags[near[:, 1]] & PROBE_ON_WALL, WALL_MIN_DISTANCE_M, SAME_PLACE_M)
    # Two probes with a thin wall between them stand in different light.
    too_close &= ~ray_scene.occluded(position[near[:, 0]], offset / np.maximum(distance, 1e-6)[:, None], distance)
    for earlier, later in near[too_close]:
        if kept[earlier]:
            kept[later] = False
    return kept
