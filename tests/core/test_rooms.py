"""Which voxels lend their light to which, and how rooms are named."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from gi_core.constants import OPENING_DEPTH_M, VOXEL_OUTDOORS
from gi_core.errors import InputError
from gi_core.rooms import find_room, light_shares, nearest, opening_nearness, outdoor_blend, rooms_of, rooms_with_light, weight_lattice
from gi_core.world import Opening, Room

ROOMS = (Room("hall", (0, 0, 0), (10, 4, 10)), Room("2", (8, 0, 8), (20, 4, 20)), Room("attic", (0, 4, 0), (10, 6, 10)))


@pytest.mark.parametrize("shape", [(16, 32, 32), (3, 1, 5), (40, 21, 20), (900, 4, 3), (1, 6, 7)])
@pytest.mark.parametrize("share", [0.001, 0.1, 1.0])
def test_the_nearest_is_as_near_as_scipys(shape, share):
    rng = np.random.default_rng(3)
    wanted = rng.random(shape) < share
    wanted[tuple(rng.integers(0, shape))] = True
    y, z, x = nearest(wanted)
    assert wanted[y, z, x].all()
    found = np.sqrt(sum((a - b) ** 2 for a, b in zip((y, z, x), np.indices(shape), strict=True)))
    np.testing.assert_allclose(found, distance_transform_edt(~wanted))


def test_outdoors_nothing_blends_what_a_room_has(make_sector):
    sector = make_sector(5)
    sector.probe_room[:] = np.arange(sector.probe_count) < 4
    baked = (sector.probe_room[sector.voxel_probe] * sector.voxel_weight).any(axis=3)
    lends = (sector.voxel_class == VOXEL_OUTDOORS) & ~baked
    assert lends.any()
    assert (baked & (sector.voxel_class == VOXEL_OUTDOORS)).any()
    probe, weight = outdoor_blend(sector)
    assert not (sector.probe_room[probe] * weight).any()
    np.testing.assert_array_equal(probe[lends], sector.voxel_probe[lends])
    lent = {row.tobytes() for row in sector.voxel_weight[lends]}
    assert {row.tobytes() for row in weight[~lends]} <= lent


def test_where_nothing_outdoors_is_free_of_rooms_nothing_is_lent(make_sector):
    sector = make_sector(5)
    sector.probe_room[:] = 1
    assert not outdoor_blend(sector)[1].any()


def test_voxels_without_weights_stay_without(make_sector):
    """Fine ones far from surfaces, which the coarse ones speak for."""
    sector = make_sector(5)
    sector.probe_room[:] = np.arange(sector.probe_count) < 4
    sector.voxel_weight[1:] = 0
    _, weight = outdoor_blend(sector)
    assert weight[0].any(axis=2).all()
    assert not weight[1:].any()


def test_a_sector_without_probes_in_rooms_is_as_it_was_baked(make_sector):
    sector = make_sector(5)
    sector.probe_room[:] = 0
    probe, weight = outdoor_blend(sector)
    assert probe is sector.voxel_probe
    assert weight is sector.voxel_weight


def test_rooms_are_found_by_name_then_by_number():
    assert [find_room(ROOMS, text) for text in ("hall", "attic", "1", "3", "2")] == [1, 3, 1, 3, 2]
    for text in ("0", "4", "-1", "cellar", ""):
        with pytest.raises(InputError, match=r"expected one of 'hall', '2', 'attic', or a number of 1 to 3"):
            find_room(ROOMS, text)
    with pytest.raises(InputError, match="this world has none"):
        find_room((), "hall")


def test_where_rooms_overlap_the_first_one_counts():
    at = np.array([[9.0, 1, 9], [15, 1, 15], [5, 5, 5], [5, 9, 5]])
    assert rooms_of(at, ROOMS).tolist() == [1, 2, 3, 0]


def test_a_room_s_light_is_what_its_own_probes_give_alone(make_sector):
    sector = make_sector(7, probes=6, voxel_probes=2)
    found = rooms_with_light(sector)
    for place in np.ndindex(sector.voxel_room.shape):
        room, weights = sector.voxel_room[place], sector.voxel_weight[place]
        rooms = {sector.probe_room[p] for p, w in zip(sector.voxel_probe[place], weights, strict=True) if w > 0}
        assert found[place] == (room if rooms == {room} else 0)
    assert (found > 0).any()
    assert not rooms_with_light(make_sector(7, probes=0)).any()


# Two rooms with 20 cm of wall between them at x = 10, a door in it, and a window of the first room in its wall at z = 0.
DOOR, WINDOW = ((10.0, -2.1, 3.5), (10.2, 2.1, 4.5)), Opening((2.0, 0.9, 0.0), (4.0, 2.4, 0.0))
HALL = Room("hall", (0, 0, 0), (10, 3, 8), (WINDOW, Opening(*DOOR, 2)))
STUDY = Room("study", (10.2, 0, 0), (18, 3, 8), (Opening(*DOOR, 1),))
PAIR = (HALL, STUDY)


def mixed(position, surface=None) -> np.ndarray:
    """Shares (n, 3) of the open air, the hall and the study."""
    shares = light_shares(position, PAIR, surface)
    assert (shares.share > 0).all()
    found = np.stack([shares.of(number, len(position)) for number in range(3)], axis=1)
    np.testing.assert_allclose(found.sum(axis=1), 1, atol=1e-6)
    return found


def test_through_a_door_each_room_gives_way_to_the_other_and_none_to_the_street():
    x = np.arange(5.0, 15.2, 0.01)
    way = np.stack([x, np.full(len(x), 1e-3), np.full(len(x), 4.0)], axis=1)
    found = mixed(way)
    assert not found[:, 0].any()
    doorway = (x >= 10.0 + 1e-6) & (x <= 10.2 - 1e-6)
    np.testing.assert_array_equal(found[doorway], np.tile([0, 0.5, 0.5], (doorway.sum(), 1)))
    assert (np.diff(found[:, 1]) <= 1e-6).all()
    # By MATH.md's bound, for a door 1 m wide and 4.2 m high with what lies below the floor.
    assert np.abs(np.diff(found[:, 1])).max() < 0.01 * np.hypot(0.5, 2.1) / (0.5 * 2.1) / (0.75 * np.pi)
    np.testing.assert_array_equal(found[[0, -1]], [[0, 1, 0], [0, 0, 1]])
    mirrored = np.stack([20.2 - way[:, 0], way[:, 1], way[:, 2]], axis=1)
    np.testing.assert_allclose(mixed(mirrored)[:, 2], found[:, 1], atol=1e-6)


def test_walls_part_two_rooms_sharply_beside_their_door():
    beside = np.array([[9.99, 1, 2], [10.21, 1, 2], [9.99, 1, 4.6], [10.21, 2.2, 4.0], [10.1, 1, 2], [5, 1, -0.5], [9.9, 1, -0.01]])
    np.testing.assert_array_equal(mixed(beside).argmax(axis=1), [1, 2, 1, 2, 0, 0, 0])
    assert mixed(beside).max(axis=1).tolist() == [1.0] * len(beside)
    # A door's reveal is lit from both sides, though light is sampled off it: here in the wall beyond the door.
    reveal = np.array([[10.1, 1, 3.52], [10.1, 2.08, 4.0]])
    np.testing.assert_array_equal(mixed(reveal + np.array([[0, 0, 1.2], [0, -0.78, 0]]), reveal), [[0, 0.5, 0.5]] * 2)


def test_a_window_and_a_door_have_each_their_share():
    """Where both are in view, and beside the window, on the street."""
    near = np.array([[3.0, 1.6, 0.5], [3.0, 1.6, -0.5], [9.5, 1.0, 4.0]])
    found = mixed(near)
    window, door = opening_nearness(HALL, near), opening_nearness(HALL, near, 2)
    assert window.min() == door[:2].max() == 0
    np.testing.assert_allclose(found[0], [window[0] / 2, 1 - window[0] / 2, 0], atol=1e-6)
    np.testing.assert_allclose(found[1], [1 - window[1] / 2, window[1] / 2, 0], atol=1e-6)
    np.testing.assert_allclose(found[2], [0, 1 - door[2] / 2, door[2] / 2], atol=1e-6)
    corner = Room(
        "hall", (0, 0, 0), (10, 3, 8), (Opening((8.5, 0.0, 0.0), (10.0, 3.0, 0.0)), Opening((10.0, 0.0, 0.0), (10.2, 3.0, 1.5), 2))
    )
    at = np.array([[9.4, 1.5, 0.6]])
    open_air, study = opening_nearness(corner, at)[0], opening_nearness(corner, at, 2)[0]
    assert min(open_air, study) > 0.1
    shares = light_shares(at, (corner, STUDY))
    assert [shares.of(number, 1)[0] for number in (0, 2)] == pytest.approx([open_air / 2, study / 2])
    assert shares.of(1, 1)[0] == pytest.approx(1 - open_air / 2 - study / 2)


def test_an_opening_fills_of_the_view_what_its_solid_angle_is():
    """Of a cube's faces each fills a sixth of what its middle sees: 1 m before a square of 2 m, a third of half the view."""
    room = Room("hall", (0, 0, 0), (10, 4, 8), (Opening((4.0, 1.0, 0.0), (6.0, 3.0, 0.0)),))
    before = np.array([[5.0, 2.0, 1.0], [5.0, 2.0, -1.0]])
    np.testing.assert_allclose(opening_nearness(room, before), (1 / 3 - 1 / 4) / (3 / 4), atol=1e-6)
    np.testing.assert_allclose(light_shares(before, (room,)).of(1, 2), [1 - 1 / 18, 1 / 18], atol=1e-6)
    # Textures have it from an eighth of a voxel nearer.
    nearer = opening_nearness(room, before * [1, 1, 1 - OPENING_DEPTH_M])
    np.testing.assert_allclose(opening_nearness(room, before, nearer_m=OPENING_DEPTH_M), nearer, atol=1e-6)


