"""``sectorlight info``: what a dataset holds, as tables."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from gi_core.dataset import Dataset, WorldInfo
from gi_core.error_report import expected_error
from gi_core.errors import InputError, SectorMissingError
from gi_core.grid import SectorIndex

REPORT_WIDTH = 140  # where no terminal says how wide it is


def show_dataset(path: Path) -> None:
    """Print a dataset's place, counts, bytes, settings and error report."""
    dataset = Dataset.open(path)
    world = dataset.world
    place = world.location
    low, high = (", ".join(f"{v:.1f}" for v in corner) for corner in world.bounds)
    total_bytes = sum(facts.bytes for facts in world.sectors.values())
    probes = sum(facts.probes for facts in world.sectors.values())
    facts = {
        "name": world.name,
        "source": world.source,
        "digest": dataset.digest,
        "preset": world.preset,
        "basis": world.basis,
        "bounds [m]": f"({low}) .. ({high})",
        "location": f"{place.latitude_degrees:.4f}, {place.longitude_degrees:.4f} ({place.source}), {place.timezone}, {place.date}",
        "north": f"{place.north_degrees:g} degrees",
        "sectors": f"{len(world.sectors):,}",
        "sector files": f"{total_bytes:,} bytes" + (f", {total_bytes / len(world.sectors):,.0f} a sector" if world.sectors else ""),
        "distant texture": f"{dataset.distant_bytes:,} bytes, light: {' or '.join(dataset.distant().lights)}",
        "bytes per probe": f"{total_bytes / probes:,.0f}" if probes else "no probe",
        "rooms, lamps, decals": f"{len(world.rooms)}, {len(world.lamps)}, {len(world.decals)}",
        "estimated error": "none was made" if world.estimated_error is None else f"{100 * world.estimated_error:.1f} % (median of sectors)",
    }
    console = Console()
    console.print(_table("Dataset", facts), _table("Counts", world.counts), _table("Settings", world.settings))
    if world.error_report is None:
        console.print("No error report: `sectorlight compare` measures one.")
    else:
        wide = console if console.is_terminal else Console(width=REPORT_WIDTH)
        wide.print(_report(world))


def show_sector(path: Path, text: str) -> None:
    """Print one sector's counts and bytes; its file is read and checked."""
    match = re.fullmatch(r"\s*(-?\d{1,9})[,_](-?\d{1,9})\s*", text)
    if not match:
        raise InputError(f"sector: expected X,Z as in 3,-2, found {text[:40]!r}")
    index = SectorIndex(int(match[1]), int(match[2]))
    dataset = Dataset.open(path)
    facts = dataset.world.sectors.get(index)
    if facts is None:
        raise SectorMissingError(f"{path}: sector {index.x},{index.z} was not baked; `sectorlight info {path}` shows what was")
    sector = dataset.sector(index)
    free = int((sector.voxel_class > 0).sum())
    rows = {
        "file": f"{dataset.sector_path(index)} ({facts.bytes:,} bytes)",
        "digest": facts.digest,
        "in memory": f"{sector.nbytes:,} bytes",
        "probes": sector.probe_count,
        "factors": sector.factor_count,
        "bricks": sector.brick_count,
        "surfels": sector.surfel_count,
        "sun planes": len(sector.sun_visibility),
        "voxels": f"{sector.voxel_class.size:,}, {free:,} in free air",
        "estimated error": "none was made" if facts.estimated_error is None else f"{100 * facts.estimated_error:.1f} %",
        "geometry": f"{len(dataset.geometry(index).triangles):,} triangles",
    }
    Console().print(_table(f"Sector {index.x},{index.z}", rows))


def _report(world: WorldInfo) -> Table:
    """What ``compare`` measured: median, 95th percentile and bias of each stage in each state, in per cent."""
    report = world.error_report or {}
    states = {name: stages for name, stages in report.get("states", {}).items() if isinstance(stages, Mapping)}
    rows = ("probes", "near", "mid", "shaded", "floor", "shaded_cube", "floor_cube", "shaded_fine", "shaded_rooms", "shaded_rooms_cube")
    expected = expected_error(report, world.basis, world.basis)
    title = "Error report: median / 95th percentile / bias [%]"
    table = Table(title=title if expected is None else f"{title}; expected on surfaces: {100 * expected:.1f} %", title_justify="left")
    for column in ("", *states):
        table.add_column(escape(column))
    for row in rows:
        if any(row in stages for stages in states.values()):
            table.add_row(row, *(_figures(stages.get(row)) for stages in states.values()))
    return table


def _figures(numbers: Any) -> str:
    found = [numbers.get(name) for name in ("median", "p95", "bias")] if isinstance(numbers, Mapping) else []
    known = [100 * value for value in found if isinstance(value, int | float)]
    return f"{known[0]:.1f} / {known[1]:.0f} / {known[2]:+.1f}" if len(known) == 3 else "-"


def _table(title: str, rows: Mapping[str, Any]) -> Table:
    table = Table("", "", title=title, title_justify="left", show_header=False)
    for name, value in _flat(rows):
        # Names come from files: escaped, or rich would read their brackets as markup.
        table.add_row(escape(name), f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) else escape(str(value)))
    return table


def _flat(rows: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    """Nested mappings as dotted names."""
    flat: list[tuple[str, Any]] = []
    for name, value in rows.items():
        if isinstance(value, Mapping):
            flat += _flat(value, f"{prefix}{name}.")
        else:
            flat.append((f"{prefix}{name}", value))
    return flat
