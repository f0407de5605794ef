"""``sectorlight loadtest``: the files it reads and writes, its progress, its table."""

import io
import json
from collections.abc import Sequence
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
from server.json_input import read_text
from server.loadtest import Options, Path3, Stage, run
from server.loadtest_limits import Limits
from server.player_paths import points_from_json

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


def read_paths(file: Path) -> Sequence[Path3]:
    """The paths in a JSON file: one list of [x, y, z] in world metres, a list of such lists, or GeoJSON's LineStrings, [x, z, height] in
    metres. Raises InputError."""
    where = f"--path {file}"
    try:
        found = json.loads(read_text(file, MAX_PATH_FILE_BYTES))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{where}: expected JSON ({str(error)[:200]})") from error
    paths = [points_from_json(path, where if path is found else f"{where}: path {i}") for i, path in enumerate(_each(found))]
    if not paths or min(map(len, paths)) < 2:
        raise InputError(f"{where}: expected paths of at least two points [x, y, z] in metres")
    return paths


def _each(found: Any) -> list[Any]:
    """What a path file holds, a path each."""
    if isinstance(found, dict) and found.get("type") == "FeatureCollection" and isinstance(found.get("features"), list):
        return list(found["features"])
    is_list_of_paths = isinstance(found, list) and found and isinstance(found[0], list) and found[0] and isinstance(found[0][0], list)
    return found if is_list_of_paths else [found]


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
    task = bar.add_task("", seen="")

    def show_progress(stage: Stage) -> None:
        bar.start()  # not before: a server that isn't there gets one line, without a bar
        recorder = stage.recorder
        seen = "" if recorder is None else f"{recorder.total('frames'):,} frames, {recorder.total('errors'):,} errors"
        bar.update(task, description=stage.name, completed=stage.done, total=stage.whole, seen=seen)

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
