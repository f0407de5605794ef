"""Streaming plans: what is needed is there in time, the budget holds, and nothing is loaded twice that could have been kept."""

from collections import Counter
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from gi_core import stream_need
from gi_core.grid import SectorIndex, sector_of, volume_first_voxel
from gi_core.stream_need import SectorTable, distance_m, sector_needs
from gi_core.stream_plan import StreamOptions, StreamPlan, StreamState, plan_streaming, retry_delay_s
from gi_core.volume import plan_boxes

HALF_SIDE = 9  # the test's world: 18 x 18 sectors, 1.15 km, with holes
MARGINS = {"look_ahead_s": 3.0, "load_margin_m": 16.0, "keep_margin_m": 64.0}


def make_table(seed: int, holes: float = 0.1) -> SectorTable:
    rng = np.random.default_rng(seed)
    places = [SectorIndex(x, z) for x in range(-HALF_SIDE, HALF_SIDE) for z in range(-HALF_SIDE, HALF_SIDE)]
    return SectorTable.of({place: int(rng.integers(1, 40)) for place in places if rng.random() >= holes})


def volume_sectors(position: np.ndarray) -> set[SectorIndex]:
    return {box.index for box in plan_boxes(volume_first_voxel(position))}


def rows_of(table: SectorTable, sectors: tuple[SectorIndex, ...]) -> list[int]:
    return [table.sectors.index(sector) for sector in sectors]


class Streamer:
    """Carries plans out, each load taking ``latency_s``; holds every plan to the rules that always hold."""

    def __init__(self, table: SectorTable, options: StreamOptions, latency_s: float = 0.1) -> None:
        self.table, self.options, self.latency_s = table, options, latency_s
        self.state = StreamState.empty(table)
        self.now_s = 0.0
        self.loads: Counter[SectorIndex] = Counter()
        self._done_at: dict[int, float] = {}

    def step(self, positions: np.ndarray, velocities: np.ndarray, dt: float) -> StreamPlan:
        self.now_s += dt
        for row in [row for row, at in self._done_at.items() if at <= self.now_s]:
            del self._done_at[row]
            self.state.loading[row] = False
            self.state.resident_bytes[row] = self.table.bytes[row]
        plan = plan_streaming(self.table, self.state, positions, velocities, now_s=self.now_s, options=self.options)
        for row in rows_of(self.table, plan.evictions):
            assert self.state.resident_bytes[row] > 0
            self.state.resident_bytes[row] = 0
        for row in rows_of(self.table, plan.loads):
            assert not self.state.loading[row]
            assert self.state.resident_bytes[row] == 0
            self.state.loading[row] = True
            self._done_at[row] = self.now_s + self.latency_s
        self.loads.update(plan.loads)
        used = self.state.resident_bytes.sum() + self.table.bytes[self.state.loading].sum()
        assert used <= self.options.budget_bytes
        return plan

    def settle(self, positions: np.ndarray, velocities: np.ndarray) -> None:
        """Until a plan has nothing to do."""
        for _ in range(400):
            plan = self.step(positions, velocities, self.latency_s)
            if not plan.loads and not self.state.loading.any():
                return
        raise AssertionError("a standing world never settles")


positions_of = st.lists(st.tuples(st.floats(-700, 700), st.floats(-700, 700)), max_size=6)
speeds = st.sampled_from([0.0, 1e-9, 1.0, 5.0, 30.0, 200.0])


