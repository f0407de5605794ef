"""The heartbeat by a clock made by hand: true to real time, one tick at once, every lost tick counted, and volumes shed before light."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from gi_core.dataset import Dataset
from gi_core.lighting import Lighting
from gi_core.live_world import TickReport
from gi_core.world import Location
from server.live_state import LiveState
from server.live_weather import fixed_weather
from server.ticker import FILL_UNTIL, Ticker
from server.world_clock import starting_clock

GOLDEN = Path(__file__).parents[1] / "golden" / "v1"
RATE = 32  # a power of two: with it the times below are exact
PERIOD_S = 1 / RATE
START_S = 1024.0


@dataclass
class Clock:
    """Stands in for the process's clock, and for the event that the ticker waits on; waits end late by what ``oversleep`` says [s]."""

    now: float = START_S
    oversleep: Callable[[], float] = lambda: 0.0
    stopped: bool = False

    def perf_counter(self) -> float:
        return self.now

    def is_set(self) -> bool:
        return self.stopped

    def set(self) -> None:
        self.stopped = True

    def wait(self, seconds: float) -> None:
        assert seconds > 0
        self.now += seconds + self.oversleep()


@dataclass
class SlowWorld:
    """A world whose tick after ``n`` others takes ``takes(n)`` seconds. It stops the clock after so many ticks."""

    clock: Clock
    ticks: int
    takes: Callable[[int], float]
    dataset: Dataset = field(default_factory=lambda: Dataset.open(GOLDEN))
    numbers: list[int] = field(default_factory=list)
    begun_s: list[float] = field(default_factory=list)
    fill_ms: list[float] = field(default_factory=list)
    is_ticking: bool = False
    undisturbed: Callable[[], AbstractContextManager[None]] = nullcontext

    def tick(self, number: int, players: object, light: object, boxes: object, fill_ms: float) -> TickReport:
        assert not self.is_ticking
        self.is_ticking = True
        self.numbers.append(number)
        self.begun_s.append(self.clock.now - START_S)
        self.fill_ms.append(fill_ms)
        if len(self.numbers) == self.ticks:
            self.clock.set()
        try:
            self.clock.now += self.takes(len(self.numbers) - 1)
        finally:
            self.is_ticking = False
        return TickReport(number)

    def close(self) -> None:
        pass


Beat = Callable[..., tuple[Ticker, SlowWorld]]


@pytest.fixture
def beat(monkeypatch: pytest.MonkeyPatch) -> Iterator[Beat]:
    """Runs some ticks of a slow world; a command before the first of them takes ``first_takes`` seconds."""
    made: list[Ticker] = []

    def run(
        ticks: int, takes: Callable[[int], float], oversleep: Callable[[], float] = lambda: 0.0, first_takes: float = 0.0
    ) -> tuple[Ticker, SlowWorld]:
        clock = Clock(oversleep=oversleep)
        world = SlowWorld(clock, ticks, takes)
        ticker = Ticker(world, LiveState(starting_clock(Location(), "12:00", RATE).with_paused(0, True), fixed_weather("clear")))
        made.append(ticker)
        monkeypatch.setattr(ticker, "_now", clock.perf_counter)
        monkeypatch.setattr(ticker, "_stop", clock)

        def dawdle(state: LiveState, number: int) -> LiveState:
            clock.now += first_takes
            return state

        ticker.apply(dawdle)
        ticker._beat()
        return ticker, world

    yield run
    for ticker in made:
        ticker.stop()


def test_nothing_drifts_however_late_the_process_is_woken(beat: Beat) -> None:
    rng = np.random.default_rng(0)
    ticker, world = beat(20_000, lambda _: float(rng.uniform(0, 0.5)) * PERIOD_S, lambda: float(rng.uniform(0, 0.4)) * PERIOD_S)
    assert world.numbers == list(range(20_000))
    late = np.array(world.begun_s) - np.arange(20_000) * PERIOD_S
    assert late.min() >= 0
    assert late.max() < 0.4 * PERIOD_S
    assert (ticker.stats.skipped, ticker.stats.late_ticks, ticker.stats.ticks) == (0, 0, 20_000)
    # And it says so: the last minute's.
    told = [time.lateness_ms for time in ticker.stats.recent]
    np.testing.assert_allclose(told, 1e3 * late[-len(told) :], atol=1e-6)
    assert ticker.stats.lateness_ms["p99"] == pytest.approx(0.4 * PERIOD_S * 1e3, rel=0.05)


