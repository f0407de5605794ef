"""Voxels, sun bits and snow of baked sectors whose answers can be written down."""

import numpy as np
import pytest

from bake_jobs.config import ADAPTIVE, settings_for
from bake_jobs.inside import Solids
from bake_jobs.placement import place_probes
from bake_jobs.rays import SURFACE_OFFSET_M, RayScene
from bake_jobs.voxels import blend
from gi_core.constants import ROOM_OUTDOORS, VOXEL_INDOORS, VOXEL_OUTDOORS, VOXEL_SIZE_M, VOXEL_SOLID
from gi_core.grid import SectorIndex, voxel_columns
from gi_core.relight_twin import sun_bits
from gi_core.rooms import rooms_of
from gi_core.world import Room

HALL = Room("hall", (20.0, 0.0, 20.0), (44.0, 8.0, 44.0))
QUICK = {"rays_per_face_edge": 4}  # voxels and placement don't look at cube maps


def hall_scene(build):
    """A solid house, and a hall with walls 0.3 m thick that an author declared a room. A ground so large that edges are far."""
    house = build().ground().box((4, 0, 4), (14, 12, 14)).box((50, 0, 20), (62, 25, 60))
    house.box(HALL.minimum, HALL.maximum, inward=True).box((19.7, 0, 19.7), (44.3, 8.3, 44.3))
    return house.scene(rooms=(HALL,))


@pytest.fixture(scope="module")
def hall(build, bake_arrays):
    scene = hall_scene(build)
    sector, meta = bake_arrays(scene, **QUICK)
    return scene, sector, meta


def centres(sector):
    """(ny, nz, nx, 3) float64 [m], sector-local (the sector is 0, 0)."""
    ny, nz, nx = sector.voxel_class.shape
    y, z, x = np.meshgrid(np.arange(ny), np.arange(nz), np.arange(nx), indexing="ij")
    return (np.stack([x, y, z], axis=-1) + sector.voxel_first + 0.5) * VOXEL_SIZE_M


@pytest.mark.parametrize("index", [(0, 0), (-1, 0), (1, -2)])
def test_voxels_cover_exactly_the_columns_of_the_sector(build, bake_arrays, index):
    sector, _ = bake_arrays(build().ground().scene(), index, **QUICK)
    x, z = (voxel_columns(i) for i in index)
    assert (sector.voxel_first[0], sector.voxel_first[2]) == (x[0], z[0])
    assert sector.voxel_class.shape[1:] == (z[1] - z[0], x[1] - x[0])
    centre = (sector.voxel_first + 0.5) * VOXEL_SIZE_M - SectorIndex(*index).origin
    assert 0 < centre[0] < VOXEL_SIZE_M
    assert 0 < centre[2] < VOXEL_SIZE_M


def test_classes_of_a_house_and_a_hall(hall):
    _, sector, _ = hall
    c = centres(sector)
    sure = 0.35  # beyond the hall's walls
    in_house = ((c > np.array([4, 0, 4])) & (c < np.array([14, 12, 14]))).all(axis=-1)
    in_hall = ((c > np.array(HALL.minimum)) & (c < np.array(HALL.maximum))).all(axis=-1)
    near_hall = ((c > np.array(HALL.minimum) - sure) & (c < np.array(HALL.maximum) + sure)).all(axis=-1)
    in_tower = ((c > np.array([50, 0, 20])) & (c < np.array([62, 25, 60]))).all(axis=-1)
    open_air = (c[..., 1] > 0) & ~in_house & ~near_hall & ~in_tower
    assert (sector.voxel_class[in_house | in_tower] == VOXEL_SOLID).all()
    assert (sector.voxel_class[in_hall] == VOXEL_INDOORS).all()
    assert (sector.voxel_room[in_hall] == 1).all()
    assert (sector.voxel_class[open_air] == VOXEL_OUTDOORS).all()
    assert (sector.voxel_room[~in_hall] == ROOM_OUTDOORS).all()
    assert min(in_house.sum(), in_hall.sum(), in_tower.sum()) > 20


def test_weights_of_every_voxel_sum_to_one_and_name_probes(hall):
    _, sector, _ = hall
    np.testing.assert_allclose(sector.voxel_weight.sum(axis=3), 1, atol=1e-6)
    assert (sector.voxel_weight >= 0).all()
    assert sector.voxel_probe.max() < sector.probe_count


def test_free_voxels_blend_what_they_see_and_only_their_own_room(hall):
    scene, sector, meta = hall
    rays = RayScene(scene.vertices, scene.triangles)
    c = centres(sector)
    blind = 0
    for y, z, x in np.argwhere(sector.voxel_class != VOXEL_SOLID):
        used = sector.voxel_probe[y, z, x][sector.voxel_weight[y, z, x] > 0]
        room = sector.voxel_room[y, z, x]
        assert (sector.probe_room[used] == room).all()
        offset = sector.probe_position[used] - c[y, z, x]
        distance = np.linalg.norm(offset, axis=1)
        blocked = rays.occluded(np.tile(c[y, z, x], (len(used), 1)), offset / distance[:, None], distance - SURFACE_OFFSET_M)
        if blocked.any():
            # It sees none of its candidates, and takes the closest of its room.
            blind += 1
            assert len(used) == 1
            own_room = np.flatnonzero(sector.probe_room == room)
            closest = np.linalg.norm(sector.probe_position[own_room] - c[y, z, x], axis=1).min()
            assert distance[0] == pytest.approx(closest, abs=1e-4)
    assert blind <= meta["voxels_blind"]  # which counts the margin's too
    assert (sector.voxel_room == 1).any()


