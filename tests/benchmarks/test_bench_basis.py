"""Rows of ``bench`` about directional bases: all there, and of sectors that could be real ones."""

import math

import pytest

from gi_core import bench_basis
from gi_core.constants import BASIS_SIZES
from gi_core.device import shared_device
from gi_core.sector import check_sector


def test_a_quick_run_has_a_row_for_each_basis_beside_the_cube():
    rows = bench_basis.run(shared_device(None), quick=True)
    assert [row.name for row in rows] == [
        *(f"relight_{basis}_feedback_{n}" for basis, n in (("cube", 6), ("sh1", 1), ("sh1", 6), ("sh2", 1), ("sh2", 6))),
        *("volume_fill_cube_of_sh1", "volume_fill_sh1_of_sh1"),
        *(f"volume_fill_{basis}_of_sh2" for basis in ("cube", "sh1", "sh2")),
    ]
    for row in rows:
        assert all(math.isfinite(value) and value > 0 for value in (row.median, row.baseline, row.ratio))
        assert row.ratio == pytest.approx(row.baseline / row.median)


@pytest.mark.parametrize("basis", BASIS_SIZES)
def test_made_up_sectors_hold_every_invariant(basis):
    check_sector(bench_basis.sector_in(basis, 0, bench_basis.STANDARD_FEEDBACK), bench_basis.SKY_PATCHES)
