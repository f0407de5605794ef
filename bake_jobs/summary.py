"""The table at the end of a bake."""

from collections.abc import Mapping

import numpy as np
from rich.console import Console
from rich.table import Table

from gi_core.dataset import WorldInfo
from gi_core.grid import SectorIndex

# So many sectors are named when they miss their target; world.json has all.
LISTED = 10


def missed_target(world: WorldInfo) -> list[tuple[SectorIndex, float]]:
    """Sectors whose estimated error is above the bake's target, and what it is; the worst first."""
    target = world.settings.get("target_error", 0)
    found = [
        (i, f.estimated_error) for i, f in world.sectors.items() if target and f.estimated_error is not None and f.estimated_error > target
    ]
    return sorted(found, key=lambda pair: (-pair[1], pair[0]))


def print_summary(
    console: Console, world: WorldInfo, distant_bytes: int, core_seconds: float, wall_seconds: float, baked: int, workers: int
) -> None:
    """Print totals and means per sector. ``core_seconds`` is processor time over the ``baked`` sectors of this run."""
    counts = world.counts
    sectors = max(counts["sectors"], 1)
    table = Table(title=f"{world.name}: {world.preset}, {counts['sectors']} sectors")
    for name in ("", "total", "per sector"):
        table.add_column(name, justify="left" if not name else "right")
    for name in ("probes", "surfels", "bricks", "factors", "voxels", "triangles"):
        table.add_row(name, f"{counts[name]:,}", f"{counts[name] / sectors:,.0f}")
    sizes = {"sector files": counts["bytes"], "geometry files": counts["geometry_bytes"]}
    if world.has_fine_voxels:
        sizes["fine voxel files"] = sum(facts.fine_bytes or 0 for facts in world.sectors.values())
    for name, size in {**sizes, "distant texture": distant_bytes}.items():
        table.add_row(name, _size(size), f"{size / 1e3 / sectors:,.1f} kB")
    if baked:
        table.add_row("core time", f"{core_seconds:,.1f} s", f"{core_seconds / baked:,.2f} s")
        table.add_row(f"time, {workers} process{'es' if workers > 1 else ''}", f"{wall_seconds:,.1f} s", f"{wall_seconds / baked:,.2f} s")
    if world.estimated_error is not None:
        table.add_row("estimated error", "", f"{100 * world.estimated_error:.1f} %")
    console.print(table)
    crowded = sum(1 for facts in world.sectors.values() if facts.probes_dropped)
    missed = missed_target(world)
    if missed:
        shown = ", ".join(f"{i.x},{i.z} ({100 * error:.1f} %)" for i, error in missed[:LISTED])
        more = f" and {len(missed) - LISTED} more" if len(missed) > LISTED else ""
        console.print(f"{len(missed)} sectors miss the target error of {100 * world.settings['target_error']:g} %: {shown}{more}")
    notes = [
        (counts["probes_dropped"], f"probes beyond 1000 a sector were dropped, in {crowded} sectors"),
        (counts["probes_dead"], "candidate probes lay inside solids"),
        (counts["voxels_blind"], "voxels see none of their nearest probes and take the closest"),
        (world.dropped_triangles.get("degenerate", 0), "degenerate triangles were dropped"),
        (world.dropped_triangles.get("duplicate", 0), "duplicate triangles were dropped"),
        (world.dropped_triangles.get("non_finite", 0), "triangles with NaN or Inf were dropped"),
    ]
    for count, text in notes:
        if count:
            console.print(f"{count:,} {text}")


def _size(size: int) -> str:
    return f"{size / 1e6:,.1f} MB" if size >= 1e6 else f"{size / 1e3:,.1f} kB"


def print_own_errors(console: Console, world: WorldInfo, own: Mapping[SectorIndex, float]) -> None:
    """Say where a target error is missed for what probes err by themselves (``own``), rather than for what lies between them."""
    found = [own[index] for index, error in missed_target(world) if own.get(index, 0.0) ** 2 > 0.5 * error**2]
    if found:
        advice = "--quality standard has a finer sky" if world.sky == "faces" else "ask for a larger --target-error"
        console.print(
            f"{len(found)} sectors miss their target by what probes err by themselves, {100 * np.median(found):.1f} % in the median, "
            f"which more probes do not mend: {advice}"
        )
