"""Where probes stand, and which points are inside something solid."""

from dataclasses import replace

import numpy as np
import pytest

from bake_jobs.config import settings_for
from bake_jobs.inside import FLAT_DIRECTIONS, Solids
from bake_jobs.placement import CLEARANCE_M, Placement, place_probes
from bake_jobs.rays import RayScene
from bake_jobs.scene import ProbeHint
from gi_core.constants import MAX_PROBES_PER_SECTOR
from gi_core.grid import SectorIndex
from gi_core.rooms import rooms_of
from gi_core.sector import PROBE_IN_MARGIN, PROBE_ON_GROUND, PROBE_ON_WALL
from gi_core.world import Room

TALK = settings_for("talk")
# Rays in float32 around an anchor within 32 m of every point here; and probes are moved off edges by a few millimetres.
CLOSE_M = 6e-3


def placed(scene, index=(0, 0), settings=TALK) -> Placement:
    rays = RayScene(scene.vertices, scene.triangles)
    solids = Solids(scene.vertices, scene.triangles)
    return place_probes(rays, solids, scene.bounds, SectorIndex(*index), settings, scene.rooms, scene.hints)


def inside(scene, points):
    return Solids(scene.vertices, scene.triangles).contain(np.asarray(points, np.float64))


def within(position, low, high):
    return ((position > np.asarray(low)) & (position < np.asarray(high))).all(axis=1)


def rows(position):
    """Positions to a tenth of a metre: lattice points are pulled 1 cm aside, out of walls on whole metres."""
    return {tuple(p) for p in np.round(position, 1).tolist()}


def test_a_plain_gives_the_lattice_and_a_ring_of_margin(build):
    p = placed(build().ground().scene())
    line = np.arange(-2.0, 68, 4)  # 16 in the sector, one beyond each border
    assert rows(p.position) == {(x, 1.5, z) for x in line for z in line}
    margin = p.flags & PROBE_IN_MARGIN != 0
    assert (~margin).sum() == 256
    for position, beyond in zip(p.position, margin, strict=True):
        assert beyond == (not (0 <= position[0] < 64 and 0 <= position[2] < 64))
    assert (p.flags & PROBE_ON_GROUND).all()
    assert (p.dead, p.dropped) == (0, 0)


@pytest.mark.parametrize("index", [(-1, -1), (-3, 2), (5, -7)])
def test_negative_and_far_sectors_get_the_same_lattice(build, index):
    origin = SectorIndex(*index).origin
    here = placed(build().ground().scene())
    there = placed(build(origin).ground().scene(), index)
    np.testing.assert_allclose(there.position - origin, here.position, atol=CLOSE_M)
    np.testing.assert_array_equal(there.flags, here.flags)


@pytest.mark.parametrize(("gap", "expected"), [(1.0, False), (1.9, False), (2.1, True), (2.5, True), (6.0, True)])
def test_a_floor_needs_head_room(build, gap, expected):
    scene = build().ground().box((16, gap, 16), (48, gap + 1, 48)).scene()
    under = placed(scene).position
    under = under[within(under, (16, 0, 16), (48, gap, 48))]
    on_lattice = under[np.isclose(np.mod(under[:, 0], 4), 2, atol=0.02) & np.isclose(np.mod(under[:, 2], 4), 2, atol=0.02)]
    assert len(on_lattice) == (64 if expected else 0)
    # Never closer to the ceiling than to the floor.
    np.testing.assert_allclose(on_lattice[:, 1], min(1.5, gap / 2), atol=0.01)


def test_every_storey_of_a_slab_building_gets_its_layer(build):
    slabs = build().ground()
    for height in (4.0, 8.0):
        slabs.box((8, height, 8), (56, height + 0.3, 56))
    p = placed(slabs.scene())
    ground = p.position[p.flags & PROBE_ON_GROUND != 0]
    ground = ground[within(ground, (8, -1, 8), (56, 20, 56))]
    heights, count = np.unique(np.round(ground[:, 1], 1), return_counts=True)
    assert dict(zip(heights.tolist(), count.tolist(), strict=True)) == {1.5: 144, 5.8: 144, 9.8: 144}


