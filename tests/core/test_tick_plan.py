"""Which sectors are relit: the players' own, the most needing, everybody in bounded time, and none that is settled."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gi_core.tick_plan import SETTLED_CHANGE, WEIGHT_RATIO, longest_wait, plan_tick, relight_need

LEAST = 5 * SETTLED_CHANGE  # worth a relight wherever players are


def arrays(relit_at, change, away):
    return np.array(relit_at, np.int64), np.array(change, float), np.array(away, float)


def test_an_idle_world_relights_nothing():
    assert plan_tick(1000, *arrays([0, 5, 900], [0, SETTLED_CHANGE, 0], [0, 50, 90])) == ()
    assert plan_tick(1000, *arrays([], [], [])) == ()
    assert plan_tick(1000, *arrays([0], [np.nan], [0])) == ()


def test_the_players_own_sector_and_the_one_that_needs_it_most():
    chosen = plan_tick(100, *arrays([99, 50, 90, 98], [0.1, 0.1, 0.1, 0.1], [0, 10, 10, 10]))
    assert chosen == (0, 1)


def test_a_settled_players_sector_leaves_its_place_to_others():
    assert plan_tick(100, *arrays([10, 50, 90, 98], [0, 0.1, 0.1, 0.1], [0, 10, 10, 10])) == (1, 2)


def test_what_nobody_is_near_to_counts_as_settled_sooner():
    change = [2 * SETTLED_CHANGE] * 4
    assert plan_tick(100, *arrays([0] * 4, change, [0, 50, 101, np.inf]), places=4) == (0, 1)
    assert plan_tick(100, *arrays([0] * 2, [5 * SETTLED_CHANGE] * 2, [1000, np.inf])) == (0, 1)


def test_need_grows_with_waiting_change_and_nearness():
    need = relight_need(100, *arrays([90, 80, 90, 90], [0.1, 0.1, 0.5, 0.1], [100, 100, 100, 40]))
    assert need[0] < min(need[1:])
    extremes = relight_need(1, *arrays([0] * 4, [LEAST, 1e9, 1e9, np.inf], [1e9, np.inf, 0, 0]))
    assert extremes.max() / extremes.min() == pytest.approx(WEIGHT_RATIO)


def test_two_places_are_the_least():
    with pytest.raises(ValueError, match="two places"):
        plan_tick(1, *arrays([0], [1], [0]), places=1)


class World:
    """Relights what plans say, and holds each plan to the rules; remembers the longest that anyone who wanted light waited."""

    def __init__(self, sectors: int, places: int) -> None:
        self.relit_at = np.zeros(sectors, np.int64)
        self.places, self.longest, self.tick = places, 0, 0

    def step(self, change: np.ndarray, away: np.ndarray) -> tuple[int, ...]:
        """All of them want light."""
        self.tick += 1
        chosen = plan_tick(self.tick, self.relit_at, change, away, places=self.places)
        assert len(set(chosen)) == len(chosen) == min(self.places, len(change))
        assert away.all() or not away[list(chosen)].all()
        waited = self.tick - self.relit_at
        self.longest = max(self.longest, int(waited.max()))
        self.relit_at[list(chosen)] = self.tick
        return chosen

    def load(self) -> None:
        self.relit_at = np.append(self.relit_at, self.tick)


@given(st.integers(1, 12), st.integers(2, 4), st.integers(0, 10**6), st.sampled_from(["steady", "changing", "one poor", "one place"]))
@settings(deadline=None, max_examples=40)
def test_everyone_who_wants_light_gets_it_within_the_bound(sectors: int, places: int, seed: int, kind: str) -> None:
    rng = np.random.default_rng(seed)
    world = World(sectors, places)
    bound = longest_wait(sectors, places=places)
    change, away = rng.uniform(LEAST, 2, sectors), rng.uniform(0, 400, sectors)
    away[rng.random(sectors) < 0.3] = 0.0
    if kind == "one poor":
        change[:], away[:] = 1.0, 1.0
        change[0], away[0] = LEAST, 1e9
    for _ in range(2 * bound):
        if kind == "changing":
            change, away = LEAST + 2 * rng.random(sectors) ** 8, np.maximum(400 * rng.random(sectors) ** 4 - 1, 0)
        if kind == "one place":
            away = np.where(np.arange(sectors) == 0, 0.0, np.maximum(away, 1.0))
        world.step(change, away)
    assert world.longest <= bound


def test_the_bound_is_not_idle_talk():
    """The poorest sector among nine does wait nearly that long, and an equal one does not wait longer than its turn."""
    poor, fair = World(9, 2), World(9, 2)
    change, away = np.ones(9), np.ones(9)
    away[1] = 0.0
    for _ in range(1000):
        fair.step(change, away)
    change[0], away[0] = LEAST, 1e9
    for _ in range(1000):
        poor.step(change, away)
    assert 0.6 * longest_wait(9) < poor.longest <= longest_wait(9)
    assert fair.longest == 8  # eight others share the one general place


@given(st.integers(0, 10**6))
@settings(deadline=None, max_examples=15)
def test_sectors_that_arrive_all_the_time_starve_nobody(seed: int) -> None:
    rng = np.random.default_rng(seed)
    world = World(4, 2)
    for k in range(200):
        if k % 7 == 0:
            world.load()
        count = len(world.relit_at)
        world.step(rng.uniform(LEAST, 1, count), np.maximum(rng.uniform(-30, 300, count), 0))
        assert world.longest <= longest_wait(count)


def test_fifty_players_sectors_take_turns():
    world = World(80, 2)
    away = np.where(np.arange(80) < 30, 0.0, 50.0)
    for _ in range(300):
        world.step(np.ones(80), away)
    # One place is theirs alone: 30 of them, each in its turn; the rest share the other.
    assert (world.tick - world.relit_at[:30]).max() <= 30
    assert world.longest <= 80
