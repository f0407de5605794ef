"""Which volumes are filled when time is short: those whose light changed near their player first, and everybody's in bounded time."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from gi_core.fill_plan import RIM_M, WEIGHT_RATIO, fill_order, longest_wait


class Crowd:
    """Volumes that fall behind again right after they are filled, ``filled`` of them in each tick."""

    def __init__(self, players: int, filled: int) -> None:
        self.since, self.fills = np.zeros(players, np.int64), np.zeros(players, int)
        self.filled, self.tick, self.longest = filled, -1, 0

    def step(self, away_m: np.ndarray) -> None:
        self.tick += 1
        order = fill_order(self.tick, self.since, away_m)
        assert sorted(order) == list(range(len(self.since)))
        self.longest = max(self.longest, int((self.tick - self.since + 1).max()))
        chosen = order[: self.filled]
        self.since[chosen] = self.tick + 1
        self.fills[chosen] += 1


def test_those_who_wait_alike_are_served_by_nearness_and_alike_ones_in_their_order():
    away = np.array([30.0, 0.0, 1e9, 10.0, 0.0, 2 * RIM_M])
    assert fill_order(7, np.full(6, 5), away).tolist() == [1, 4, 3, 0, 2, 5]
    assert fill_order(0, np.zeros(0, np.int64), np.zeros(0)).tolist() == []


def test_a_far_change_waits_until_its_age_outweighs_a_near_one():
    away = np.array([0.0, np.inf])
    just_not = int(WEIGHT_RATIO) - 1
    assert fill_order(10, np.array([10, 11 - just_not]), away)[0] == 0
    assert fill_order(10, np.array([10, 10 - just_not - 1]), away)[0] == 1


def test_far_players_rate_falls_first_and_to_a_quarter():
    """Ten near and ten far; time for 20 volumes a tick, and less and less of it."""
    away = np.repeat([0.0, RIM_M], 10)
    rates = {}
    for filled in (20, 15, 13, 5):
        crowd = Crowd(20, filled)
        for _ in range(400):
            crowd.step(away)
        rates[filled] = crowd.fills[:10].mean() / 400, crowd.fills[10:].mean() / 400
    assert rates[20] == (1.0, 1.0)
    for filled in (15, 13):  # near ones lose nothing while far ones may lose more
        near, far = rates[filled]
        assert near == 1.0
        assert far == (filled - 10) / 10
    near, far = rates[5]
    # A quarter, but for whole ticks of waiting.
    assert near + far == 0.5
    assert 0.2 < far / near < 0.3


@given(st.integers(1, 40), st.integers(1, 6), st.integers(0, 10**6), st.sampled_from(["steady", "changing", "one far"]))
@settings(deadline=None, max_examples=40)
def test_everybodys_volume_is_filled_within_the_bound(players: int, filled: int, seed: int, kind: str) -> None:
    rng = np.random.default_rng(seed)
    crowd, bound = Crowd(players, filled), longest_wait(players, filled=filled)
    away = rng.uniform(0, 1.5 * RIM_M, players)
    if kind == "one far":
        away[:], away[0] = 0.0, np.inf
    for _ in range(2 * bound):
        if kind == "changing":
            away = 2 * RIM_M * rng.random(players) ** 4
        crowd.step(away)
    assert crowd.longest <= bound


def test_the_bound_is_not_idle_talk():
    crowd = Crowd(9, 2)
    for _ in range(1000):
        crowd.step(np.where(np.arange(9) == 0, np.inf, 0.0))
    assert 0.6 * longest_wait(9, filled=2) < crowd.longest <= longest_wait(9, filled=2)
