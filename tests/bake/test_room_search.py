"""Rooms that are found: what is enclosed and can be walked into is one, what the sky or the street reaches is not."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from bake_jobs.air_basins import find_basins
from bake_jobs.room_openings import THICKEST_M
from bake_jobs.room_search import world_rooms
from bake_jobs.scene_source import load_scene
from gi_core.constants import OPENING_LEAST_VIEW, ROOM_CELL_M
from gi_core.errors import SourceError
from gi_core.rooms import holds, light_shares, rooms_of
from gi_core.world import Room

WALL = 0.2
DOOR, WINDOW = (1.0, 2.0), (1.4, 0.9, 2.2)  # widths [m], heads, and a sill


def house(block, low, high, height=2.8, door=True, window=True, roof=True, along=2.0):
    """Four walls about the inside of a box on the ground (x, z), a roof, and so far along the walls at the lowest z and x a door and a
    window."""
    (x0, z0), (x1, z1), h = low, high, WALL / 2
    doors = [(along, -0.1, along + DOOR[0], DOOR[1])] if door else []
    windows = [(along, WINDOW[1], along + WINDOW[0], WINDOW[2])] if window else []
    block.wall((x0 - WALL, z0 - h), (x1 + WALL, z0 - h), height, doors)
    block.wall((x0 - WALL, z1 + h), (x1 + WALL, z1 + h), height)
    block.wall((x0 - h, z0 - WALL), (x0 - h, z1 + WALL), height, windows)
    block.wall((x1 + h, z0 - WALL), (x1 + h, z1 + WALL), height)
    if roof:
        block.box((x0 - WALL, height - 0.01, z0 - WALL), (x1 + WALL, height + 0.3, z1 + WALL))
    return block


def found(block, search="open", **fields):
    return world_rooms(block.scene(**fields), search)


@pytest.fixture
def ground(build):
    return build().ground((-64, -64), (128, 128))


def test_a_house_with_a_door_and_a_window_is_one_room_that_ends_at_its_walls(ground):
    (room,) = found(house(ground, (10.3, 20.15), (18.4, 26.2)))
    assert room.name == "found-1"
    np.testing.assert_allclose(room.minimum, (10.3, 0, 20.15), atol=2e-3)
    np.testing.assert_allclose(room.maximum, (18.4, 2.79, 26.2), atol=2e-3)
    door, window = sorted(room.openings, key=lambda opening: opening.minimum[1])
    # From rim to rim, and to the wall's outer side, told to 1 cm; a door goes on below the floor as far as it is high.
    np.testing.assert_allclose((door.minimum, door.maximum), ((12.1, -2.0, 20.15 - WALL), (13.1, 2.0, 20.15)), atol=0.012)
    np.testing.assert_allclose((window.minimum, window.maximum), ((10.3 - WALL, 0.9, 21.95), (10.3, 2.2, 23.35)), atol=0.012)
    rng = np.random.default_rng(1)
    inside = rng.uniform(room.minimum, room.maximum, (2000, 3))
    assert holds(room, inside).all()
    outside = rng.uniform((8, 0, 18), (21, 4, 29), (2000, 3))
    outside = outside[((outside < room.minimum) | (outside > room.maximum)).any(axis=1)]
    assert not holds(room, outside).any()


def test_a_house_at_an_angle_is_a_room_too(build):
    block = build().ground((-64, -64), (64, 64))
    turn = np.array([[np.cos(0.5), -np.sin(0.5)], [np.sin(0.5), np.cos(0.5)]])
    corners = np.array([(0, 0), (8, 0), (8, 6), (0, 6)]) @ turn.T
    for number in range(4):
        block.wall(corners[number], corners[(number + 1) % 4], 2.8, [(3.0, -0.1, 4.0, 2.0)] if number == 0 else ())
    block.box((-10, 2.79, -10), (12, 3.1, 12))  # a roof that overhangs all of it
    (room,) = found(block)
    rng = np.random.default_rng(2)
    points = rng.uniform((-9, 0.1, -9), (11, 2.7, 11), (20_000, 3))
    local = points[:, [0, 2]] @ turn
    # Beside walls that follow no axis a room's edge is as sharp as its cells: to half the diagonal of one, and the grown wall (4 cm).
    edge = ROOM_CELL_M * np.sqrt(0.5) + 0.04
    low, high = np.array([0, 0]) + WALL / 2, np.array([8, 6]) - WALL / 2
    inside = ((local > low + edge) & (local < high - edge)).all(axis=1)
    outside = ((local < low - edge) | (local > high + edge)).any(axis=1)
    assert holds(room, points[inside]).all()
    assert not holds(room, points[outside]).any()
    assert len(room.openings) >= 1


def test_two_rooms_with_a_door_between_are_two(ground):
    block = house(ground, (10, 20), (20, 26))
    block.wall((15, 19.9), (15, 26.1), 2.8, [(2.0, -0.1, 3.0, 2.0)])
    first, second = found(block)
    assert (first.maximum[0], second.minimum[0]) == pytest.approx((14.9, 15.1), abs=2e-3)
    # Only the first room has a door and a window of its own. The door between is one box through the wall, and among both rooms' own.
    assert ([each.to for each in first.openings], [each.to for each in second.openings]) == ([0, 0, 2], [1])
    door = first.openings[-1]
    assert second.openings[0] == replace(door, to=1)
    np.testing.assert_allclose((door.minimum, door.maximum), ((14.9, -2.0, 21.9), (15.1, 2.0, 22.9)), atol=0.012)
    # On the way from one to the other nothing is the street's.
    x = np.arange(12.0, 18.0, 0.05)
    for height in (0.05, 1.5, 1.95):
        way = np.stack([x, np.full(len(x), height), np.full(len(x), 22.4)], axis=1)
        assert not light_shares(way, (first, second)).of(0, len(x)).any()


def test_doors_join_drawn_rooms_and_found_ones(ground):
    block = house(ground, (10, 20), (20, 26))
    block.wall((15, 19.9), (15, 26.1), 2.8, [(2.0, -0.1, 3.0, 2.0)])
    drawn = Room("front", (10.0, 0.0, 20.0), (14.9, 2.79, 26.0))
    front, back = found(block, rooms=(drawn,))
    assert (front.name, back.name) == ("front", "found-1")
    assert ([each.to for each in front.openings], [each.to for each in back.openings]) == ([0, 0, 2], [1])
    # Nobody asked for the room behind: the door leads to air that is in no room.
    (alone,) = found(block, "none", rooms=(drawn,))
    assert [each.to for each in alone.openings] == [0, 0, 0]
    boxes = (drawn, Room("back", (15.1, 0.0, 20.0), (20.0, 2.79, 26.0)))
    for rooms in (boxes, boxes[::-1]):
        assert [sorted(each.to for each in room.openings) for room in found(block, "none", rooms=rooms)] == (
            [[0, 0, 2], [1]] if rooms == boxes else [[2], [0, 0, 1]]
        )


def test_rooms_that_touch_or_overlap_open_into_each_other_where_one_ends(ground):
    """Two drawn in one hall: side by side, and one over the other, whose own is what the first leaves."""
    block = house(ground, (10, 20), (20, 26), door=False, window=False)
    west = Room("west", (10.0, 0.0, 20.0), (15.0, 2.79, 26.0))
    for east in (Room("east", (15.0, 0.0, 20.0), (20.0, 2.79, 26.0)), Room("east", (13.0, 0.0, 20.0), (20.0, 2.79, 26.0))):
        rooms = found(block, "none", rooms=(west, east))
        for room, to in zip(rooms, (2, 1), strict=True):
            (seam,) = room.openings
            assert seam.to == to
            np.testing.assert_allclose((seam.minimum, seam.maximum), ((15, -2.79, 20), (15, 2.79, 26)), atol=0.011)


def front_and_back(block, thick, door=(2.0, -0.1, 3.0, 2.0)):
    """The scene of a house of two rooms, so thick a wall between them and a door in it; and the rooms, as an author would draw them."""
    block = house(block, (10, 20), (22, 26))
    block.wall((16, 19.9), (16, 26.1), 2.8, [door], thick=thick)
    front, back = (
        Room("front", (10.0, 0.0, 20.0), (16 - thick / 2, 2.79, 26.0)),
        Room("back", (16 + thick / 2, 0.0, 20.0), (22.0, 2.79, 26.0)),
    )
    return block.scene(rooms=(front, back)), (front, back)


@pytest.mark.parametrize("thick", [0.6, 0.8, 1.2, THICKEST_M - 0.1])
@pytest.mark.parametrize("is_drawn", [True, False])
def test_a_door_goes_through_a_wall_of_old_masonry(ground, thick, is_drawn):
    scene, drawn = front_and_back(ground, thick)
    front, back = world_rooms(scene, "none") if is_drawn else world_rooms(replace(scene, rooms=()), "open")
    for room, box in zip((front, back), drawn, strict=True):
        np.testing.assert_allclose((room.minimum, room.maximum), (box.minimum, box.maximum), atol=2e-3)
    # One box behind the other from side to side, each as a door through a thin wall is: shortest along the way.
    doors = [opening for opening in front.openings if opening.to]
    assert ([each.to for each in back.openings], len(front.openings) - len(doors)) == ([1] * len(doors), 2)
    np.testing.assert_allclose(doors[0].minimum, (16 - thick / 2, -2, 21.9), atol=0.012)
    np.testing.assert_allclose(doors[-1].maximum, (16 + thick / 2, 2, 22.9), atol=0.012)
    for door, behind in pairwise(doors):
        assert door.maximum[0] == behind.minimum[0]
    for door in doors:
        assert np.argmin(np.subtract(door.maximum, door.minimum)) == 0
    x = np.arange(12.0, 20.0, 0.05)
    way = np.stack([x, np.zeros(len(x)), np.full(len(x), 22.4)], axis=1)
    shares = light_shares(way, (front, back))
    assert not shares.of(0, len(x)).any()
    step = 0.05 * np.hypot(0.5, 2) / (0.5 * 2) / (np.pi * (1 - OPENING_LEAST_VIEW))
    assert np.abs(np.diff(shares.of(1, len(x)))).max() <= step * 1.01


@pytest.mark.parametrize("is_drawn", [True, False])
def test_what_leads_to_the_open_air_ends_in_a_thick_wall_s_outer_side(ground, is_drawn):
    """A door and a window with an awning in a wall of 0.8 m: boxes, each shortest along the way. And a door that a porch goes on from, 2 m
    deep: nothing tells where the wall ends, so it stays flat in the inner side."""
    ground.wall((9.8, 20.4), (18.2, 20.4), 2.8, [(1.2, -0.1, 1.9, 2.0), (4.2, 0.9, 5.6, 2.2)], thick=0.8)
    ground.box((13.5, 2.21, 18.0), (16.0, 2.4, 20.1))
    ground.wall((9.8, 26.1), (18.2, 26.1), 2.8, [(3.2, -0.1, 4.2, 2.0)])
    ground.box((12.4, 0, 26.1), (12.9, 2.8, 28.2)).box((14.1, 0, 26.1), (14.6, 2.8, 28.2)).box((12.4, 2.1, 26.1), (14.6, 2.8, 28.2))
    for x in (9.9, 18.1):
        ground.wall((x, 20), (x, 26.2), 2.8)
    ground.box((9.8, 2.79, 20), (18.2, 3.1, 28.2))
    hall = Room("hall", (10.0, 0.0, 20.8), (18.0, 2.79, 26.0))
    (room,) = found(ground, "none" if is_drawn else "open", rooms=(hall,) if is_drawn else ())
    np.testing.assert_allclose((room.minimum, room.maximum), (hall.minimum, hall.maximum), atol=2e-3)
    outer, inner, window, porch = sorted(
        room.openings, key=lambda opening: (opening.minimum[2] > 25, opening.minimum[1], opening.minimum[2])
    )
    np.testing.assert_allclose((outer.minimum, outer.maximum), ((11.0, -2.0, 20.0), (11.7, 2.0, 20.4)), atol=0.012)
    np.testing.assert_allclose((inner.minimum, inner.maximum), ((11.0, -2.0, 20.4), (11.7, 2.0, 20.8)), atol=0.012)
    np.testing.assert_allclose((window.minimum, window.maximum), ((14.0, 0.9, 20.0), (15.4, 2.2, 20.8)), atol=0.012)
    np.testing.assert_allclose((porch.minimum, porch.maximum), ((13.0, -2.0, 26.0), (14.0, 2.0, 26.0)), atol=0.012)


def test_where_a_door_ends_is_told_of_walls_up_to_a_limit(ground):
    scene, _ = front_and_back(ground, THICKEST_M + 0.1)
    assert [[each.to for each in room.openings] for room in world_rooms(scene, "none")] == [[0, 0, 0], [0]]


def test_windows_that_face_each_other_over_a_gap_are_no_door(ground):
    """Two houses 0.8 m apart, their walls 0.2 m thick: between the windows is the street's air, for nothing lines the way there."""
    west, east = Room("west", (10.0, 0.0, 20.0), (16.0, 2.79, 26.0)), Room("east", (17.2, 0.0, 20.0), (23.0, 2.79, 26.0))
    block = ground
    for room, x in ((west, 16.1), (east, 17.1)):
        (x0, _, z0), (x1, top, z1) = room.minimum, room.maximum
        block.wall((x, z0 - 0.2), (x, z1 + 0.2), top, [(2.1, 0.9, 3.5, 2.2)])
        block.box((x0, top, z0 - 0.2), (x1, top + 0.3, z1 + 0.2))
        for z in (z0 - 0.1, z1 + 0.1):
            block.wall((x0, z), (x1, z), top)
    block.wall((9.9, 19.8), (9.9, 26.2), 2.79).wall((23.1, 19.8), (23.1, 26.2), 2.79)
    for room in world_rooms(block.scene(rooms=(west, east)), "none"):
        assert [opening.to for opening in room.openings] == [0]
    # With the gap walled up around the windows it is a wall, and what goes through it a door.
    block.wall((16.6, 19.8), (16.6, 26.2), 2.79, [(2.1, 0.9, 3.5, 2.2)], thick=0.82)
    for room, to in zip(world_rooms(block.scene(rooms=(west, east)), "none"), (2, 1), strict=True):
        (door,) = room.openings
        assert door.to == to
        np.testing.assert_allclose((door.minimum, door.maximum), ((16, 0.9, 21.9), (17.2, 2.2, 23.3)), atol=0.012)


