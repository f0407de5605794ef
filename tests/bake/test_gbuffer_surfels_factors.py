"""What probes see, and how it is clustered and weighed: invariants in plain loops, on scenes whose surfaces are known."""

from dataclasses import dataclass

import numpy as np
import pytest

from bake_jobs import factors, gbuffer, surfels
from bake_jobs.gbuffer import cube_map_pattern
from bake_jobs.rays import RayScene
from bake_jobs.surfels import KEY_OFFSET_M, principal_direction
from gi_core.constants import BRICK_CELL_M, CUBE_FACES, MAX_BRICK_LEVEL
from gi_core.sector import check_sector, counts
from gi_core.sky_patches import patch_of
from gi_core.world import Room

DOUBLE_BEYOND_M = 8.0
# A surfel is the mean of hits that were keyed 2 cm off their surface, each good to float32's 1e-4 m in a small scene.
CELL_TOLERANCE_M = KEY_OFFSET_M + 1e-3
FAR_M = np.array([64.0 * 800, 0.0, -64.0 * 790])  # 51 km east, 51 km north


@dataclass
class Clustered:
    probes: np.ndarray
    seen: gbuffer.GBuffer
    surfels: surfels.Surfels
    pattern: gbuffer.RayPattern


def look(scene, probes, origin=(0.0, 0.0, 0.0), edge=8, room=None) -> Clustered:
    pattern = cube_map_pattern(edge)
    probes = np.asarray(probes, np.float64)
    seen = gbuffer.render(RayScene(scene.vertices, scene.triangles), probes, pattern)
    room = np.zeros(len(seen.position), np.uint16) if room is None else room(seen)
    found = surfels.cluster(seen, room, np.asarray(origin, np.float64), scene.albedo, scene.emission, DOUBLE_BEYOND_M)
    return Clustered(probes, seen, found, pattern)


def furnish(build):
    """Ground, two houses, and a 1 cm wall on a whole metre."""
    builder = build().ground().box((8, 0, 8), (20, 10, 20), 0.3).box((40, 0, 12), (52, 30, 40), 0.7).box((30, 0, 0), (30.01, 6, 50), 0.6)
    return builder.scene()


@pytest.fixture(scope="module")
def town(build):
    """The furnished scene seen by probes on both sides of the wall."""
    x, z = (a.ravel() for a in np.meshgrid([2.0, 26.0, 28.7, 31.3, 36.0, 60.0], [4.0, 22.0, 30.0, 44.0, 58.0]))
    return look(furnish(build), np.stack([x, np.full_like(x, 1.5), z], axis=1))


@pytest.mark.parametrize("edge", [1, 2, 7, 16])
def test_directions_are_unit_and_weights_of_a_face_sum_to_one(edge):
    pattern = cube_map_pattern(edge)
    assert pattern.direction.shape == (6 * edge * edge, 3)
    # Sums of at most 1536 float32 numbers that were divided by their float64 sum.
    np.testing.assert_allclose(np.linalg.norm(pattern.direction, axis=1), 1, atol=2e-7)
    np.testing.assert_allclose(pattern.weight.sum(axis=0, dtype=np.float64), 1, atol=1e-6)
    assert (pattern.weight >= 0).all()


@pytest.mark.parametrize("edge", [8, 16])
def test_weights_are_form_factors_of_known_shapes(edge):
    pattern = cube_map_pattern(edge)
    up = pattern.direction[:, 1] > 0
    # The upper half of the view fills all of +Y, none of -Y, half of each side.
    np.testing.assert_allclose(pattern.weight[up].sum(axis=0), [0.5, 0.5, 1, 0, 0.5, 0.5], atol=1e-6)
    # A cone of half angle a around the axis of a face fills sin(a) ** 2 of it; texels on the cone's rim are in or out whole.
    for degrees in (30, 45, 60):
        inside = pattern.direction[:, 1] > np.cos(np.radians(degrees))
        rim = 2 * np.sin(np.radians(2 * degrees)) / edge
        assert pattern.weight[inside, 2].sum() == pytest.approx(np.sin(np.radians(degrees)) ** 2, abs=rim)


