"""The study of walls across borders finds such walls, and the bend that was put into the light of one."""

import numpy as np
import pytest

from bake_jobs.rays import RayScene
from bake_jobs.seam_walls import WINDOWS, Walls, across, bends_along
from gi_core.constants import VOLUME_SHAPE
from gi_core.grid import SectorIndex
from gi_core.volume import Volume


def test_a_wall_across_a_border_is_found_from_its_front_and_a_short_one_is_not(build):
    # A long house across x = 0; one that ends 5 m beyond it; one that another stands close before.
    scene = build().box((-20, 0, 10), (20, 20, 20)).box((-20, 0, 40), (5, 20, 50)).scene()
    middle, normal, along = across(RayScene(scene.vertices, scene.triangles), SectorIndex(0, 0).origin, 0.0, 0)
    assert len(middle) > 2
    np.testing.assert_allclose(middle[:, 0], 0, atol=1e-6)
    assert {round(z, 3) for z in middle[:, 2].tolist()} == {10.0, 20.0}
    np.testing.assert_allclose(normal[:, 2], np.where(middle[:, 2] < 15, -1, 1), atol=1e-6)
    np.testing.assert_allclose(np.abs(along[:, 0]), 1, atol=1e-6)


@pytest.mark.parametrize("step", [0.0, 0.2])
def test_the_bend_of_a_step_at_the_border_is_its_own(step):
    # Columns 0 to 19 are the sector's, and 20 begins the next: light is higher by the step from there on.
    light = np.ones(VOLUME_SHAPE)
    light[:, :, 20:] += step
    values = np.broadcast_to(light[None, ..., None], (6, *VOLUME_SHAPE, 3)).astype(np.float32)
    volume = Volume(values, np.zeros(VOLUME_SHAPE, np.uint8), np.zeros(3, np.int64), (SectorIndex(0, 0),))
    walls = Walls(np.array([[64.0, 20, 50]]), np.array([[0.0, 0, 1]]), np.array([[1.0, 0, 0]]))
    bends = bends_along(volume, walls.middle[0], walls.normal[0], walls.along[0])
    assert len(bends) == len(WINDOWS)
    # Linear between voxel centres, so bent at two of them: as much as the slope changes by in a quarter of a metre, of which the nearer of
    # two readings has three quarters.
    np.testing.assert_allclose(bends, [0, 0.75 * step * 0.25 / 3.125 / (1 + step / 2), 0], rtol=0.05, atol=1e-5)
