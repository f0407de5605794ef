"""What a load test sees, second by second, and the figures it comes to."""

from bisect import bisect_right
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

# What a server says of itself is 0 or within these; anything else is no figure, and no sum or quotient of figures is beyond float.
LEAST_FIGURE, LARGEST_FIGURE = 1e-9, 1e15
# Different errors that a report quotes; all are counted.
MAX_QUOTED_ERRORS = 20
# The server is asked once a second, so a jump is seen up to a second late, and what it does to the light takes some ticks.
SECONDS_AROUND_A_JUMP = 2


@dataclass
class Second:
    """One second of the test: its sums, and what its ticks took and how late they began."""

    latency_ms: list[float] = field(default_factory=list)
    tick_ms: list[float] = field(default_factory=list)
    lateness_ms: list[float] = field(default_factory=list)
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
        """A member, or a member of a member; None when it is no figure."""
        value: Any = self.members
        for name in names:
            value = value.get(name) if isinstance(value, dict) else None
        return float(value) if _is_figure(value) else None

    def ticks(self) -> tuple[list[int], list[float], list[float]]:
        """The ticks that it tells of one by one: their numbers, what each took [ms], how late each began [ms]. Raises ValueError."""
        try:
            numbers, took_ms, lateness_ms = (list(self.members["recent"][name]) for name in ("tick", "ms", "lateness_ms"))
        except (KeyError, TypeError) as error:
            raise ValueError(f"expected members tick, ms and lateness_ms of recent ({error})") from error
        if not len(numbers) == len(took_ms) == len(lateness_ms) or not all(map(_is_figure, (*numbers, *took_ms, *lateness_ms))):
            raise ValueError("expected as many figures in tick, ms and lateness_ms of recent")
        return [int(n) for n in numbers], [float(ms) for ms in took_ms], [float(ms) for ms in lateness_ms]


def _is_figure(value: Any) -> bool:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return is_number and (value == 0 or LEAST_FIGURE <= abs(value) <= LARGEST_FIGURE)


class Recorder:
    """Collects from all clients of one test. Times are seconds since its start."""

    def __init__(self) -> None:
        self.seconds: defaultdict[int, Second] = defaultdict(Second)
        self.jumps: set[int] = set()
        self.live: list[Live] = []
        self.known_tick: int | None = None
        """The last tick of the server's that is taken in, or from before the test; None before it has told of any."""
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

    def server(self, said: Live) -> None:
        """The server said how it does, and how each tick went that is later than ``known_tick``. Raises ValueError where it did not."""
        self.live.append(said)
        tick, rate = said.number("tick"), said.number("tick_rate")
        if tick is None or rate is None or rate <= 0:
            return
        if self.known_tick is None:
            self.known_tick = int(tick) - 1  # the tick itself may not be over
            return
        numbers, took_ms, lateness_ms = said.ticks()
        for number, took, lateness in zip(numbers, took_ms, lateness_ms, strict=True):
            second = self.seconds[int(max(said.at - (tick - number) / rate, 0.0))]
            second.tick_ms.append(took)
            second.lateness_ms.append(lateness)
        # A server that was started anew counts from 0 again.
        self.known_tick = numbers[-1] if numbers else min(self.known_tick, int(tick))

    def jump(self, at: float) -> None:
        """The world jumped at most a second ago: light may change at once around then."""
        self.jumps.update(range(int(at) - SECONDS_AROUND_A_JUMP, int(at) + SECONDS_AROUND_A_JUMP + 1))

    def total(self, name: str) -> int:
        """Sum of a member of ``Second``."""
        return sum(getattr(second, name) for second in self.seconds.values())

    def pops_outside_jumps(self) -> int:
        """Pops that no jump of the world explains."""
        return sum(second.pops for number, second in self.seconds.items() if number not in self.jumps)

    def every(self, name: str) -> list[float]:
        """All values of a list of ``Second`` [ms], in no order."""
        return [value for second in self.seconds.values() for value in getattr(second, name)]

    def gained(self, *names: str) -> int | None:
        """By how much a counter of the server grew during the test."""
        first, last = (snapshot.number(*names) if snapshot else None for snapshot in self._ends())
        return None if first is None or last is None else round(last - first)

    def last(self, *names: str) -> float | None:
        """What a member of the server's figures was at the end."""
        last = self._ends()[1]
        return None if last is None else last.number(*names)

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
    latencies = recorder.every("latency_ms")
    if setting.mode == "stream" and latencies and (not setting.same_clock or min(latencies) < 0):
        offset = min(latencies)  # two machines' clocks differ by more than a network takes: only the differences mean something
    total_bytes = recorder.total("bytes")
    pops = recorder.pops_outside_jumps()
    return {
        "players": setting.players,
        "seconds": round(seconds, 3),
        "tick_ms": _summary(recorder.every("tick_ms")),
        "lateness_ms": _summary(recorder.every("lateness_ms")),
        "late_ticks": recorder.gained("late_ticks"),
        "skipped": recorder.gained("skipped"),
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


def _summary(values: Sequence[float]) -> dict[str, float | None]:
    """p50, p99 and max [ms] of the whole test; None of nothing."""
    shares = {"p50": 0.5, "p99": 0.99, "max": 1.0}
    return {name: _shifted(percentile(values, share), 0.0) for name, share in shares.items()}


def _shifted(value: float | None, offset: float) -> float | None:
    return None if value is None else round(value - offset, 3)


def _cache(recorder: Recorder) -> dict[str, int | None]:
    """How the server's cache counters grew."""
    members = recorder.live[-1].members.get("cache") if recorder.live else None
    return {name: recorder.gained("cache", name) for name in sorted(members)} if isinstance(members, dict) else {}


def _per_second(recorder: Recorder, setting: Setting, seconds: float, offset: float) -> list[dict[str, Any]]:
    """One object for each second that was whole."""
    rows = []
    asked_at = [said.at for said in recorder.live]

    def said_until(at: float) -> Live | None:
        count = bisect_right(asked_at, at)
        return recorder.live[count - 1] if count else None

    for number in range(int(seconds)):
        second = recorder.seconds.get(number, Second())
        before, until = said_until(number), said_until(number + 1)
        row: dict[str, Any] = {
            "volume_ms_p50": _shifted(percentile(second.latency_ms, 0.5), offset),
            "volume_ms_p99": _shifted(percentile(second.latency_ms, 0.99), offset),
            "bytes_per_player": round(second.bytes / setting.players, 1),
            "frames": second.frames,
            "pops": second.pops,
            "errors": second.errors,
            "jump": number in recorder.jumps,
        }
        for name in ("tick_ms", "lateness_ms"):
            row |= {f"{name}_{key}": value for key, value in _summary(getattr(second, name)).items() if key != "max"}
        for name in ("late_ticks", "skipped", "misses"):
            last, first = (None if said is None else said.number(name) for said in (until, before))
            row[name] = None if last is None or first is None else round(last - first)
        row["memory_bytes"] = None if until is None else until.number("memory_bytes")
        rows.append(row)
    return rows
