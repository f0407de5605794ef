"""``sectorlight compare``: options to ``compare_dataset``, its progress, and the report as a table, JSON and a chart."""

import io
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from bake_jobs.compare import choose_sectors, compare_dataset
from bake_jobs.compare_report import draw_chart, report_table, stored, write_json
from bake_jobs.lamp_file import load_lamps
from bake_jobs.sanity import NonsenseError
from bake_jobs.scene_source import load_scene
from gi_core.constants import SECTOR_SIZE_M
from gi_core.container import write_atomic
from gi_core.dataset import Dataset, write_world
from gi_core.error_report import OWN
from gi_core.errors import InputError
from gi_core.grid import SectorIndex
from gi_core.outputs import expect_file

SectorRange = tuple[tuple[int, int], tuple[int, int]]
NEIGHBOURS = tuple((dx, dz) for dx in (-1, 0, 1) for dz in (-1, 0, 1))
REPORT_WIDTH = 120  # where no terminal says how wide it is
# What a bake measures of itself: a tenth of the time that a hundred sectors of `standard` take.
BAKE_STATES, BAKE_SECTORS, BAKE_POINTS, BAKE_SAMPLES = ("noon", "overcast"), 2, 32, 1024


def run(
    dataset_path: Path,
    states: Sequence[str],
    sectors: Sequence[SectorIndex] | None,
    points: int,
    samples: int,
    seed: int,
    source: str | None,
    lamps_path: Path | None,
    json_path: Path | None,
    plot_path: Path | None,
    device: str | None,
    store: bool = True,
) -> None:
    """Measure, print the table on stdout, write what was asked for, and keep the report in the dataset where ``store`` says so.

    Raises as ``compare_dataset``, ``load_lamps`` and ``load_scene`` do, and NonsenseError where receivers have no light by day, or none
    that is a number.
    """
    if plot_path is not None and plot_path.suffix.lower() != ".png":
        raise InputError(f"--plot {plot_path}: expected a name that ends in .png")
    for option, path in (("--json", json_path), ("--plot", plot_path)):
        if path is not None:
            expect_file(path, option)
    lamps = None if lamps_path is None else load_lamps(lamps_path)
    report = _measured(
        dataset_path, states, source, sectors=sectors, points_per_sector=points, samples=samples, seed=seed, device=device, lamps=lamps
    )
    console = Console()
    if not console.is_terminal:
        console = Console(width=REPORT_WIDTH)
    console.print(report_table(report))
    if json_path is not None:
        write_json(json_path, report)
    if plot_path is not None:
        picture = io.BytesIO()
        draw_chart(report).save(picture, "PNG")
        write_atomic(plot_path, picture.getvalue())
    _expect_light(dataset_path, report)
    if store and lamps is None:
        _store(dataset_path, report, has_source=source is not None)


def report_bake(dataset_path: Path, source: str | None) -> None:
    """A small report of a bake that has just ended, kept in the dataset, and its gist on stderr. ``source`` is wanted where the bake left
    out what surrounds its sectors. Raises as ``run``."""
    chosen = choose_sectors(Dataset.open(dataset_path), 0, BAKE_SECTORS)
    report = _measured(dataset_path, BAKE_STATES, source, sectors=chosen, points_per_sector=BAKE_POINTS, samples=BAKE_SAMPLES)
    _expect_light(dataset_path, report)
    _store(dataset_path, report, has_source=source is not None)
    said = {state: in_words(report["states"][state][OWN]) for state in BAKE_STATES}
    if any(said.values()):
        shown = "; ".join(f"{state} {error}" for state, error in said.items() if error)
        where = f"{BAKE_POINTS} points of each of {len(chosen)} sectors"
        print(f"Errors beside the path tracer, {where}: {shown}. `sectorlight compare` measures more.", file=sys.stderr)


def in_words(numbers: Mapping[str, Any]) -> str:
    """A stage's error in a line; nothing where nothing was compared."""
    if not numbers["n"]:
        return ""
    low, high = (100 * end for end in numbers["median_ci"])
    return f"{max(low, 0):.1f} to {high:.1f} % in the median, {100 * numbers['p95']:.0f} % at the 95th percentile"


