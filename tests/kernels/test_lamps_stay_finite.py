"""Whatever lamp ``check_lamp`` accepts, no NaN or infinity leaves the lamps' functions or kernels."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gi_core import lights_twin
from gi_core.device import Device, available_devices, describe, shared_device
from gi_core.geometry_file import Geometry
from gi_core.grid import SectorIndex
from gi_core.light_geometry import ShadowGeometry
from gi_core.light_plan import SurfelBounds, changed_spheres, surfel_words, touching_lamps
from gi_core.light_surfels import SurfelLights
from gi_core.lights import (
    MAX_CONE_DEGREES,
    MAX_LUMENS,
    MAX_RANGE_M,
    MAX_SIZE_M,
    MIN_CONE_DEGREES,
    MIN_RANGE_M,
    MIN_SIZE_M,
    area_halves,
    check_lamp,
    light_records,
)
from gi_core.world import LAMP_KINDS, Lamp

SURFELS = 40  # a full word of bits, and part of another
HERE = SectorIndex(-3, 2)


def numbers(low: float, high: float) -> st.SearchStrategy[float]:
    """The ends, and any magnitude between them: half of all draws are whole or tiny."""
    return st.one_of(
        st.sampled_from([low, high, *([5e-324, 1e-310, 1e-45] if low == 0 else [])]), st.floats(low, high), st.floats(low, min(high, 100.0))
    )


NEAR = st.one_of(st.floats(-1, 70), st.sampled_from([0.0, 5.0, 10.0, 64.0]))
COMPONENT = st.one_of(st.sampled_from([0.0, 1.0, -1.0, 1e-6, 1e9]), st.floats(-1e9, 1e9), st.floats(-1, 1))


@st.composite
def lamps(draw, surfel_position) -> Lamp:
    """Lamps that may be lit with, near the sector, or in a surfel of it, or anywhere."""
    place = draw(st.one_of(st.tuples(NEAR, NEAR, NEAR), st.sampled_from(surfel_position.tolist()).map(tuple)))
    position = tuple((np.array(place, np.float64) + HERE.origin).tolist())
    if draw(st.integers(0, 9)) == 0:
        position = draw(st.tuples(*[st.floats(-1e9, 1e9)] * 3))
    direction = draw(st.tuples(COMPONENT, COMPONENT, COMPONENT).filter(lambda v: np.hypot(np.hypot(v[0], v[1]), v[2]) > 2e-6))
    lamp = Lamp(
        "any",
        draw(st.sampled_from(LAMP_KINDS)),
        position,
        draw(numbers(0, MAX_LUMENS)),
        draw(st.tuples(*[numbers(0, 1e6)] * 3)),
        draw(numbers(MIN_RANGE_M, MAX_RANGE_M)),
        direction,
        draw(numbers(MIN_CONE_DEGREES, MAX_CONE_DEGREES)),
        draw(st.tuples(*[numbers(MIN_SIZE_M, MAX_SIZE_M)] * 2)),
    )
    check_lamp(lamp)
    return lamp


def in_a_box(sector):
    """The sector with its surfels on and about a box from (5, 0, 5) to (10, 10, 10), some of them in one place, some on its walls."""
    rng = np.random.default_rng(1)
    position = rng.uniform(0, 15, (SURFELS, 3))
    position[:10] = np.round(position[:10] / 5) * 5
    position[10:15] = position[0]
    normal = np.array([[1, 0, 0], [0, 1, 0], [0, 0, -1], [0, -1, 0]], np.float32)[rng.integers(0, 4, SURFELS)]
    normal[20:] = sector.surfel_normal[20:]
    return replace(sector, index=HERE, surfel_position=position.astype(np.float32), surfel_normal=normal)


def box_and_slivers() -> ShadowGeometry:
    """The box's walls, and triangles that are a line, a point, or longer than the world."""
    low, high = np.array([5.0, 0, 5]), np.array([10.0, 10, 10])
    corners = []
    for axis in range(3):
        a, b = np.roll([high[axis - 2] - low[axis - 2], 0, 0], axis - 2), np.roll([high[axis - 1] - low[axis - 1], 0, 0], axis - 1)
        for side in (low, np.where(np.arange(3) == axis, high, low)):
            corners += [[side, side + a, side + a + b], [side, side + a + b, side + b]]
    corners += [[[1, 1, 1], [1, 1, 1], [1, 1, 1]], [[0, 0, 0], [20, 20, 20], [10, 10, 10]], [[-1e4, 3, -1e4], [1e4, 3, -1e4], [0, 3, 1e4]]]
    vertices = np.array(corners, np.float64).reshape(-1, 3) + HERE.origin
    flat = np.zeros((len(corners), 3), np.float32)
    geometry = Geometry(vertices, np.arange(len(vertices), dtype=np.int32).reshape(-1, 3), flat, flat)
    return ShadowGeometry({HERE: geometry}.__getitem__, [HERE])


SHADOWS = box_and_slivers()


@pytest.fixture(scope="module", params=[describe(d) for d in available_devices()])
def device(request) -> Device:
    return shared_device(request.param)


@pytest.fixture(scope="module")
def sector(make_sector):
    return in_a_box(make_sector(5, surfels=SURFELS))


def all_finite(records: np.ndarray) -> bool:
    return all(np.isfinite(records[name]).all() for name in records.dtype.names)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(data=st.data())
def test_records_plans_and_twin_are_finite(sector, data):
    lamp = data.draw(lamps(sector.surfel_position))
    records = light_records([lamp], sector.index.origin)
    assert all_finite(records)
    assert np.isfinite(area_halves(lamp)).all()
    assert np.isfinite(changed_spheres([], [lamp], sector.index.origin)).all()
    for found in touching_lamps([lamp], SurfelBounds(sector)):
        assert np.isfinite([found.low, found.high]).all()
        assert (found.low <= found.high).all()
        near = lights_twin.shadow_triangles(SHADOWS, found, sector.index.origin)
        light = lights_twin.light_surfels(records, lights_twin.surfel_places(sector), [near])
        assert np.isfinite(light).all()
        assert (light >= 0).all()


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_kernels_are_finite_and_leave_nothing_behind(device, sector, data):
    static, dynamic = (data.draw(st.lists(lamps(sector.surfel_position), max_size=3)) for _ in range(2))
    lit = SurfelLights(device, sector, SHADOWS)
    lit.set_static(static)
    lit.set_dynamic(dynamic)
    values = np.zeros((SURFELS, 4), np.float32)
    if lit.buffer is not None:
        device.read(lit.buffer, values)
    assert np.isfinite(values).all()
    assert (values >= 0).all()
    lit.set_dynamic([])
    lit.set_static([])
    assert lit.nbytes == 0


@pytest.mark.parametrize("kind", LAMP_KINDS)
def test_a_sector_without_surfels_takes_any_lamp(device, make_sector, kind):
    empty = make_sector(5, surfels=0)
    assert len(surfel_words(empty)) == 0
    lit = SurfelLights(device, empty, SHADOWS)
    lit.set_static([Lamp("", kind, (5.0, 5.0, 5.0), 1e9)])
    lit.set_dynamic([Lamp("", kind, (6.0, 5.0, 5.0), 1e9)])
    assert lit.buffer is None
    assert lit.nbytes == 0
