"""The sun's shadow map: kernels equal their twins, samples know their source, moving boxes cast shadows."""

from dataclasses import replace

import numpy as np
import pytest

from gi_core import shadow_map_twin
from gi_core.device import Device, available_devices, describe, shared_device
from gi_core.grid import SectorIndex
from gi_core.layout import NO_SAMPLE, WHOLE_SAMPLE
from gi_core.live_shadows import NEAR_M, sectors_within
from gi_core.resident_sector import ResidentSector
from gi_core.shadow_map import LAST_NUMBER, ShadowMap, SunSamples
from gi_core.shadow_plan import (
    MAP_TEXELS,
    NO_BOXES,
    MovingBox,
    box_corners,
    box_triangles,
    oldest_fresh,
    plan_map,
    sun_or_box_moved,
    triangle_records,
)

ZERO = SectorIndex(0, 0)
MIDDLE = np.array([32.0, 2.0, 32.0])
TOP = 60.0


@pytest.fixture(scope="module", params=[describe(d) for d in available_devices()])
def device(request) -> Device:
    return shared_device(request.param)


def towards(elevation_degrees: float, azimuth_degrees: float = 25.0) -> np.ndarray:
    elevation, azimuth = np.radians([elevation_degrees, azimuth_degrees])
    return np.array([np.cos(elevation) * np.cos(azimuth), np.sin(elevation), np.cos(elevation) * np.sin(azimuth)])


def drawn(device: Device, corners: np.ndarray, to_sun: np.ndarray, boxes=(), position=MIDDLE) -> ShadowMap:
    shadow_map = ShadowMap(device, lambda _: triangle_records(corners), TOP)
    plan = plan_map(position, to_sun, {ZERO}, 0.0, TOP, box_corners(boxes))
    assert plan is not None
    shadow_map.begin(plan)
    while not shadow_map.draw(10):
        pass
    return shadow_map


