"""Points of comparison in a scene where it is plain what is air, wall and cellar."""

import numpy as np
import pytest

from bake_jobs.compare_points import (
    CLIENT_OFFSET_M,
    EYE_HEIGHT_M,
    MID_M,
    NEAR_M,
    choose_points,
    corner_voxels,
    look_around,
    nearest_open_voxel,
    standing_eye,
)
from bake_jobs.rays import RayScene
from gi_core.constants import VOXEL_SIZE_M
from gi_core.geometry_file import Geometry
from gi_core.grid import SectorIndex, volume_first_voxel, voxel_centre
from gi_core.sector import PROBE_IN_MARGIN, PROBE_ON_GROUND

GROUND_M = 3.0
BLOCK = np.array([[20.0, GROUND_M - 1, 20.0], [45.0, GROUND_M + 12, 40.0]])  # its bottom is open: it stands in the ground
# Of the 192 rays one meets a plane within 9 degrees of its normal (1 % too far), but a corner may lie between them (worst seen 4.4 %).
LOOK_SLACK = 1.05


def scene_geometry():
    """Ground from -200 to 264 m and one closed block, all on the floats' grid."""
    low, high = -200.0, 264.0
    ground = [[low, GROUND_M, low], [low, GROUND_M, high], [high, GROUND_M, high], [high, GROUND_M, low]]
    corners = [[BLOCK[i, 0], BLOCK[j, 1], BLOCK[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = [[0, 1, 2], [0, 2, 3]]
    for a, b, c, d in quads:
        triangles += [[4 + a, 4 + b, 4 + c], [4 + a, 4 + c, 4 + d]]
    count = len(triangles)
    return Geometry(
        np.array(ground + corners), np.array(triangles, np.int32), np.full((count, 3), 0.4, np.float32), np.zeros((count, 3), np.float32)
    )


def distance_to_scene(points):
    to_block = np.linalg.norm(np.maximum(np.maximum(BLOCK[0] - points, points - BLOCK[1]), 0), axis=1)
    return np.minimum(points[:, 1] - GROUND_M, to_block)


class StubSector:
    """What choose_points reads of a sector. Probes: in the open, in the block, in the open but in a room, in the margin."""

    index = SectorIndex(0, 0)
    probe_position = np.array([[5, 5, 5], [30, 5, 30], [6, 5, 5], [7, 5, 5]], np.float32)
    probe_room = np.array([0, 0, 1, 0], np.uint16)
    probe_flags = np.array([PROBE_ON_GROUND, 0, 0, PROBE_IN_MARGIN], np.uint8)


@pytest.fixture(scope="module")
def rays():
    geometry = scene_geometry()
    return RayScene(geometry.vertices, geometry.triangles)


@pytest.fixture(scope="module")
def chosen(rays):
    return choose_points(rays, scene_geometry(), StubSector(), 60, np.random.default_rng(3))


def inside_block(points, slack=0.0):
    return ((points > BLOCK[0] + slack) & (points < BLOCK[1] - slack)).all(axis=1)


def test_eye_stands_on_the_ground_not_on_the_roof(rays):
    np.testing.assert_allclose(standing_eye(rays, SectorIndex(0, 0), scene_geometry()), [32, GROUND_M + EYE_HEIGHT_M, 32], atol=1e-4)


def test_open_voxels_are_those_above_ground_and_outside_the_block(chosen):
    index = np.stack(np.indices(chosen.open_voxel.shape), axis=-1).reshape(-1, 3)
    centre = voxel_centre(index[:, [2, 0, 1]] + volume_first_voxel(chosen.eye))
    expected = (centre[:, 1] > GROUND_M) & ~inside_block(centre)
    np.testing.assert_array_equal(chosen.open_voxel.ravel(), expected)


@pytest.mark.parametrize(("kind", "low", "high"), [("near", 0.0, NEAR_M), ("mid", MID_M / LOOK_SLACK, np.inf)])
def test_voxels_lie_as_far_from_surfaces_as_their_stage_says(chosen, kind, low, high):
    voxels = getattr(chosen, kind)
    assert len(voxels) == 60
    assert chosen.open_voxel[tuple(voxels.T)].all()
    centre = voxel_centre(voxels[:, [2, 0, 1]] + volume_first_voxel(chosen.eye))
    assert ((centre[:, [0, 2]] >= 0) & (centre[:, [0, 2]] < 64)).all()
    distance = distance_to_scene(centre)
    assert (distance >= low).all()
    assert (distance <= high).all()


def test_only_open_air_probes_of_the_sector_itself_are_compared(chosen):
    np.testing.assert_array_equal(chosen.probe, [0])
    np.testing.assert_array_equal(chosen.probe_position, [[5, 5, 5]])


def test_surface_points_lie_on_surfaces_and_look_into_open_air(chosen):
    point, normal = chosen.surface, chosen.normal
    assert len(point) == 60
    assert np.abs(distance_to_scene(point)).max() < 1e-5  # float32 geometry within 500 m
    off = point + 0.5 * CLIENT_OFFSET_M * normal
    assert (distance_to_scene(off) > 0.1).all()
    assert not inside_block(off).any()
    on_ground = point[:, 1] == GROUND_M
    assert 5 < on_ground.sum() < 55  # both kinds occur
    np.testing.assert_array_equal(normal[on_ground], np.tile([0.0, 1, 0], (on_ground.sum(), 1)))
    assert not inside_block(point[on_ground] + [0, 0.01, 0]).any()


def test_the_same_seed_chooses_the_same_points(rays, chosen):
    again = choose_points(rays, scene_geometry(), StubSector(), 60, np.random.default_rng(3))
    other = choose_points(rays, scene_geometry(), StubSector(), 60, np.random.default_rng(4))
    for name in ("near", "mid", "surface", "normal"):
        np.testing.assert_array_equal(getattr(chosen, name), getattr(again, name))
        assert not np.array_equal(getattr(chosen, name), getattr(other, name))


def test_inside_the_block_and_under_the_ground_is_no_open_air(rays):
    seen = look_around(rays, np.array([[30.0, 5, 30], [30.0, GROUND_M - 0.5, 30], [30, GROUND_M + 12.5, 30], [2.0, 4, 2]]))
    np.testing.assert_array_equal(seen.open_air, [False, False, True, True])


def test_nearest_open_voxel():
    open_voxel = np.zeros((16, 32, 32), bool)
    open_voxel[3, 4, 5] = open_voxel[9, 20, 20] = True
    nearest = nearest_open_voxel(open_voxel)
    np.testing.assert_array_equal(nearest[:, 3, 4, 5], [3, 4, 5])
    np.testing.assert_array_equal(nearest[:, 0, 0, 0], [3, 4, 5])
    np.testing.assert_array_equal(nearest[:, 15, 31, 31], [9, 20, 20])


def test_corner_voxels_surround_the_point():
    origin = np.array([10.0, -5.0, 30.0])
    points = origin + VOXEL_SIZE_M * np.array([[2.25, 7.5, 11.75], [31.5, 15.5, -0.5]])
    corners = corner_voxels(points, origin)
    assert {tuple(c) for c in corners[0].tolist()} == {(y, z, x) for y in (7, 8) for z in (11, 12) for x in (2, 3)}
    assert {tuple(c) for c in corners[1].tolist()} == {(15, 0, 31)}  # beyond the edge the outermost voxel is read


def test_nothing_in_an_empty_sector():
    empty = Geometry(np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32))
    points = choose_points(RayScene(empty.vertices, empty.triangles), empty, StubSector(), 5, np.random.default_rng(0))
    assert len(points.surface) == len(points.near) == 0
