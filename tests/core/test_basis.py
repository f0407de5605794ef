"""Directional bases by known answers: uniform light, one distant light, light of the second degree, the axes; and their conversions."""

import numpy as np
import pytest

from gi_core.ambient_cube import FACE_DIRECTIONS
from gi_core.basis import (
    FEEDBACK,
    SH_COSINE,
    SH_NORM,
    basis_of_size,
    conversion,
    convert,
    evaluate,
    evaluation_weights,
    factor_shares,
    feedback_weights,
    from_axes,
    harmonics,
    projection_weights,
    served_from,
)
from gi_core.constants import BASIS_SIZES
from gi_core.errors import InputError

BASES = tuple(BASIS_SIZES)


def sphere(n=20_000):
    """Unit directions that share the sphere evenly, and what each stands for [sr]."""
    y = 1 - (2 * np.arange(n) + 1) / n
    turn = np.arange(n) * np.pi * (3 - np.sqrt(5))
    level = np.sqrt(1 - y * y)
    return np.stack([level * np.cos(turn), y, level * np.sin(turn)], axis=1), 4 * np.pi / n


DIRECTIONS, SOLID_ANGLE = sphere()
NORMALS = DIRECTIONS[::499]


def project(basis, radiance):
    """(1, B, 3) from radiance (n,) along DIRECTIONS."""
    coefficients = projection_weights(basis, DIRECTIONS).T @ radiance * SOLID_ANGLE
    return np.repeat(coefficients[None, :, None], 3, axis=2)


def along_normals(basis, coefficients):
    return evaluate(basis, np.repeat(coefficients, len(NORMALS), axis=0), NORMALS)[:, 0]


@pytest.mark.parametrize("basis", BASES)
def test_uniform_light_gives_pi_times_its_radiance_on_every_surface(basis):
    np.testing.assert_allclose(along_normals(basis, project(basis, np.full(len(DIRECTIONS), 1000.0))), np.pi * 1000, rtol=2e-3)


def test_harmonics_are_orthonormal():
    products = harmonics(DIRECTIONS).T @ harmonics(DIRECTIONS) * SOLID_ANGLE
    np.testing.assert_allclose(products, np.eye(9), atol=1e-3)


# How far each basis lies from the true cosine of one distant light, anywhere on the sphere, as a share of what a facing surface gets:
# the harmonics' 1/4 + t/2 + 5/32 (3 t^2 - 1) instead of max(t, 0), most at grazing light; of the cube 1 - 1 / sqrt(3), at the corners.
WORST = {"sh2": 3 / 32 + 1e-6, "cube": 1 - 1 / np.sqrt(3) + 1e-3}


@pytest.mark.parametrize("basis", WORST)
@pytest.mark.parametrize("towards", [(0, 1, 0), (1, 1, 1), (-3, 2, 6)])
def test_one_distant_light_is_as_far_off_as_the_cosines_missing_bands_say(basis, towards):
    towards = np.array([towards]) / np.linalg.norm(towards)
    found = along_normals(basis, np.repeat(projection_weights(basis, towards).astype(float)[..., None], 3, axis=2))
    truth = np.maximum(NORMALS @ towards[0], 0)
    assert np.abs(found - truth).max() <= WORST[basis]
    facing = evaluate(basis, np.repeat(projection_weights(basis, towards)[..., None], 3, axis=2), towards)[0, 0]
    assert facing == pytest.approx(1.0625 if basis == "sh2" else (towards**2) @ np.abs(towards[0]), rel=1e-5)


def test_zh3_is_nearer_to_light_from_one_side_than_linear_harmonics():
    # A slit of sky over a street. (A whole uniform dome is linear: there ZH3 expects a band that is not there.)
    radiance = np.where(DIRECTIONS[:, 1] > 0.8, 1.0, 0.02)
    truth = np.maximum(NORMALS @ DIRECTIONS.T, 0) @ radiance * SOLID_ANGLE
    coefficients = project("sh1", radiance)
    linear = evaluation_weights("sh1", NORMALS) @ coefficients[0, :, 0]
    assert linear.min() < 0 < truth.min()
    off, off_linear = (np.abs(found - truth).mean() for found in (along_normals("sh1", coefficients), linear))
    assert off < 0.5 * off_linear


