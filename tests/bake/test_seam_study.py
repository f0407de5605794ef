"""The study of steps between neighbouring voxels finds those that were put there. Those of cities: accuracy/test_air_of_cities.py."""

import numpy as np

from bake_jobs.seam_study import percentiles, volume_steps
from gi_core.constants import VOLUME_SHAPE, VOXEL_OUTDOORS, VOXEL_SOLID
from gi_core.grid import SectorIndex
from gi_core.volume import Volume

HERE = SectorIndex(0, 0)
COLUMNS = 20  # sector 0 has columns 0 to 19, and sector 1 begins with 20: its centre is at 64.06 m


def volume(values: np.ndarray, mask: np.ndarray | None = None) -> Volume:
    """A volume from column 0 in x and z, of light (y, z, x) that is the same in all faces and channels."""
    mask = np.full(VOLUME_SHAPE, VOXEL_OUTDOORS, np.uint8) if mask is None else mask
    light = np.broadcast_to(values[None, ..., None], (6, *VOLUME_SHAPE, 3)).astype(np.float32)
    return Volume(light, mask, np.zeros(3, np.int64), (HERE,))


def test_a_step_at_a_border_is_found_and_each_pair_once():
    light = np.ones(VOLUME_SHAPE)
    light[:, :, COLUMNS:] = 1.5
    steps = volume_steps(volume(light), HERE)
    # Of the sector's columns each has an eastern and a southern neighbour.
    assert len(steps.size) == 2 * COLUMNS**2 * VOLUME_SHAPE[0]
    assert steps.across.sum() == 2 * COLUMNS * VOLUME_SHAPE[0]
    np.testing.assert_allclose(steps.size, np.where(steps.across & ~steps.along_z, 0.5 / 1.25, 0.0), atol=1e-12)


def test_pairs_inside_count_as_often_as_their_like_across():
    # A ramp in the lowest four layers, even light above them. From the seventh on there is no air at the border.
    light, mask = np.ones(VOLUME_SHAPE), np.full(VOLUME_SHAPE, VOXEL_OUTDOORS, np.uint8)
    light[:4] *= 1.1 ** np.arange(32)
    mask[6:, :, COLUMNS - 1 :] = mask[6:, COLUMNS - 1 :, :] = VOXEL_SOLID
    steps = volume_steps(volume(light, mask), HERE)
    along_x = steps.where(~steps.along_z)
    across, inside = percentiles(along_x.where(along_x.layer < 4))
    np.testing.assert_allclose(across, 0.1 / 1.05, rtol=1e-5)
    np.testing.assert_allclose(inside, across, rtol=1e-5)
    # Of all pairs inside three in four have no step. By weight one in three has none, as across.
    assert np.median(along_x.size[~along_x.across]) == 0
    np.testing.assert_allclose(percentiles(along_x), (across, inside), rtol=1e-5)


def test_air_beside_solids_is_told_from_free_air():
    mask = np.full(VOLUME_SHAPE, VOXEL_OUTDOORS, np.uint8)
    mask[5, 10, 10] = VOXEL_SOLID
    steps = volume_steps(volume(np.ones(VOLUME_SHAPE), mask), HERE)
    # Six neighbours are in four pairs each; in four of these the other is the solid one.
    assert steps.near.sum() == 6 * 4 - 4
