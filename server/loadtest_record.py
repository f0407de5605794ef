"""What a load test sees, second by second, and the figures it comes to."""

import math
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

# Different errors that a report quotes; all are counted.
MAX_QUOTED_ERRORS = 20
# The server is asked once a second, so a jump is seen up to a second late, and what it does to the light takes some ticks.
SECONDS_AROUND_A_JUMP = 2


@dataclass
class Second:
    """Sums over one second of the test."""

    latency_ms: list[float] = field(default_factory=list)
    bytes: int = 0
    frames: int = 0
    pops: int = 0
    errors: int = 0


@dataclass(frozen=True)
class Live:
    """What ``GET /v1/live`` said [at seconds since the start]; a member that it did not have is missing here too."""

    at: float
    members: dict[str, Any]

    def number(self, *names: str) -> float | None:
        """A member, or a member of a member; None when it is not a finite number."""
        value: Any = self.members
        for name in names:
            value = value.get(name) if isinstance(value, dict) else None
        return float(value) if isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value) else None


class Recorder:
    """Collects from all clients of one test. Times are seconds since its start."""

    def __init__(self) -> None:
        self.seconds: defaultdict[int, Second] = defaultdict(Second)
        self.jumps: set[int] = set()
        self.live: list[Live] = []
        self.errors: Counter[str] = Counter()
        self.full_frames = 0
        self.unjudged_frames = 0

    def message(self, at: float, size: int, latency_ms: float | None) -> None:
        """Some client received a volume or a part of one."""
        second = self.seconds[int(at)]
        second.bytes += size
        second.frames += 1
        if latency_ms is not None:
            second.latency_ms.append(latency_ms)

    def pops(self, at: float, count: int) -> None:
        """So many voxels of one client changed more than they may between two ticks."""
        self.seconds[int(at)].pops += count

    def error(self, at: float, text: str) -> None:
        """Something failed that must not."""
        self.seconds[int(at)].errors += 1
        self.errors[text if text in self.errors or len(self.errors) < MAX_QUOTED_ERRORS else "others"] += 1

    def jump(self, at: float) -> None:
        """The world jumped at most a second ago: light may change at once around then."""
        self.jumps.update(range(int(at) - SECONDS_AROUND_A_JUMP, int(at) + SECONDS_AROUND_A_JUMP + 1))

    def total(self, name: str) -> int:
        """Sum of a member of ``Second``."""
        return sum(getattr(second, name) for second in self.seconds.values())

    def pops_outside_jumps(self) -> int:
        """Pops that no jump of the world explains."""
        return sum(second.pops for number, second in self.seconds.items() if number not in self.jumps)

    def latencies(self) -> list[float]:
        """All of them [ms], in no order."""
        return [value for second in self.seconds.values() for value in second.latency_ms]

    def gained(self, *names: str) -> int | None:
        """By how much a counter of the server grew during the test."""
        first, last = (snapshot.number(*names) if snapshot else None for snapshot in self._ends())
        return None if first is None or last is None else round(last - first)

    def last(self, *names: str) -> float | None:
        """What a member of the server's figures was at the end."""
        last = self._ends()[1]
        return None if last is None else last.number(*names)

    def largest(self, *names: str) -> float | None:
        """The largest that a member was during the test."""
        values = [value for snapshot in self.live if (value := snapshot.number(*names)) is not None]
        return max(values, default=None)

    def _ends(self) -> tuple[Live | None, Live | None]:
        return (self.live[0], self.live[-1]) if self.live else (None, None)


def percentile(values: Sequence[float], share: float) -> float | None:
    """The value that ``share`` of the values do not exceed, or None of none."""
    return float(np.quantile(values, share, method="inverted_cdf")) if len(values) else None


@dataclass(frozen=True)
class Setting:
    """How a test was run: what a report repeats."""

    players: int
    mode: str
    speed: float
    pop_bound: float
    same_clock: bool