def test_a_niche_and_a_rebate_lead_nowhere(ground):
    """A door 1.4 m wide that narrows to 0.8 m in the wall's farther part, and beside it a niche 0.7 m deep."""
    block = house(ground, (10, 20), (22, 26), door=False, window=False)
    block.wall((15.8, 19.9), (15.8, 26.1), 2.8, [(1.0, -0.1, 2.4, 2.0), (4.0, 0.5, 5.0, 2.0)], thick=0.7)
    block.wall((16.3, 19.9), (16.3, 26.1), 2.8, [(1.3, -0.1, 2.1, 2.0)], thick=0.3)
    front, back = Room("front", (10.0, 0.0, 20.0), (15.45, 2.79, 26.0)), Room("back", (16.45, 0.0, 20.0), (22.0, 2.79, 26.0))
    for rooms in ((front, back), (back, front)):
        for room, to in zip(world_rooms(block.scene(rooms=rooms), "none"), (2, 1), strict=True):
            assert {opening.to for opening in room.openings} == {to}
    (alone,) = world_rooms(block.scene(rooms=(front,)), "none")
    assert [opening.to for opening in alone.openings] == [0]  # the door, into air of no room


def test_what_the_street_or_the_sky_reaches_is_no_room(build):
    street = build().ground((-64, -64), (128, 128))
    for z in (0.0, 14.0):  # a canyon, 10 m wide and 20 m high
        street.box((0, 0, z), (60, 20, z + 4))
    # With a gallery along one side, so that some of it is covered.
    courtyard = house(build().ground((-64, -64), (128, 128)), (10, 20), (22, 25), height=9, roof=False).box((10, 3, 20), (22, 3.3, 22))
    underpass = (
        build().ground((-64, -64), (128, 128)).box((0, 0, 0), (20, 10, 10)).box((0, 0, 16), (20, 10, 26)).box((0, 4, 9), (20, 10, 17))
    )
    shed = house(build().ground((-64, -64), (128, 128)), (10, 20), (12, 22), window=False, along=0.6)  # 11 m3: too small for a room
    for scene in (street, courtyard, underpass, shed):
        assert found(scene) == ()