def test_ticks_that_take_too_long_are_skipped_whole_and_counted(beat: Beat) -> None:
    """Each takes two and a half periods: every tick begins at once after the one before, under the number that real time has reached."""
    ticker, world = beat(100, lambda _: 2.5 * PERIOD_S)
    np.testing.assert_array_equal(world.begun_s, np.arange(100) * 2.5 * PERIOD_S)
    np.testing.assert_array_equal(world.numbers, np.floor(np.arange(100) * 2.5))
    assert ticker.stats.skipped == world.numbers[-1] + 1 - 100
    assert ticker.stats.late_ticks == ticker.stats.ticks == 100
    assert {time.lateness_ms for time in ticker.stats.recent} == {0.0, 0.5 * PERIOD_S * 1e3}


def test_a_tick_that_is_a_little_late_begins_at_once_and_the_next_in_time(beat: Beat) -> None:
    ticker, world = beat(5, lambda n: 1.25 * PERIOD_S if n == 1 else 0.0)
    assert world.numbers == [0, 1, 2, 3, 4]
    assert world.begun_s == [0.0, PERIOD_S, 2.25 * PERIOD_S, 3 * PERIOD_S, 4 * PERIOD_S]
    assert (ticker.stats.skipped, ticker.stats.late_ticks) == (0, 1)


def test_one_long_stall_costs_its_ticks_and_no_more(beat: Beat) -> None:
    ticker, world = beat(6, lambda n: 10.5 * PERIOD_S if n == 2 else 0.0)
    assert world.numbers == [0, 1, 2, 12, 13, 14]
    assert world.begun_s[3:] == [12.5 * PERIOD_S, 13 * PERIOD_S, 14 * PERIOD_S]
    assert (ticker.stats.skipped, ticker.stats.late_ticks) == (9, 1)
    assert [time.lateness_ms for time in ticker.stats.recent][3:] == [0.5 * PERIOD_S * 1e3, 0.0, 0.0]


def test_a_tick_that_fails_is_counted_and_the_next_is_in_time(beat: Beat) -> None:
    def takes(before: int) -> float:
        if before == 1:
            raise RuntimeError("this tick fails")
        return 0.0

    ticker, world = beat(4, takes)
    assert world.numbers == [0, 1, 2, 3]
    assert world.begun_s == [0.0, PERIOD_S, 2 * PERIOD_S, 3 * PERIOD_S]
    assert (ticker.stats.failed_ticks, ticker.stats.ticks, ticker.failure) == (1, 3, None)


def test_light_that_cannot_be_made_is_the_failure_of_the_tick_that_it_is_for(beat: Beat, monkeypatch: pytest.MonkeyPatch) -> None:
    """Short ticks make the next one's light."""
    make = Ticker._lighting_at

    def but_the_third(ticker: Ticker, number: int) -> Lighting:
        if number == 2:
            raise RuntimeError("no light")
        return make(ticker, number)

    monkeypatch.setattr(Ticker, "_lighting_at", but_the_third)
    ticker, world = beat(4, lambda _: 0.0)
    assert world.numbers == [0, 1, 3, 4]
    assert (ticker.stats.failed_ticks, ticker.stats.ticks, ticker.failure) == (1, 4, None)


def test_volumes_get_what_commands_and_light_leave_of_a_ticks_time(beat: Beat) -> None:
    _, world = beat(2, lambda _: 0.0, first_takes=0.25 * PERIOD_S)
    assert world.fill_ms == pytest.approx([(FILL_UNTIL - 0.25) * PERIOD_S * 1e3, FILL_UNTIL * PERIOD_S * 1e3])
    # None may be left; the world is lit all the same.
    _, world = beat(2, lambda _: 0.0, first_takes=0.75 * PERIOD_S)
    assert world.fill_ms[0] < 0
    assert world.numbers == [0, 1]
