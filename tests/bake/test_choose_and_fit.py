"""Choosing probes and fitting weights: arrays in, answers that can be written down out."""

import numpy as np
import pytest

from bake_jobs.choose import Chooser, Pairs, neighbour_pairs
from bake_jobs.distinct import distinct, least
from bake_jobs.fit import fit_weights


def everyone(count):
    """All pairs of ``count`` voxels."""
    voxel, probe = (a.ravel() for a in np.meshgrid(np.arange(count), np.arange(count), indexing="ij"))
    return Pairs.of(voxel, probe, count)


def choose(light, pairs, worth=1e-3, most=1000, importance=None, may=None):
    light = np.asarray(light, np.float32)
    importance = np.ones(len(light)) if importance is None else np.asarray(importance, np.float64)
    chooser = Chooser(light, importance, pairs, np.ones(len(light), bool) if may is None else np.asarray(may))
    chooser.take_best(worth, most)
    return chooser


def test_uniform_light_needs_one_probe():
    assert len(choose(np.full((50, 4), 3.0), everyone(50)).chosen) == 1


def test_a_wall_that_parts_uniform_light_needs_a_probe_on_each_side():
    side = np.arange(40) % 2
    pairs = everyone(40)
    within = side[pairs.voxel] == side[pairs.probe]
    chosen = choose(np.full((40, 4), 3.0), Pairs.of(pairs.voxel[within], pairs.probe[within], 40)).chosen
    assert sorted(side[chosen].tolist()) == [0, 1]


def test_what_two_probes_mix_into_needs_no_third():
    share = np.linspace(0, 1, 30)[:, None]
    ends = np.array([[0.0, 1.0, 2.0], [2.0, 0.0, 1.0]])
    chooser = choose(share * ends[0] + (1 - share) * ends[1], everyone(30), worth=1e-2)
    # Greedy begins in the middle, which serves most, and adds both ends.
    assert len(chooser.chosen) == 3
    assert {0, 29} < set(chooser.chosen)
    assert chooser.error.max() < 1e-6


def test_a_probe_that_is_dearer_than_its_gain_is_not_taken():
    light = np.zeros((20, 2))
    light[7] = 0.5
    assert len(choose(light, everyone(20), worth=0.6).chosen) == 1  # 0.5 ^ 2 twice is 0.5
    assert choose(light, everyone(20), worth=0.4).chosen[1] == 7


def test_importance_decides_between_two_places_and_a_budget_ends_the_choice():
    light = np.zeros((20, 2))
    light[4], light[9] = 1.0, -1.0
    importance = np.ones(20)
    importance[9] = 3
    assert choose(light, everyone(20), most=2, importance=importance).chosen[1] == 9
    assert len(choose(np.random.default_rng(1).normal(size=(50, 3)), everyone(50), most=7).chosen) == 7


def test_only_allowed_voxels_become_probes():
    may = np.zeros(30, bool)
    may[[3, 5]] = True
    light = np.random.default_rng(2).normal(size=(30, 3))
    assert set(choose(light, everyone(30), may=may).chosen) <= {3, 5}
    assert choose(light, everyone(30), may=np.zeros(30, bool)).chosen == []


def test_gains_kept_up_to_date_are_those_worked_out_anew():
    rng = np.random.default_rng(3)
    light = rng.normal(size=(60, 4)).astype(np.float32)
    chooser = choose(light, everyone(60), most=10)
    explained, covered = chooser._explained, chooser._covered
    assert covered.all()
    for j in rng.integers(0, 60, 10):
        step, off = light[j] - explained, light - explained
        t = np.clip((off * step).sum(axis=1) / np.maximum((step * step).sum(axis=1), 1e-12), 0, 1)
        fall = (off**2).sum(axis=1) - ((off - t[:, None] * step) ** 2).sum(axis=1)
        # Float32 products of numbers up to 10.
        assert chooser._gain[j] == pytest.approx(np.maximum(fall, 0).sum(), abs=1e-3)


