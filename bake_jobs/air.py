"""The air that players can be in: lattice voxels up to a band above the street, all rooms, and a thin lattice above.

Columns are looked at from below, one by one, so that what belongs to a column depends on the world alone and not on the sector that asks.
"""

from dataclasses import dataclass

import numpy as np

from bake_jobs.config import FILL_MARGIN, BakeSettings
from bake_jobs.inside import Solids
from bake_jobs.rays import RayScene
from bake_jobs.voxel_classes import solid_voxels
from gi_core.arrays import Bool, Float64, Int64, UInt16
from gi_core.constants import ROOM_OUTDOORS, SECTOR_SIZE_M, VOXEL_SIZE_M
from gi_core.grid import SectorIndex, voxel_centre, voxel_columns
from gi_core.rooms import holds, rooms_of
from gi_core.world import Room

# Above the band: every fourth column, at these multiples of the band's height over the street.
SPARSE_STEP = 4
SPARSE_HEIGHTS = (1.4, 2.0, 3.0, 5.0, 9.0, 17.0)


@dataclass(frozen=True, eq=False)
class Air:
    """Voxels in free air. n voxels, in ascending order of x, z, y.

    lattice : (n, 3) int64, world lattice (x, y, z); centre : (n, 3) float64 [m], world frame
    height : (n,) float64 [m] above the street; room : (n,) uint16
    in_band : (n,) bool, up to the band's height or in a room: the others only carry light up there
    own : (n,) bool, in the sector's own columns
    """

    lattice: Int64
    centre: Float64
    height: Float64
    room: UInt16
    in_band: Bool
    own: Bool


def find_air(
    ray_scene: RayScene, solids: Solids, bounds: Float64, index: SectorIndex, settings: BakeSettings, rooms: tuple[Room, ...]
) -> Air:
    """Air of a sector and of FILL_MARGIN columns around it. ``bounds`` (2, 3) [m] are the whole scene's."""
    (x0, x1), (z0, z1) = voxel_columns(index.x), voxel_columns(index.z)
    z, x = np.meshgrid(np.arange(z0 - FILL_MARGIN, z1 + FILL_MARGIN), np.arange(x0 - FILL_MARGIN, x1 + FILL_MARGIN), indexing="ij")
    street = _street(ray_scene, bounds, x, z)
    band = int(np.ceil(settings.band_m / VOXEL_SIZE_M))
    known = np.isfinite(street)
    lowest = np.ceil(np.where(known, street, 0) / VOXEL_SIZE_M - 0.5).astype(np.int64)
    y = lowest + np.arange(band)[:, None, None]
    lattice = np.stack([np.broadcast_to(x, y.shape), y, np.broadcast_to(z, y.shape)], axis=-1)
    free = ~solid_voxels(ray_scene, solids, voxel_centre(lattice)) & known
    parts = [lattice[free], *(_room_lattice(room, x, z) for room in rooms)]
    sparse = known & (x % SPARSE_STEP == 0) & (z % SPARSE_STEP == 0) & (x >= x0) & (x < x1) & (z >= z0) & (z < z1)
    for factor in SPARSE_HEIGHTS:
        layer = lowest + round(factor * band)
        high = np.stack([x[sparse], layer[sparse], z[sparse]], axis=1)
        parts.append(high[high[:, 1] * VOXEL_SIZE_M < bounds[1, 1] + settings.band_m])
    found = np.unique(np.concatenate(parts)[:, [0, 2, 1]], axis=0)[:, [0, 2, 1]]
    centre = voxel_centre(found)
    room = rooms_of(centre, rooms)
    column = found[:, 2] - (z0 - FILL_MARGIN), found[:, 0] - (x0 - FILL_MARGIN)
    height = centre[:, 1] - np.where(known, street, bounds[0, 1])[column]
    in_band = (found[:, 1] < lowest[column] + band) | (room != ROOM_OUTDOORS)
    # The band's solids were sorted out above; up here a tower may still be in the way.
    inside = np.zeros(len(found), bool)
    inside[~in_band] = solids.contain(centre[~in_band])
    own = (found[:, 0] >= x0) & (found[:, 0] < x1) & (found[:, 2] >= z0) & (found[:, 2] < z1)
    kept = ~inside
    return Air(found[kept], centre[kept], height[kept], room[kept], in_band[kept], own[kept])


def beside_border(air: Air, margin_m: float) -> Bool:
    """(n, 3): whether a voxel lies within ``margin_m`` of a border line along each axis; never along y."""
    place = air.centre / SECTOR_SIZE_M
    near = np.abs(place - np.round(place)) * SECTOR_SIZE_M < margin_m
    near[:, 1] = False
    return np.asarray(near & air.in_band[:, None], np.bool_)


def border_blocks(air: Air, index: SectorIndex, margin_m: float) -> list[tuple[Int64, int]]:
    """Voxels (numbers) within ``margin_m`` of the sector's border lines, block by block: four corners that four sectors share, and four
    edges that two do. Every sector that shares a block finds the same voxels in it, in the same order."""
    place = air.centre[:, [0, 2]] / SECTOR_SIZE_M
    line = np.round(place)
    near = beside_border(air, margin_m)[:, [0, 2]]
    # 2 k on border line k, 2 k + 1 between lines k and k + 1.
    block = np.where(near, 2 * line, 2 * np.floor(place) + 1).astype(np.int64)
    found = []
    first = 2 * np.array(index)
    touching = near.any(axis=1) & air.in_band & ((block >= first) & (block <= first + 2)).all(axis=1)
    for key in np.unique(block[touching], axis=0):
        found.append((np.flatnonzero(touching & (block == key).all(axis=1)), 4 if (key % 2 == 0).all() else 2))
    return found


def _street(ray_scene: RayScene, bounds: Float64, x: Int64, z: Int64) -> Float64:
    """Height [m] of the lowest surface in each column (nz, nx); nan where there is none."""
    at = voxel_centre(np.stack([x, np.zeros_like(x), z], axis=-1)).reshape(-1, 3)
    at[:, 1] = bounds[0, 1] - 10.0
    hits = ray_scene.closest(at, np.tile(np.array([[0, 1, 0]], np.float32), (len(at), 1)))
    street = np.where(hits.hit, at[:, 1] + hits.distance, np.nan)
    # To the centimetre: rays are rounded.
    return np.asarray(np.round(street, 2).reshape(x.shape), np.float64)


def _room_lattice(room: Room, x: Int64, z: Int64) -> Int64:
    """Lattice indices (n, 3) of the voxels of a room in these columns."""
    y = np.arange(int(np.floor(room.minimum[1] / VOXEL_SIZE_M)), int(np.ceil(room.maximum[1] / VOXEL_SIZE_M)) + 1)
    lattice = np.stack([a.ravel() for a in np.meshgrid(x[0], y, z[:, 0], indexing="ij")], axis=1)
    centre = voxel_centre(lattice)
    return lattice[holds(room, centre)]
