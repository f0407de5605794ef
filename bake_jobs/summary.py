"""The table at the end of a bake."""

from rich.console import Console
from rich.table import Table

from gi_core.dataset import WorldInfo


def print_summary(console: Console, world: WorldInfo, core_seconds: float, wall_seconds: float, baked: int, workers: int) -> None:
    """Print totals and means per sector. ``core_seconds`` is processor time over the ``baked`` sectors of this run."""
    counts = world.counts
    sectors = max(counts["sectors"], 1)
    table = Table(title=f"{world.name}: {world.preset}, {counts['sectors']} sectors")
    for name in ("", "total", "per sector"):
        table.add_column(name, justify="left" if not name else "right")
    for name in ("probes", "surfels", "bricks", "factors", "voxels", "triangles"):
        table.add_row(name, f"{counts[name]:,}", f"{counts[name] / sectors:,.0f}")
    table.add_row("sector files", f"{counts['bytes'] / 1e6:,.1f} MB", f"{counts['bytes'] / 1e3 / sectors:,.0f} kB")
    table.add_row("geometry files", f"{counts['geometry_bytes'] / 1e6:,.1f} MB", f"{counts['geometry_bytes'] / 1e3 / sectors:,.1f} kB")
    if baked:
        table.add_row("core time", f"{core_seconds:,.1f} s", f"{core_seconds / baked:,.2f} s")
        table.add_row(f"time, {workers} processes", f"{wall_seconds:,.1f} s", f"{wall_seconds / baked:,.2f} s")
    console.print(table)
    crowded = sum(1 for facts in world.sectors.values() if facts.probes_dropped)
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