def test_no_reconstruction_is_negative():
    rng = np.random.default_rng(0)
    for basis, size in BASIS_SIZES.items():
        low = 0 if basis == "cube" else -1
        assert evaluate(basis, rng.uniform(low, 1, (500, size, 3)), rng.permutation(DIRECTIONS)[:500]).min() >= 0


@pytest.mark.parametrize("basis", ["sh1", "sh2"])
def test_shares_of_any_light_sum_to_one_at_most(basis):
    # The most that sources of exitance 1 can add to a coefficient is what those add that add anything.
    share = projection_weights(basis, DIRECTIONS) / np.pi * SOLID_ANGLE * factor_shares(basis)
    assert np.maximum(share, 0).sum(axis=0).max() <= 1 + 1e-9
    assert np.maximum(-share, 0).sum(axis=0).max() <= 1


@pytest.mark.parametrize("basis", BASES)
def test_a_bounce_keeps_less_than_all_light_whatever_its_directions_and_signs(basis):
    """The greatest that a surface's irradiance can differ when exitances around a probe differ by at most 1, times the albedo."""
    weights = projection_weights(basis, DIRECTIONS) / np.pi * SOLID_ANGLE
    kept = np.abs(feedback_weights(basis, NORMALS.astype(np.float32)) @ weights.T).sum(axis=1).max()
    # 2e-3: what the lattice's cosines differ from their integral by.
    assert kept * FEEDBACK[basis].albedo_max <= FEEDBACK[basis].shrinks + (2e-3 if basis == "cube" else 0)
    assert FEEDBACK[basis].shrinks < 1


def test_a_cube_from_harmonics_is_irradiance_along_the_axes():
    rng = np.random.default_rng(1)
    light = rng.uniform(0, 1, (7, 9, 3)).astype(np.float32)
    cube = convert(light, "sh2", "cube")
    for face, axis in enumerate(FACE_DIRECTIONS):
        expected = evaluate("sh2", light, np.broadcast_to(axis, (7, 3)))
        np.testing.assert_allclose(cube[:, face], expected, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(convert(light, "sh2", "sh1"), light[:, :4])


def test_a_cube_from_linear_harmonics_has_what_zh3_adds():
    light = project("sh1", np.where(DIRECTIONS[:, 1] > 0.8, 1.0, 0.0)).astype(np.float32)
    cube = convert(light, "sh1", "cube")
    expected = [evaluate("sh1", light, axis[None])[0] for axis in FACE_DIRECTIONS]
    np.testing.assert_allclose(cube[0], expected, rtol=1e-5)
    assert (conversion("sh1", "cube") @ light[0])[3, 0] < 0 <= cube[0, 3, 0]


def test_light_from_axes_has_that_irradiance_there():
    faces = np.random.default_rng(2).uniform(0, 1, 6)
    np.testing.assert_allclose(conversion("sh2", "cube") @ (from_axes("sh2") @ faces), faces, rtol=1e-5)
    uniform = from_axes("sh1") @ np.ones(6)
    np.testing.assert_allclose(uniform, [np.sqrt(4 * np.pi), 0, 0, 0], atol=1e-6)


def test_a_basis_is_never_served_from_a_poorer_one():
    assert [served_from(basis) for basis in BASES] == [("cube",), ("cube", "sh1"), ("cube", "sh1", "sh2")]
    with pytest.raises(InputError, match="this light is in cube; expected cube"):
        convert(np.zeros((1, 6, 3), np.float32), "cube", "sh2")
    with pytest.raises(InputError, match="7 coefficients"):
        basis_of_size(7)


def test_the_contracts_numbers():
    assert pytest.approx([0.28209479, *3 * [0.48860251], 1.09254843, 1.09254843, 0.31539157, 1.09254843, 0.54627422]) == SH_NORM
    assert pytest.approx([np.pi, *3 * [2 * np.pi / 3], *5 * [np.pi / 4]]) == SH_COSINE
