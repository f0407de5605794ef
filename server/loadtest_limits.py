"""What a load test may be asked to hold, and whether a report does."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from typing import Any


@dataclass(frozen=True)
class Limits:
    """Upper bounds; None leaves a figure alone. Each is the flag --max-NAME of the command."""

    tick_p99_ms: float | None = None
    late_share: float | None = None
    volume_p99_ms: float | None = None
    megabits: float | None = None
    misses: int | None = None
    pops: int | None = None
    errors: int | None = None


def _late_share(report: dict[str, Any]) -> float | None:
    late, ticks = report["late_ticks"], report["ticks"]
    return None if late is None or ticks is None else late / max(ticks, 1)


_FIGURES: dict[str, tuple[str, Callable[[dict[str, Any]], float | None]]] = {
    "tick_p99_ms": ("99th percentile of the tick [ms]", lambda report: report["tick_ms"]["p99"]),
    "late_share": ("share of late ticks", _late_share),
    "volume_p99_ms": ("99th percentile of volume latency [ms]", lambda report: report["volume_ms"]["p99"]),
    "megabits": ("Mbit/s per player", lambda report: 8e-6 * report["bytes_per_second_per_player"]),
    "misses": ("misses", lambda report: report["misses"]),
    "pops": ("pops", lambda report: report["pops"]),
    "errors": ("errors", lambda report: report["errors"]),
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
