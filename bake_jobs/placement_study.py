"""What placement and voxel weights are worth, apart from everything else: path-traced cubes at probes, blended by baked weights, beside
path-traced cubes at voxels. And a map of where probes went.

    python -m bake_jobs.placement_study table SOURCE X,Z [X,Z ...]     a table on stdout
    python -m bake_jobs.placement_study map SOURCE X0:X1,Z0:Z1 OUT.png
"""

import re
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from bake_jobs.compare_points import choose_points
from bake_jobs.compare_states import parse_states
from bake_jobs.config import ADAPTIVE, BakeSettings, settings_for
from bake_jobs.geometry_clip import SectorCutter
from bake_jobs.path_tracer import PathTracer
from bake_jobs.scene import Scene
from bake_jobs.scene_source import load_scene
from bake_jobs.sector_job import SectorBaker
from gi_core.arrays import Float64, Int64
from gi_core.errors import InputError
from gi_core.grid import SectorIndex, volume_first_voxel, voxel_centre
from gi_core.lighting import Lighting
from gi_core.lighting_model import make_lighting
from gi_core.lights import lamps_on
from gi_core.sector import PROBE_IN_MARGIN, Sector
from gi_core.spectrum import LUMINANCE_FROM_RGB
from gi_core.sun_table import SunTable

STATES = ("noon", "low_sun", "overcast")
POINTS, SAMPLES = 150, 4096
STAGES = ("near", "mid")
TALK = settings_for("talk")
FITTED: dict[str, Any] = {name: ADAPTIVE[name] for name in ("voxel_weights", "voxel_candidates")}
VARIANTS: dict[str, BakeSettings] = {
    "grid, nearest (talk)": TALK,
    "grid, fitted": replace(TALK, **FITTED),
    "adaptive, nearest": replace(TALK, **{**ADAPTIVE, "voxel_weights": "nearest", "voxel_candidates": TALK.voxel_candidates}),
    "adaptive, fitted": replace(TALK, **ADAPTIVE),
    "adaptive, fitted, probe_worth 0.002": replace(TALK, **ADAPTIVE, probe_worth=0.002),
}
PIXELS_PER_M = 4


def main(arguments: Sequence[str]) -> None:
    """The command line that the module's docstring shows."""
    match arguments:
        case ["table", source, *sectors] if sectors and all(re.fullmatch(r"-?\d+,-?\d+", text) for text in sectors):
            print_table(load_scene(source), [SectorIndex(*map(int, text.split(","))) for text in sectors])
        case ["map", source, area, output] if found := re.fullmatch(r"(-?\d+):(-?\d+),(-?\d+):(-?\d+)", area):
            x0, x1, z0, z1 = map(int, found.groups())
            draw_map(load_scene(source), [SectorIndex(x, z) for z in range(z0, z1) for x in range(x0, x1)]).save(Path(output))
        case _:
            raise SystemExit(__doc__)


def print_table(scene: Scene, sectors: Sequence[SectorIndex]) -> None:
    """One row per variant, means over the sectors; median / 95th percentile of relative errors in per cent."""
    tracer = PathTracer(scene.vertices, scene.triangles, scene.albedo, scene.emission)
    lightings = {s.name: make_lighting(scene.location, s.time, s.weather) for s in parse_states(STATES, scene.location)}
    columns = [f"{state}, {stage}" for state in STATES for stage in STAGES]
    print(f"| placement, weights | probes | core s | estimate | {' | '.join(columns)} |")
    print("|---" * (4 + len(columns)) + "|")
    places: dict[SectorIndex, dict[str, Int64]] = {}
    truth: dict[tuple[SectorIndex, str, str], Float64] = {}
    for name, settings in VARIANTS.items():
        baker = baker_of(scene, settings)
        probes, seconds, estimates = 0, 0.0, []
        errors: dict[tuple[str, str], list[Float64]] = {}
        for index in sectors:
            geometry = SectorCutter(scene).cut(index)
            started = time.process_time()
            sector, meta = baker.bake_arrays(index, geometry)
            seconds += time.process_time() - started
            probes += sector.probe_count
            estimates.append(meta.get("estimated_error"))
            if index not in places:
                points = choose_points(tracer.rays, geometry, sector, POINTS, np.random.default_rng(0))
                places[index] = {s: getattr(points, s)[:, [2, 0, 1]] + volume_first_voxel(points.eye) for s in STAGES}
            position = sector.probe_position.astype(np.float64) + index.origin
            for state, lighting in lightings.items():
                cubes = luminance(tracer, scene, position, lighting, seed=1)
                for stage in STAGES:
                    lattice, key = places[index][stage], (index, state, stage)
                    if key not in truth:
                        truth[key] = luminance(tracer, scene, voxel_centre(lattice), lighting, seed=2)
                    blended, inside = blend_voxels(sector, lattice, cubes)
                    exact = truth[key][inside]
                    off = np.abs(blended - exact) / np.maximum(exact, 0.02 * exact.mean())
                    errors.setdefault((state, stage), []).append(off)
        cells = [figures(np.concatenate(errors[state, stage])) for state in STATES for stage in STAGES]
        known = [e for e in estimates if e is not None]
        estimate = f"{100 * np.mean(known):.1f}" if known else ""
        print(f"| {name} | {probes / len(sectors):.0f} | {seconds / len(sectors):.2f} | {estimate} | {' | '.join(cells)} |", flush=True)


