"""How the ticks went: percentiles of the last minute, and counts since the start."""

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from gi_core.live_world import TickReport

WINDOW = 1800  # a minute at 30 Hz


@dataclass(eq=False)
class TickStats:
    """Filled by the ticker, read by anybody; single values may be a tick apart.

    late_ticks : ended after the next was due; skipped : ticks whose time had passed before they could begin
    misses : sectors that volumes read and that were not there, summed over ticks
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
    recent_ms: deque[float] = field(default_factory=lambda: deque(maxlen=WINDOW))
    recent_lateness_ms: deque[float] = field(default_factory=lambda: deque(maxlen=WINDOW))
    parts_ms: dict[str, deque[float]] = field(default_factory=dict)
    waiting: int = 0

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
        self.recent_ms.append(took_ms)
        self.recent_lateness_ms.append(lateness_ms)
        for name, value in report.ms.items():
            self.parts_ms.setdefault(name, deque(maxlen=WINDOW)).append(value)

    def percentiles(self) -> dict[str, float]:
        """p50, p99 and max of the last minute's ticks [ms]; zeros before the first."""
        return percentiles(self.recent_ms)


def percentiles(values: "deque[float]") -> dict[str, float]:
    """p50, p99 and max; zeros of nothing."""
    found = np.array(list(values) or [0.0])
    p50, p99 = np.percentile(found, [50, 99]).tolist()
    return {"p50": round(p50, 4), "p99": round(p99, 4), "max": round(float(found.max()), 4)}
