"""How wrong is a distant texel? Both its lights beside the path tracer's mean over the very points that it stands for.

    python -m bake_jobs.distant_study SOURCE DATASET X,Z [X,Z ...]     a table on stdout
    python -m bake_jobs.distant_study SOURCE DATASET time              what they take: time, bytes

DATASET is a bake of SOURCE that has at least these sectors. ``relit``: the mean of the same probes, lit as for a volume: what of an error
is the bake's own, and what comes of blending suns and snow.
"""

import re
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from bake_jobs.compare_report import StageSamples, summarise
from bake_jobs.compare_states import DEFAULT_STATES, parse_states
from bake_jobs.distant_transfer import TransferBaker, of_texel
from bake_jobs.path_tracer import Estimate, PathTracer
from bake_jobs.scene import Scene
from bake_jobs.scene_source import load_scene
from gi_core.arrays import Float32
from gi_core.basis import convert
from gi_core.dataset import Dataset
from gi_core.engine import Engine
from gi_core.errors import SectorlightError
from gi_core.grid import SectorIndex
from gi_core.lighting import Lighting
from gi_core.lights import lamps_on

# Of each of some hundred probes.
SAMPLES = 512
STAGES = ("sky", "full", "relit")
REPEATS, TIMED_SECTORS = 51, 20


def main(arguments: Sequence[str]) -> None:
    """The command line that the module's docstring shows."""
    match arguments:
        case [source, path, *sectors] if sectors and all(re.fullmatch(r"-?\d+,-?\d+", text) for text in sectors):
            scene, engine = load_scene(source), Engine(Dataset.open(path))
            tracer = PathTracer(scene.vertices, scene.triangles, scene.albedo, scene.emission)
            print_table(tracer, engine, [SectorIndex(*map(int, text.split(","))) for text in sectors])
        case [source, path, "time"]:
            print_costs(load_scene(source), Engine(Dataset.open(path)))
        case _:
            raise SystemExit(__doc__)


def print_costs(scene: Scene, engine: Engine) -> None:
    """Processor's microseconds to light the whole texture, medians of REPEATS; bytes; its seconds for a sector's transfer, mean of some."""
    dataset = engine.dataset
    world, transfer = dataset.world, dataset.distant().transfer
    for state in parse_states(DEFAULT_STATES, world.location):
        lighting = engine.lighting(state.time, state.weather)
        spent = {light: _median_us(partial(engine.distant, lighting, light)) for light in dataset.distant().lights}
        lights = len(lighting.directional_lights)
        print(f"{state.name}, {lights} of sun and moon: {', '.join(f'{light} {us:.0f} us' for light, us in spent.items())}")
    texels, held = len(world.sectors), 0 if transfer is None else transfer.nbytes
    print(f"{texels} texels: {dataset.distant_bytes:,} bytes in the file, {held:,} in memory; {held / texels:,.0f} a texel")
    baker = TransferBaker(scene, world.sun_table.directions, world.sky_patches)
    some = [dataset.sector(index) for index in sorted(world.sectors)[:: max(1, texels // TIMED_SECTORS)]]
    started = time.process_time()
    for sector in some:
        baker.transfer(sector)
    print(f"bake: {(time.process_time() - started) / len(some):.2f} s a sector, {len(some)} sectors")


def _median_us(call: Callable[[], object]) -> float:
    spent = []
    for _ in range(REPEATS):
        # Of the thread, which does all of it: a busy machine adds nothing.
        started = time.thread_time()
        call()
        spent.append(time.thread_time() - started)
    return float(np.median(spent)) * 1e6


def print_table(tracer: PathTracer, engine: Engine, sectors: Sequence[SectorIndex], samples: int = SAMPLES) -> None:
    """A row per state: median / 95th percentile / bias [%] of luminance over sectors and faces, and the tracer's own noise."""
    print(f"| state | values | {' | '.join(STAGES)} | noise |")
    print("|---" * (3 + len(STAGES)) + "|")
    for state in parse_states(DEFAULT_STATES, engine.dataset.world.location):
        found = texel_errors(tracer, engine, sectors, engine.lighting(state.time, state.weather), samples)
        cells = [_figures(found[stage]) for stage in STAGES]
        print(f"| {state.name} | {found['full']['n']} | {' | '.join(cells)} | {_share(found['full']['noise'])} |", flush=True)


def texel_errors(
    tracer: PathTracer, engine: Engine, sectors: Sequence[SectorIndex], lighting: Lighting, samples: int = SAMPLES
) -> dict[str, dict[str, Any]]:
    """``compare_report.summarise`` of each of STAGES in one light; a texel counts six values.

    Raises InputError for a dataset whose texels know the sky alone, SectorMissingError.
    """
    stages = {stage: StageSamples() for stage in STAGES}
    textures = {"sky": engine.distant(lighting, "sky"), "full": engine.distant(lighting, "full")}
    for index in sectors:
        sector = engine.dataset.sector(index)
        probes = np.flatnonzero(of_texel(sector.probe_room, sector.probe_flags))
        if not len(probes):
            continue
        places = sector.probe_position[probes].astype(np.float64) + index.origin
        lamps = lamps_on(engine.lamps, lighting)
        truth = _mean(tracer.cube_irradiance(places, lighting, lamps, samples=samples, seed=1))
        for stage, texture in textures.items():
            stages[stage].add(texture.values[index.z - texture.origin.z, index.x - texture.origin.x], truth)
        stages["relit"].add(_relit(engine, index, lighting)[probes].mean(axis=0, dtype=np.float64), truth)
    return {stage: summarise(values) for stage, values in stages.items()}


def _relit(engine: Engine, index: SectorIndex, lighting: Lighting) -> Float32:
    return convert(engine.lit_sector(index, lighting), engine.dataset.world.basis, "cube")


def _mean(estimate: Estimate) -> Estimate:
    """Of independent points' values (n, 6, 3), their mean's."""
    count = len(estimate.mean)
    return Estimate(estimate.mean.mean(axis=0), np.sqrt((estimate.standard_error**2).sum(axis=0)) / count)


def _figures(numbers: dict[str, Any]) -> str:
    return " / ".join(_share(numbers[name], "+" if name == "bias" else "") for name in ("median", "p95", "bias"))


def _share(number: float | None, sign: str = "") -> str:
    return "-" if number is None else f"{100 * number:{sign}.1f}"


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except SectorlightError as error:
        raise SystemExit(str(error)) from error
