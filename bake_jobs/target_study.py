"""Is a bake's own estimate of its error to be believed? Sectors baked for several target errors, beside the path tracer.

    python -m bake_jobs.target_study SOURCE X0:X1,Z0:Z1 OUTDIR [POINTS [bake]]     a table on stdout

POINTS voxels a sector are measured, 60 if no number is given. What OUTDIR has of an earlier run is not baked again, for 0 core seconds.

interpolation  by the bake: median over faces of trial lights that no probe was placed and no weight fitted for, at voxels near surfaces
blended        the same by the path tracer: traced at the probes, blended by the baked weights, beside traced at voxels near surfaces
estimate       by the bake: what it measured at a few voxels (bake_jobs/served_error.py), or interpolation where that is more
own            by the bake: what the estimate has over interpolation, in squares
served         those voxels in a volume, with the light that the bake's own sources and bounces give its probes, beside the same

Blended and served are measured under suns that are none of the bake's, or, where the last word is ``bake``, under the very ones that it
measured under; the first line says how far off the nearest that it tried stands.
"""

import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from rich.console import Console

from bake_jobs.compare import Reference, points_of, sector_rng
from bake_jobs.compare_report import StageSamples, summarise
from bake_jobs.compare_states import parse_states
from bake_jobs.config import settings_for
from bake_jobs.path_tracer import Estimate, PathTracer
from bake_jobs.runner import SectorRange, bake
from bake_jobs.scene_source import load_scene
from bake_jobs.served_error import MOMENTS
from bake_jobs.trial_states import trial_states
from gi_core.arrays import AnyArray, Float64
from gi_core.basis import conversion
from gi_core.dataset import Dataset
from gi_core.engine import Engine
from gi_core.errors import InputError
from gi_core.grid import volume_first_voxel, voxel_centre
from gi_core.lighting import Lighting
from gi_core.lighting_model import make_lighting
from gi_core.lights import lamps_on
from gi_core.sector import Sector
from gi_core.sector_file import read
from gi_core.sun_table import SunTable
from gi_core.world import Location

PRESET = "standard"
TARGETS = (0.10, 0.05, 0.03)
STATES = ("morning=2026-05-02T09:20/clear", "afternoon=2026-08-30T16:10/partly_cloudy")
POINTS, SAMPLES = 60, 512
COLUMNS = (
    "target",
    "probes",
    "core s",
    "missed",
    "interpolation",
    "own",
    "estimate",
    "blended",
    "served",
    "ratio",
    "estimate:served of each",
)


@dataclass
class Measured:
    """What one target came to. estimates, own, each : of the sectors that have an estimate; blended, served : of all, in all states"""

    probes: list[int] = field(default_factory=list)
    estimates: list[float] = field(default_factory=list)
    own: list[float] = field(default_factory=list)
    each: list[StageSamples] = field(default_factory=list)
    blended: StageSamples = field(default_factory=StageSamples)
    served: StageSamples = field(default_factory=StageSamples)


def main(arguments: Sequence[str]) -> None:
    """The command line that the module's docstring shows."""
    match arguments:
        case [source, area, output, *rest] if found := re.fullmatch(
            r"(-?\d+):(-?\d+),(-?\d+):(-?\d+)( [1-9]\d*)?( bake)?", " ".join([area, *rest])
        ):
            x0, x1, z0, z1 = map(int, found.groups()[:4])
            print_table(source, ((x0, x1), (z0, z1)), Path(output), int(found[5] or POINTS), found[6] is not None)
        case _:
            raise SystemExit(__doc__)


def print_table(source: str, sectors: SectorRange, output: Path, points: int, bakes_suns: bool) -> None:
    """One row per target, medians in per cent; of what is measured, where it lies with 95 % confidence, the tracer's noise taken off."""
    scene = load_scene(source)
    tracer = PathTracer(scene.vertices, scene.triangles, scene.albedo, scene.emission)
    known: dict[bytes, list[Estimate]] = {}
    for number, target in enumerate(TARGETS):
        folder = output / f"{target:g}"
        seconds: list[float] = []
        console = Console(quiet=True)
        bake(source, folder, PRESET, 1, sectors, console=console, target_error=target, on_baked=seconds.append)
        dataset = Dataset.open(folder)
        if number == 0:
            lightings = _lightings(dataset.world.location, bakes_suns)
            print("; ".join(f"{name}: {nearest_trial_sun(dataset, light):.0f} degrees" for name, light in lightings.items()))
            print(f"\n| {' | '.join(COLUMNS)} |\n{'|---' * len(COLUMNS)}|")
        found = measure(dataset, tracer, known, points, lightings)
        estimate, own = np.array(found.estimates), np.array(found.own)
        low, high = _interval(found.served)
        cells = [f"{100 * target:.0f}", f"{np.mean(found.probes):.0f}", f"{np.mean(seconds or [0.0]):.1f}", f"{(estimate > target).sum()}"]
        cells += [f"{100 * np.median(error):.1f}" for error in (np.sqrt(estimate**2 - own**2), own, estimate)]
        cells += [f"{_text(_interval(found.blended))}", f"{_text((low, high))}", f"{(low + high) / 2 / np.median(estimate):.2f}"]
        cells += [" ".join(f"{100 * e:.1f}:{50 * sum(_interval(s)):.1f}" for e, s in zip(estimate, found.each, strict=True))]
        print(f"| {' | '.join(cells)} |", flush=True)