def test_in_a_window_through_a_thick_wall_room_and_street_are_halves():
    """From side to side of a wall of 1 m, reveals included, though light is sampled off those in the masonry; and it ends at the wall."""
    room = Room("hall", (0, 0, 0), (10, 4, 8), (Opening((4.0, 1.0, -1.0), (6.0, 3.0, 0.0)),))
    z = np.linspace(-2.0, 1.0, 301)
    way = np.stack([np.full(301, 5.0), np.full(301, 2.0), z], axis=1)
    share = light_shares(way, (room,)).of(1, 301)
    np.testing.assert_allclose(share[(z > -0.999) & (z < -0.001)], 0.5)
    assert (np.diff(share) >= -1e-6).all()
    assert np.diff(share).max() < 0.01 * np.sqrt(2) / (0.75 * np.pi)  # MATH.md's bound for half sides of 1 m
    np.testing.assert_allclose(share + share[::-1], 1, atol=1e-6)
    reveal = np.array([[4.02, 2.0, -0.9], [5.0, 1.02, -0.5]])
    np.testing.assert_allclose(light_shares(reveal + 0.78 * np.array([[1, 0, 0], [0, 1, 0]]), (room,), reveal).of(1, 2), 0.5)
    beside = np.array([[3.9, 2.0, -0.5], [3.9, 2.0, -1.02], [5.0, 3.1, -1.02]])
    assert not light_shares(beside, (room,)).of(1, 3).any()