def test_factors_and_sky_of_a_face_sum_to_one_where_nothing_is_lost(town):
    gathered = factors.gather(town.seen, town.pattern, town.surfels)
    lost = ~town.seen.hits.hit.reshape(town.seen.probes, -1) & (town.pattern.direction[:, 1] <= 0)
    for probe in range(town.seen.probes):
        total = gathered.weight[gathered.starts[probe] : gathered.starts[probe + 1]].sum(axis=0)
        # What looks below the horizon and meets nothing sees neither ground nor sky.
        below_the_edge = town.pattern.weight[lost[probe]].sum(axis=0)
        np.testing.assert_allclose(total + below_the_edge, 1, atol=1e-5)


def test_factor_sources_ascend_within_a_probe_and_sky_feeds_its_own_face_only(town):
    gathered = factors.gather(town.seen, town.pattern, town.surfels)
    bricks = len(town.surfels.brick_cell)
    for probe in range(town.seen.probes):
        source = gathered.source[gathered.starts[probe] : gathered.starts[probe + 1]].astype(int)
        assert (np.diff(source) > 0).all()
    assert gathered.source.max() < bricks + len(CUBE_FACES)
    for source, weight in zip(gathered.source, gathered.weight, strict=True):
        if source >= bricks:
            assert list(np.flatnonzero(weight)) == [source - bricks]


@pytest.mark.parametrize("basis", ["cube", "sh1", "sh2"])
def test_each_patch_has_what_the_rays_towards_it_see_of_the_sky(town, basis):
    pattern = cube_map_pattern(8, basis)
    gathered = factors.gather(town.seen, pattern, town.surfels, sky_patches=32)
    bricks = len(town.surfels.brick_cell)
    left = ~town.seen.hits.hit.reshape(town.seen.probes, -1)
    for probe in range(town.seen.probes):
        own = slice(gathered.starts[probe], gathered.starts[probe + 1])
        source, weight = gathered.source[own].astype(int), gathered.weight[own]
        assert (np.diff(source) > 0).all()
        expected = np.zeros((32, pattern.weight.shape[1]))
        for ray in np.flatnonzero(left[probe] & (pattern.direction[:, 1] > 0)):
            expected[patch_of(pattern.direction[ray : ray + 1], 32)[0]] += pattern.weight[ray]
        found = np.zeros_like(expected)
        found[source[source >= bricks] - bricks] = weight[source >= bricks]
        np.testing.assert_allclose(found, expected, atol=1e-6)
    # What the distant texel averages are the cube's shares, whatever the basis.
    np.testing.assert_array_equal(gathered.sky, factors.sky_factors(town.seen, town.pattern))


def test_in_a_closed_room_bricks_fill_every_face_and_no_sky_is_seen(build):
    room = look(build().box((0, 0, 0), (9, 5, 7), inward=True).scene(), [[1, 1, 1], [4.5, 2.5, 3.5], [8.7, 4.8, 0.2]], edge=16)
    gathered = factors.gather(room.seen, room.pattern, room.surfels)
    assert not gathered.sky.any()
    assert room.seen.hits.hit.all()
    for probe in range(3):
        total = gathered.weight[gathered.starts[probe] : gathered.starts[probe + 1]].sum(axis=0)
        np.testing.assert_allclose(total, 1, atol=1e-5)  # float32 sums of 1536 rays


def test_every_surfel_lies_in_its_bricks_cell_and_faces_its_way(town):
    s = town.surfels
    for brick in range(len(s.brick_cell)):
        size = BRICK_CELL_M * 2.0 ** s.brick_level[brick]
        for surfel in range(s.brick_starts[brick], s.brick_starts[brick + 1]):
            low = s.brick_cell[brick] * size
            assert (s.position[surfel] >= low - CELL_TOLERANCE_M).all()
            assert (s.position[surfel] <= low + size + CELL_TOLERANCE_M).all()
            assert principal_direction(s.normal[surfel : surfel + 1])[0] == s.brick_direction[brick]


def test_bricks_are_distinct_and_none_is_empty_or_overfull(town):
    s = town.surfels
    sizes = np.diff(s.brick_starts)
    assert s.brick_starts[0] == 0
    assert s.brick_starts[-1] == s.count
    assert (sizes >= 1).all()
    assert (sizes <= 64).all()  # 4 x 4 x 4 cells
    # Those of one cell that face one way are what different probes see.
    probe, brick_of_hit = s.hit // town.seen.rays, s.brick_of_surfel[s.of_hit]
    seen_by = set()
    for brick in range(len(s.brick_cell)):
        key = (*s.brick_cell[brick].tolist(), int(s.brick_level[brick]), int(s.brick_direction[brick]))
        views = {(key, int(who)) for who in np.unique(probe[brick_of_hit == brick])}
        assert not views & seen_by
        seen_by |= views
    assert len({key for key, _ in seen_by}) < len(s.brick_cell)  # or this scene tests nothing


