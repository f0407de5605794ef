"""``sectorlight bench``: measurements as a table and as JSON."""

import json
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table

from gi_core.bench import Measurement
from gi_core.container import write_atomic

TABLE_WIDTH = 160  # where no terminal says how wide it is


def show(measurements: Sequence[Measurement]) -> None:
    """Print one row for each measurement on stdout."""
    table = Table(title="Medians, each beside its baseline in the same run", title_justify="left")
    for name in ("name", "median", "baseline", "ratio", "unit", "what the baseline is", "sizes", "device"):
        table.add_column(name, justify="right" if name in ("median", "baseline", "ratio") else "left", no_wrap=name == "name")
    for row in measurements:
        sizes = ", ".join(f"{count:,} {what}" for what, count in row.sizes.items())
        table.add_row(row.name, *(f"{v:,.4g}" for v in (row.median, row.baseline, row.ratio)), row.unit, row.baseline_is, sizes, row.device)
    table.caption = "ratio: how many times as good as the baseline; times: baseline / median, rates: median / baseline"
    console = Console()
    if not console.is_terminal:
        console = Console(width=TABLE_WIDTH)
    console.print(table)


def write_json(path: Path, measurements: Sequence[Measurement]) -> None:
    """The measurements as a JSON list, whole or not there."""
    write_atomic(path, (json.dumps([row.to_json() for row in measurements], indent=1, allow_nan=False) + "\n").encode())