@pytest.mark.parametrize("settings", [{}, {**ADAPTIVE, "trial_rays_per_face_edge": 4}], ids=["grid", "adaptive"])
def test_no_voxel_blends_a_probe_behind_a_plane_without_thickness(build, bake_arrays, settings):
    wall_x = 30.0
    scene = build().ground().quad((wall_x, 0, -40), (0, 12, 0), (0, 0, 144)).scene()
    sector, _ = bake_arrays(scene, **QUICK, **settings)
    at = centres(sector)[..., None, :]
    probe = sector.probe_position[sector.voxel_probe]
    used = (sector.voxel_weight > 0) & (at[..., 1] > 0) & (at[..., 1] < 9) & (probe[..., 1] < 12)
    assert (used & (np.abs(at[..., 0] - wall_x) < 4)).sum() > 100
    assert ((at[..., 0] < wall_x) == (probe[..., 0] < wall_x))[used].all()


def test_solid_voxels_blend_what_some_nearest_air_blends(hall):
    _, sector, _ = hall
    air = np.argwhere(sector.voxel_class != VOXEL_SOLID)
    _, nz, nx = sector.voxel_class.shape
    for at in np.argwhere(sector.voxel_class == VOXEL_SOLID)[::5]:
        if min(at[1], at[2], nz - 1 - at[1], nx - 1 - at[2]) < 4:
            continue  # the nearest may lie in the neighbour's columns
        squared = ((air - at) ** 2).sum(axis=1)
        own = sector.voxel_probe[tuple(at)].tolist(), sector.voxel_weight[tuple(at)].tolist()
        nearest = [(sector.voxel_probe[tuple(n)].tolist(), sector.voxel_weight[tuple(n)].tolist()) for n in air[squared == squared.min()]]
        assert own in nearest


def test_neighbouring_sectors_fill_solids_on_their_border_alike(build, bake_arrays):
    """A voxel of the border column blends air near it, from whichever side, so that no seam shows."""
    scene = build().ground().box((58, 0, 10), (70, 12, 50)).scene()
    west, east = (bake_arrays(scene, (x, 0), **QUICK)[0] for x in (0, 1))
    for sector in (west, east):
        np.testing.assert_allclose(sector.voxel_weight.sum(axis=3), 1, atol=1e-6)
    assert (west.voxel_class[:, :, -1] == VOXEL_SOLID).any()
    assert west.voxel_first[0] + west.voxel_class.shape[2] == east.voxel_first[0]


def test_a_room_without_a_probe_of_its_own_is_not_black(build, bake_arrays):
    closet = Room("closet", (30.0, 20.0, 30.0), (34.0, 24.0, 34.0))  # up in the air: no floor, no wall, no probe
    sector, _ = bake_arrays(build().ground().scene(rooms=(closet,)), **QUICK)
    inside = sector.voxel_room == 1
    assert inside.any()
    assert not (sector.probe_room == 1).any()
    np.testing.assert_allclose(sector.voxel_weight[inside].sum(axis=1), 1, atol=1e-6)


def test_a_sector_without_probes_is_empty_but_whole(build, bake_arrays):
    sector, meta = bake_arrays(build().quad((10, 0, 10), (0, 5, 0), (0, 0, 0.1)).scene(), **QUICK, margin_m=0.0)
    assert meta["probes"] == sector.probe_count
    if not sector.probe_count:
        assert not sector.voxel_weight.any()


PILLAR_LOW, PILLAR_HIGH = np.array([30.0, 0, 30.0]), np.array([34.0, 20, 34.0])


def pillar_shadow(points, direction):
    """Whether points (n, 3) on the ground look through the pillar along a direction: the slab test, in float64."""
    with np.errstate(divide="ignore", invalid="ignore"):
        enter, leave = (PILLAR_LOW - points) / direction, (PILLAR_HIGH - points) / direction
    near, far = np.minimum(enter, leave).max(axis=1), np.maximum(enter, leave).min(axis=1)
    return (near < far) & (far > 0)


def unit(*xyz):
    return np.array(xyz) / np.linalg.norm(xyz)


SUNS = np.array([unit(1, 1, 0.05), unit(-0.7, 0.6, 0.9), unit(0.02, 1, 0.03), unit(0.5, 0.12, -1)])


@pytest.fixture(scope="module")
def pillar(build, bake_arrays):
    scene = build().ground().box(PILLAR_LOW, PILLAR_HIGH).scene()
    return bake_arrays(scene, sun_directions=SUNS, rays_per_face_edge=16)[0]