def test_walls_that_no_probe_sees_together_are_two_bricks(build):
    """A thin house's front, and three metres behind it the wall of its light well, which looks the same way: one cell holds both."""
    house = build().ground().box((0.1, 0, 4.5), (4, 12, 4.9), 0.5).box((0.1, 0, 7.5), (4, 12, 9), 0.5)
    front, well, beside = (2.0, 2.0, 2.0), (2.0, 2.0, 6.0), (-6.0, 2.0, 2.0)

    def facing_south(*probes):
        found = look(house.scene(), probes, edge=16).surfels
        cell = (found.brick_cell == (0, 0, 1)).all(axis=1) & (found.brick_direction == 5) & (found.brick_level == 0)
        return [np.unique(np.floor(found.position[found.brick_of_surfel == brick, 2])).tolist() for brick in np.flatnonzero(cell)]

    assert facing_south(front, well) == [[4.0], [7.0]]
    assert facing_south(front) == [[4.0]]
    assert facing_south(front, well, beside) == [[4.0, 7.0]]


def test_levels_grow_with_the_distance_of_the_closest_that_sees(town):
    s = town.surfels
    distance = town.seen.hits.distance[s.hit]
    closest = np.full(s.count, np.inf)
    for surfel, d in zip(s.of_hit, distance, strict=True):
        closest[surfel] = min(closest[surfel], d)
    for surfel, brick in enumerate(s.brick_of_surfel):
        expected = 0
        while closest[surfel] >= DOUBLE_BEYOND_M * 2.0**expected and expected < MAX_BRICK_LEVEL:
            expected += 1
        assert s.brick_level[brick] == expected
    assert len(set(s.brick_level.tolist())) >= 4  # or this scene tests nothing


def test_every_hit_is_in_one_surfel_whose_mean_it_shares(town):
    s = town.surfels
    assert set(s.of_hit.tolist()) == set(range(s.count))
    for surfel in range(0, s.count, 37):
        members = s.hit[s.of_hit == surfel]
        np.testing.assert_allclose(s.position[surfel], town.seen.position[members].mean(axis=0), atol=1e-9)


def test_surfels_of_a_stepped_wall_lie_on_it(build):
    """Ribs 0.3 m deep and 0.4 m wide on a wall: a cell has hits on ribs and between them, and their mean is in none of both planes."""
    wall = build().ground().box((20, 0, 0), (30, 12, 40), 0.5)
    for z in np.arange(0, 40, 0.8):
        wall.box((19.7, 0, z), (20, 12, z + 0.4), 0.5)
    s = look(wall.scene(), [[3, 4, 10], [3, 6, 20], [3, 5, 30]], edge=16).surfels
    facing = s.normal[:, 0] < -0.99
    assert facing.sum() > 20
    depth = s.position[facing, 0]
    assert np.minimum(np.abs(depth - 20), np.abs(depth - 19.7)).max() < 1e-3


