"""World frame, sector grid and voxel lattice."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from gi_core.constants import VOXEL_SIZE_M
from gi_core.grid import SectorIndex, sector_of, volume_first_voxel, voxel_centre, voxel_columns

sectors = st.integers(-100_000, 100_000)


@given(sectors)
def test_neighbouring_sectors_share_no_voxel_and_leave_none_out(i):
    assert voxel_columns(i)[1] == voxel_columns(i + 1)[0]
    first, end = voxel_columns(i)
    assert end - first in (20, 21)


@given(sectors, st.integers(0, 19))
def test_a_voxel_belongs_to_the_sector_that_holds_its_centre(i, k):
    first, _ = voxel_columns(i)
    centre = voxel_centre(np.array([first + k, 0, first + k]))
    assert sector_of(centre) == SectorIndex(i, i)


def test_negative_positions_are_in_negative_sectors():
    assert sector_of(np.array([-0.001, 5.0, -64.0])) == SectorIndex(-1, -1)
    assert sector_of(np.array([0.0, -5.0, 63.999])) == SectorIndex(0, 0)


@given(st.lists(st.floats(-1e5, 1e5), min_size=3, max_size=3))
def test_a_volume_is_centred_within_half_a_voxel(position):
    first = volume_first_voxel(np.array(position))
    middle = (voxel_centre(first) + voxel_centre(first + np.array([31, 15, 31]))) / 2
    assert (np.abs(middle - position) <= VOXEL_SIZE_M / 2 + 1e-9).all()
