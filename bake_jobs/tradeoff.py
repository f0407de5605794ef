"""What accuracy costs: presets and single knobs on one city, each with its error, bytes, bake seconds and tick microseconds.

plan      variants: presets, ``standard`` with one knob turned, and when asked for ``talk`` with one idea of ``standard``'s added
run       each is baked and compared with the path tracer at the same points: one JSON file a variant, kept when the run is cut off
measure   ticks of all of them, in turns in one run: on a busy machine only their ratios count
"""

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from bake_jobs.compare import compare_dataset
from bake_jobs.compare_states import parse_states
from bake_jobs.config import PRESETS, settings_for, with_knobs
from bake_jobs.geometry_clip import SectorCutter
from bake_jobs.path_tracer import Estimate
from bake_jobs.runner import SectorRange, bake, bake_identity
from bake_jobs.scene import Scene
from bake_jobs.tradeoff_ticks import tick_microseconds
from gi_core.constants import SECTOR_SIZE_M
from gi_core.container import write_atomic
from gi_core.dataset import Dataset
from gi_core.errors import InputError

BASELINE = "standard"
STATES = ("noon", "low_sun", "overcast")
ON_SURFACES = "shaded"
BLOCK = 2  # sectors along each side when none are named
# Of BASELINE, one at a time, by group; a row may need another turned with it.
KNOBS: dict[str, tuple[str, ...]] = {
    "rays": ("rays_per_face_edge=8", "rays_per_face_edge=16"),
    "cells": ("cells_double_beyond_m=2", "cells_double_beyond_m=8", "cells_double_beyond_m=16"),
    "placement": ("placement=grid margin_m=4.75",),
    "spacing": ("probe_worth=0.03", "probe_worth=0.003", "target_error=0.05", "target_error=0.02"),
    "sky": ("sky=faces", "sky_patches=24", "sky_patches=48"),
    "feedback": ("feedback_probes=3", "far_feedback=closest"),
    "basis": ("basis=cube", "basis=sh1"),
    "voxels": ("voxel_weights=nearest", "wall_weights=nearest", "voxel_probes=2", "voxel_levels=2"),
    "sun": ("sun_hour_step_degrees=15", "sun_declination_step_degrees=16", "sun_hour_step_degrees=3.75"),
}
TALK, IDEAS = "talk", "ideas"
# What BASELINE adds to TALK, an idea at a time; and several feedback probes, which it left out again.
IDEA_KNOBS: tuple[str, ...] = (
    "sky=patches sky_patches=96",
    "cells_double_beyond_m=4",
    "basis=sh2",
    "placement=adaptive margin_m=3.2",
    "rays_per_face_edge=12",
    "sun_hour_step_degrees=7.5 sun_declination_step_degrees=8",
    "voxel_weights=fitted voxel_candidates=24",
    "voxel_weights=fitted voxel_candidates=24 wall_weights=fitted",
    "voxel_weights=fitted voxel_candidates=24 far_feedback=likest",
    "feedback_probes=3",
)


@dataclass(frozen=True)
class Variant:
    """One way to bake. name : of its row; knobs : turned on top of the preset"""

    name: str
    preset: str
    knobs: tuple[str, ...] = ()

    @property
    def folder(self) -> str:
        """A file name for it."""
        return self.name.replace(" ", "").replace("=", "-").replace("+", "_")


@dataclass(frozen=True)
class Sweep:
    """What is baked and how it is judged.

    source, scene : the same, named and loaded; points, samples, seed : as ``compare_dataset`` has them
    """

    source: str
    scene: Scene
    sectors: SectorRange
    states: tuple[str, ...] = STATES
    points: int = 60
    samples: int = 1024
    seed: int = 0


def plan(names: Sequence[str] = ()) -> list[Variant]:
    """Presets and KNOBS, or those with some names: a preset's, a group's of KNOBS, a knob's, or IDEAS. Raises InputError for others."""
    everything = [(preset, Variant(preset, preset)) for preset in PRESETS]
    everything += [(group, _turned(BASELINE, knobs)) for group, rows in KNOBS.items() for knobs in rows]
    if IDEAS in names:
        everything += [(IDEAS, _turned(TALK, knobs)) for knobs in IDEA_KNOBS]
    known = {name for group, variant in everything for name in (group, *variant.knobs)}
    unknown = [name for name in names if name not in known]
    if unknown:
        raise InputError(
            f"--variants {unknown[0][:60]!r}: expected some of {', '.join((*PRESETS, *KNOBS, IDEAS))}, or a knob as in sky_patches=48"
        )
    return [variant for group, variant in everything if not names or {group, *variant.knobs} & set(names)]


def _turned(preset: str, knobs: str) -> Variant:
    """A preset with knobs turned that are written one after another."""
    turned = tuple(knobs.split())
    return Variant(" + ".join((preset, *turned)), preset, turned)


