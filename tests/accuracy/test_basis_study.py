"""The study's ways to hold irradiance, by known answers."""

import numpy as np
import pytest

from bake_jobs.basis_study import (
    DIAGONALS,
    OWN_NORMALS,
    STUDIES,
    cube_least_squares,
    diagonal_weights,
    microseconds,
    own_normals,
    spiral,
)
from gi_core.ambient_cube import basis_weights
from gi_core.basis import conversion, evaluation_weights
from gi_core.grid import SectorIndex

DIRECTIONS = spiral(20_000)
NORMALS = spiral(200)


@pytest.mark.parametrize("name", STUDIES)
def test_uniform_light_is_uniform_in_every_way(name):
    study = STUDIES[name]
    coefficients = study.project(DIRECTIONS).sum(axis=0) * 4 * np.pi / len(DIRECTIONS)
    assert len(coefficients) == study.coefficients
    rebuilt = study.rebuild(np.tile(coefficients[None, :, None], (len(NORMALS), 1, 3)), NORMALS)
    np.testing.assert_allclose(rebuilt, np.pi, rtol=3e-3)  # the lattice's cosines


def test_the_least_squares_cube_is_nearer_over_all_normals_and_farther_along_the_axes():
    faces = basis_weights(NORMALS.astype(np.float32))
    light = np.array([3.5, 1, 1, 1, 0, 0, 0, 0, 0])  # from one diagonal, where the cube sees least
    truth = evaluation_weights("sh2", NORMALS) @ light
    sampled, fitted = conversion("sh2", "cube") @ light, cube_least_squares() @ light
    assert np.square(faces @ fitted - truth).mean() < 0.9 * np.square(faces @ sampled - truth).mean()
    assert np.abs(fitted - sampled).min() > 0.01


def test_eight_vectors_blend_to_one_and_read_one_alone_nowhere():
    weights = diagonal_weights(NORMALS)
    np.testing.assert_allclose(weights.sum(axis=1), 1)
    assert weights.min() >= 0
    # The diagonals are not orthogonal: along one of them its three neighbours count too.
    np.testing.assert_allclose(np.sort(diagonal_weights(DIAGONALS[:1])[0])[-4:], [1 / 12, 1 / 12, 1 / 12, 3 / 4], atol=1e-12)


def test_a_sectors_own_surfaces_are_drawn_by_area(build):
    """A floor in one sector, three thin walls in the next, whose ends are a hundredth of them."""
    block = build().ground((0, 0), (60, 60))
    for x in (70, 80, 90):
        block.wall((x, 10), (x, 50), 30)
    scene = block.scene()
    floor, walls = (own_normals(scene, SectorIndex(x, 0)) for x in (0, 1))
    np.testing.assert_allclose(np.abs(floor), [[0, 1, 0]] * OWN_NORMALS)
    assert np.mean(np.abs(walls[:, 0]) == 1) > 0.9
    np.testing.assert_allclose(np.linalg.norm(walls, axis=1), 1)
    assert len(own_normals(scene, SectorIndex(9, 9))) == OWN_NORMALS, "of all, where a sector has none"


def test_what_reading_takes_is_a_time():
    assert microseconds(STUDIES["cube"]) > 0
