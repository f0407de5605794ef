"""How wrong is each source of the sun's visibility, against shadow rays?

    python -m bake_jobs.compare_sun DATASET [--sectors N] [--json OUT]

    table         the bake's directions, blended
    map           the shadow map, drawn around a player in the middle of the sector
    stale         the same for a sun one degree earlier: as old as a sample gets before it is dropped
    served        the map where it is valid, else the table: what a relight around a player uses
    table_there   the table on those surfels alone that the map has a valid sample of

Errors are of share x cosine, a surfel's share of what it would get facing an open sun: mean absolute error (mae), and bias of the sum.
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from bake_jobs.compare import choose_sectors
from bake_jobs.compare_points import standing_eye
from bake_jobs.rays import RayScene
from bake_jobs.sun_sources import SunSources, suns
from bake_jobs.sun_truth import cell_points, true_share
from gi_core.arrays import Bool, Float64
from gi_core.constants import SECTOR_SIZE_M
from gi_core.container import write_atomic
from gi_core.dataset import Dataset
from gi_core.device import Device, shared_device
from gi_core.grid import SectorIndex
from gi_core.resident_sector import ResidentSector
from gi_core.shadow_map import SunSamples
from gi_core.shadow_plan import MAP_TEXELS, TEXELS_PER_METRE

# Surfels that the sun grazes below this cosine have samples of 0 by rule, and next to no light.
LEAST_COSINE = 0.01
SOURCES = ("table", "table_there", "map", "stale", "served")
SECTORS_UNDER_A_MAP = (MAP_TEXELS / TEXELS_PER_METRE / SECTOR_SIZE_M) ** 2


class Tally:
    """Sums over surfels of one source's errors."""

    def __init__(self) -> None:
        self._absolute = self._served = self._true = 0.0
        self._count = 0

    def add(self, served: Float64, true: Float64) -> None:
        self._absolute += float(np.abs(served - true).sum())
        self._served += float(served.sum())
        self._true += float(true.sum())
        self._count += len(true)

    def to_json(self) -> dict[str, Any]:
        """``{n, mae, bias}``; None where there is nothing to divide by."""
        mae = self._absolute / self._count if self._count else None
        return {"n": self._count, "mae": mae, "bias": self._served / self._true - 1 if self._true else None}


def compare_sun(dataset: Dataset, sectors: Sequence[SectorIndex], device: Device) -> dict[str, Any]:
    """``{elevations: {degrees: {source: {n, mae, bias}, valid}}, microseconds: {...}, bytes_a_surfel: {...}}``.

    ``valid`` is the share of surfels towards the sun that the map has a valid sample of. Raises as Dataset does.
    """
    parts = {index: dataset.geometry(index) for index in sorted(dataset.world.sectors)}
    first = np.cumsum([0, *(len(part.vertices) for part in parts.values())])
    triangles = [part.triangles + start for part, start in zip(parts.values(), first, strict=False)]
    rays = RayScene(np.concatenate([part.vertices for part in parts.values()]), np.concatenate(triangles).astype(np.int32))
    sources = SunSources(dataset, device, parts.__getitem__)
    moments = suns(dataset.world.location)
    tallies = {elevation: {source: Tally() for source in SOURCES} for elevation, _, _ in moments}
    valid: dict[float, list[Bool]] = {elevation: [] for elevation, _, _ in moments}
    surfels, table_bytes, sample_bytes = 0, 0, 0
    for index in sectors:
        sector = dataset.sector(index)
        resident = ResidentSector(device, sector, dataset.world.sky_patches)
        samples = SunSamples(device, resident)
        surfels += sector.surfel_count
        table_bytes += sector.sun_visibility.nbytes
        sample_bytes += samples.nbytes
        points, eye = cell_points(rays, sector), standing_eye(rays, index, parts[index])
        for elevation, to_sun, earlier in moments:
            share, known = true_share(rays, points, sector.surfel_count, to_sun)
            cosine = sector.surfel_normal.astype(np.float64) @ to_sun
            counted = known & (cosine > LEAST_COSINE)
            table = sources.table(resident, to_sun)
            stale, stale_there = sources.shadow_map(samples, eye, earlier)
            drawn, there = sources.shadow_map(samples, eye, to_sun)
            served = {
                "table": (table, counted),
                "table_there": (table, counted & there),
                "map": (drawn, counted & there),
                "stale": (stale, counted & stale_there),
                "served": (np.where(there, drawn, table), counted),
            }
            for source, (found, chosen) in served.items():
                tallies[elevation][source].add((found * cosine)[chosen], (share * cosine)[chosen])
            valid[elevation].append(there[counted])
    draw, sample, table_time = (
        1e6 * float(np.median(taken)) for taken in (sources.draw_seconds, sources.sample_seconds, sources.table_seconds)
    )
    return {
        "elevations": {
            f"{elevation:g}": {source: tally.to_json() for source, tally in found.items()}
            | {"valid": float(np.concatenate(valid[elevation]).mean())}
            for elevation, found in tallies.items()
        },
        "microseconds": {"direct_light": table_time, "sample": sample, "draw": draw, "draw_a_sector": draw / SECTORS_UNDER_A_MAP},
        "bytes_a_surfel": {"table": table_bytes / surfels, "map": sample_bytes / surfels},
        "sectors": [[index.x, index.z] for index in sectors],
        "surfels": surfels,
        "dataset": dataset.world.bake_id,
        "device": device.name,
    }


def show(report: dict[str, Any], console: Console) -> None:
    """Print the report."""
    table = Table(title="Sun visibility: mean absolute error of share x cosine / bias of the sum", title_justify="left")
    table.add_column("sun")
    for source in SOURCES:
        table.add_column(source, justify="right")
    table.add_column("map valid", justify="right")
    for elevation, found in report["elevations"].items():
        cells = [
            "-" if found[source]["bias"] is None else f"{found[source]['mae']:.4f} / {100 * found[source]['bias']:+.1f} %"
            for source in SOURCES
        ]
        table.add_row(f"{elevation} degrees", *cells, f"{100 * found['valid']:.0f} %")
    taken, held = report["microseconds"], report["bytes_a_surfel"]
    console.print(table)
    console.print(
        f"{report['surfels']:,} surfels of {len(report['sectors'])} sectors. Device time for a sector: {taken['direct_light']:.0f} us for "
        f"direct light from either source; the map {taken['sample']:.0f} us to sample, and {taken['draw_a_sector']:.0f} us of drawing "
        f"({taken['draw'] / 1e3:.1f} ms for the sectors that it covers). Bytes a surfel: table {held['table']:.1f}, map {held['map']:.1f}.",
        soft_wrap=True,
    )


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="python -m bake_jobs.compare_sun", description="Sources of the sun's visibility, against rays.")
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--sectors", type=int, default=9, help="how many to draw at random")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, help="write the report here")
    parser.add_argument("--device", help="part of an OpenCL device's name")
    given = parser.parse_args()
    dataset = Dataset.open(given.dataset)
    report = compare_sun(dataset, choose_sectors(dataset, given.seed, given.sectors), shared_device(given.device))
    show(report, Console(width=130))
    if given.json is not None:
        write_atomic(given.json, (json.dumps(report, indent=1) + "\n").encode())


if __name__ == "__main__":
    main()