def report_of(recorder: Recorder, setting: Setting, seconds: float, cpu_share: float, interrupted: bool) -> dict[str, Any]:
    """The report as JSON. Server figures that were not to be had are None."""
    offset = 0.0
    latencies = recorder.latencies()
    if setting.mode == "stream" and latencies and (not setting.same_clock or min(latencies) < 0):
        offset = min(latencies)  # two machines' clocks differ by more than a network takes: only the differences mean something
    total_bytes = recorder.total("bytes")
    pops = recorder.pops_outside_jumps()
    return {
        "players": setting.players,
        "seconds": round(seconds, 3),
        "tick_ms": {
            "p50": recorder.last("tick_ms", "p50"),
            "p99": recorder.last("tick_ms", "p99"),
            "max": recorder.largest("tick_ms", "max"),
        },
        "late_ticks": recorder.gained("late_ticks"),
        "volume_ms": {f"p{n}": _shifted(percentile(latencies, n / 100), offset) for n in (50, 99)},
        "bytes_per_second_per_player": round(total_bytes / seconds / setting.players, 1) if seconds > 0 and setting.players else 0.0,
        "misses": recorder.gained("misses"),
        "pops": pops,
        "errors": recorder.total("errors"),
        "mode": setting.mode,
        "speed": setting.speed,
        "ticks": recorder.gained("ticks"),
        "tick_rate": recorder.last("tick_rate"),
        "volume_ms_since": "the quickest frame" if offset else "the tick" if setting.mode == "stream" else "the request",
        "frames": recorder.total("frames"),
        "full_frames": recorder.full_frames,
        "frames_not_judged": recorder.unjudged_frames,
        "pop_bound": setting.pop_bound,
        "pops_in_jumps": recorder.total("pops") - pops,
        "relit": recorder.gained("relit"),
        "resident_sectors": recorder.last("resident_sectors"),
        "resident_bytes": recorder.last("resident_bytes"),
        "memory_bytes": recorder.last("memory_bytes"),
        "memory_bytes_gained": recorder.gained("memory_bytes"),
        "cache": _cache(recorder),
        "client_cpu_share": round(cpu_share, 3),
        "interrupted": interrupted,
        "error_messages": dict(recorder.errors),
        "per_second": _per_second(recorder, setting, seconds, offset),
    }


def _shifted(value: float | None, offset: float) -> float | None:
    return None if value is None else round(value - offset, 3)


def _cache(recorder: Recorder) -> dict[str, int | None]:
    """How the server's cache counters grew."""
    members = recorder.live[-1].members.get("cache") if recorder.live else None
    return {name: recorder.gained("cache", name) for name in sorted(members)} if isinstance(members, dict) else {}


def _per_second(recorder: Recorder, setting: Setting, seconds: float, offset: float) -> list[dict[str, Any]]:
    """One object for each second that was whole."""
    rows = []
    for number in range(int(seconds)):
        second = recorder.seconds.get(number, Second())
        until = [snapshot for snapshot in recorder.live if snapshot.at <= number + 1]
        before = [snapshot for snapshot in until if snapshot.at <= number]
        row: dict[str, Any] = {
            "volume_ms_p50": _shifted(percentile(second.latency_ms, 0.5), offset),
            "volume_ms_p99": _shifted(percentile(second.latency_ms, 0.99), offset),
            "bytes_per_player": round(second.bytes / setting.players, 1),
            "frames": second.frames,
            "pops": second.pops,
            "errors": second.errors,
            "jump": number in recorder.jumps,
        }
        for name in ("p50", "p99"):
            row[f"tick_ms_{name}"] = until[-1].number("tick_ms", name) if until else None
        for name in ("late_ticks", "misses"):
            last, first = (ends[-1].number(name) if ends else None for ends in (until, before))
            row[name] = None if last is None or first is None else round(last - first)
        rows.append(row)
    return rows
