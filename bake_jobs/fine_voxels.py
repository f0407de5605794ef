"""Voxels of half the size near surfaces, for volumes of cascade -1: where a coarse voxel reads through a wall, a fine one seldom does.

Up to the band's height, within reach of a surface, a fine voxel blends probes as a coarse one does (bake_jobs/voxels.py); all others
have no weights, and a reader interpolates the coarse ones there.
"""

import numpy as np

from bake_jobs.adaptive import NEAR_SURFACE_M, Trial
from bake_jobs.air import Air
from bake_jobs.config import FILL_MARGIN, BakeSettings
from bake_jobs.inside import Solids
from bake_jobs.placement import Placement
from bake_jobs.rays import RayScene
from bake_jobs.surface_fit import SurfaceFit
from bake_jobs.trial_fit import TrialFit
from bake_jobs.trial_light import TrialScene
from bake_jobs.voxel_classes import solid_voxels
from bake_jobs.voxels import blend, nearest_lit, sector_lattice
from gi_core.arrays import Bool, Float64, Int64, UInt16
from gi_core.constants import FINE_VOXEL_SIZE_M, ROOM_OUTDOORS, VOXEL_INDOORS, VOXEL_OUTDOORS, VOXEL_SOLID
from gi_core.grid import SectorIndex, voxel_centre, voxel_columns
from gi_core.rooms import rooms_of
from gi_core.voxel_grid import VoxelGrid
from gi_core.world import Room

# Corners of the cell that a client's sample lies in are never farther into a wall.
SOLID_REACH_VOXELS = 2.0
# A voxel this close to a surface sees little else, which no probe does: it takes what the next one off the surface has.
TIGHT_M = 0.4
_AROUND = np.array([(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) != (0, 0, 0)], np.float32)
LOOK_AROUND = _AROUND / np.linalg.norm(_AROUND, axis=1, keepdims=True)


def bake_fine_voxels(
    ray_scene: RayScene,
    solids: Solids,
    surfaces: Float64,
    index: SectorIndex,
    placement: Placement,
    settings: BakeSettings,
    rooms: tuple[Room, ...],
    trial: Trial | None,
    trial_scene: TrialScene | None,
    surface_fit: SurfaceFit | None = None,
) -> VoxelGrid:
    """Fine voxels of a sector. ``surfaces`` (2,) [m] are the lowest and highest surface in it; weights are fitted to trial light where
    there is any, and those of voxels in walls by ``surface_fit``."""
    in_band = None if trial is None else trial.air.centre[trial.air.own & trial.air.in_band, 1]
    top = surfaces[0] + settings.band_m if in_band is None or not len(in_band) else float(in_band.max())
    lattice, shape = sector_lattice(index, float(surfaces[0]), min(top, float(surfaces[1]) + NEAR_SURFACE_M), FINE_VOXEL_SIZE_M)
    centre = voxel_centre(lattice.reshape(-1, 3), FINE_VOXEL_SIZE_M)
    room = rooms_of(centre, rooms)
    kind = np.where(room == ROOM_OUTDOORS, VOXEL_OUTDOORS, VOXEL_INDOORS).astype(np.uint8)
    solid = solid_voxels(ray_scene, solids, centre.reshape(*shape, 3), FINE_VOXEL_SIZE_M).reshape(-1)
    kind[(room == ROOM_OUTDOORS) & solid] = VOXEL_SOLID
    air = np.flatnonzero(kind != VOXEL_SOLID)
    near = air[_surface_within(ray_scene, centre[air], NEAR_SURFACE_M)]
    tight = _surface_within(ray_scene, centre[near], TIGHT_M)
    lacks = kind == VOXEL_SOLID
    lacks[near[tight]] = True
    near = near[~tight]
    fit = None
    if trial is not None and trial_scene is not None:
        fit = TrialFit(_trial_at(near, lattice, centre, room, index, trial, trial_scene), lattice.reshape(-1, 3)[near], settings)
    probe = np.zeros((len(centre), settings.voxel_probes), np.uint16)
    weight = np.zeros((len(centre), settings.voxel_probes), np.float32)
    probe[near], weight[near], blind = blend(ray_scene, centre[near], kind[near], room[near], placement, settings, fit)
    blind &= room[near] == ROOM_OUTDOORS
    lacks[near[blind]] = True
    lit = np.zeros(len(centre), bool)
    lit[near[~blind]] = True
    # What sees no probe, or is in the wall, blends what the nearest lit voxel does; deep inside a wall nobody looks.
    source, away = nearest_lit(lit, shape)
    lacks &= away <= SOLID_REACH_VOXELS
    probe[lacks], weight[lacks] = probe[source[lacks]], weight[source[lacks]]
    if surface_fit is not None:
        read = surface_fit.fit(lattice, lacks & (room == ROOM_OUTDOORS), FINE_VOXEL_SIZE_M)
        probe[read.voxel], weight[read.voxel] = read.probe, read.weight
    inner = (slice(None), slice(FILL_MARGIN, -FILL_MARGIN), slice(FILL_MARGIN, -FILL_MARGIN))
    k = settings.voxel_probes
    return VoxelGrid(
        first=lattice[0, FILL_MARGIN, FILL_MARGIN].astype(np.int32),
        kind=np.ascontiguousarray(kind.reshape(shape)[inner]),
        probe=np.ascontiguousarray(probe.reshape(*shape, k)[inner]),
        weight=np.ascontiguousarray(weight.reshape(*shape, k)[inner]),
    )


def _surface_within(ray_scene: RayScene, points: Float64, distance_m: float) -> Bool:
    """(n,): which points (n, 3) [m] have a surface within a distance, along one of 26 directions."""
    rays = len(LOOK_AROUND)
    reach = np.full(rays * len(points), distance_m)
    met = ray_scene.occluded(np.repeat(points, rays, axis=0), np.tile(LOOK_AROUND, (len(points), 1)), reach)
    return np.asarray(met.reshape(-1, rays).any(axis=1), np.bool_)


def _trial_at(
    near: Int64, lattice: Int64, centre: Float64, room: UInt16, index: SectorIndex, trial: Trial, trial_scene: TrialScene
) -> Trial:
    """Trial light at some of the fine voxels, beside that of the sector's probes."""
    at = lattice.reshape(-1, 3)[near]
    (x0, x1), (z0, z1) = (voxel_columns(i, FINE_VOXEL_SIZE_M) for i in index)
    own = (at[:, 0] >= x0) & (at[:, 0] < x1) & (at[:, 2] >= z0) & (at[:, 2] < z1)
    air = Air(at, centre[near], np.zeros(len(near)), room[near], np.ones(len(near), bool), own)
    return Trial(trial.states, air, trial_scene.light(centre[near], trial.light.cells), trial.probe_cube)
