"""What serving may trade, of datasets that are baked already: a volume's basis and encoding, and how many bounces a tick makes."""

import json
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bake_jobs.compare import Reference, points_of, sector_rng
from bake_jobs.compare_report import StageSamples, summarise
from bake_jobs.compare_states import parse_states
from bake_jobs.path_tracer import Estimate, PathTracer
from bake_jobs.tradeoff import Sweep, Variant, asked
from gi_core.arrays import AnyArray, Float32
from gi_core.basis import convert, served_from
from gi_core.bench import side_by_side
from gi_core.container import write_atomic
from gi_core.dataset import Dataset
from gi_core.device import shared_device
from gi_core.engine import Engine
from gi_core.error_report import DARKEST_SHARE_OF_MEAN
from gi_core.grid import SectorIndex
from gi_core.lighting import Lighting
from gi_core.lights import lamps_on
from gi_core.relight import Relighter
from gi_core.relight_input import RelightInput, relight_input
from gi_core.resident_sector import ResidentSector
from gi_core.spectrum import LUMINANCE_FROM_RGB
from gi_core.volume import sample_volume

# Seeds that compare gives to probes, near and mid first: with the same paths after them, figures are those of its rows.
DRAWN_BEFORE_SURFACES = 3
PASSES = (1, 2, 3, 4, 6, 8)
# Light (B, ..., 3) [lx] -> the bytes of a reply, and the light that a client reads of them.
Encoding = Callable[[Float32], tuple[int, Float32]]
UNSIGNED = ("rgb9e5",)  # cannot hold harmonics


def with_serving(
    sweep: Sweep,
    variants: Sequence[Variant],
    rows: Sequence[dict[str, Any]],
    output: Path,
    encodings: Mapping[str, Encoding],
    device: str | None = None,
    restart: bool = False,
    progress: Callable[[Variant, str], None] | None = None,
) -> list[dict[str, Any]]:
    """Rows of ``tradeoff.run``; those of presets get ``served`` and ``bounces``, kept in ``output/served`` for the next time."""
    tracer, known = None, dict[bytes, list[Estimate]]()
    whole = []
    for variant, row in zip(variants, rows, strict=True):
        path = output / "served" / f"{variant.folder}.json"
        question = json.loads(json.dumps(asked(sweep, variant) | {"encodings": list(encodings)}))
        found = None if variant.knobs or restart else _finished(path, question)
        if found is None and not variant.knobs:
            if progress is not None:
                progress(variant, "serving")
            scene = sweep.scene
            tracer = tracer or PathTracer(scene.vertices, scene.triangles, scene.albedo, scene.emission)
            dataset = Dataset.open(output / "datasets" / variant.folder)
            sectors = [SectorIndex(x, z) for x, z in row["sectors"]]
            found = {
                "asked": question,
                "served": served(sweep, dataset, sectors, tracer, known, encodings, device),
                "bounces": bounces(sweep, dataset, sectors, device),
            }
            write_atomic(path, (json.dumps(found, indent=1, sort_keys=True) + "\n").encode())
        whole.append(row if found is None else row | {"served": found["served"], "bounces": found["bounces"]})
    return whole