def test_neighbours_are_all_that_are_near_and_a_thin_lattice_of_those_far():
    lattice = np.stack([a.ravel() for a in np.meshgrid(np.arange(-9, 10), np.arange(3), np.arange(-9, 10), indexing="ij")], axis=1)
    voxel, probe = neighbour_pairs(lattice, np.zeros(lattice.shape, bool))
    assert len({*zip(voxel.tolist(), probe.tolist(), strict=True)}) == len(voxel)
    middle = int(np.flatnonzero((lattice == 0).all(axis=1))[0])
    mine = set(probe[voxel == middle].tolist())
    for number, place in enumerate(lattice):
        distance = np.linalg.norm(place)
        step = 1 if distance <= 2.5 else 2 if distance <= 5 else 4
        assert (number in mine) == (distance <= 8 and (place % step == 0).all())


def test_in_a_narrow_strip_every_voxel_may_explain_far_ones():
    lattice = np.stack([np.ones(20, int), np.zeros(20, int), np.arange(20)], axis=1)
    for across in (False, True):
        _, probe = neighbour_pairs(lattice, np.tile([across, False, False], (20, 1)))
        assert (np.bincount(probe)[4] == 17 - 4) == across  # itself, four before, eight after
        assert np.bincount(probe)[5] == 5


def small_problems(count, candidates=6, rows=12, seed=0):
    rng = np.random.default_rng(seed)
    columns = rng.uniform(0.5, 2, (count, candidates, rows)).astype(np.float32)
    return columns, np.full((count, candidates), 1 / candidates, np.float32), rng


def test_weights_are_never_negative_and_sum_to_one():
    columns, prior, rng = small_problems(200)
    weight = fit_weights(columns, rng.uniform(0.2, 3, (200, 12)).astype(np.float32), prior, 0.01, 4)
    assert (weight >= 0).all()
    np.testing.assert_allclose(weight.sum(axis=1), 1, atol=1e-6)  # float32 quotients
    assert ((weight > 0).sum(axis=1) <= 4).all()


def test_a_mixture_is_found():
    columns, prior, _ = small_problems(50)
    truth = np.zeros((50, 6), np.float32)
    truth[:, 1], truth[:, 4] = 0.3, 0.7
    weight = fit_weights(columns, np.einsum("nc,ncr->nr", truth, columns), prior, 0.0, 4)
    np.testing.assert_allclose(weight, truth, atol=0.01)  # a fixed number of steps; worst seen 0.004


def test_where_light_decides_nothing_distance_does():
    columns = np.ones((1, 3, 12), np.float32)
    prior = np.array([[0.6, 0.3, 0.1]], np.float32)
    np.testing.assert_allclose(fit_weights(columns, np.ones((1, 12), np.float32), prior, 0.01, 3), prior, atol=1e-3)


def test_a_candidate_that_is_not_there_gets_nothing():
    columns, prior, _ = small_problems(20)
    prior[:, 2] = 0
    assert (fit_weights(columns, columns[:, 2].copy(), prior, 0.001, 4)[:, 2] == 0).all()


def test_a_fit_does_not_depend_on_what_is_fitted_beside_it():
    columns, prior, rng = small_problems(64)
    target = rng.uniform(0.5, 2, (64, 12)).astype(np.float32)
    together = fit_weights(columns, target, prior, 0.01, 4)
    alone = np.concatenate([fit_weights(columns[n : n + 1], target[n : n + 1], prior[n : n + 1], 0.01, 4) for n in range(64)])
    np.testing.assert_allclose(together, alone, atol=1e-5)  # sums of twelve products in another order


@pytest.mark.parametrize(("keys", "different"), [(0, 1), (1, 1), (20_000, 1), (20_000, 300), (20_000, 15_000), (20_000, 10**9)])
def test_distinct_keys_are_those_that_sorting_finds(keys, different):
    drawn = np.random.default_rng(keys + different).integers(-1, different, keys)
    for some in (drawn, drawn * (1 << 33), -7 * drawn):  # neighbours, and keys that differ in their high bits alone
        found, number = distinct(some)
        expected, of_key = np.unique(some, return_inverse=True)
        np.testing.assert_array_equal(found, expected)
        np.testing.assert_array_equal(number, of_key)


def test_the_least_of_each_group_is_the_first_that_sorting_finds():
    rng = np.random.default_rng(7)
    values, group = rng.integers(0, 5, 400).astype(np.float32), rng.integers(0, 60, 400)
    group[group == 31] = 30
    order = np.lexsort((values, group))
    named, first = np.unique(group[order], return_index=True)
    expected = np.zeros(60, np.int64)
    expected[named] = order[first]
    np.testing.assert_array_equal(least(values, group, 60), expected)