def baker_of(scene: Scene, settings: BakeSettings) -> SectorBaker:
    """A baker with the sun table that a bake would use."""
    table = SunTable.build(scene.location, settings.sun_declination_step_degrees, settings.sun_hour_step_degrees)
    return SectorBaker(scene, settings, table.directions, "study")


def luminance(tracer: PathTracer, scene: Scene, points: Float64, lighting: Lighting, seed: int) -> Float64:
    """(n, 6): path-traced cubes, luminance."""
    lamps = lamps_on(scene.lamps, lighting)
    return tracer.cube_irradiance(points, lighting, lamps, samples=SAMPLES, seed=seed).mean @ LUMINANCE_FROM_RGB


def blend_voxels(sector: Sector, lattice: Int64, cubes: Float64) -> tuple[Float64, Int64]:
    """What baked weights make of probes' cubes (P, 6) at those of the voxels (n, 3) that the sector has: (k, 6), and which (k,)."""
    at = lattice - sector.voxel_first
    inside = np.flatnonzero(((at >= 0) & (at < np.array(sector.voxel_class.shape)[[2, 0, 1]])).all(axis=1))
    x, y, z = at[inside].T
    return np.einsum("nk,nkf->nf", sector.voxel_weight[y, z, x], cubes[sector.voxel_probe[y, z, x]]), inside


def figures(errors: Float64) -> str:
    """Median / 95th percentile in per cent."""
    return f"{100 * np.median(errors):.1f} / {100 * np.quantile(errors, 0.95):.0f}"


def draw_map(scene: Scene, sectors: Sequence[SectorIndex]) -> Image.Image:
    """Sectors from above: the city in grey, brighter where higher; own probes as dots, orange up to 6 m over the street, blue above."""
    baker = baker_of(scene, replace(TALK, **ADAPTIVE))
    origins = np.array([index.origin for index in sectors])
    low, high = origins.min(axis=0), origins.max(axis=0) + 64.0
    width, depth = (int((high - low)[axis] * PIXELS_PER_M) for axis in (0, 2))
    x, z = np.meshgrid((np.arange(width) + 0.5) / PIXELS_PER_M + low[0], (np.arange(depth) + 0.5) / PIXELS_PER_M + low[2])
    top = scene.bounds[1, 1] + 1.0
    above = np.stack([x.ravel(), np.full(x.size, top), z.ravel()], axis=1)
    hits = baker.rays.closest(above, np.tile(np.array([[0, -1, 0]], np.float32), (len(above), 1)))
    height = np.where(hits.hit, top - hits.distance, scene.bounds[0, 1]).reshape(x.shape)
    street = np.quantile(height, 0.05)
    grey = 25 + 130 * np.clip((height - street) / 30.0, 0, 1) ** 0.6
    image = Image.fromarray(np.repeat(grey.astype(np.uint8)[:, :, None], 3, axis=2))
    draw = ImageDraw.Draw(image)
    for index in sectors:
        placed, _ = baker.place(index)
        own = placed.position[placed.flags & PROBE_IN_MARGIN == 0]
        for px, py, pz in own[np.argsort(own[:, 1])]:
            u, v = (px - low[0]) * PIXELS_PER_M, (pz - low[2]) * PIXELS_PER_M
            draw.ellipse((u - 3, v - 3, u + 3, v + 3), fill=(255, 150, 40) if py < street + 6 else (90, 170, 255), outline=(0, 0, 0))
        u, v = (index.origin - low)[[0, 2]] * PIXELS_PER_M
        draw.rectangle((u, v, u + 64 * PIXELS_PER_M - 1, v + 64 * PIXELS_PER_M - 1), outline=(255, 255, 255))
        draw.text((u + 6, v + 4), f"{len(own)} + {len(placed.position) - len(own)}", fill=(255, 255, 255), font_size=20)
    return image


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except InputError as error:
        raise SystemExit(str(error)) from error