def _expect_light(dataset_path: Path, report: dict[str, Any]) -> None:
    if report["dark_by_day"]:
        shown = "; ".join(report["dark_by_day"][:5])
        said = "receivers without any light by day, or with light that is no number, in"
        raise NonsenseError(f"{dataset_path}: this dataset is nonsense: {said} {shown}; bake it again")


def _measured(dataset_path: Path, states: Sequence[str], source: str | None, **asked: Any) -> dict[str, Any]:
    """What ``compare_dataset`` says, shown how far it is. ``source``: where the scene is; ``asked``: as it takes it."""
    scene = None if source is None else load_scene(source)
    with Progress(
        TextColumn("comparing"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        TextColumn("{task.description}"),
        console=Console(stderr=True),
        transient=True,
    ) as progress:
        task = progress.add_task("", total=None)

        def advance(done: int, steps: int, what: str) -> None:
            progress.update(task, completed=done, total=steps, description=what)

        return compare_dataset(dataset_path, states, scene=scene, progress=advance, **asked)


def _store(dataset_path: Path, report: dict[str, Any], has_source: bool) -> None:
    """Keep a report in its dataset, or say why not."""
    dataset = Dataset.open(dataset_path)
    at_edge = [(x, z) for x, z in report["sectors"] if any(_left_out(dataset, SectorIndex(x + dx, z + dz)) for dx, dz in NEIGHBOURS)]
    reason = ""
    if dataset.world.bake_id != report["dataset"]:
        reason = "was baked anew in the meantime"
    elif at_edge and not has_source:
        reason = f"sector {at_edge[0][0]},{at_edge[0][1]} is at the edge of what was baked, and the city goes on beyond: name its --source"
    else:
        try:
            write_world(dataset.path, replace(dataset.world, error_report=stored(report, dataset.world.basis)))
        except OSError as error:
            reason = error.strerror or str(error)
    if reason:
        print(f"sectorlight: {dataset_path}: the report was not stored: {reason}", file=sys.stderr)


def _left_out(dataset: Dataset, index: SectorIndex) -> bool:
    """Whether a sector that was not baked may hold some of the city: beyond the city's own bounds there is nothing to bake."""
    low, high = dataset.world.bounds[:, [0, 2]]
    corner = index.origin[[0, 2]]
    return index not in dataset.world.sectors and bool(np.all((corner < high) & (corner + SECTOR_SIZE_M > low)))


def split_states(text: str) -> list[str]:
    """``noon,dusk=20:45/clear:haze=0.5,snow=0`` -> one text per state: a weather's own commas do not part states."""
    states: list[str] = []
    for part in text.split(","):
        # Only a weather's numbers have = without the / that a state's moment has.
        if states and "=" in part and "/" not in part:
            states[-1] += f",{part}"
        else:
            states.append(part)
    return states


def sectors_of(dataset_path: Path, chosen: str | SectorRange, seed: int) -> list[SectorIndex]:
    """The sectors of a dataset that are meant by ``all``, a number of them, or half-open ranges. Raises InputError when there is none."""
    dataset = Dataset.open(dataset_path)
    known = sorted(dataset.world.sectors)
    if isinstance(chosen, tuple):
        (x0, x1), (z0, z1) = chosen
        found = [i for i in known if x0 <= i.x < x1 and z0 <= i.z < z1]
        if not found:
            raise InputError(f"--sectors={x0}:{x1},{z0}:{z1}: {dataset_path} has no sector there; `sectorlight info` shows its extent")
        return found
    if chosen == "all":
        return known
    if not re.fullmatch(r"[1-9]\d{0,6}", chosen):
        raise InputError(f"--sectors: expected X0:X1,Z0:Z1, a number of sectors, or all; found {chosen[:60]!r}")
    return choose_sectors(dataset, seed, int(chosen))
