"""``sectorlight loadtest``: the files it reads and writes, its progress, its table."""

import io
import json
import math
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from gi_core.container import write_atomic
from gi_core.errors import InputError
from gi_core.outputs import expect_file
from server import loadtest_limits, loadtest_plot
from server.loadtest import Options, Path3, run
from server.loadtest_limits import Limits
from server.loadtest_record import Recorder

CACHE_COUNTS = ("hits", "misses", "player_volume_hits", "player_volume_misses")
MAX_PATH_FILE_BYTES = 1 << 26
# Above this the load test itself is what is slow, and its latencies are its own.
BUSY_CLIENT = 0.9


def checked_url(text: str) -> str:
    """The server's address without a path. Raises InputError."""
    try:
        parts = urlsplit(text)
        fits = parts.scheme in ("http", "https") and parts.hostname and parts.port != 0 and parts.path in ("", "/") and not parts.query
    except ValueError:
        fits = False
    if not fits:
        raise InputError(f"URL {text[:200]!r}: expected the address of a server, as in http://127.0.0.1:8000")
    return text.rstrip("/")


def read_paths(file: Path) -> list[Path3]:
    """The paths in a JSON file: one list of [x, y, z] in world metres, or a list of such lists. Raises InputError."""
    try:
        with file.open("rb") as opened:
            found = json.loads(opened.read(MAX_PATH_FILE_BYTES))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"--path {file}: expected a readable JSON file, found {error}") from error
    paths = found if isinstance(found, list) and found and isinstance(found[0], list) and found[0] and _is_point(found[0][0]) else [found]
    for path in paths:
        if not isinstance(path, list) or len(path) < 2 or not all(map(_is_point, path)):
            raise InputError(f"--path {file}: expected a list of at least two points [x, y, z] in metres, or a list of such lists")
    return [[(float(x), float(y), float(z)) for x, y, z in path] for path in paths]


def _is_point(value: Any) -> bool:
    numbers = isinstance(value, list) and len(value) == 3 and all(isinstance(n, int | float) and not isinstance(n, bool) for n in value)
    return numbers and all(abs(n) < 1e9 and math.isfinite(n) for n in value)


def run_command(options: Options, limits: Limits, json_path: Path | None, plot_path: Path | None) -> tuple[list[str], bool]:
    """Run a test, show it, write it. Returns the limits it missed, a line each, and whether it was interrupted."""
    for flag, path in (("--json", json_path), ("--plot", plot_path)):
        if path is not None:
            expect_file(path, flag)
    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[seen]}"),
        TimeRemainingColumn(),
        console=Console(stderr=True),
    )
    task = bar.add_task(f"{options.players} players", total=options.seconds, seen="")

    def show_progress(at: float, recorder: Recorder) -> None:
        bar.start()  # not before: a server that isn't there gets one line, without a bar
        seen = f"{recorder.total('frames'):,} frames, {recorder.total('errors'):,} errors"
        bar.update(task, completed=min(at, options.seconds), seen=seen)

    try:
        report = run(options, show_progress)
    finally:
        bar.stop()
    if json_path is not None:
        write_atomic(json_path, (json.dumps(report, indent=1, allow_nan=False) + "\n").encode())
    if plot_path is not None:
        picture = io.BytesIO()
        loadtest_plot.draw(report).save(picture, "PNG")
        write_atomic(plot_path, picture.getvalue())
    Console().print(table_of(report))
    return list(loadtest_limits.missed(report, limits)), report["interrupted"]


def table_of(report: dict[str, Any]) -> Table:
    """A report for a terminal."""
    table = Table(title=f"{report['players']} players at {report['speed']:g} m/s for {report['seconds']:.1f} s, {report['mode']}")
    table.add_column("what")
    table.add_column("", justify="right")
    rows = {
        "tick p50 / p99 / max [ms]": _numbers(*(report["tick_ms"][name] for name in ("p50", "p99", "max"))),
        "lateness p50 / p99 / max [ms]": _numbers(*(report["lateness_ms"][name] for name in ("p50", "p99", "max"))),
        "late ticks, skipped, of all": _numbers(report["late_ticks"], report["skipped"], report["ticks"]),
        f"volume latency since {report['volume_ms_since']} p50 / p99 [ms]": _numbers(*report["volume_ms"].values()),
        "Mbit/s per player": _numbers(8e-6 * report["bytes_per_second_per_player"]),
        "misses": _numbers(report["misses"]),
        f"pops (beyond {report['pop_bound']:.0%} in a tick), around jumps": _numbers(report["pops"], report["pops_in_jumps"]),
        "frames, full, not judged": _numbers(report["frames"], report["full_frames"], report["frames_not_judged"]),
        "errors": _numbers(report["errors"]),
        "cache hits / misses of queries, of players' volumes": _numbers(*(report["cache"].get(name) for name in CACHE_COUNTS)),
        "server memory, gained [MB]": _numbers(*(_mega(report[name]) for name in ("memory_bytes", "memory_bytes_gained"))),
        "this client's share of a core": _numbers(report["client_cpu_share"]),
    }
    for name, text in rows.items():
        table.add_row(Text(name), text)  # Text: brackets are units, not markup
    for text, count in report["error_messages"].items():
        table.add_row(Text(text), f"{count:,}", style="red")
    if report["client_cpu_share"] > BUSY_CLIENT:
        table.caption = "This client was busy all the time: its latencies are its own. Use fewer players, or several load tests."
    return table


def _mega(value: float | None) -> float | None:
    return None if value is None else value / 1e6


def _numbers(*values: float | None) -> str:
    return " / ".join("?" if value is None else f"{value:,}" if isinstance(value, int) else f"{value:,.4g}" for value in values)
