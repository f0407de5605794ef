"""How the ticks went: percentiles of the last minute, and counts since the start."""

from bisect import bisect_left
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from gi_core.live_world import TickReport

WINDOW = 1800  # a minute at 30 Hz
# Upper ends of a histogram's buckets [s]: from a tick that does nothing to one that takes all of the slowest rate's time.
BUCKETS_S = (0.0005, 0.001, 0.002, 0.004, 0.008, 0.016, 0.033, 0.066, 0.25, 1.0)


class TickTime(NamedTuple):
    """A tick, how long it took [ms], and how long after it was due it began [ms]."""

    tick: int
    ms: float
    lateness_ms: float


@dataclass(eq=False)
class TickStats:
    """Filled by the ticker, read by anybody; single values may be a tick apart.

    late_ticks : ended after the next was due; skipped : ticks whose time had passed before they could begin
    misses : sectors that volumes read and that were not there, summed over ticks
    bucket_counts : ticks that took no longer than each of BUCKETS_S and longer than the one before; the last: longer than all
    seconds : that all ticks took together
    """

    ticks: int = 0
    late_ticks: int = 0
    skipped: int = 0
    misses: int = 0
    relit: int = 0
    settled: int = 0
    volumes: int = 0
    loads: int = 0
    evictions: int = 0
    failed_ticks: int = 0
    recent: deque[TickTime] = field(default_factory=lambda: deque(maxlen=WINDOW))
    parts_ms: dict[str, deque[float]] = field(default_factory=dict)
    waiting: int = 0
    bucket_counts: list[int] = field(default_factory=lambda: [0] * (len(BUCKETS_S) + 1))
    seconds: float = 0.0

    def add(self, report: TickReport, took_ms: float, lateness_ms: float, period_ms: float) -> None:
        """Count a tick that began ``lateness_ms`` after it was due and took ``took_ms``."""
        self.ticks += 1
        self.late_ticks += lateness_ms + took_ms > period_ms
        self.misses += len(report.missing)
        self.relit += len(report.relit)
        self.settled += len(report.settled)
        self.volumes += len(report.filled)
        self.loads += len(report.loaded)
        self.evictions += len(report.evicted)
        self.waiting = report.waiting
        self.bucket_counts[bisect_left(BUCKETS_S, took_ms / 1e3)] += 1
        self.seconds += took_ms / 1e3
        self.recent.append(TickTime(report.tick, took_ms, lateness_ms))
        for name, value in report.ms.items():
            self.parts_ms.setdefault(name, deque(maxlen=WINDOW)).append(value)

    @property
    def tick_ms(self) -> dict[str, float]:
        """p50, p99 and max of what the last minute's ticks took [ms]; zeros before the first."""
        return percentiles(time.ms for time in list(self.recent))

    @property
    def lateness_ms(self) -> dict[str, float]:
        """The same of how late they began [ms]."""
        return percentiles(time.lateness_ms for time in list(self.recent))

    def later_than(self, tick: int) -> list[TickTime]:
        """The ticks of the last minute that came after one, in their order."""
        return [time for time in list(self.recent) if time.tick > tick]


def percentiles(values: Iterable[float]) -> dict[str, float]:
    """p50, p99 and max; zeros of nothing."""
    found = np.array(list(values) or [0.0])
    p50, p99 = np.percentile(found, [50, 99]).tolist()
    return {"p50": round(p50, 4), "p99": round(p99, 4), "max": round(float(found.max()), 4)}