@pytest.mark.parametrize(("pillar", "lintel"), [(0.6, 4.1), (1.2, 3.4), (1.6, 3.2)])
def test_an_arcade_open_along_one_side_is_no_room(build, pillar, lintel):
    """4 m deep and 4.1 m high, a pillar every 4 m: wide bays are one with the street, arches open too much of what is behind them."""
    arcade = build().ground((-64, -64), (128, 128)).box((0, 0, 4), (40, 12, 14)).box((0, 4.1, 0), (40, 12, 4.1))
    for x in np.arange(0, 41, 4.0):
        arcade.box((x - pillar / 2, 0, 0), (x + pillar / 2, 4.2, 0.6))
    for x in (0.0, 39.7):
        arcade.box((x, 0, 0), (x + 0.3, 4.2, 4.1))
    arcade.box((0, lintel, 0), (40, 4.2, 0.6))
    assert found(arcade) == ()


def test_a_closed_box_is_a_room_only_when_asked_for(ground):
    block = house(ground, (10, 20), (18, 26), door=False, window=False)
    assert found(block) == ()
    (room,) = found(block, "all")
    assert room.openings == ()
    # Solid blocks have no air inside, whatever is asked for.
    assert found(ground.box((40, 0, 40), (50, 10, 50)), "all") == (room,)


