"""Triangles cut at sector borders: nothing lost, nothing twice, no cracks between sectors."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bake_jobs.geometry_clip import SectorCutter, clip
from bake_jobs.scene import Scene
from gi_core import geometry_file
from gi_core.constants import SECTOR_SIZE_M
from gi_core.grid import SectorIndex
from gi_core.quantise import STEPS_PER_METRE

# Coordinates that tidy cities love: on borders, on whole metres; and any others.
COORDINATE = st.one_of(st.sampled_from([-64.0, 0.0, 32.0, 64.0, 128.0]), st.integers(-150, 150).map(float), st.floats(-150, 150))
TRIANGLES = st.lists(st.lists(COORDINATE, min_size=9, max_size=9), min_size=1, max_size=6)


def areas(corners):
    return np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2


def scene_of(corners) -> Scene:
    corners = np.asarray(corners, np.float64).reshape(-1, 3, 3)
    count = len(corners)
    colour = np.linspace(0.1, 0.9, count, dtype=np.float32)[:, None].repeat(3, axis=1)
    return Scene(corners.reshape(-1, 3), np.arange(3 * count, dtype=np.int32).reshape(-1, 3), colour, np.zeros_like(colour))


def pieces(geometry):
    return geometry.vertices[geometry.triangles]


@settings(max_examples=60, deadline=None)
@given(TRIANGLES)
def test_the_sectors_areas_sum_to_the_scenes_for_every_triangle(corners):
    scene = scene_of(corners)
    cutter = SectorCutter(scene)
    total = np.zeros(len(scene.triangles))
    for index in cutter.sectors():
        cut = cutter.cut(index)
        own = pieces(cut)
        local = own[..., [0, 2]] - index.origin[[0, 2]]
        assert (local >= -1e-9).all()
        assert (local <= SECTOR_SIZE_M + 1e-9).all()
        for triangle in range(len(total)):  # colours tell the triangles apart
            total[triangle] += areas(own[cut.albedo[:, 0] == scene.albedo[triangle, 0]]).sum()
    # Pieces of less than 1e-9 m2 are dropped; float64 cuts of triangles of up to 4e4 m2.
    np.testing.assert_allclose(total, areas(scene.vertices[scene.triangles]), atol=1e-6, rtol=1e-9)


@settings(max_examples=40, deadline=None)
@given(TRIANGLES)
def test_pieces_keep_their_triangles_plane_and_winding(corners):
    scene = scene_of(corners)
    cutter = SectorCutter(scene)
    whole = scene.vertices[scene.triangles]
    normals = np.cross(whole[:, 1] - whole[:, 0], whole[:, 2] - whole[:, 0])
    for index in cutter.sectors():
        cut = cutter.cut(index)
        own = pieces(cut)
        for piece, colour in zip(own, cut.albedo[:, 0], strict=True):
            triangle = int(np.flatnonzero(scene.albedo[:, 0] == colour)[0])
            normal = np.cross(piece[1] - piece[0], piece[2] - piece[0])
            if np.linalg.norm(normal) > 1e-3 and np.linalg.norm(normals[triangle]) > 1e-3:  # slivers' normals are rounding
                assert normal @ normals[triangle] > 0


def test_a_wall_on_a_border_belongs_to_the_sector_that_starts_there():
    wall = [[64, 0, 10], [64, 5, 10], [64, 5, 40]]
    cutter = SectorCutter(scene_of([wall]))
    assert cutter.sectors() == [SectorIndex(1, 0)]
    assert len(cutter.cut(SectorIndex(1, 0)).triangles) == 1
    assert len(cutter.cut(SectorIndex(0, 0)).triangles) == 0


def test_sectors_are_those_that_a_surface_reaches_not_its_bounding_box():
    thin_diagonal = [[1, 0, 1], [191, 0, 190], [190, 0, 191]]
    found = SectorCutter(scene_of([thin_diagonal])).sectors()
    assert {SectorIndex(i, i) for i in range(3)} <= set(found)
    assert SectorIndex(2, 0) not in found
    assert SectorIndex(0, 2) not in found
    assert found == sorted(found, key=lambda s: (s.z, s.x))


@pytest.mark.parametrize("index", [(0, 0), (-2, 3), (781, -800)])
def test_neighbours_store_the_same_vertices_on_their_common_border(index):
    """Random triangles across a border: what each sector's file holds there must meet without a crack."""
    here, there = SectorIndex(*index), SectorIndex(index[0] + 1, index[1])
    rng = np.random.default_rng(5)
    corners = here.origin + rng.uniform([30, 0, 5], [98, 30, 59], (40, 3, 3))
    cutter = SectorCutter(scene_of(corners))
    on_border = []
    for sector in (here, there):
        data = geometry_file.encode(sector, cutter.cut(sector), "b" * 32)
        found = geometry_file.decode(data, "here")[0]
        steps = np.rint((found.vertices - here.origin) * STEPS_PER_METRE).astype(int)
        on_border.append({tuple(v) for v in steps[steps[:, 0] == SECTOR_SIZE_M * STEPS_PER_METRE].tolist()})
    assert len(on_border[0]) > 40
    assert on_border[0] == on_border[1]


def test_a_cut_leaves_one_or_two_triangles_and_names_their_source():
    triangle = np.array([[[0.0, 0, 0], [10, 0, 0], [0, 0, 10]], [[20, 0, 0], [21, 0, 0], [20, 0, 1]]])
    left, from_left = clip(triangle, 0, 5.0, keep_above=False)
    right, from_right = clip(triangle, 0, 5.0, keep_above=True)
    assert from_left.tolist() == [0, 0]
    assert from_right.tolist() == [0, 1]
    assert areas(left).sum() == pytest.approx(37.5)
    assert areas(right).sum() == pytest.approx(12.5 + 0.5)


@pytest.mark.parametrize("x", [0.0, 64.0, -64.0])
def test_a_triangle_that_ends_on_a_border_stays_on_its_side(x):
    west = [[x - 10, 0, 1], [x, 0, 5], [x - 10, 0, 9]]
    cutter = SectorCutter(scene_of([west]))
    assert cutter.sectors() == [SectorIndex(int(x // 64) - 1, 0)]
    assert areas(pieces(cutter.cut(cutter.sectors()[0]))).sum() == pytest.approx(40.0)
