"""Weights in a byte each: how near they come to what a bake found, and that a probe's light stays what it was."""

import numpy as np
import pytest

from gi_core import factor_weights
from gi_core.basis import basis_of_size, factor_shares
from gi_core.sector import counts


def weights_of(sector, seed: int = 0) -> np.ndarray:
    """Weights (F, B) as a bake would find them, for a sector's factor lists: no share exceeds one, nor does a probe's sum."""
    rng = np.random.default_rng(seed)
    raw = rng.uniform(0, 1, (sector.factor_count, sector.basis_size)) ** 4
    probe = np.repeat(np.arange(sector.probe_count), counts(sector.factor_starts))
    for b in range(sector.basis_size):
        raw[:, b] /= np.maximum(np.bincount(probe, raw[:, b], sector.probe_count), 1)[probe]
    if sector.basis_size == 6:
        return raw
    return raw * rng.choice([-1, 1], raw.shape) / factor_shares(basis_of_size(sector.basis_size))


def rows_of(sector) -> np.ndarray:
    """Which probe's bricks or sky a factor belongs to."""
    probe = np.repeat(np.arange(sector.probe_count), counts(sector.factor_starts))
    return 2 * probe + (sector.factor_source >= sector.brick_count)


def coded(sector, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Codes, scales and what they stand for."""
    code, scale = factor_weights.encode(weights, sector.factor_starts, sector.factor_source >= sector.brick_count)
    return code, scale, factor_weights.decode(code, scale, sector.factor_starts, sector.sky_starts)


def test_a_probe_neither_gains_nor_loses_light(make_sector):
    sector = make_sector(2)
    weights, row = weights_of(sector), rows_of(sector)
    found = coded(sector, weights)[2]
    for b in range(6):
        before, after = (np.bincount(row, w[:, b], 2 * sector.probe_count) for w in (weights, found))
        assert (after <= before + 1e-6).all()
        # float16 scales are rounded down, by one part in 1024 or the least float16; float32 sums add 1e-6.
        np.testing.assert_allclose(after, before, rtol=1 / 1024 + 2e-6, atol=6e-8)


def test_codes_of_what_codes_stand_for_are_the_same(make_sector):
    sector = make_sector(3)
    code, scale, once = coded(sector, weights_of(sector))
    again, other_scale, _ = coded(sector, once)
    np.testing.assert_array_equal(again, code)
    np.testing.assert_allclose(other_scale, scale, rtol=1 / 500)


@pytest.mark.parametrize("basis", [4, 9])
@pytest.mark.parametrize("patches", [1, 145])
def test_harmonics_lie_within_their_steps(make_sector, basis, patches):
    sector = make_sector(13, basis=basis, patches=patches)
    weights, row, rows = weights_of(sector), rows_of(sector), 2 * sector.probe_count
    found = coded(sector, weights)[2]
    np.testing.assert_array_equal(np.sign(found[:, 0]) * np.sign(weights[:, 0]) >= 0, True)
    for b in range(basis):
        top = np.zeros(rows)
        np.maximum.at(top, row, np.abs(weights[:, b]))
        off = found[:, b].astype(np.float64) - weights[:, b]
        # Half a step of 1/127 in the square root is at most 1/127 of the largest weight, and the scale moves by as much again. The
        # first band has a third of the steps, the second a quarter; a code or three of each probe are moved by up to three steps.
        step = 1 if b == 0 else 3 if b < 4 else 4
        bound = 2 * step * top / 127 + 1e-6
        assert (np.abs(off) <= (1 if b == 0 else 4) * bound[row]).all()
        assert (np.abs(off) > bound[row]).sum() <= 3 * rows
        if b:  # so that no direction comes from rounding
            sums = np.abs(np.bincount(row, off, rows))
            assert np.median(sums[top > 0] / top[top > 0]) < 0.01
            assert (sums <= bound).all()


@pytest.mark.parametrize("basis", [4, 6, 9])
def test_sums_of_shares_are_those_of_the_weights(make_sector, basis):
    sector = make_sector(5, basis=basis)
    share = sector.factor_weight * factor_shares(basis_of_size(basis))
    probe = np.repeat(np.arange(sector.probe_count), counts(sector.factor_starts))
    expected = np.stack([np.bincount(probe, share[:, b], sector.probe_count) for b in range(basis)], axis=1)
    found = factor_weights.share_sums(sector.factor_code, sector.factor_scale, sector.factor_starts, sector.sky_starts)
    np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.parametrize(("dtype", "most"), [(np.uint8, 255), (np.int8, 127)])
def test_the_sum_of_as_many_factors_as_a_file_may_hold_does_not_wrap(dtype, most):
    basis = 6 if dtype == np.uint8 else 4
    code = np.full((3 * 65_535, basis), most, dtype)
    starts, scale = 65_535 * np.arange(4, dtype=np.uint32), np.ones((3, 2, basis), np.float16)
    np.testing.assert_array_equal(factor_weights.share_sums(code, scale, starts, starts[1:]), 65_535.0)