def test_a_point_a_hair_behind_a_wall_is_the_rooms_that_it_is_seen_from():
    """The ceiling met behind the edge of a wall: 0.4 mm in it. In the wall's middle it is not."""
    assert mixed(np.array([[5.0, 2.0, -4e-4], [18.0004, 1, 4], [5, 2, -0.01]])).argmax(axis=1).tolist() == [1, 2, 0]


def test_a_lattice_tells_of_the_doors_to_one_room():
    door = Opening((10.0, -2.1, 3.5), (10.6, 2.1, 4.5), 2)  # through a wall that has a cell's centre in it
    pair = (replace(HALL, openings=(WINDOW, door)), replace(STUDY, minimum=(10.6, 0, 0)))
    both = weight_lattice(np.array([-2, -2, -2]), pair, (1,)), weight_lattice(np.array([-2, -2, -2]), pair, (1,), 2)
    y, z, x = np.meshgrid(*(0.78125 * (np.arange(n) + 0.5) - 6.25 for n in (64, 128, 128)), indexing="ij")
    at = np.stack([x, y, z], axis=-1)
    for weight, to in zip(both, (0, 2), strict=True):
        np.testing.assert_allclose(
            weight[1].reshape(-1), 255 * opening_nearness(pair[0], at.reshape(-1, 3), to, OPENING_DEPTH_M), atol=0.5001
        )
        assert weight[1].any()
    between = ((at >= door.minimum) & (at <= door.maximum)).all(axis=-1)
    assert between.any()
    np.testing.assert_array_equal(both[1][0], np.where(between, 127, both[0][0]))
