"""Time to bake a sector on one core, beside what its rays alone take."""

import time
from collections.abc import Callable
from functools import partial

import numpy as np

from bake_jobs.config import settings_for
from bake_jobs.gbuffer import cube_map_pattern
from bake_jobs.geometry_clip import SectorCutter
from bake_jobs.rays import RayScene
from bake_jobs.scene_source import load_scene
from bake_jobs.sector_job import SectorBaker
from gi_core.bench import Measurement
from gi_core.sun_table import SunTable

SOURCE = "procedural:midtown?blocks=4x4&seed=1"
PRESET = "talk"


def bench_bake(sectors: int = 5) -> Measurement:
    """Processor seconds from a scene in memory to both files of a sector, the median over sectors around the middle of a city.

    Baseline: casting the same primary rays and no more, so ``ratio`` = baseline / median is the share of a bake that no cleverness in
    the rest can save; it is below 1 by nature. Building the ray tracer, once for each process, is in neither.
    """
    scene, settings = load_scene(SOURCE), settings_for(PRESET)
    table = SunTable.build(scene.location, settings.sun_declination_step_degrees, settings.sun_hour_step_degrees)
    baker, cutter = SectorBaker(scene, settings, table.directions, "bench"), SectorCutter(scene)
    rays, pattern = RayScene(scene.vertices, scene.triangles), cube_map_pattern(settings.rays_per_face_edge)
    middle = (scene.bounds[0] + scene.bounds[1]) / 2
    nearest = sorted(cutter.sectors(), key=lambda index: float(np.linalg.norm((index.origin + 32.0 - middle)[[0, 2]])))
    taken, rays_alone, counts = [], [], []
    for index in nearest[:sectors]:
        sector, _ = baker.bake_arrays(index, cutter.cut(index))  # not timed: gives the probes, and warms caches
        position = sector.probe_position.astype(np.float64) + index.origin
        origin = np.repeat(position, len(pattern.direction), axis=0)
        direction = np.tile(pattern.direction, (len(position), 1))
        taken.append(processor_seconds(partial(baker.bake, index)))
        rays_alone.append(processor_seconds(partial(rays.closest, origin, direction)))
        counts.append((sector.probe_count, sector.surfel_count, sector.factor_count, len(origin)))
    median, baseline = float(np.median(taken)), float(np.median(rays_alone))
    sizes = dict(zip(("probes", "surfels", "factors", "rays"), (int(n) for n in np.median(counts, axis=0)), strict=True))
    return Measurement(
        "bake_sector", median, "s", baseline, baseline / median, {"sectors": len(taken)} | sizes, "CPU, one core", "its primary rays alone"
    )


def processor_seconds(run: Callable[[], object]) -> float:
    """Processor time [s] of one call, all threads together: a busy machine adds little to it."""
    started = time.process_time()
    run()
    return time.process_time() - started
