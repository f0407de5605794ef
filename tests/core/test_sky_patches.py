"""The sky as patches: the dome is cut fairly, maps are averaged exactly, and level ground gets what the sky gives it."""

import numpy as np
import pytest

from gi_core.errors import InputError
from gi_core.sky import horizontal_illuminance, map_directions, row_solid_angle
from gi_core.sky_patches import level_shares, patch_of, patch_radiance, patches_in_rows

COUNTS = (4, 8, 24, 32, 48, 145, 1024)


def dome(n=200_000):
    y = 1 - (np.arange(n) + 0.5) / n
    turn = np.arange(n) * np.pi * (3 - np.sqrt(5))
    level = np.sqrt(1 - y * y)
    return np.stack([level * np.cos(turn), y, level * np.sin(turn)], axis=1)


@pytest.mark.parametrize("patches", COUNTS)
def test_patches_share_the_dome_evenly(patches):
    rows = patches_in_rows(patches)
    assert sum(rows) == patches
    assert rows[0] == 1
    assert min(rows) > 0
    seen = np.bincount(patch_of(dome(), patches), minlength=patches)
    assert len(seen) == patches
    # A lattice point falls to one side of an edge or the other.
    np.testing.assert_allclose(seen, len(dome()) / patches, rtol=0.02 if patches < 200 else 0.15)


def test_patches_are_about_as_wide_as_high():
    for patches in (24, 32, 48, 145):
        direction, patch = dome(), patch_of(dome(), patches)
        for p in range(patches):
            own = direction[patch == p]
            middle = own.mean(axis=0) / np.linalg.norm(own.mean(axis=0))
            # No corner of a square of its area lies farther from the middle than 0.71 of its edge.
            assert np.arccos((own @ middle).min()) < 1.1 * np.sqrt(2 * np.pi / patches)


@pytest.mark.parametrize("patches", COUNTS)
def test_means_keep_all_light_of_a_map(patches):
    sky = np.zeros((64, 128, 3), np.float32)
    sky[:32] = np.random.default_rng(patches).uniform(0, 1000, (32, 128, 3))
    whole = (row_solid_angle() @ sky[:32].sum(axis=1)).astype(float)
    found = patch_radiance(sky, patches)
    np.testing.assert_allclose(found.sum(axis=0) * 2 * np.pi / patches, whole, rtol=1e-6)  # the map is float32
    uniform = np.zeros_like(sky)
    uniform[:32] = 7.0
    np.testing.assert_allclose(patch_radiance(uniform, patches), 7, rtol=1e-12)


def test_a_bright_texel_is_in_the_patch_that_its_direction_is_in():
    for row, column in ((0, 5), (9, 0), (17, 77), (31, 127)):
        sky = np.zeros((64, 128, 3), np.float32)
        sky[row, column] = 1e4
        direction = map_directions()[row, column][None]
        assert int(patch_radiance(sky, 32)[:, 0].argmax()) == patch_of(direction, 32)[0]


def test_level_ground_gets_what_the_sky_gives_it():
    polar = map_directions()[..., 1]
    sky = np.zeros((64, 128, 3), np.float32)
    sky[:32] = (1000 * (1 + 2 * polar) / 3)[..., None]  # CIE overcast
    found = np.pi * level_shares("patches", 32) @ patch_radiance(sky, 32)
    # Within a patch the sky's gradient and the cosine's are multiplied as means: 1.9 % for the lowest row of 26 degrees.
    np.testing.assert_allclose(found, horizontal_illuminance(sky[:32].astype(float)), rtol=0.02)
    for patches in COUNTS:
        assert level_shares("patches", patches).sum() == pytest.approx(1)


def test_the_talks_scalars_have_the_whole_of_level_ground_in_the_upper_face():
    assert level_shares("faces", 6).tolist() == [0, 0, 1, 0, 0, 0]


@pytest.mark.parametrize("patches", [0, 3, 1025])
def test_a_dome_of_too_few_or_too_many_is_refused(patches):
    with pytest.raises(InputError, match="sky patches: expected 4 to 1024"):
        patches_in_rows(patches)