def middle_block(scene: Scene) -> SectorRange:
    """BLOCK by BLOCK sectors around the middle of a scene, as half-open ranges; fewer where the scene has fewer."""
    available = SectorCutter(scene).sectors()
    middle = (scene.bounds[0] + scene.bounds[1]) / 2
    corner = [round(float(middle[axis]) / SECTOR_SIZE_M) - BLOCK // 2 for axis in (0, 2)]
    inside = [i for i in available if all(low <= at < low + BLOCK for at, low in zip(i, corner, strict=True))]
    if not inside:  # a ring road around nothing
        nearest = min(available, key=lambda i: float(np.linalg.norm((i.origin + SECTOR_SIZE_M / 2 - middle)[[0, 2]])))
        corner = [nearest.x, nearest.z]
    return (corner[0], corner[0] + BLOCK), (corner[1], corner[1] + BLOCK)


def run(
    sweep: Sweep,
    variants: Iterable[Variant],
    output: Path,
    jobs: int | None = None,
    device: str | None = None,
    restart: bool = False,
    progress: Callable[[Variant, str], None] | None = None,
) -> list[dict[str, Any]]:
    """A row for each variant, in order; those that an earlier run finished are taken from ``output`` unless ``restart`` says no.

    progress : called with a variant and what is done with it now

    Raises as ``runner.bake`` and ``compare_dataset`` do.
    """
    say = progress or (lambda _, __: None)
    parse_states(sweep.states, sweep.scene.location)
    known: dict[bytes, list[Estimate]] = {}
    rows, wanted = [], list(variants)
    for variant in wanted:
        path = output / "rows" / f"{variant.folder}.json"
        row = None if restart else _finished(path, sweep, variant)
        if row is None:
            row = _measure(sweep, variant, output / "datasets" / variant.folder, jobs, device, known, say)
            write_atomic(path, (json.dumps(row, indent=1, sort_keys=True) + "\n").encode())
        rows.append(row)
    say(wanted[0], "ticks of all")
    ticks = tick_microseconds([output / "datasets" / variant.folder for variant in wanted], device)
    return [row | {"tick_us": microseconds} for row, microseconds in zip(rows, ticks, strict=True)]


def _measure(
    sweep: Sweep,
    variant: Variant,
    folder: Path,
    jobs: int | None,
    device: str | None,
    known: dict[bytes, list[Estimate]],
    say: Callable[[Variant, str], None],
) -> dict[str, Any]:
    say(variant, "bake")
    seconds: list[float] = []
    # Core seconds of a bake that is not whole would be of other sectors.
    quiet = Console(quiet=True)
    world = bake(
        sweep.source, folder, variant.preset, jobs, sweep.sectors, sweep.seed, True, quiet, knobs=variant.knobs, on_baked=seconds.append
    )
    chosen = [index for index in sorted(world.sectors) if world.sectors[index].probes]
    if not chosen:
        raise InputError(f"--sectors: no sector of {sweep.source} there has a probe under {variant.name}")

    def advance(done: int, steps: int, what: str) -> None:
        say(variant, f"{what} ({done}/{steps})")

    report = compare_dataset(
        folder,
        sweep.states,
        sectors=chosen,
        points_per_sector=sweep.points,
        samples=sweep.samples,
        seed=sweep.seed,
        device=device,
        scene=sweep.scene,
        progress=advance,
        known=known,
    )
    facts = [world.sectors[index] for index in chosen]
    return {
        "variant": variant.name,
        "preset": variant.preset,
        "knobs": list(variant.knobs),
        "asked": asked(sweep, variant),
        "basis": world.basis,
        "sectors": [[index.x, index.z] for index in chosen],
        "probes": float(np.mean([f.probes for f in facts])),
        "factors": float(np.mean([f.factors for f in facts])),
        "bytes": float(np.mean([f.bytes + (f.fine_bytes or 0) for f in facts])),
        "bake_seconds": float(np.mean(seconds)),
        "estimated_error": world.estimated_error,
        "states": report["states"],
        "error": error_of(report["states"], ON_SURFACES),
    }


def error_of(states: dict[str, Any], stage: str) -> dict[str, float] | None:
    """Medians over the states of a stage's median, 95th percentile and size of bias; None where no state has the stage."""
    found = [stages[stage] for stages in states.values() if stages.get(stage, {}).get("median") is not None]
    if not found:
        return None
    return {name: float(np.median([abs(numbers[name]) for numbers in found])) for name in ("median", "p95", "bias")}


def pareto(rows: Sequence[dict[str, Any]], price: str) -> list[int]:
    """Which rows no other row beats in both price and median error on surfaces, from the cheapest on; none that has no error."""
    best, front = np.inf, []
    judged = [number for number, row in enumerate(rows) if row["error"] is not None]
    for number in sorted(judged, key=lambda i: (rows[i][price], rows[i]["error"]["median"])):
        if rows[number]["error"]["median"] < best:
            best = rows[number]["error"]["median"]
            front.append(number)
    return front


def asked(sweep: Sweep, variant: Variant) -> dict[str, Any]:
    """What decides a row's figures: a row of anything else, another version of the baker among it, is not this one's."""
    settings = settings_for(variant.preset)
    if variant.knobs:
        settings = with_knobs(settings, variant.knobs)
    judged = {"states": list(sweep.states), "points": sweep.points, "samples": sweep.samples, "seed": sweep.seed}
    ranges = [list(axis) for axis in sweep.sectors]
    baked = {"settings": settings.to_json(), "bake": bake_identity(sweep.scene, settings, sweep.seed)}
    return judged | {"source": sweep.source, "ranges": ranges} | baked


def _finished(path: Path, sweep: Sweep, variant: Variant) -> dict[str, Any] | None:
    """The row that an earlier run wrote, if it answers the same question and its dataset is there still."""
    try:
        row = json.loads(path.read_bytes())
        Dataset.open(path.parents[1] / "datasets" / variant.folder)
    except (OSError, ValueError):
        return None
    return row if isinstance(row, dict) and row.get("asked") == asked(sweep, variant) else None
