"""What a load test may be asked to hold, and whether a report does."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from typing import Any


@dataclass(frozen=True)
class Limits:
    """Upper bounds; None leaves a figure alone. Each is the flag --max-NAME of the command."""

    tick_p99_ms: float | None = None
    lateness_p99_ms: float | None = None
    late_share: float | None = None
    skipped: int | None = None
    volume_p99_ms: float | None = None
    megabits: float | None = None
    misses: int | None = None
    pops: int | None = None
    errors: int | None = None
    cache_miss_share: float | None = None
    memory_gained_mb: float | None = None


def _late_share(report: dict[str, Any]) -> float | None:
    late, ticks = report["late_ticks"], report["ticks"]
    return None if late is None or ticks is None else late / max(ticks, 1)


def _cache_miss_share(report: dict[str, Any]) -> float | None:
    misses, hits = ([report["cache"].get(kind + name) for kind in ("", "player_volume_")] for name in ("misses", "hits"))
    return None if None in misses + hits else sum(misses) / max(sum(misses + hits), 1)


def _memory_gained_mb(report: dict[str, Any]) -> float | None:
    gained = report["memory_bytes_gained"]
    return None if gained is None else gained / 1e6


_FIGURES: dict[str, tuple[str, Callable[[dict[str, Any]], float | None]]] = {
    "tick_p99_ms": ("99th percentile of the tick [ms]", lambda report: report["tick_ms"]["p99"]),
    "lateness_p99_ms": ("99th percentile of ticks' lateness [ms]", lambda report: report["lateness_ms"]["p99"]),
    "late_share": ("share of late ticks", _late_share),
    "skipped": ("skipped ticks", lambda report: report["skipped"]),
    "volume_p99_ms": ("99th percentile of volume latency [ms]", lambda report: report["volume_ms"]["p99"]),
    "megabits": ("Mbit/s per player", lambda report: 8e-6 * report["bytes_per_second_per_player"]),
    "misses": ("misses", lambda report: report["misses"]),
    "pops": ("pops", lambda report: report["pops"]),
    "errors": ("errors", lambda report: report["errors"]),
    "cache_miss_share": ("share of queries and players' volumes that were made anew", _cache_miss_share),
    "memory_gained_mb": ("memory that the server gained [MB]", _memory_gained_mb),
}


def missed(report: dict[str, Any], limits: Limits) -> Iterator[str]:
    """A line for each limit that a report does not hold. A figure that is not known holds none."""
    for member in fields(limits):
        bound = getattr(limits, member.name)
        if bound is None:
            continue
        what, figure = _FIGURES[member.name]
        found = figure(report)
        flag = f"--max-{member.name.replace('_', '-')} {bound:g}"
        if found is None:
            yield f"{flag}: {what} is not known: the server did not say"
        elif found > bound:
            yield f"{flag}: {what} was {found:.6g}"