def measure(
    dataset: Dataset, tracer: PathTracer, known: dict[bytes, list[Estimate]], points: int, lightings: dict[str, Lighting]
) -> Measured:
    """All sectors of a dataset that have probes. known : as ``compare.Reference`` has it; points : voxels of a sector at most"""
    engine, found = Engine(dataset), Measured()
    basis = dataset.world.basis
    for index, facts in sorted(dataset.world.sectors.items()):
        if not facts.probes:
            continue
        found.probes.append(facts.probes)
        served = StageSamples()
        if facts.estimated_error is not None:
            found.estimates.append(facts.estimated_error)
            found.own.append(read(dataset.sector_path(index))[1]["own_error"])
            found.each.append(served)
        sector, chosen = dataset.sector(index), points_of(tracer, dataset, index, points, 0)
        lattice = chosen.near[:, [2, 0, 1]] + volume_first_voxel(chosen.eye)
        at = lattice - sector.voxel_first
        own = ((at >= 0) & (at < np.array(sector.voxel_class.shape)[[2, 0, 1]])).all(axis=1)
        for lighting in lightings.values():
            lamps, rng = lamps_on(engine.lamps, lighting), sector_rng(0, index, lighting.digest)
            reference = Reference(tracer, lighting, lamps, SAMPLES, rng, basis, known)
            truth = reference.cubes(voxel_centre(lattice[own]))
            probes = reference.cubes(sector.probe_position.astype(np.float64) + index.origin)
            mean, noise = blend(sector, at[own], probes)
            found.blended.add(mean, Estimate(truth.mean, np.hypot(truth.standard_error, noise)))
            y, z, x = chosen.near[own].T
            light = engine.volume(chosen.eye, lighting).values[:, y, z, x]
            for samples in (found.served, served):
                samples.add(np.einsum("fb,bnc->nfc", conversion(basis, "cube"), light), truth)
    return found


def blend(sector: Sector, at: AnyArray, cubes: Estimate) -> tuple[Float64, Float64]:
    """Probes' cubes (P, 6, 3) blended by the baked weights of the sector's voxels ``at`` (n, 3), (x, y, z): mean and standard error."""
    x, y, z = at.T
    probe, weight = sector.voxel_probe[y, z, x], sector.voxel_weight[y, z, x]
    mean = np.einsum("nk,nkfc->nfc", weight, cubes.mean[probe])
    return mean, np.sqrt(np.einsum("nk,nkfc->nfc", weight**2, cubes.standard_error[probe] ** 2))


def nearest_trial_sun(dataset: Dataset, lighting: Lighting) -> float:
    """Degrees from a lighting's sun to the nearest of those that probes were placed and weights fitted for."""
    settings = settings_for(PRESET)
    table = SunTable.build(dataset.world.location, settings.sun_declination_step_degrees, settings.sun_hour_step_degrees)
    suns = trial_states(table.directions, with_lamps=False).sun_direction
    return float(np.degrees(np.arccos((suns @ np.asarray(lighting.sun.direction)).max())))


def _lightings(location: Location, bakes_suns: bool) -> dict[str, Lighting]:
    if bakes_suns:
        return {moment: make_lighting(location, moment) for moment in MOMENTS}
    return {state.name: make_lighting(location, state.time, state.weather) for state in parse_states(STATES, location)}


def _interval(samples: StageSamples) -> tuple[float, float]:
    low, high = summarise(samples)["median_ci"]
    return low, high


def _text(interval: tuple[float, float]) -> str:
    return f"{100 * interval[0]:.1f} to {100 * interval[1]:.1f}"


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except InputError as error:
        raise SystemExit(str(error)) from error
