"""The study's ways to hold irradiance, by known answers."""

import numpy as np
import pytest

from bake_jobs.basis_study import DIAGONALS, STUDIES, cube_least_squares, diagonal_weights, spiral
from gi_core.ambient_cube import basis_weights
from gi_core.basis import conversion, evaluation_weights

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
