"""Weights in a byte each: how near they come to what a bake found, and that a probe's light stays what it was."""

import numpy as np
import pytest

from gi_core import factor_weights, quantise
from gi_core.basis import basis_of_size, factor_shares, from_axes, projection_weights
from gi_core.factor_weights import Codes
from gi_core.sector import counts


def weights_of(sector, seed: int = 0) -> np.ndarray:
    """Weights (F, B) as a bake would find them, for a sector's factor lists: no share exceeds one, nor does a probe's sum. Harmonics are of
    three rays each."""
    rng = np.random.default_rng(seed)
    raw = rng.uniform(0, 1, (sector.factor_count, 6)) ** 4
    probe = np.repeat(np.arange(sector.probe_count), counts(sector.factor_starts))
    for b in range(6):
        raw[:, b] /= np.maximum(np.bincount(probe, raw[:, b], sector.probe_count), 1)[probe]
    if sector.basis_size == 6:
        return raw
    rays = rng.normal(size=(len(raw), 1, 3)) * 3 + rng.normal(size=(len(raw), 3, 3))
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    basis = basis_of_size(sector.basis_size)
    # A quarter is the first harmonic's share of a ray.
    return sum(4 * raw[:, k, None] * projection_weights(basis, rays[:, k]) for k in range(3)) / 3


def rows_of(sector) -> np.ndarray:
    """Which probe's bricks or sky a factor belongs to."""
    probe = np.repeat(np.arange(sector.probe_count), counts(sector.factor_starts))
    return 2 * probe + (sector.factor_source >= sector.brick_count)


def coded(sector, weights: np.ndarray) -> tuple[Codes, np.ndarray]:
    """Codes, and what they stand for."""
    codes = factor_weights.encode(weights, sector.factor_starts, sector.factor_source >= sector.brick_count)
    return codes, factor_weights.decode(codes, sector.factor_starts, sector.sky_starts)


def test_a_probe_neither_gains_nor_loses_light(make_sector):
    sector = make_sector(2)
    weights, row = weights_of(sector), rows_of(sector)
    found = coded(sector, weights)[1]
    for b in range(6):
        before, after = (np.bincount(row, w[:, b], 2 * sector.probe_count) for w in (weights, found))
        assert (after <= before + 1e-6).all()
        # float16 scales are rounded down, by one part in 1024 or the least float16; float32 sums add 1e-6.
        np.testing.assert_allclose(after, before, rtol=1 / 1024 + 2e-6, atol=6e-8)


def test_codes_of_what_codes_stand_for_are_the_same(make_sector):
    sector = make_sector(3)
    codes, once = coded(sector, weights_of(sector))
    again, _ = coded(sector, once)
    np.testing.assert_array_equal(again.factor_code, codes.factor_code)
    np.testing.assert_allclose(again.factor_scale, codes.factor_scale, rtol=1 / 500)


@pytest.mark.parametrize("basis", [4, 9])
@pytest.mark.parametrize("patches", [1, 145])
def test_harmonics_are_those_of_a_patch_of_light(make_sector, basis, patches):
    sector = make_sector(13, basis=basis, patches=patches)
    shares = weights_of(sector) * factor_shares(basis_of_size(basis))
    row, rows = rows_of(sector), 2 * sector.probe_count
    codes, weights = coded(sector, shares / factor_shares(basis_of_size(basis)))
    found = weights * factor_shares(basis_of_size(basis))
    top = np.zeros(rows)
    np.maximum.at(top, row, shares[:, 0])
    # Half a step of 1/127 in the square root is at most 1/127 of the largest share, and the scale moves by as much again.
    np.testing.assert_array_less(np.abs(found[:, 0] - shares[:, 0]), 2 * top[row] / 127 + 1e-6)
    # Half a step of a direction's 16, of a band whose share is twice the first one's; and the trim.
    large = shares[:, 0] > 0.3 * top[row]
    off = np.abs(found[large, 1:4] / found[large, :1] - shares[large, 1:4] / shares[large, :1])
    assert np.median(off) < 1 / 16
    for b in range(1, basis):
        before, after = (np.bincount(row, values[:, b], rows) for values in (shares, found))
        total = np.bincount(row, found[:, 0], rows)
        # Half a step of a trim's signed root: 1/127 of its root, or the square of half a step where it is none.
        trim = np.abs(quantise.decode_signed_root(codes.factor_trim)[:, :, b - 1].reshape(-1))
        assert (np.abs(after - before) <= total * (1.1 * np.sqrt(trim) / 127 + 1.1 / 254**2) + 1e-6).all()


@pytest.mark.parametrize("basis", ["sh1", "sh2"])
def test_the_faces_of_a_sky_of_six_scalars_are_exact(basis):
    """They are no light from anywhere: three halves of a direction's first band, and two thirds of its second."""
    weights = np.float64(from_axes(basis).T)
    starts = np.array([0, 6], np.uint32)
    codes = factor_weights.encode(weights, starts, np.ones(6, bool))
    # Half a step of a root of 127, and the trims that make up for it.
    np.testing.assert_allclose(factor_weights.decode(codes, starts, starts[:1]), weights, rtol=1 / 127, atol=1e-6)
    assert np.abs(quantise.decode_signed_root(codes.factor_trim)).max() < 1 / 254


@pytest.mark.parametrize("basis", [4, 6, 9])
def test_sums_of_shares_are_those_of_the_weights(make_sector, basis):
    sector = make_sector(5, basis=basis)
    share = sector.factor_weight * factor_shares(basis_of_size(basis))
    probe = np.repeat(np.arange(sector.probe_count), counts(sector.factor_starts))
    expected = np.stack([np.bincount(probe, share[:, b], sector.probe_count) for b in range(basis)], axis=1)
    found = factor_weights.share_sums(sector.factor_codes, sector.factor_starts, sector.sky_starts)
    np.testing.assert_allclose(found, expected[:, : sector.factor_scale.shape[2]], atol=1e-5)


@pytest.mark.parametrize(("dtype", "most"), [(np.uint8, 255), (np.int8, 127)])
def test_the_sum_of_as_many_factors_as_a_file_may_hold_does_not_wrap(dtype, most):
    codes, scales = (6, 6) if dtype == np.uint8 else (4, 1)
    code = np.full((3 * 65_535, codes), most, dtype)
    starts, scale = 65_535 * np.arange(4, dtype=np.uint32), np.ones((3, 2, scales), np.float16)
    trim = None if dtype == np.uint8 else np.zeros((3, 2, 8), np.int8)
    np.testing.assert_array_equal(factor_weights.share_sums(Codes(code, scale, trim), starts, starts[1:]), 65_535.0)
