"""Which voxels lend their light to which, and how rooms are named."""

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from gi_core.constants import VOXEL_OUTDOORS
from gi_core.errors import InputError
from gi_core.rooms import find_room, nearest, outdoor_blend, rooms_of, rooms_with_light
from gi_core.world import Room

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