@pytest.mark.parametrize("k", [1, 3])
def test_feedback_comes_from_the_closest_probes_that_see_the_surfel(town, k):
    probe, weight = surfels.feedback(town.surfels, town.seen, k)
    s = town.surfels
    np.testing.assert_allclose(weight.sum(axis=1), 1, atol=1e-6)
    seen_by: list[dict[int, float]] = [{} for _ in range(s.count)]
    for hit, surfel in zip(s.hit, s.of_hit, strict=True):
        p, d = int(hit // town.seen.rays), float(town.seen.hits.distance[hit])
        seen_by[surfel][p] = min(d, seen_by[surfel].get(p, np.inf))
    for surfel in range(s.count):
        ranked = sorted(seen_by[surfel].values())
        used = [seen_by[surfel][int(p)] for p, w in zip(probe[surfel], weight[surfel], strict=True) if w > 0]  # KeyError: does not see it
        # Weights of 1 / distance^2 are rounded to fifteenths of the largest: none is left of what is 5.5 times as far.
        worth = [distance for distance in ranked[:k] if distance**2 < 30 * max(ranked[0], 0.25) ** 2]
        assert abs(len(used) - len(worth)) <= (abs(len(ranked[:k]) - len(worth)) > 0)
        np.testing.assert_allclose(used, ranked[: len(used)], atol=2e-3)  # distances are compared in whole millimetres
        assert (np.diff(weight[surfel]) <= 1e-7).all()


def test_a_feedback_probe_has_a_free_line_to_a_near_surfel(town, build):
    """Not from the G-buffer but by a ray of its own."""
    probe, _ = surfels.feedback(town.surfels, town.seen, 1)
    s = town.surfels
    near = np.flatnonzero(s.brick_level[s.brick_of_surfel] == 0)
    start = s.position[near] + 0.01 * s.normal[near]
    to_probe = town.probes[probe[near, 0]] - start
    reach = np.linalg.norm(to_probe, axis=1)
    scene = furnish(build)
    blocked = RayScene(scene.vertices, scene.triangles).occluded(start, to_probe / reach[:, None], reach)
    assert len(near) > 1000
    # A surfel is a mean: around an edge of the 1 cm wall it may lie inside it.
    assert blocked.mean() < 0.01


@pytest.mark.parametrize("thickness", [0.01, 0.0])
@pytest.mark.parametrize("x", [32.0, 32.3, 31.995])
def test_the_two_faces_of_a_thin_wall_never_share_a_surfel_or_a_brick(build, thickness, x):
    builder = build().ground(low=(0, 0), high=(64, 64))
    if thickness:
        builder.box((x, 0, 8), (x + thickness, 6, 56))
    else:
        builder.quad((x, 0, 8), (0, 6, 0), (0, 0, 48))
    probes = [[x + dx, 1.5, z] for dx in (-5.0, -1.0, -0.3, 0.3, 1.0, 5.0) for z in (20.0, 32.0, 44.0)]
    seen = look(builder.scene(), probes)
    s = seen.surfels
    on_wall = np.abs(seen.seen.hits.normal[s.hit, 0]) > 0.9
    from_east = seen.probes[s.hit // seen.seen.rays, 0] > x
    for group in (s.of_hit, s.brick_of_surfel[s.of_hit]):
        west = set(group[on_wall & ~from_east].tolist())
        east = set(group[on_wall & from_east].tolist())
        assert west
        assert east
        assert not west & east


def rooms_behind_a_wall(wall_x=33.0, gap=0.05, number=1):
    """Authored boxes that end ``gap`` before the walls; the second is ``number`` rooms later than the first."""
    filler = tuple(Room(f"far {i}", (900.0 + i, 0, 0), (900.5 + i, 1, 1)) for i in range(number - 1))
    west = Room("west", (20.0, gap, 20.0), (wall_x - gap, 4.0, 44.0))
    return (west, *filler, Room("east", (wall_x + 0.1 + gap, gap, 20.0), (50.0, 4.0, 44.0)))


@pytest.mark.parametrize("gap", [0.0, 0.05])
@pytest.mark.parametrize("number", [1, 2, 40])
def test_what_stands_in_two_rooms_never_shares_a_brick(build, gap, number):
    rooms = rooms_behind_a_wall(gap=gap, number=number)
    scene = build().ground(low=(10, 10), high=(60, 60)).box((33.0, 0, 10), (33.1, 4, 60)).quad((10, 4, 10), (50, 0, 0), (0, 0, 50)).scene()
    probes = np.array([[x, 1.5, z] for x in (30.0, 32.0, 34.1, 36.0) for z in (26.0, 32.0, 38.0)])
    probe_room = np.repeat([1, 1, 1 + number, 1 + number], 3).astype(np.uint16)
    seen = look(scene, probes, room=lambda gbuffer: surfels.rooms_of_hits(gbuffer, probe_room, rooms))
    s = seen.surfels
    by = probe_room[s.hit // seen.seen.rays]
    inside = (seen.seen.position[s.hit][:, 2] > 20) & (seen.seen.position[s.hit][:, 2] < 44)
    for group in (s.of_hit, s.brick_of_surfel[s.of_hit]):
        west, east = (set(group[(by == room) & inside].tolist()) for room in (1, 1 + number))
        assert min(len(west), len(east)) > 20
        assert not west & east


def test_the_outside_of_a_rooms_wall_is_outdoors(build):
    room = Room("hut", (20.0, 0.0, 20.0), (30.0, 4.0, 30.0))
    scene = build().ground(low=(0, 0), high=(64, 64)).box(room.minimum, room.maximum, without=("-y",)).scene()  # walls are sheets
    probes = np.array([[25.0, 1.5, 25.0], [15.0, 1.5, 25.0]])
    seen = look(scene, probes)
    found = surfels.rooms_of_hits(seen.seen, np.array([1, 0], np.uint16), (room,)).reshape(2, -1)
    assert (found[0] == 1).all()
    assert not found[1].any()


@pytest.mark.parametrize("offset", [np.zeros(3), FAR_M], ids=["at the origin", "51 km away"])
@pytest.mark.parametrize("x", [32.0, 64.0, -3.0, 30.5])
def test_a_wall_on_whole_metres_is_one_layer_of_cells(build, offset, x):
    """Rounding must not scatter the hits of one plane over the cells in front of it and behind it."""
    scene = build(offset).ground(low=(-40, 0), high=(100, 64)).quad((x, 0, 0), (0, 0, 64), (0, 12, 0)).scene()
    probes = np.array([[x + 3.0, 2.0, z] for z in (12.0, 24.0, 36.0, 48.0)]) + offset
    seen = look(scene, probes, origin=offset, edge=16)
    s = seen.surfels
    for way in (0, 2):  # the wall's front, the ground
        of_way = s.brick_direction[s.brick_of_surfel] == way
        near = of_way & (s.brick_level[s.brick_of_surfel] == 0)
        across = {0: [1, 2], 2: [0, 2]}[way]
        axis = {0: 0, 2: 1}[way]
        assert near.sum() > 50
        places = np.floor(s.position[near][:, across]).astype(int)
        assert len(np.unique(places, axis=0)) == near.sum()
        assert len(np.unique(s.brick_cell[s.brick_of_surfel[near], axis])) == 1


def test_a_city_51_km_away_gives_the_same_arrays(build, bake_arrays):
    """Positions and factors are local: only where the sector lies may differ."""

    def baked(offset, index):
        builder = build(offset).ground(low=(-20, -20), high=(84, 84)).box((10, 0, 10), (25, 12, 30), 0.3).box((40, 0, 35), (52, 20, 55))
        return bake_arrays(builder.scene(), index, rays_per_face_edge=8)[0]

    here, far = baked((0, 0, 0), (0, 0)), baked(FAR_M, (800, -790))
    assert here.probe_count == far.probe_count
    np.testing.assert_allclose(far.probe_position, here.probe_position, atol=1e-3)
    np.testing.assert_array_equal(far.factor_starts, here.factor_starts)
    np.testing.assert_array_equal(far.factor_source, here.factor_source)
    np.testing.assert_allclose(far.factor_weight, here.factor_weight, atol=1e-6)
    np.testing.assert_array_equal(far.brick_cell, here.brick_cell)
    np.testing.assert_allclose(far.surfel_position, here.surfel_position, atol=1e-3)


def test_baked_arrays_hold_every_invariant_of_a_sector(build, bake_arrays):
    scene = build().ground().box((8, 0, 8), (20, 10, 20), 0.99).box((40, 0, 12), (52, 30, 40), 0.7, emission=500.0).scene()
    for index in ((0, 0), (-1, -1), (2, 1)):
        sector, meta = bake_arrays(scene, index, rays_per_face_edge=8)
        check_sector(sector, len(CUBE_FACES))
        assert sector.surfel_albedo.max() <= np.float32(0.95)
        assert meta["probes"] == sector.probe_count > 100
        assert (counts(sector.brick_starts) > 0).all()


def test_probes_in_an_empty_world_see_only_sky(build):
    nothing = look(build().quad((500, 0, 500), (0, 0, 1), (1, 0, 0)).scene(), [[0, 5.0, 0]])
    gathered = factors.gather(nothing.seen, nothing.pattern, nothing.surfels)
    assert nothing.surfels.count == 0
    np.testing.assert_allclose(gathered.sky, [[0.5, 0.5, 1, 0, 0.5, 0.5]], atol=1e-6)
    probe, weight = surfels.feedback(nothing.surfels, nothing.seen, 2)
    assert probe.shape == weight.shape == (0, 2)