def random_city(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    boxes = [
        MovingBox((x, h / 2, z), (rng.uniform(1, 8), h / 2, rng.uniform(1, 8)), rng.uniform(0, 90))
        for x, z, h in zip(rng.uniform(0, 64, 12), rng.uniform(0, 64, 12), rng.uniform(2, TOP, 12), strict=True)
    ]
    loose = rng.uniform(0, 60, (40, 1, 3)) + rng.normal(0, 4, (40, 3, 3))
    ground = np.array([[[-50.0, 0, -50], [150, 0, -50], [150, 0, 150]], [[-50, 0, -50], [150, 0, 150], [-50, 0, 150]]])
    return np.concatenate([box_triangles(box_corners(boxes)), loose, ground])


@pytest.mark.parametrize("elevation", [90.0, 62.0, 30.0, 6.0])
def test_the_map_equals_its_twin(device, elevation):
    corners = random_city(int(elevation))
    shadow_map = drawn(device, corners, towards(elevation))
    expected = shadow_map_twin.draw(shadow_map.plan, corners)
    found = shadow_map.read()
    # A centre that lies on an edge within float32's rounding may belong to either side of it: 2e-4 of a texel at 1024.
    differs = np.abs(found - expected) > 2e-3
    assert differs.mean() < 2e-4
    assert (expected > shadow_map_twin.NOTHING_DRAWN).mean() > 0.05


@pytest.mark.parametrize("elevation", [90.0, 30.0, 6.0])
def test_triangles_seen_edge_on_shade_nothing_above_them(device, elevation):
    """Walls along the sun's rays: rounding makes up their slope, and what lies behind would be shaded by hundreds of metres of it."""
    rng, to_sun, count = np.random.default_rng(0), towards(elevation), 3000
    a, b = rng.uniform(-60, 120, (2, count, 3))
    aside = rng.normal(size=(count, 3)) * 10 ** rng.uniform(-7, -2, (count, 1))
    c = a + rng.uniform(-0.5, 1.5, (count, 1)) * (b - a) + rng.uniform(-40, 40, (count, 1)) * to_sun + aside
    corners = np.stack([a, b, c], axis=1)
    shadow_map = drawn(device, corners, to_sun)
    highest = shadow_map_twin.map_from_world(shadow_map.plan, corners)[..., 2].max()
    found = shadow_map.read()
    assert (found > shadow_map_twin.NOTHING_DRAWN).any()
    assert found.max() <= highest + 1e-3  # float32 knows some hundred metres to 3e-5 m


def samples_of(device, make_sector, seed: int, **changes) -> SunSamples:
    sector = make_sector(seed, surfels=2000)
    rng = np.random.default_rng(seed)
    position = rng.uniform(0, 64, (sector.surfel_count, 3)) * [1, 0.5, 1]
    fine = np.zeros_like(sector.brick_level)
    sector = replace(sector, index=ZERO, surfel_position=position.astype(np.float32), brick_level=fine, **changes)
    return SunSamples(device, ResidentSector(device, sector, 6))


@pytest.mark.parametrize("elevation", [90.0, 62.0, 30.0, 6.0])
def test_samples_equal_their_twin(device, make_sector, elevation):
    corners = random_city(int(elevation))
    shadow_map = drawn(device, corners, towards(elevation))
    samples = samples_of(device, make_sector, 5)
    shadow_map.sample(samples)
    found, number = samples.read()
    sector = samples.resident.sector
    size = np.ones(sector.surfel_count)
    share, valid = shadow_map_twin.sample(
        shadow_map.plan, shadow_map.read(), sector.surfel_position.astype(float), sector.surfel_normal.astype(float), size, TOP
    )
    # One tap of sixteen may fall into the neighbouring texel, or a plane may touch what it is compared with.
    assert ((number == 1) == valid).mean() > 0.999
    both = (number == 1) & valid
    assert both.sum() > 200
    assert (found[~valid & (number != 1)] == NO_SAMPLE).all()
    assert np.abs(found[both].astype(int) - share[both]).mean() < 0.01 * WHOLE_SAMPLE
    assert 0.02 < (share[both] == WHOLE_SAMPLE).mean() < 0.9


def test_a_floor_in_the_open_is_lit_and_one_under_a_roof_is_not(device, make_sector):
    ground = random_city(1)[-2:]
    roof = box_triangles(box_corners([MovingBox((32.0, 10.0, 32.0), (8.0, 0.5, 8.0))]))
    shadow_map = drawn(device, np.concatenate([ground, roof]), towards(60.0))
    up = np.tile(np.float32([0, 1, 0]), (2000, 1))
    samples = samples_of(device, make_sector, 5, surfel_normal=up)
    position = samples.resident.sector.surfel_position.copy()
    position[:, 1] = 0.0
    samples = SunSamples(device, ResidentSector(device, replace(samples.resident.sector, surfel_position=position), 6))
    shadow_map.sample(samples)
    found, _ = samples.read()
    moved = position - 10.0 / towards(60.0)[1] * -towards(60.0)
    over = np.abs(moved[:, [0, 2]] - 32).max(axis=1)
    assert (found[over > 10.5] == WHOLE_SAMPLE).all()
    assert (found[over < 5.5] == 0).all()


def test_a_moving_box_casts_a_shadow_and_takes_it_along(device, make_sector):
    ground = random_city(1)[-2:]
    up = np.tile(np.float32([0, 1, 0]), (2000, 1))
    sector = samples_of(device, make_sector, 5, surfel_normal=up).resident.sector
    flat = sector.surfel_position.copy()
    flat[:, 1] = 0.0
    samples = SunSamples(device, ResidentSector(device, replace(sector, surfel_position=flat), 6))
    dark = []
    for x in (20.0, 44.0):
        shadow_map = drawn(device, ground, towards(90.0), (MovingBox((x, 1.5, 32.0), (6.0, 1.0, 6.0)),))
        shadow_map.sample(samples)
        found, _ = samples.read()
        dark.append(flat[found == 0][:, 0])
    assert 14 < dark[0].min() < dark[0].max() < 26
    assert 38 < dark[1].min() < dark[1].max() < 50


def test_each_surfel_knows_its_source(device, make_sector):
    corners = random_city(3)
    shadow_map = drawn(device, corners, towards(50.0))
    samples = samples_of(device, make_sector, 5)
    shadow_map.sample(samples)
    first, _ = samples.read()
    # The player leaves: the next map, for nearly the same sun, covers none of the surfels, whose samples stay.
    away = plan_map(MIDDLE + np.array([2000.0, 0, 0]), towards(50.5), {ZERO}, 0.0, TOP)
    shadow_map.begin(away)
    assert shadow_map.draw(1)
    shadow_map.sample(samples)
    kept, number = samples.read()
    normal = samples.resident.sector.surfel_normal
    facing = np.all([normal @ towards(e) > 0.02 for e in (50.0, 50.5, 53.0)], axis=0)
    np.testing.assert_array_equal(kept[facing], first[facing])
    assert (number[facing & (first != NO_SAMPLE)] == 1).all()
    # Then the sun moves on: what it says of the surfels is stale, and the bake takes over.
    shadow_map.begin(plan_map(MIDDLE + np.array([2000.0, 0, 0]), towards(53.0), {ZERO}, 0.0, TOP))
    shadow_map.draw(1)
    shadow_map.sample(samples)
    gone, _ = samples.read()
    assert (gone[facing] == NO_SAMPLE).all()


def test_samples_grow_old_between_looks(device, make_sector):
    shadow_map = drawn(device, random_city(3), towards(50.0))
    samples = samples_of(device, make_sector, 5)
    assert not samples.forget_old(towards(50.0))  # there are none
    shadow_map.sample(samples)
    # The next map covers none of the surfels: most samples are of the first look, the second's are of surfels that face away.
    shadow_map.begin(plan_map(MIDDLE + np.array([2000.0, 0, 0]), towards(50.8), {ZERO}, 0.0, TOP))
    shadow_map.draw(1)
    shadow_map.sample(samples)
    before, number = samples.read()
    assert {1, 2} <= set(number[before != NO_SAMPLE].tolist())
    assert not samples.forget_old(towards(50.9))
    assert samples.forget_old(towards(51.2))
    after, _ = samples.read()
    assert (after[number < 2] == NO_SAMPLE).all()
    np.testing.assert_array_equal(after[number == 2], before[number == 2])
    assert samples.are_there
    assert samples.forget_old(towards(30.0))
    assert not samples.are_there
    assert (samples.read()[0] == NO_SAMPLE).all()


def test_looks_at_a_map_at_every_tick_are_not_all_remembered(device, make_sector):
    """As when a box moves for minutes; and samples are forgotten a little early at most, never late."""
    samples = samples_of(device, make_sector, 5)
    suns = [towards(50.0 + step / 3000) for step in range(9000)]
    kept = [samples.look(sun) for sun in suns]
    assert len(samples._looks) <= 18
    degrees = np.degrees(np.arccos(np.minimum(np.array(suns)[np.array(kept) - 1] @ suns[-1], 1)))
    assert degrees[-1] <= 1
    assert degrees[-1] > 1 - 2 / 16


def test_samples_start_anew_when_looks_run_out_of_numbers(device, make_sector):
    shadow_map = drawn(device, random_city(3), towards(50.0))
    samples, other = samples_of(device, make_sector, 5), samples_of(device, make_sector, 5)
    samples.number = LAST_NUMBER - 1
    for number in (LAST_NUMBER, 1):
        shadow_map.sample(samples)
        assert samples.number == number
    shadow_map.sample(other)
    np.testing.assert_array_equal(samples.read(), other.read())


def test_a_ray_that_leaves_what_was_drawn_below_the_roofs_is_not_valid(device, make_sector):
    shadow_map = ShadowMap(device, lambda _: triangle_records(random_city(3)), 2000.0)
    plan = plan_map(MIDDLE, towards(10.0), {ZERO}, 0.0, 2000.0)
    assert plan.reach_height_m < 2000.0
    shadow_map.begin(plan)
    shadow_map.draw(1)
    samples = samples_of(device, make_sector, 5)
    shadow_map.sample(samples)
    facing = samples.resident.sector.surfel_normal @ towards(10.0) > 0.02
    assert (samples.read()[0][facing] == NO_SAMPLE).all()


def test_a_map_is_planned_anew_when_sun_or_box_have_moved_enough():
    def moved(elevation: float, *boxes: MovingBox) -> bool:
        return sun_or_box_moved(plan, towards(elevation), box_corners(boxes))

    van = MovingBox((0, 0, 0), (3, 1, 1))
    plan = plan_map(MIDDLE, towards(50.0), {ZERO}, 0.0, TOP, box_corners([van]))
    assert not moved(50.1, replace(van, position=(0.3, 0, 0)))
    assert moved(50.3, van)
    assert moved(50.0, replace(van, position=(0.6, 0, 0)))
    assert moved(50.0)
    # What turns or grows in place casts another shadow, too.
    assert moved(50.0, replace(van, turned_degrees=90.0))
    assert moved(50.0, replace(van, half_size=(9, 3, 3)))
    assert not moved(50.0, replace(van, turned_degrees=5.0))  # its corners are 0.28 m further
    assert plan_map(MIDDLE, towards(0.5), {ZERO}, 0.0, TOP) is None


def test_a_box_has_its_corners_and_twelve_triangles():
    corners = box_corners([MovingBox((10, 2, 5), (3, 1, 0.5), 90.0), MovingBox((0, 0, 0), (1, 2, 3))])
    np.testing.assert_allclose(corners[0].min(axis=0), [9.5, 1, 2], atol=1e-12)
    np.testing.assert_allclose(corners[0].max(axis=0), [10.5, 3, 8], atol=1e-12)
    a, b, c = np.moveaxis(box_triangles(corners), 1, 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).reshape(2, 12).sum(axis=1) / 2
    np.testing.assert_allclose(area, [2 * (6 * 2 + 6 * 1 + 2 * 1), 2 * (2 * 4 + 2 * 6 + 4 * 6)])
    assert box_triangles(NO_BOXES).shape == (0, 3, 3)
    np.testing.assert_array_equal(box_corners([]), NO_BOXES)


def test_sectors_towards_the_sun_are_drawn_and_others_are_not():
    sectors = {SectorIndex(x, z) for x in range(-40, 41) for z in range(-40, 41)}
    plan = plan_map(MIDDLE, towards(10.0, 0.0), sectors, 0.0, TOP)
    drawn_x = [index.x for index in plan.sectors]
    assert max(drawn_x) * 64 >= 128 + plan.reach_m - 64
    assert max(abs(index.z) for index in plan.sectors) <= 4
    assert len(plan.sectors) < 200
    overhead = plan_map(MIDDLE, towards(90.0), sectors, 0.0, TOP)
    assert {(i.x, i.z) for i in overhead.sectors} == {(x, z) for x in range(-2, 3) for z in range(-2, 3)}


def test_maps_are_fresh_while_the_sun_stands_near_theirs():
    drawn_for = [towards(e) for e in (40.0, 40.6, 41.2, 41.5)]
    assert oldest_fresh(drawn_for, towards(41.5)) == 1
    assert oldest_fresh(drawn_for, towards(60.0)) == 4


def test_an_unchanged_sun_gives_the_same_texels_wherever_the_player_stands(device):
    corners = random_city(7)
    here, there = (drawn(device, corners, towards(40.0), position=MIDDLE + np.array([x, 0, 0])) for x in (0.0, 3.7))
    shift = np.round((there.plan.middle - here.plan.middle) @ np.stack([here.plan.across, here.plan.down], axis=1) * 4).astype(int)
    a, b = here.read(), there.read()
    height = (there.plan.middle - here.plan.middle) @ here.plan.to_sun
    x, y = shift
    inner = slice(64, MAP_TEXELS - 64)
    moved = np.roll(b, (y, x), (0, 1)) + height
    close = np.abs(a - moved)[inner, inner] < 5e-3
    both = (a[inner, inner] > -1e29) & (moved[inner, inner] > -1e29)
    assert close[both].mean() > 0.999


def test_seventy_kilometres_from_the_origin_samples_are_the_same(device, make_sector):
    shift = np.array([775 * 64.0, 0.0, -775 * 64.0])
    near = samples_of(device, make_sector, 5)
    far = SunSamples(device, ResidentSector(device, replace(near.resident.sector, index=SectorIndex(775, -775)), 6))
    corners = random_city(3)
    found = []
    for samples, at in ((near, np.zeros(3)), (far, shift)):
        index = samples.resident.sector.index
        # A sector's triangles are local to it; the sun stands so that the shift is of whole texels.
        shadow_map = ShadowMap(device, lambda _: triangle_records(corners), TOP)
        shadow_map.begin(plan_map(MIDDLE + at, towards(90.0), {index}, 0.0, TOP))
        assert shadow_map.draw(1)
        shadow_map.sample(samples)
        found.append(samples.read())
    np.testing.assert_array_equal(found[1][0], found[0][0])
    np.testing.assert_array_equal(found[1][1], found[0][1])
    assert 0.02 < (found[0][0] == WHOLE_SAMPLE).mean() < 0.9


def test_sectors_near_a_player_are_whole_in_its_map():
    """Else a map would be drawn for such a sector again and again."""
    rng = np.random.default_rng(5)
    around = {SectorIndex(x, z) for x in range(-6, 6) for z in range(-6, 6)}
    counts = set()
    for _ in range(300):
        place = rng.uniform(-200, 200, 3)
        plan = plan_map(place, towards(rng.uniform(2, 90), rng.uniform(0, 360)), around, 0.0, TOP)
        near = sectors_within(NEAR_M, place, around)
        assert all(plan.covers_whole(index) for index in near)
        counts.add(len(near))
    assert {6, 9} <= counts <= {4, 6, 9}