def test_authored_rooms_win_and_come_first(ground):
    block = house(house(ground, (10, 20), (18, 26)), (30, 20), (38, 26))
    lobby = Room("lobby", (10.0, 0.0, 20.0), (18.0, 2.79, 26.0))
    authored, other = found(block, rooms=(lobby,))
    assert authored == replace(lobby, openings=authored.openings)
    assert len(authored.openings) == 2
    assert (other.name, other.minimum[0]) == ("found-1", pytest.approx(30.0, abs=2e-3))
    assert found(block, "none", rooms=(lobby,)) == (authored,)


def test_a_found_city_is_the_authored_one():
    """The rooms of the made-up city, found with its author's list put away."""
    scene = load_scene("procedural:midtown?blocks=1x1&seed=1")
    rooms = world_rooms(replace(scene, rooms=()), "open")
    known = {room.minimum: room for room in scene.rooms}
    assert len(rooms) == len(known) > 0
    for room in rooms:
        nearest = min(known, key=lambda low: np.abs(np.subtract(low, room.minimum)).max())
        np.testing.assert_allclose(room.minimum, nearest, atol=2e-3)
        np.testing.assert_allclose(room.maximum, known[nearest].maximum, atol=2e-3)
        assert len(room.openings) == len(known[nearest].openings)
    np.testing.assert_array_equal(rooms_of(np.array([room.minimum for room in rooms]) + 1, rooms), np.arange(1, len(rooms) + 1))