@pytest.mark.parametrize("plane", range(len(SUNS)))
def test_a_pillars_shadow_falls_where_it_should(pillar, plane):
    seen = sun_bits(pillar, plane).astype(bool)
    ground = pillar.surfel_normal[:, 1] > 0.99
    ground &= pillar.surfel_position[:, 1] < 0.1
    # Hits at the very foot of a wall start within it.
    points = pillar.surfel_position.astype(np.float64)
    ground &= ~((points > PILLAR_LOW - [0.02, 1, 0.02]) & (points < PILLAR_HIGH + np.array([0.02, 1, 0.02]))).all(axis=1)
    points = points[ground]
    # Rays start 5 cm above the surfel.
    expected = pillar_shadow(points + np.array([0, 0.05, 0]), SUNS[plane])
    assert expected.sum() > (5 if SUNS[plane][1] < 0.9 else 0)
    np.testing.assert_array_equal(~seen[ground], expected)


@pytest.mark.parametrize("plane", range(len(SUNS)))
def test_surfels_that_face_away_see_no_sun_and_lone_walls_that_face_it_do(pillar, plane):
    seen = sun_bits(pillar, plane).astype(bool)
    facing = pillar.surfel_normal @ SUNS[plane]
    assert not seen[facing <= 0].any()
    walls = np.abs(pillar.surfel_normal[:, 1]) < 0.01  # nothing stands before the pillar's
    assert seen[walls & (facing > 0)].all()
    assert (walls & (facing > 0)).any()


def test_bits_beyond_the_last_surfel_are_zero(pillar):
    octets = pillar.sun_visibility.astype("<u4").view(np.uint8)
    bits = np.unpackbits(octets, axis=1, bitorder="little")
    assert bits.shape[1] % 32 == 0
    assert not bits[:, pillar.surfel_count :].any()


def test_snow_lies_on_what_is_flat_and_open(build, bake_arrays):
    scene = build().ground().box((10, 6, 10), (30, 6.4, 30)).quad((40, 0, 40), (0, 0, 20), (15, 15, 0)).scene()
    sector, _ = bake_arrays(scene, rays_per_face_edge=16)
    position, up, snow = sector.surfel_position, sector.surfel_normal[:, 1], sector.surfel_snow
    under_roof = ((position[:, [0, 2]] > 10.5) & (position[:, [0, 2]] < 29.5)).all(axis=1) & (position[:, 1] < 5)
    on_roof = ((position[:, [0, 2]] > 10.5) & (position[:, [0, 2]] < 29.5)).all(axis=1) & (up > 0.99) & (position[:, 1] > 6)
    open_ground = (position[:, 0] < 9) & (up > 0.99)
    for group, expected in ((under_roof, 0), (on_roof, 1), (open_ground, 1), (up < 0.3, 0)):
        assert group.any()
        np.testing.assert_array_equal(snow[group], expected)
    ramp = (position[:, 0] > 41) & (position[:, 0] < 54) & (position[:, 2] > 41) & (position[:, 2] < 59) & (np.abs(up - 0.7071) < 0.01)
    assert ramp.any()
    np.testing.assert_allclose(snow[ramp], 1, atol=0.01)  # 45 degrees: just flat enough


def test_room_numbers_of_voxels_come_from_their_centres(hall):
    scene, sector, _ = hall
    np.testing.assert_array_equal(sector.voxel_room.reshape(-1), rooms_of(centres(sector).reshape(-1, 3), scene.rooms))


@pytest.mark.parametrize("height", [5.0, 9.0])
def test_at_a_border_both_sectors_blend_the_same_probes(build, height):
    # A house on either side: probes along its walls are near, and each sector holds but its own. (Beside the roofs' many probes none of the
    # street's is among the candidates, and each still blends its own.)
    scene = build().ground().box((40, 0, 10), (56, 24, 50)).box((70, 0, 10), (90, 18, 50)).scene()
    rays, settings = RayScene(scene.vertices, scene.triangles), settings_for("talk")
    z = np.arange(12.0, 48.0, 2.0)
    blends = []
    for index, x in ((SectorIndex(0, 0), 64 - 1e-4), (SectorIndex(1, 0), 64 + 1e-4)):
        placed = place_probes(rays, Solids(scene.vertices, scene.triangles), scene.bounds, index, settings, (), ())
        at = np.stack([np.full_like(z, x), np.full_like(z, height), z], axis=1)
        kind, room = np.full(len(at), VOXEL_OUTDOORS, np.uint8), np.zeros(len(at), np.uint16)
        probe, weight, blind = blend(rays, at, kind, room, placed, settings, None)
        assert not blind.any()
        blends.append(np.einsum("nk,nka->na", weight, placed.position[probe]))
    # The mean place of what is blended, the same but for a weight of 1e-4 / FADE_M: by distance alone it lies metres apart.
    assert np.abs(blends[0] - blends[1]).max() < 0.01