def served(
    sweep: Sweep,
    dataset: Dataset,
    sectors: Sequence[SectorIndex],
    tracer: PathTracer,
    known: dict[bytes, list[Estimate]],
    encodings: Mapping[str, Encoding],
    device: str | None,
) -> list[dict[str, Any]]:
    """A row for each basis that the dataset can be served in and each encoding that can hold it.

    bytes : of a volume's reply; median, p95 : of shaded points, medians over the states; changed : the 99th percentile of what the encoding
    alone does to a shaded point, over states and sectors
    """
    engine, own = Engine(dataset, device), dataset.world.basis
    lightings = [engine.lighting(state.time, state.weather) for state in parse_states(sweep.states, dataset.world.location)]
    ways = [(basis, name) for basis in served_from(own) for name in encodings if basis == "cube" or name not in UNSIGNED]
    samples = {way: [StageSamples() for _ in lightings] for way in ways}
    changed: dict[tuple[str, str], list[AnyArray]] = {way: [] for way in ways}
    sizes: dict[tuple[str, str], int] = {}
    for index in sectors:
        points = points_of(tracer, dataset, index, sweep.points, sweep.seed)
        for place, lighting in enumerate(lightings):
            rng, lamps = sector_rng(sweep.seed, index, lighting.digest), lamps_on(engine.lamps, lighting)
            rng.integers(1 << 62, size=DRAWN_BEFORE_SURFACES)
            truth = Reference(tracer, lighting, lamps, sweep.samples, rng, own, known).surfaces(points.surface, points.normal)
            for basis in served_from(own):
                volume = engine.volume(points.eye, lighting, basis=basis)
                at = (volume.origin, volume.voxel_size, points.surface, points.normal.astype(np.float32))
                exact = sample_volume(volume.values, *at) @ LUMINANCE_FROM_RGB
                for way in [way for way in ways if way[0] == basis]:
                    sizes[way], decoded = encodings[way[1]](volume.values)
                    light = sample_volume(decoded, *at)
                    samples[way][place].add(light, truth)
                    changed[way].append(_relative(light @ LUMINANCE_FROM_RGB, exact))
    rows = []
    for way in ways:
        found = [summarise(gathered) for gathered in samples[way]]
        lit = [figures for figures in found if figures["median"] is not None]
        medians = {name: float(np.median([figures[name] for figures in lit])) if lit else None for name in ("median", "p95")}
        off = np.concatenate(changed[way])
        rows.append(
            {"basis": way[0], "encoding": way[1], "bytes": sizes[way], "changed": float(np.quantile(off, 0.99)) if len(off) else None}
            | medians
        )
    return rows


def bounces(sweep: Sweep, dataset: Dataset, sectors: Sequence[SectorIndex], device_name: str | None) -> list[dict[str, Any]]:
    """How far probes' faces are from where their bounces end, so many passes after the light of the first state came on in the dark.

    median, p95 : relative, of luminance; microseconds : of the passes, for one sector
    """
    world, device = dataset.world, shared_device(device_name)
    relighter, engine = Relighter(device), Engine(dataset, device_name)
    lighting: Lighting = engine.lighting(*_moment(sweep, dataset))
    given = relight_input(lighting, world.sun_table, world.sky, world.sky_patches)
    errors: dict[int, list[AnyArray]] = {passes: [] for passes in PASSES}
    taken: dict[int, list[float]] = {passes: [] for passes in PASSES}
    for index in sectors:
        resident = ResidentSector(device, dataset.sector(index), world.sky_patches)
        end = convert(relighter.converge(resident, given).cubes, world.basis, "cube") @ LUMINANCE_FROM_RGB
        for passes in PASSES:
            run = partial(_light_anew, relighter, resident, given, passes)
            taken[passes].append(side_by_side(run, run, rounds=5)[0])
            so_far = convert(resident.read_cubes(), world.basis, "cube") @ LUMINANCE_FROM_RGB
            errors[passes].append(_relative(so_far, end).reshape(-1))
    rows = []
    for passes in PASSES:
        median, p95 = (float(v) for v in np.quantile(np.concatenate(errors[passes]), (0.5, 0.95)))
        rows.append({"passes": passes, "median": median, "p95": p95, "microseconds": 1e6 * float(np.median(taken[passes]))})
    return rows


def _moment(sweep: Sweep, dataset: Dataset) -> tuple[str, str]:
    state = parse_states(sweep.states, dataset.world.location)[0]
    return state.time, state.weather


def _light_anew(relighter: Relighter, resident: ResidentSector, given: RelightInput, passes: int) -> None:
    """Passes from darkness, to the end of the device's work."""
    sector = resident.sector
    resident.write_cubes(np.zeros((sector.probe_count, sector.basis_size, 3), np.float32))
    relighter.relight([resident], given, passes)
    relighter.device.queue.finish()


def _relative(found: AnyArray, exact: AnyArray) -> AnyArray:
    """|found - exact|, over exact or what counts as darkest."""
    if not exact.size:
        return exact
    return np.asarray(
        np.abs(found - exact) / np.maximum(np.maximum(exact, DARKEST_SHARE_OF_MEAN * exact.mean()), np.finfo(np.float32).tiny)
    )


def _finished(path: Path, question: dict[str, Any]) -> dict[str, Any] | None:
    """What an earlier run wrote, if it answers the same question."""
    try:
        found = json.loads(path.read_bytes())
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) and found.get("asked") == question else None