def test_too_large_a_piece_of_covered_air_is_refused_by_name(ground, monkeypatch):
    monkeypatch.setattr("bake_jobs.room_search.MAX_REGION_CELLS", 10_000)
    with pytest.raises(SourceError, match=r"\[rooms\] find: expected covered air in parts of at most 596 m3, found one of \d+ m3"):
        found(house(ground, (10, 20), (18, 26)))


def test_air_is_cut_where_it_is_narrow_and_nowhere_else():
    air = np.zeros((9, 24, 40), bool)
    air[1:8, 2:22, 2:18] = air[1:8, 2:22, 19:38] = True
    assert np.unique(find_basins(air)).tolist() == [0, 1, 2]
    air[1:6, 10:13, 18] = True  # a door
    basins = find_basins(air)
    assert np.unique(basins).tolist() == [0, 1, 2]
    assert set(np.unique(basins[1:8, 2:22, 2:17])) == {1}
    assert set(np.unique(basins[1:8, 2:22, 20:38])) == {2}
    air[1:8, 5:20, 18] = True  # as good as no wall
    assert np.unique(find_basins(air)).tolist() == [0, 1]
    high = np.zeros((13, 24, 40), bool)
    high[1:12, 2:22, 2:18] = high[1:12, 2:22, 19:38] = high[1:11, 5:20, 18] = True  # under a beam
    assert np.unique(find_basins(high)).tolist() == [0, 1]
    assert np.unique(find_basins(np.ones((4, 5, 6), bool))).tolist() == [1]
    assert not find_basins(np.zeros((4, 5, 6), bool)).any()
