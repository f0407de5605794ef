"""One sector, baked: a pure function of scene, settings, seed and index. Any process gives the same bytes."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from bake_jobs import adaptive, factors, far_feedback, fine_voxels, gbuffer, placement, sun_visibility, surfels, voxels
from bake_jobs.air import find_air
from bake_jobs.config import BakeSettings
from bake_jobs.distant_transfer import TransferBaker, of_texel
from bake_jobs.geometry_clip import SectorCutter
from bake_jobs.inside import Solids
from bake_jobs.path_tracer import PathTracer
from bake_jobs.rays import RayScene
from bake_jobs.reader_probes import add_probes
from bake_jobs.sanity import expect_normals
from bake_jobs.scene import Scene
from bake_jobs.served_error import ServedError
from bake_jobs.surface_fit import SurfaceFit
from bake_jobs.target_error import TargetSearch
from bake_jobs.trial_light import TrialScene
from bake_jobs.trial_states import TrialStates, trial_states
from gi_core import factor_weights, fine_file, geometry_file, sector_file
from gi_core.arrays import Float32, Float64
from gi_core.constants import ALBEDO_MAX
from gi_core.distant_transfer import DistantTransfer
from gi_core.geometry_file import Geometry
from gi_core.grid import SectorIndex
from gi_core.sector import Sector
from gi_core.sun_table import SunTable

# What probes err by themselves changes a little with their number: it is measured so many times at most.
BAKES_FOR_TARGET = 3
# Three rows of a city of 5 km, of some 50 kB each: a sector's surface is asked for by its eight neighbours too.
CUT_KEPT = 256
# Several readers share a voxel, so few rays do for one. Of an odd number one would run level, and see neither sky nor ground.
READER_RAYS_PER_FACE_EDGE = 4


@dataclass(frozen=True, eq=False)
class BakedSector:
    """A sector's files, its part of the distant file, and what the summary says of it.

    fine_bytes : None where no fine voxels were asked for
    """

    index: SectorIndex
    sector_bytes: bytes
    geometry_bytes: bytes
    fine_bytes: bytes | None
    transfer: DistantTransfer
    meta: dict[str, Any]


class SectorBaker:
    """Bakes sectors of one scene; what they share is built once."""

    def __init__(self, scene: Scene, settings: BakeSettings, sun_directions: Float64, bake_id: str) -> None:
        """``sun_directions`` (D, 3), unit, world frame, with a target error those of the scene's SunTable; ``bake_id`` identifies scene and
        settings in every file."""
        self._scene = scene
        self._settings = settings
        self._sun_directions = sun_directions
        self._bake_id = bake_id
        self.rays = RayScene(scene.vertices, scene.triangles)
        self._solids = Solids(scene.vertices, scene.triangles)
        self.cutter = SectorCutter(scene)
        self._cut = lru_cache(maxsize=CUT_KEPT)(self.cutter.cut)
        self.transfers = TransferBaker(scene, sun_directions, settings.sky_sources, self.rays)
        self._pattern = gbuffer.cube_map_pattern(settings.rays_per_face_edge, settings.basis)
        self.trial: TrialScene | None = None
        self._readers: TrialScene | None = None
        if settings.placement == "adaptive" or settings.voxel_weights == "fitted":
            states = trial_states(sun_directions, bool(scene.lamps) or bool(scene.emission.any()))
            self.trial = self._trial_scene(settings.trial_rays_per_face_edge, states)
            # Weights and far surfels go by fitted states alone; where probes of their own are worth it, readers tell by all.
            of_readers = states if settings.reader_probes else states.without_held_out()
            self._readers = self._trial_scene(READER_RAYS_PER_FACE_EDGE, of_readers)
        self._served_error = self._judge() if settings.target_error and settings.placement == "adaptive" else None

    def bake(self, index: SectorIndex) -> BakedSector:
        """All files of one sector."""
        geometry = self._cut(index)
        placed, trial, sector, meta = self._bake(index, geometry)
        expect_normals(sector)
        sector_bytes = sector_file.encode(sector, meta, self._settings.sky_sources)
        fine = None
        if self._settings.voxel_levels > 1:
            rooms, around = self._scene.rooms, (self.rays, self._solids, _surfaces(geometry), index)
            surface_fit = self._surface_fit(index, geometry, placed, trial)
            found = fine_voxels.bake_fine_voxels(*around, placed, self._settings, rooms, trial, self.trial, surface_fit)
            fine = fine_file.encode(index, found, self._bake_id)
        # From the file's bytes: so a transfer that is found later, from a finished sector, is the same.
        transfer = self.transfers.transfer(sector_file.decode(sector_bytes, f"sector {index}")[0])
        return BakedSector(index, sector_bytes, geometry_file.encode(index, geometry, self._bake_id), fine, transfer, meta)

    def bake_arrays(self, index: SectorIndex, geometry: Geometry) -> tuple[Sector, dict[str, Any]]:
        """One sector's arrays before quantisation, and its meta. ``geometry`` is what SectorCutter.cut gives for it."""
        return self._bake(index, geometry)[2:]

    def _bake(self, index: SectorIndex, geometry: Geometry) -> tuple[placement.Placement, adaptive.Trial | None, Sector, dict[str, Any]]:
        """Probes, what voxels were fitted to, arrays and meta. With a target error baked again, since probes err themselves."""
        if self._served_error is None:
            placed, trial = self.place(index)
            return placed, trial, *self._arrays(index, geometry, placed, trial)
        search = self._search(index)
        count = search.probes()
        for left in reversed(range(BAKES_FOR_TARGET)):
            placed, trial = self._first(search, count)
            sector, meta = self._arrays(index, geometry, placed, trial)
            interpolation = meta.get("estimated_error", 0.0)
            measured = self._served_error.of(sector, search.judged) or 0.0
            own = float(np.sqrt(max(measured**2 - interpolation**2, 0.0)))
            if left == 0 or measured <= self._settings.target_error:
                break
            before, count = count, search.probes(own)
            if count == before:
                break
        if "estimated_error" in meta:
            meta["estimated_error"], meta["own_error"] = round(max(measured, interpolation), 5), round(own, 5)
        return placed, trial, sector, meta

    def _arrays(
        self, index: SectorIndex, geometry: Geometry, placed: placement.Placement, trial: adaptive.Trial | None
    ) -> tuple[Sector, dict[str, Any]]:
        scene, settings, rays = self._scene, self._settings, self.rays
        seen = gbuffer.render(rays, placed.position, self._pattern)
        room = surfels.rooms_of_hits(seen, placed.room, scene.rooms)
        clustered = surfels.cluster(seen, room, index.origin, scene.albedo, scene.emission, settings.cells_double_beyond_m)
        weights = factors.gather(seen, self._pattern, clustered, None if settings.sky == "faces" else settings.sky_patches)
        feedback_probe, feedback_weight = surfels.feedback(clustered, seen, settings.feedback_probes)
        if settings.far_feedback == "likest" and trial is not None and self._readers is not None:
            feedback_probe, feedback_weight = far_feedback.likest_where_far(
                clustered, seen, room, placed, trial, self._readers, feedback_probe, feedback_weight
            )
        surface_fit = self._surface_fit(index, geometry, placed, trial)
        lattice = voxels.bake_voxels(rays, self._solids, _surfaces(geometry), index, placed, settings, scene.rooms, trial, surface_fit)
        emits = bool(clustered.emission.any())
        codes = factor_weights.encode(weights.weight, weights.starts, weights.source >= len(clustered.brick_cell))
        sector = Sector(
            index=index,
            probe_position=(placed.position - index.origin).astype(np.float32),
            probe_flags=placed.flags,
            probe_room=placed.room,
            factor_starts=weights.starts,
            factor_source=weights.source,
            **codes._asdict(),
            brick_starts=clustered.brick_starts.astype(np.uint32),
            brick_level=clustered.brick_level,
            brick_cell=clustered.brick_cell,
            brick_direction=clustered.brick_direction,
            surfel_position=clustered.position.astype(np.float32),
            surfel_normal=clustered.normal,
            surfel_albedo=np.minimum(clustered.albedo, np.float32(ALBEDO_MAX)),
            surfel_snow=sun_visibility.bake_snow(rays, clustered, index.origin),
            surfel_emission=clustered.emission if emits else None,
            feedback_probe=feedback_probe,
            feedback_weight=feedback_weight,
            sun_visibility=sun_visibility.bake_visibility(rays, clustered, index.origin, self._sun_directions),
            voxel_first=lattice.first,
            voxel_class=lattice.kind,
            voxel_room=lattice.room,
            voxel_probe=lattice.probe,
            voxel_weight=lattice.weight,
        )
        meta = {
            "bake_id": self._bake_id,
            "probes": sector.probe_count,
            "factors": sector.factor_count,
            "bricks": sector.brick_count,
            "surfels": sector.surfel_count,
            "voxels": int(lattice.kind.size),
            "triangles": len(geometry.triangles),
            "probes_dead": placed.dead,
            "probes_dropped": placed.dropped,
            "voxels_blind": lattice.blind,
            "distant_sky": _distant_sky(weights.sky, placed),
        }
        if lattice.estimated_error is not None:
            meta["estimated_error"] = round(lattice.estimated_error, 5)
        return sector, meta

    def _trial_scene(self, edge: int, states: TrialStates) -> TrialScene:
        scene = self._scene
        return TrialScene(self.rays, scene.albedo, scene.emission, scene.lamps, states, edge)

    def _surface_fit(
        self, index: SectorIndex, geometry: Geometry, placed: placement.Placement, trial: adaptive.Trial | None
    ) -> SurfaceFit | None:
        if trial is None or self._readers is None or self._settings.wall_weights == "nearest":
            return None
        steps = [(x, z) for z in (-1, 0, 1) for x in (-1, 0, 1) if (x, z) != (0, 0)]
        around = [self._cut(SectorIndex(index.x + x, index.z + z)) for x, z in steps]
        where = (self.rays, self._solids, geometry, around, placed, self._settings, self._scene.rooms)
        return SurfaceFit(*where, trial, self._readers)

    def _judge(self) -> ServedError:
        scene, settings = self._scene, self._settings
        # Another process does another sector: one thread each.
        tracer = PathTracer(scene.vertices, scene.triangles, scene.albedo, scene.emission, threads=1, rays=self.rays)
        table = SunTable.build(scene.location, settings.sun_declination_step_degrees, settings.sun_hour_step_degrees)
        return ServedError(tracer, scene.location, table, settings.sky, settings.sky_sources)

    def place(self, index: SectorIndex) -> tuple[placement.Placement, adaptive.Trial | None]:
        """Probes, and where the voxels' weights are to be fitted, the trial light; a target error is taken to be interpolation's alone."""
        scene, settings, rays, solids, trial = self._scene, self._settings, self.rays, self._solids, self.trial
        if trial is None:
            return placement.place_probes(rays, solids, scene.bounds, index, settings, scene.rooms, scene.hints), None
        if settings.placement == "adaptive":
            search = self._search(index)
            found = self._first(search, search.probes() if settings.target_error else min(search.ranking.enough, settings.probe_budget))
            return self._with_reader_probes(index, *found)
        air = find_air(rays, solids, scene.bounds, index, settings, scene.rooms)
        light = trial.light(air.centre)
        placed = placement.place_probes(rays, solids, scene.bounds, index, settings, scene.rooms, scene.hints)
        # Only for fitted weights is a grid's light tried out.
        return placed, adaptive.Trial(trial.states, air, light, trial.light(placed.position).cube)

    def _search(self, index: SectorIndex) -> TargetSearch:
        """Ranked places for a sector's probes."""
        scene, settings, rays, solids, trial = self._scene, self._settings, self.rays, self._solids, self.trial
        assert trial is not None
        air = find_air(rays, solids, scene.bounds, index, settings, scene.rooms)
        light = trial.light(air.centre)
        ranking = adaptive.rank_probes(rays, solids, index, settings, scene.rooms, scene.hints, air, light, trial)
        return TargetSearch(rays, ranking, trial.states, air, light, settings)

    def _first(self, search: TargetSearch, count: int) -> tuple[placement.Placement, adaptive.Trial | None]:
        placed, cube = search.ranking.first(count)
        return placed, search.trial(cube) if self._settings.voxel_weights == "fitted" else None

    def _with_reader_probes(
        self, index: SectorIndex, placed: placement.Placement, trial: adaptive.Trial | None
    ) -> tuple[placement.Placement, adaptive.Trial | None]:
        if not self._settings.reader_probes:
            return placed, trial
        surface_fit = self._surface_fit(index, self._cut(index), placed, trial)
        if trial is None or surface_fit is None or self.trial is None:
            return placed, trial
        return add_probes(surface_fit, index, self._settings, self._scene.hints, placed, trial, self.trial)


def _surfaces(geometry: Geometry) -> Float64:
    """(2,) [m]: the lowest and highest surface."""
    heights = geometry.vertices[:, 1] if len(geometry.vertices) else np.zeros(1)
    return np.array([heights.min(), heights.max()])


def _distant_sky(sky: Float32, placed: placement.Placement) -> list[float]:
    """Mean sky factor of each cube face over a sector's outdoor probes: its distant texel (slide "Distant shading")."""
    chosen = of_texel(placed.room, placed.flags)
    if not chosen.any():
        return [0.0] * 6
    return [round(float(v), 5) for v in sky[chosen].mean(axis=0, dtype=np.float64)]