def players(places: list[tuple[float, float]], speed: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    positions = np.array([(x, 1.5, z) for x, z in places]).reshape(-1, 3)
    heading = np.random.default_rng(seed).choice([0.0, 0.5, 1.0, 1.5, 0.3, 1.8], len(places)) * np.pi
    return positions, speed * np.stack([np.cos(heading), np.zeros(len(places)), np.sin(heading)], axis=1)


@given(positions_of, speeds, st.integers(0, 99))
@settings(deadline=None, max_examples=30)
def test_needs_cover_every_volume_on_the_way(places: list[tuple[float, float]], speed: float, seed: int) -> None:
    table = make_table(seed)
    positions, velocities = players(places, speed, seed)
    needs = sector_needs(table, positions, velocities, **MARGINS)
    touched = {sector for position in positions for sector in volume_sectors(position)} & set(table.sectors)
    assert {table.sectors[row] for row in np.flatnonzero(needs.touched)} == touched
    assert not needs.keep_s[needs.touched].any()
    assert not needs.ahead_s[needs.touched].any()
    assert (needs.keep_s <= needs.ahead_s).all()
    for t in np.linspace(0, MARGINS["look_ahead_s"], 13):
        for position, velocity in zip(positions, velocities, strict=True):
            met = volume_sectors(position + t * velocity) & set(table.sectors)
            assert all(needs.ahead_s[row] <= t for row in rows_of(table, tuple(met)))
    # And no more than that: a sector that is wanted comes within the load margin of a volume by then.
    for row in np.flatnonzero(np.isfinite(needs.ahead_s)):
        at = positions + needs.ahead_s[row] * velocities
        assert distance_m(table.places[row : row + 1], at)[0] <= 50 + MARGINS["load_margin_m"] + 1e-6
    reach = distance_m(table.places, positions)
    np.testing.assert_allclose(needs.away_m[needs.touched], reach[needs.touched])
    assert np.isfinite(needs.keep_s[reach <= 50 + MARGINS["keep_margin_m"]]).all()
    assert np.isinf(needs.keep_s[reach > 50 + MARGINS["keep_margin_m"] + 3 * speed + 1e-6]).all()


@given(positions_of, speeds, st.integers(0, 99))
@settings(deadline=None, max_examples=25)
def test_needs_are_the_same_however_players_are_grouped_and_sectors_found(
    places: list[tuple[float, float]], speed: float, seed: int
) -> None:
    table = make_table(seed)
    positions, velocities = players(places, speed, seed)
    velocities[: len(places) // 2] /= 40
    whole = sector_needs(table, positions, velocities, **MARGINS)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stream_need, "_FEW_PAIRS", 0)
        patch.setattr(stream_need, "_SLOW_REACH", 1)
        patch.setattr(stream_need, "_MOST_GRID_CELLS", 0)
        searched = sector_needs(make_table(seed), positions, velocities, **MARGINS)
    for name in ("touched", "ahead_s", "keep_s", "away_m"):
        np.testing.assert_array_equal(getattr(whole, name), getattr(searched, name))


@given(st.data())
@settings(deadline=None, max_examples=80)
def test_any_plan_obeys_the_rules(data: st.DataObject) -> None:
    seed = data.draw(st.integers(0, 999))
    rng = np.random.default_rng(seed)
    table = make_table(seed)
    positions, velocities = players(data.draw(positions_of), data.draw(speeds), seed)
    count = len(table.sectors)
    kind = rng.choice(3, count, p=data.draw(st.sampled_from([[1, 0, 0], [0.5, 0.45, 0.05], [0.2, 0.8, 0], [0.9, 0.05, 0.05]])))
    state = StreamState(np.where(kind == 1, table.bytes, 0), kind == 2, rng.choice([0.0, 5.0, 20.0], count))
    options = StreamOptions(data.draw(st.sampled_from([1, 50, 300, 1000, 10**6])), max_loading=data.draw(st.sampled_from([1, 4, 500])))
    plan = plan_streaming(table, state, positions, velocities, now_s=10.0, options=options)
    loads, evictions, left_out = (rows_of(table, rows) for rows in (plan.loads, plan.evictions, plan.left_out))
    needs = sector_needs(table, positions, velocities, **MARGINS)

    assert len(set(loads)) == len(loads)
    assert len(set(evictions)) == len(evictions)
    assert len(loads) <= max(options.max_loading - state.loading.sum(), 0)
    for row in loads:
        assert state.resident_bytes[row] == 0
        assert not state.loading[row]
        assert state.retry_at_s[row] <= 10.0
        assert np.isfinite(needs.ahead_s[row])
    assert [needs.ahead_s[row] for row in loads] == sorted(needs.ahead_s[row] for row in loads)
    assert all(state.resident_bytes[row] > 0 for row in evictions)
    stays = (state.resident_bytes > 0) & ~np.isin(np.arange(count), evictions)
    reserved = table.bytes[state.loading].sum()
    assert state.resident_bytes[stays].sum() + reserved + table.bytes[loads].sum() <= max(options.budget_bytes, reserved)
    assert not stays.any() or options.budget_bytes >= reserved + state.resident_bytes[stays].sum()
    # Least needed first, and what a volume reads last.
    gone = [row for row in evictions if not needs.touched[row]]
    kept = stays & ~needs.touched
    assert not gone or not kept.any() or min(needs.keep_s[row] for row in gone) >= needs.keep_s[kept].max()
    if table.bytes[needs.touched].sum() + table.bytes[state.loading & ~needs.touched].sum() <= options.budget_bytes:
        assert left_out == []
        assert not needs.touched[evictions].any()
        waiting = needs.touched & (state.resident_bytes == 0) & ~state.loading & (state.retry_at_s <= 10.0)
        assert len(loads) == max(options.max_loading - state.loading.sum(), 0) or set(np.flatnonzero(waiting)) <= set(loads)
    assert set(plan.missing) == {table.sectors[row] for row in np.flatnonzero(needs.touched & (state.resident_bytes == 0))}
    assert set(left_out) <= set(np.flatnonzero(needs.touched))
    if options.budget_bytes == 10**6:
        assert evictions == []


@given(positions_of, speeds, st.integers(0, 99), st.sampled_from([40, 120, 400, 1200]))
@settings(deadline=None, max_examples=25)
def test_who_stands_still_has_each_sector_loaded_once(places: list[tuple[float, float]], speed: float, seed: int, budget: int) -> None:
    positions, velocities = players(places, speed, seed)
    assume((np.abs(positions[:, [0, 2]] - 64 * np.round(positions[:, [0, 2]] / 64)) > 1e-6).all())  # on a border, two sectors are nearest
    streamer = Streamer(make_table(seed), StreamOptions(budget))
    streamer.settle(positions, velocities)
    assert max(streamer.loads.values(), default=0) <= 1
    final = streamer.step(positions, velocities, 1.0)
    assert final.loads == final.evictions == ()
    assert set(final.missing) == set(final.left_out)
    # Where volumes' sectors alone do not fit, those that players stand in are there first.
    standing = {sector_of(position) for position in positions} & set(streamer.table.sectors)
    if streamer.table.bytes[rows_of(streamer.table, tuple(standing))].sum() <= budget:
        assert not standing & set(final.missing)


def random_path(seed: int, speed: float) -> Callable[[float], tuple[np.ndarray, np.ndarray]]:
    """Position and velocity over time on legs of 5 to 150 m, in any direction, inside the world."""
    rng = np.random.default_rng(seed)
    corners = [np.array([0.0, 1.5, 0.0])]
    while len(corners) < 400:
        angle, length = rng.uniform(0, 2 * np.pi), rng.uniform(5, 150)
        corner = corners[-1] + length * np.array([np.cos(angle), 0, np.sin(angle)])
        if np.abs(corner).max() < 64 * HALF_SIDE - 1:
            corners.append(corner)
    legs = np.diff(corners, axis=0)
    length = np.linalg.norm(legs, axis=1)
    start = np.concatenate([[0.0], np.cumsum(length) / speed])

    def at(t: float) -> tuple[np.ndarray, np.ndarray]:
        leg = int(np.searchsorted(start, t, side="right")) - 1
        velocity = legs[leg] * (speed / length[leg])
        return corners[leg] + (t - start[leg]) * velocity, velocity

    return at


@pytest.mark.parametrize("speed", [1.0, 5.0, 30.0])
@pytest.mark.parametrize("seed", range(3))
def test_a_player_never_meets_a_sector_that_is_not_there(speed: float, seed: int) -> None:
    """Stronger than never standing in one: the whole volume is there, at any time, whatever way the path turns."""
    table = make_table(seed, holes=0.0)
    streamer = Streamer(table, StreamOptions(budget_bytes=40 * 30), latency_s=0.1)
    path = random_path(seed, speed)
    streamer.settle(*(v[None] for v in path(0.0)))
    plan_every = 1 / 10
    for k in range(500):
        position, velocity = path(k * plan_every)
        plan = streamer.step(position[None], velocity[None], plan_every)
        assert plan.missing == (), f"at {k * plan_every:.1f} s, {position}"
        assert plan.left_out == ()
    assert len(streamer.loads) > (10 if speed == 1.0 else 20)


@pytest.mark.parametrize("seed", range(2))
def test_ten_drivers_share_a_budget_without_a_miss(seed: int) -> None:
    table = make_table(seed, holes=0.0)
    streamer = Streamer(table, StreamOptions(budget_bytes=200 * 20, max_loading=8))
    paths = [random_path(100 * seed + k, 30.0) for k in range(10)]

    def at(t: float) -> tuple[np.ndarray, np.ndarray]:
        states = [path(t) for path in paths]
        return np.array([p for p, _ in states]), np.array([v for _, v in states])

    streamer.settle(*at(0.0))
    for k in range(200):
        assert streamer.step(*at(k / 10), 0.1).missing == ()


@pytest.mark.parametrize("speed", [1.0, 5.0, 30.0])
@pytest.mark.parametrize("half_way_m", [3.0, 30.0])
def test_to_and_fro_over_a_border_loads_nothing_twice(speed: float, half_way_m: float) -> None:
    """Even with memory full of other places, as after a long walk."""
    table = make_table(5, holes=0.0)
    around = distance_m(table.places, np.array([[0.0, 1.5, 10.0]])) <= 50 + 64 + 3 * speed + half_way_m
    streamer = Streamer(table, StreamOptions(budget_bytes=int(table.bytes[around].sum())))
    rows = np.flatnonzero(~around)
    full = np.cumsum(table.bytes[rows]) <= streamer.options.budget_bytes
    streamer.state.resident_bytes[rows[full]] = table.bytes[rows[full]]
    period = 4 * half_way_m / speed
    step = 1.0 / speed  # a metre
    for k in range(int(3 * period / step)):
        phase = (k * step / period) % 1
        x = half_way_m * (4 * phase - 1 if phase < 0.5 else 3 - 4 * phase)
        velocity = speed if phase < 0.5 else -speed
        streamer.step(np.array([[x, 1.5, 10.0]]), np.array([[velocity, 0.0, 0.0]]), step)
    assert len(streamer.loads) >= 4
    assert set(streamer.loads.values()) == {1}


def test_a_sector_that_failed_waits_and_the_others_do_not_wait_for_it() -> None:
    table = make_table(1, holes=0.0)
    state = StreamState.empty(table)
    here = table.sectors.index(SectorIndex(0, 0))
    state.retry_at_s[here] = 7.0
    position, still = np.array([[10.0, 1.5, 10.0]]), np.zeros((1, 3))
    options = StreamOptions(10**6, max_loading=100)
    before = plan_streaming(table, state, position, still, now_s=6.9, options=options)
    assert SectorIndex(0, 0) not in before.loads
    assert len(before.loads) >= 4
    assert SectorIndex(0, 0) in before.missing
    after = plan_streaming(table, state, position, still, now_s=7.0, options=options)
    assert after.loads[0] == SectorIndex(0, 0)


def test_retries_wait_longer_and_longer_up_to_a_minute() -> None:
    delays = [retry_delay_s(n) for n in range(1, 100)]
    assert delays[:4] == [0.5, 1.0, 2.0, 4.0]
    assert delays == sorted(delays)
    assert delays[-1] == 60.0 == retry_delay_s(10**9)
    assert retry_delay_s(0) == 0.5


def test_sectors_larger_than_the_table_says_are_evicted_down_to_the_budget() -> None:
    table = make_table(2, holes=0.0)
    state = StreamState.empty(table)
    state.resident_bytes[:] = table.bytes + 3
    position, still = np.array([[10.0, 1.5, 10.0]]), np.zeros((1, 3))
    plan = plan_streaming(table, state, position, still, now_s=0.0, options=StreamOptions(500))
    left = (table.bytes + 3).sum() - (table.bytes + 3)[rows_of(table, plan.evictions)].sum()
    assert 450 < left <= 500
    assert not volume_sectors(position[0]) & set(plan.evictions)
    assert plan.loads == ()


def test_a_world_without_sectors_or_players_needs_nothing() -> None:
    nobody = np.zeros((0, 3))
    for table in (SectorTable.of({}), make_table(0)):
        for at in (nobody, np.array([[0.0, 0.0, 0.0]])):
            plan = plan_streaming(table, StreamState.empty(table), at, at, now_s=0.0, options=StreamOptions(10))
            assert plan.evictions == ()
            assert bool(plan.loads) == bool(len(at) and len(table.sectors))


def test_sectors_far_apart_are_found_too() -> None:
    table = SectorTable.of({SectorIndex(-900_000, 5): 1, SectorIndex(900_000, -7): 1, SectorIndex(0, 0): 1})
    x, z = np.array([-900_000, 900_000, 0, 0, 900_000, 10**6]), np.array([5, -7, 0, 1, -6, 0])
    assert table.rows(x, z).tolist() == [0, 2, 1, 3, 3, 3]
    position = np.array([[900_000 * 64.0 + 10, 1.5, -7 * 64.0 + 10]])
    assert plan_streaming(table, StreamState.empty(table), position, np.zeros((1, 3)), now_s=0.0, options=StreamOptions(10)).loads == (
        SectorIndex(900_000, -7),
    )


@pytest.mark.parametrize("wrong", [{"budget_bytes": 0}, {"load_margin_m": 64.0}, {"look_ahead_s": -1.0}, {"max_loading": 0}])
def test_options_that_could_not_stream_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="budget"):
        StreamOptions(**{"budget_bytes": 10, **wrong})  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="byte"):
        SectorTable.of({SectorIndex(0, 0): 0})


def test_a_plan_tells_how_far_players_are_for_who_lights_sectors() -> None:
    table = make_table(3, holes=0.0)
    positions = np.array([[10.0, 1.5, 10.0], [-100.0, 1.5, 70.0]])
    plan = plan_streaming(table, StreamState.empty(table), positions, 0 * positions, now_s=0.0, options=StreamOptions(1000))
    standing = {sector_of(position) for position in positions}
    assert {table.sectors[row] for row in np.flatnonzero(plan.needs.away_m == 0)} == standing
