"""Whatever the sun, the player, the triangles and the boxes: plans are finite, a map holds depths of what was drawn, samples are shares."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gi_core import shadow_map_twin
from gi_core.device import Device, available_devices, describe, shared_device
from gi_core.grid import SectorIndex
from gi_core.layout import NO_SAMPLE, WHOLE_SAMPLE
from gi_core.resident_sector import ResidentSector
from gi_core.shadow_map import ShadowMap, SunSamples
from gi_core.shadow_plan import (
    LOWEST_SUN_DEGREES,
    MovingBox,
    ShadowPlan,
    box_corners,
    box_triangles,
    oldest_fresh,
    plan_map,
    sun_or_box_moved,
    triangle_records,
)

ZERO = SectorIndex(0, 0)
SECTORS = {SectorIndex(x, z) for x in (-3, 0, 1) for z in (0, 2)}
TOP_M = 60.0
NEAR = st.one_of(st.sampled_from([0.0, 32.0, 64.0]), st.floats(-200, 200))
ELEVATION = st.one_of(st.sampled_from([-90.0, 0.0, LOWEST_SUN_DEGREES, 90.0]), st.floats(-90, 90))


@st.composite
def suns(draw: st.DrawFn) -> np.ndarray:
    elevation, azimuth = math.radians(draw(ELEVATION)), math.radians(draw(st.floats(-180, 180)))
    return np.array([math.cos(elevation) * math.cos(azimuth), math.sin(elevation), math.cos(elevation) * math.sin(azimuth)])


POINT = st.tuples(NEAR, NEAR, NEAR)
BOXES = st.lists(st.builds(MovingBox, POINT, st.tuples(*[st.one_of(st.just(0.0), st.floats(0, 50))] * 3), st.floats(-1e6, 1e6)), max_size=2)
# Anywhere, in one place, or nearly along one line.
TRIANGLE = st.one_of(
    st.tuples(POINT, POINT, POINT),
    POINT.map(lambda p: (p, p, p)),
    st.tuples(POINT, POINT, st.floats(-1, 2), st.floats(-1e-3, 1e-3)).map(lambda g: (g[0], g[1], tuple(along(*g)))),
)


def along(a, b, share, off):
    """A point at a share of the way from a to b, a little off the line."""
    return np.array(a) + share * (np.array(b) - np.array(a)) + off


@settings(max_examples=150, deadline=None)
@given(
    to_sun=suns(),
    position=st.tuples(*[st.one_of(NEAR, st.floats(-1e9, 1e9))] * 3),
    heights=st.tuples(*[st.floats(-1e4, 1e4)] * 2),
    boxes=BOXES,
    later=suns(),
)
def test_plans_are_finite(to_sun, position, heights, boxes, later):
    corners = box_corners(boxes)
    plan = plan_map(np.array(position), to_sun, SECTORS, min(heights), max(heights), corners)
    if to_sun[1] < math.sin(math.radians(LOWEST_SUN_DEGREES)):
        assert plan is None
        return
    axes = np.stack([plan.across, plan.down, plan.to_sun])
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-9)
    assert np.abs(plan.middle - position).max() <= 0.25  # half a texel along either axis, but for the rounding of 1e9 m
    assert 0 <= plan.reach_m < math.inf
    assert plan.reach_height_m > 0
    assert set(plan.sectors) <= SECTORS
    for name in plan.frame(ZERO.origin).dtype.names:
        assert np.isfinite(plan.frame(ZERO.origin)[name]).all()
    assert np.isfinite(corners).all()
    assert sun_or_box_moved(plan, later, corners) in (True, False)
    assert oldest_fresh([plan.to_sun, later], later) in (0, 1)


@pytest.fixture(scope="module", params=[describe(d) for d in available_devices()])
def device(request) -> Device:
    return shared_device(request.param)


@pytest.fixture(scope="module")
def samples(device, make_sector) -> SunSamples:
    """Of surfels from below the ground to above the roofs, some on the planes that triangles like to lie in, cells of 1 to 8 m."""
    sector = make_sector(5, surfels=200)
    rng = np.random.default_rng(5)
    position = rng.uniform(-20, 80, (200, 3))
    position[::3] = np.round(position[::3] / 32) * 32
    normal = sector.surfel_normal.copy()
    normal[::2] = np.eye(3)[rng.integers(0, 3, 100)] * rng.choice([-1, 1], (100, 1))
    sector = replace(sector, index=ZERO, surfel_position=position.astype(np.float32), surfel_normal=normal)
    return SunSamples(device, ResidentSector(device, sector, 6))


def drawn(device: Device, plan: ShadowPlan, corners: np.ndarray) -> ShadowMap:
    shadow_map = ShadowMap(device, lambda _: triangle_records(corners), TOP_M)
    shadow_map.begin(replace(plan, sectors=(ZERO,)))
    assert shadow_map.draw(1)
    return shadow_map


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    to_sun=suns().filter(lambda s: s[1] >= math.sin(math.radians(LOWEST_SUN_DEGREES))),
    position=POINT,
    triangles=st.lists(TRIANGLE, min_size=1, max_size=4),
    boxes=BOXES,
)
def test_maps_hold_depths_of_what_was_drawn_and_samples_are_shares(device, samples, to_sun, position, triangles, boxes):
    moving = box_corners(boxes)
    plan = plan_map(np.array(position), to_sun, {ZERO}, 0.0, TOP_M, moving)
    corners = np.array(triangles, np.float64)
    shadow_map = drawn(device, plan, corners)
    every = np.concatenate([corners, box_triangles(moving)])
    depth = shadow_map_twin.map_from_world(plan, every)[..., 2]
    found = shadow_map.read()
    assert np.isfinite(found).all()
    assert found.max() <= depth.max() + 1e-3  # float32 knows some hundred metres to 3e-5 m
    shadow_map.sample(samples)
    share, number = samples.read()
    assert ((share <= WHOLE_SAMPLE) | (share == NO_SAMPLE)).all()
    assert number.max() <= samples.number
    assert (share[number == samples.number] <= WHOLE_SAMPLE).all()
    sector = samples.resident.sector
    expected, _ = shadow_map_twin.sample(
        plan, found, sector.surfel_position.astype(float), sector.surfel_normal.astype(float), np.ones(200), TOP_M
    )
    assert expected.max() <= WHOLE_SAMPLE
