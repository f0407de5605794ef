"""Voxels of half the size: near surfaces only, never reading through a wall, with the rest left to the coarse ones."""

from dataclasses import replace

import numpy as np
import pytest

from bake_jobs.config import settings_for
from bake_jobs.fine_voxels import SOLID_REACH_VOXELS
from bake_jobs.sector_job import SectorBaker
from gi_core import fine_file, sector_file
from gi_core.constants import FINE_VOXEL_SIZE_M, VOXEL_OUTDOORS, VOXEL_SOLID
from gi_core.grid import SectorIndex, voxel_centre, voxel_columns

HERE = SectorIndex(0, 0)
UP = np.array([[0.0, 1.0, 0.0]])
QUICK = {"rays_per_face_edge": 4, "grid_spacing_m": 8.0, "wall_spacing_m": 12.0, "voxel_levels": 2}
WALL_X = 30.0  # a wall without thickness, 10 m high, from x = 30 on its west side to the east


def baked(scene, **settings):
    """Probes' positions, fine voxels and their centres (ny, nz, nx, 3) of a scene's first sector."""
    baker = SectorBaker(scene, replace(settings_for("talk"), **{**QUICK, **settings}), UP, "test")
    found = baker.bake(HERE)
    sector, _ = sector_file.decode(found.sector_bytes, "sector")
    voxels, index, bake_id = fine_file.decode(found.fine_bytes, "fine")
    assert (index, bake_id) == (HERE, "test")
    y, z, x = np.meshgrid(*(np.arange(n) for n in voxels.kind.shape), indexing="ij")
    return sector.probe_position.astype(float), voxels, voxel_centre(np.stack([x, y, z], axis=-1) + voxels.first, FINE_VOXEL_SIZE_M)


@pytest.fixture(scope="module")
def house(build):
    scene = build().ground().box((20, 0, 20), (36, 12, 30)).scene()
    return baked(scene)


def test_without_the_knob_there_is_no_file(build):
    baker = SectorBaker(build().ground().scene(), replace(settings_for("talk"), **{**QUICK, "voxel_levels": 1}), UP, "test")
    assert baker.bake(HERE).fine_bytes is None


def test_columns_and_classes_are_the_sectors_own(house):
    _, voxels, centre = house
    (x0, x1), (z0, z1) = (voxel_columns(i, FINE_VOXEL_SIZE_M) for i in HERE)
    assert voxels.kind.shape[1:] == (z1 - z0, x1 - x0)
    inside = ((centre > (20, 0, 20)) & (centre < (36, 12, 30))).all(axis=-1) | (centre[..., 1] < 0)
    np.testing.assert_array_equal(voxels.kind == VOXEL_SOLID, inside)


def test_weights_are_near_surfaces_only_and_sum_to_one(house):
    _, voxels, centre = house
    total = voxels.weight.sum(axis=3)
    lit = total > 0
    np.testing.assert_allclose(total[lit], 1, atol=1e-6)
    outside = np.maximum(np.maximum((20, 0, 20) - centre, centre - (36, 12, 30)), 0)
    to_house, to_ground = np.linalg.norm(outside, axis=-1), np.abs(centre[..., 1])
    to_surface = np.minimum(to_house, to_ground)
    air = voxels.kind == VOXEL_OUTDOORS
    assert not lit[air & (to_surface > 3.3)].any()  # NEAR_SURFACE_M, and nothing beyond it
    assert lit[air & (to_surface < 2.0)].all()
    solid = voxels.kind == VOXEL_SOLID
    depth = np.minimum.reduce([centre[..., 0] - 20, 36 - centre[..., 0], 12 - centre[..., 1], centre[..., 2] - 20, 30 - centre[..., 2]])
    above_ground = solid & (centre[..., 1] > 2)
    assert lit[above_ground & (depth < FINE_VOXEL_SIZE_M)].all()
    assert not lit[above_ground & (depth > (SOLID_REACH_VOXELS + 1) * FINE_VOXEL_SIZE_M)].any()


def test_no_voxel_blends_a_probe_behind_a_wall_without_thickness(build):
    scene = build().ground().quad((WALL_X, 0, 0), (0, 10, 0), (0, 0, 64)).scene()
    probes, voxels, centre = baked(scene)
    lit = np.argwhere(voxels.weight > 0)
    at = centre[tuple(lit[:, :3].T)]
    probe = probes[voxels.probe[tuple(lit.T)]]
    # At its ends they see past it.
    beside = (np.abs(at[:, 0] - WALL_X) < 3) & (at[:, 1] > 0) & (at[:, 1] < 6) & (np.abs(at[:, 2] - 32) < 24)
    assert beside.sum() > 1000
    over_the_top = probe[:, 1] > 9
    assert ((at[:, 0] < WALL_X) == (probe[:, 0] < WALL_X))[beside & ~over_the_top].all()


def test_fitted_weights_need_no_more_than_the_scene(build):
    """The adaptive bake fits fine voxels to trial light at their own places: same form, other weights."""
    scene = build().ground().box((20, 0, 20), (36, 12, 30)).scene()
    _, fitted, _ = baked(scene, placement="adaptive", voxel_weights="fitted", voxel_candidates=24, margin_m=3.2, trial_rays_per_face_edge=4)
    _, nearest, _ = baked(scene, placement="adaptive", voxel_candidates=24, margin_m=3.2, trial_rays_per_face_edge=4)
    lit = fitted.weight.sum(axis=3) > 0
    np.testing.assert_array_equal(lit, nearest.weight.sum(axis=3) > 0)
    assert np.abs(fitted.weight - nearest.weight).max() > 0.1