def test_wall_probes_stand_off_a_houses_walls_on_the_outside_only(build):
    low, high = np.array([20.0, 0, 20.0]), np.array([44.0, 30, 44.0])
    p = placed(build().ground().box(low, high).scene())
    wall = p.position[p.flags & PROBE_ON_WALL != 0]
    assert len(wall) >= 20
    beyond = np.maximum(np.maximum(low - wall, wall - high), 0)[:, [0, 2]]
    off = beyond.max(axis=1)
    # Those in the plane of the next wall are pushed off it.
    pushed = np.abs(off - CLEARANCE_M) < CLOSE_M
    np.testing.assert_allclose(off[~pushed], TALK.wall_offset_m, atol=CLOSE_M)
    assert pushed.mean() < 0.5
    for side in range(4):  # each wall has its own
        axis, sign = (0, 2)[side // 2], (-1, 1)[side % 2]
        edge = (low, high)[side % 2][axis]
        assert (np.abs(wall[:, axis] - (edge + sign)) < 0.01).sum() >= 3
    heights = np.unique(np.round(wall[:, 1], 2))
    assert heights.max() > 12
    assert not within(p.position, low, high).any()


def test_a_probe_in_a_narrow_gap_stands_in_its_middle(build):
    p = placed(build().ground(y=0).box((10, 0, 0), (30, 20, 64)).box((31.2, 0, 0), (50, 20, 64)).scene())
    gap = p.position[within(p.position, (30, 0, 0), (31.2, 20, 64)) & (p.flags & PROBE_ON_WALL != 0)]
    assert len(gap) >= 5
    np.testing.assert_allclose(gap[:, 0], 30.6, atol=CLOSE_M)


SOLIDS = {
    "closed box": lambda b: b.box((10, 0, 10), (40, 12, 40)),
    "box without a floor": lambda b: b.box((10, 0, 10), (40, 12, 40), without=("-y",)),
    "box without a floor, sunk in the ground": lambda b: b.box((10, -1, 10), (40, 12, 40), without=("-y",)),
    "overlapping boxes": lambda b: b.box((10, 0, 10), (40, 8, 40)).box((12, 0, 9), (39, 12, 41)).box((20, 4, 5), (30, 11, 45)),
    "boxes wall to wall": lambda b: b.box((10, 0, 10), (25, 12, 40)).box((25, 0, 10), (40, 12, 40)),
}


@pytest.mark.parametrize("name", SOLIDS)
def test_no_probe_stands_inside_a_solid(build, name):
    # Floors inside would attract probes: each storey is a hit of the grid.
    builder = SOLIDS[name](build().ground())
    scene = builder.scene()
    p = placed(scene)
    assert not within(p.position, (10, 0, 10), (40, 8, 40)).any()
    assert within(p.position, (8, 0, 8), (42, 30, 42)).sum() > 30  # on its roof and walls they do
    x, y, z = (a.ravel() for a in np.meshgrid(np.linspace(10.3, 39.7, 9), [0.4, 3.0, 7.6], np.linspace(10.3, 39.7, 9)))
    assert inside(scene, np.stack([x, y, z], axis=1)).all()
    outside = [[9.5, 1, 20], [41.5, 5, 41.5], [25, 13.0, 25], [5, 30, 5], [50, 0.2, 50], [-60, 1, -60]]
    assert not inside(scene, outside)[[0, 1, 3, 4, 5]].any()
    assert not inside(scene, [[25, 12.5, 25]])[0]


@pytest.mark.parametrize("count", [1, 12])
def test_solids_end_within_four_centimetres_of_their_walls(build, count):
    """They grow for the test by up to 36 mm, each by another amount."""
    row = build().ground()
    for n in range(count):
        row.box((4.0 * n, 0, 10), (4.0 * n + 2, 5, 12))
    scene = row.scene()
    middle = np.array([1.0, 2.5, 11.0]) + np.arange(count)[:, None] * [4.0, 0, 0]
    half = np.array([1.0, 2.5, 1.0])
    for axis, sign in ((0, -1), (0, 1), (1, 1), (2, -1), (2, 1)):
        for beyond, expected in ((-0.01, True), (0.04, False)):
            points = middle + np.array([0.13, 0.21, -0.17])
            points[:, axis] = middle[:, axis] + sign * (half[axis] + beyond)
            assert (inside(scene, points) == expected).all()


def test_a_point_between_towers_is_not_inside(build):
    towers = build().ground(low=(-200, -200), high=(264, 264))
    for x in range(0, 64, 16):
        for z in range(0, 64, 16):
            towers.box((x, 0, z), (x + 13, 80, z + 13), without=("-y",) if (x + z) % 32 else ())
    x, z = (a.ravel() for a in np.meshgrid(np.arange(0, 64, 1.7), np.arange(0, 64, 1.7)))
    street = (np.mod(x, 16) > 13.2) | (np.mod(z, 16) > 13.2)
    solid = (np.mod(x, 16) < 12.8) & (np.mod(z, 16) < 12.8) & (x > 0.2) & (z > 0.2)
    found = inside(towers.scene(), np.stack([x, np.full_like(x, 2.0), z], axis=1))
    assert not found[street].any()
    assert found[solid].all()


CANOPIES = {
    "sheet facing up": lambda b: b.quad((20, 4, 20), (0, 0, 20), (20, 0, 0)),
    "sheet facing down": lambda b: b.quad((20, 4, 20), (20, 0, 0), (0, 0, 20)),
    "slab": lambda b: b.box((20, 4, 20), (40, 4.2, 40)),
    "gabled sheet": lambda b: b.quad((20, 4, 20), (0, 0, 20), (10, 3, 0)).quad((30, 7, 20), (0, 0, 20), (10, -3, 0)),
}


@pytest.mark.parametrize("name", CANOPIES)
def test_a_canopy_does_not_kill_the_probes_under_it(build, name):
    p = placed(CANOPIES[name](build().ground()).scene())
    under = p.position[within(p.position, (20, 0, 20), (40, 4, 40)) & (p.flags & PROBE_ON_GROUND != 0)]
    assert len(under) == 25


def test_hints_add_and_forbid(build):
    add = ProbeHint("add", (10.0, 10.0, 10.0), (20.0, 14.0, 20.0), 2.0)
    forbid = ProbeHint("forbid", (41.0, 0.0, 41.0), (51.0, 5.0, 51.0))
    plain = rows(placed(build().ground().scene()).position)
    hinted = placed(build().ground().scene(hints=(add, forbid)))
    found = rows(hinted.position)
    assert found - plain == {(x, y, z) for x in range(11, 20, 2) for y in (11, 13) for z in range(11, 20, 2)}
    assert plain - found == {(x, 1.5, z) for x in (42, 46, 50) for z in (42, 46, 50)}
    added = hinted.position[:, 1] > 5
    assert not hinted.flags[added].any()


def test_an_added_probe_inside_a_house_is_refused_unless_it_is_a_room(build):
    add = ProbeHint("add", (21.0, 1.0, 21.0), (39.0, 9.0, 39.0), 4.0)
    house = build().ground().box((20, 0, 20), (40, 10, 40))
    without_room = placed(house.scene(hints=(add,)))
    assert not within(without_room.position, (20, 0, 20), (40, 10, 40)).any()
    assert without_room.dead >= 32
    hall = Room("hall", (20.0, 0.0, 20.0), (40.0, 10.0, 40.0))
    with_room = placed(house.scene(hints=(add,), rooms=(hall,)))
    indoors = within(with_room.position, (20, 0, 20), (40, 10, 40))
    assert indoors.sum() >= 32
    assert (with_room.room[indoors] == 1).all()
    assert (with_room.room[~within(with_room.position, (19.99, -0.1, 19.99), (40.01, 10.01, 40.01))] == 0).all()


def test_the_first_room_that_holds_a_point_names_it():
    rooms = (Room("a", (0.0, 0.0, 0.0), (4.0, 4.0, 4.0)), Room("b", (2.0, 0.0, 0.0), (8.0, 4.0, 4.0)))
    points = np.array([[1.0, 1, 1], [3, 1, 1], [5, 1, 1], [9, 1, 1], [4, 4, 4]])
    assert rooms_of(points, rooms).tolist() == [1, 1, 2, 0, 1]


def test_at_most_a_thousand_probes_and_those_of_the_sector_come_first(build):
    crowd = ProbeHint("add", (-4.0, 5.0, -4.0), (68.0, 20.0, 68.0), 3.0)
    p = placed(build().ground().scene(hints=(crowd,)))
    assert len(p.position) == MAX_PROBES_PER_SECTOR
    assert p.dropped > 1000
    assert not (p.flags & PROBE_IN_MARGIN).any()
    # The ground, where players are, lost none.
    assert (p.flags & PROBE_ON_GROUND != 0).sum() == 256


def street(build, offset=(0.0, 0.0, 0.0)):
    """Houses on both sides of the border x = 64, one across it, walls at whole and broken metres, one just beyond a margin."""
    houses = build(offset).ground(low=(-64, -64), high=(192, 128))
    for low, high in (
        ((40, 0, 4), (60, 22, 20)),
        ((66, 0, 4), (90, 31, 21.3)),
        ((58.5, 0, 30.2), (71.7, 14, 44)),
        ((30.3, 0, 50), (63.2, 9, 60)),
        ((68.5, 0, 50), (80, 17, 60.6)),
    ):
        houses.box(low, high)
    return houses.scene()


def test_margin_probes_are_the_neighbours_own(build):
    scene = street(build)
    west, east = placed(scene, (0, 0)), placed(scene, (1, 0))
    strip = {}
    for name, p in (("west", west), ("east", east)):
        # Not the outermost metre of a margin: there, what thins a probe may itself be thinned from beyond.
        shared = within(p.position, (61, -10, 0), (67, 100, 64))
        strip[name] = p.position[shared], p.room[shared], p.flags[shared]
    assert len(strip["west"][0]) > 40
    assert rows(strip["west"][0]) == rows(strip["east"][0])
    for name, own in (("west", (60, 64)), ("east", (64, 68))):
        position, _, flags = strip[name]
        is_own = (position[:, 0] >= own[0]) & (position[:, 0] < own[1])
        assert ((flags & PROBE_IN_MARGIN == 0) == is_own).all()


def test_wall_probes_stand_on_both_sides_of_a_thin_wall(build):
    p = placed(build().ground().box((31.0, 0, 0), (31.1, 12, 64)).scene())
    wall = p.position[(p.flags & PROBE_ON_WALL != 0) & (np.abs(p.position[:, 0] - 31) < 1.5)]
    west, east = wall[wall[:, 0] < 31], wall[wall[:, 0] > 31.1]
    assert len(west) >= 8
    np.testing.assert_allclose(west[:, 1:], east[:, 1:], atol=0.03)  # each is pulled 1 cm along its own face


def test_placement_is_deterministic_and_local(build):
    first, again = placed(street(build)), placed(street(build))
    np.testing.assert_array_equal(first.position, again.position)
    shift = np.array([-64.0 * 781, 0, 64.0 * 780])  # 50 km away
    far = placed(street(build, shift), (-781, 780))
    np.testing.assert_allclose(far.position - shift, first.position, atol=CLOSE_M)
    np.testing.assert_array_equal(far.flags, first.flags)


def test_draft_places_fewer_probes_by_the_same_rules(build):
    settings = settings_for("draft")
    p = placed(build().ground().scene(), settings=settings)
    assert (p.flags & PROBE_IN_MARGIN == 0).sum() == 64
    assert len(p.position) == 100


def test_no_probe_stands_in_a_tower_of_many_overlapping_parts(build):
    rng = np.random.default_rng(3)
    tower = build().ground()
    for _ in range(40):
        low = rng.uniform(20, 28, 3) * [1, 0, 1]
        high = rng.uniform(36, 44, 3) * [1, 0, 1] + [0, rng.uniform(4, 90), 0]
        tower.box(low, high)
    p = placed(tower.scene(), settings=replace(TALK, wall_spacing_m=4.0))
    assert not within(p.position, (28, 0, 28), (36, 4, 36)).any()
    core = np.stack([np.full(50, 32.0), np.linspace(0.5, 60, 50), np.full(50, 31.0)], axis=1)
    top = tower.scene().vertices[:, 1]
    assert inside(tower.scene(), core[core[:, 1] < np.sort(top[top > 0])[0]]).all()


@pytest.mark.parametrize("enough", [1, 3, 8])
def test_votes_are_the_same_whether_all_rays_are_cast_or_those_that_decide(build, enough):
    scene = build().ground().box((10, 0, 10), (30, 8, 40)).box((25, 2, 20), (50, 12, 30)).scene()
    solids = Solids(scene.vertices, scene.triangles)
    points = np.random.default_rng(5).uniform((0, 0.1, 0), (64, 14, 64), (300, 3))
    votes = sum(solids._leaves(points, np.tile(direction, (300, 1))).astype(int) for direction in FLAT_DIRECTIONS)
    assert set(votes) >= {0, 8}
    np.testing.assert_array_equal(solids.have_votes(points, FLAT_DIRECTIONS, enough), votes >= enough)
