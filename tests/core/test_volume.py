"""Which sectors a volume reads, and what a client makes of it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gi_core.ambient_cube import basis_weights, evaluate, project_radiance
from gi_core.constants import VOLUME_SHAPE, VOXEL_SOLID
from gi_core.grid import sector_of, voxel_centre
from gi_core.volume import box_mask, nearest_columns, plan_boxes, sample_coefficients, sample_volume, sector_slices

lattice = st.integers(-1_000_000, 1_000_000)


@settings(max_examples=50, deadline=None)
@given(lattice, lattice, lattice)
def test_boxes_cover_the_volume_once_with_the_right_sectors(x, y, z):
    first = np.array([x, y, z])
    covered = np.zeros(VOLUME_SHAPE, int)
    for box in plan_boxes(first):
        (bx, by, bz), (nx, ny, nz) = box.volume_first, box.size
        covered[by : by + ny, bz : bz + nz, bx : bx + nx] += 1
        for corner in (box.lattice_first, np.add(box.lattice_first, box.size) - 1):
            assert sector_of(voxel_centre(corner)) == box.index
    assert (covered == 1).all()


def test_a_linear_field_is_sampled_exactly():
    rng = np.random.default_rng(0)
    origin, size = np.array([10.0, -3.0, 7.0]), np.full(3, 3.125)
    slope = rng.normal(size=(6, 3, 3))
    y, z, x = np.meshgrid(*(np.arange(n) for n in VOLUME_SHAPE), indexing="ij")
    centres = origin + size * np.stack([x, y, z], axis=-1)
    values = np.einsum("yzxa,bca->byzxc", centres, slope).astype(np.float32)
    points = origin + rng.uniform(0, 1, (200, 3)) * size * (np.array([32, 16, 32]) - 1)
    expected = np.einsum("na,bca->nbc", points, slope)
    # float32 values of up to 400.
    np.testing.assert_allclose(sample_coefficients(values, origin, size, points), expected, atol=1e-3)


def test_beyond_the_edge_the_edge_is_read():
    values = np.random.default_rng(1).uniform(size=(6, *VOLUME_SHAPE, 3)).astype(np.float32)
    found = sample_coefficients(values, np.zeros(3), np.ones(3), np.array([[-50.0, -50.0, -50.0], [500.0, 500.0, 500.0]]))
    np.testing.assert_allclose(found, [values[:, 0, 0, 0], values[:, -1, -1, -1]], rtol=1e-6)


def test_a_client_reads_a_quarter_voxel_off_the_surface():
    values = np.zeros((6, *VOLUME_SHAPE, 3), np.float32)
    values[2] = np.arange(16, dtype=np.float32)[:, None, None, None]
    up = np.array([[0.0, 1.0, 0.0]], np.float32)
    found = sample_volume(values, np.zeros(3), np.full(3, 4.0), np.array([[40.0, 8.0, 40.0]]), up)
    np.testing.assert_allclose(found, 2.25, rtol=1e-6)


def test_columns_without_light_copy_the_nearest_that_have_some():
    has_light = np.zeros(VOLUME_SHAPE[1:], bool)
    has_light[:, :4] = True
    lack, nearest = nearest_columns(has_light)
    assert len(lack) == (~has_light).sum()
    assert (lack[:, 1] >= 4).all()
    np.testing.assert_array_equal(nearest, np.stack([lack[:, 0], np.full(len(lack), 3)], axis=1))


@pytest.mark.parametrize("holes", [0.0, 0.1, 0.9])
def test_no_column_that_has_light_is_nearer(holes):
    """Also where those that have some are no rectangle."""
    rng = np.random.default_rng(0)
    has_light = np.zeros(VOLUME_SHAPE[1:], bool)
    has_light[5:20, 9:12] = True
    has_light &= rng.random(has_light.shape) >= holes
    lack, nearest = nearest_columns(has_light)
    np.testing.assert_array_equal(lack, np.argwhere(~has_light))
    assert has_light[tuple(nearest.T)].all()
    apart = np.square(lack[:, None] - np.argwhere(has_light)[None]).sum(axis=2)
    np.testing.assert_array_equal(np.square(lack - nearest).sum(axis=1), apart.min(axis=1))


def test_heights_beyond_a_sectors_layers_read_its_lowest_and_highest(make_sector):
    sector = make_sector(1)
    box = next(b for b in plan_boxes(np.array([0, -8, 0])) if b.index == sector.index)
    y, _, _ = sector_slices(box, sector)
    assert y.tolist() == [0] * 7 + [0, 1, 2, 3] + [3] * 5
    mask = box_mask(box, sector)
    assert (mask[:7] == VOXEL_SOLID).all()
    np.testing.assert_array_equal(mask[11], sector.voxel_class[3, : box.size[2], : box.size[0]])


def test_cube_weights_sum_to_one_and_axes_are_exact():
    rng = np.random.default_rng(2)
    normal = rng.normal(size=(500, 3))
    normal = (normal / np.linalg.norm(normal, axis=1, keepdims=True)).astype(np.float32)
    np.testing.assert_allclose(basis_weights(normal).sum(axis=1), 1, rtol=1e-6)
    cube = rng.uniform(size=(6, 6, 3)).astype(np.float32)
    axes = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], np.float32)
    np.testing.assert_array_equal(evaluate(cube, axes), cube[np.arange(6), np.arange(6)])


def test_uniform_radiance_gives_pi_on_every_face():
    rng = np.random.default_rng(3)
    direction = rng.normal(size=(200_000, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    cube = project_radiance(direction, np.ones((200_000, 3)), np.full(200_000, 4 * np.pi / 200_000))
    # Monte Carlo noise of 200 000 samples: 0.26 %; four of its sigmas.
    np.testing.assert_allclose(cube, np.pi, rtol=0.0105)
