"""Whatever light up to 1e30 lx a sector gets, no NaN or infinity leaves a relight, what is shown of it, or a volume filled from it."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gi_core.basis import basis_of_size, served_from
from gi_core.constants import BASIS_SIZES
from gi_core.device import Device, available_devices, describe, shared_device
from gi_core.layout import DIRECTIONAL_LIGHT
from gi_core.relight import Relighter
from gi_core.relight_input import RelightInput
from gi_core.resident_sector import ResidentSector
from gi_core.volume import box_record, plan_boxes

PATCHES, PLANES = 6, 12
# 1e14 times what the brightest lamp gives a surfel where it hangs. Sums of 255 ** 2 times as much stay below float32's end.
MOST_LX = float(np.float32(1e30))
LUX = st.one_of(st.sampled_from([0.0, 1e-45, 1e-38, 1.0, MOST_LX]), st.floats(0, MOST_LX, width=32), st.floats(0, 1e5, width=32))
SHARE = st.one_of(st.sampled_from([0.0, 1e-45, 0.25, 1.0]), st.floats(0, 1, width=32))


@st.composite
def lights(draw: st.DrawFn) -> RelightInput:
    """Sky, sun and moon of any strength, colour and direction."""
    records = np.zeros(draw(st.integers(0, 2)), DIRECTIONAL_LIGHT.dtype)
    for record in records:
        direction = np.array(draw(st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 1e-3)))
        record["direction"][:3] = direction / np.linalg.norm(direction)
        record["irradiance"][:3] = draw(st.tuples(LUX, LUX, LUX))
        record["plane"] = draw(st.tuples(*[st.integers(0, PLANES - 1)] * 4))
        weight = np.array(draw(st.tuples(*[SHARE] * 4)))
        record["plane_weight"] = weight / max(weight.sum(), 1)
    sky = draw(st.lists(st.tuples(LUX, LUX, LUX), min_size=PATCHES, max_size=PATCHES))
    return RelightInput(np.array(sky, np.float32), records, draw(SHARE))


@pytest.fixture(scope="module", params=[describe(d) for d in available_devices()])
def device(request) -> Device:
    return shared_device(request.param)


@pytest.fixture(scope="module", params=[4, 6, 9])
def resident(request, device, make_sector) -> ResidentSector:
    """Of a sector with surfels that shine. Random harmonics are no light and may grow: weak ones are what a real sector has."""
    sector = make_sector(3, probes=12, surfels=60, basis=request.param, feedback=3, emits=True)
    if request.param != 6:
        sector = replace(sector, factor_scale=sector.factor_scale * np.float16(0.3))
    return ResidentSector(device, sector, PATCHES)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(light=lights(), held=LUX, lamps=LUX, passes=st.integers(1, 8))
def test_relights_are_finite(resident, light, held, lamps, passes):
    sector, device = resident.sector, resident.device
    shape = (sector.probe_count, sector.basis_size, 3)
    # Of harmonics that are held, the higher ones may be negative.
    signs = np.where(np.arange(sector.basis_size) % 2 == 1, -1 if sector.basis_size != 6 else 1, 1)[:, None]
    resident.write_cubes(np.broadcast_to(np.float32(held) * signs, shape).astype(np.float32))
    resident.set_lamps(device.upload(np.pad(np.full((sector.surfel_count, 3), lamps, np.float32), ((0, 0), (0, 1)))))
    Relighter(device).relight([resident], light, passes)
    found = resident.read_cubes()
    assert np.isfinite(found).all()
    if sector.basis_size == 6:
        assert (found >= 0).all()

    box = next(b for b in plan_boxes(np.array([0, -1, 0])) if b.index == sector.index)
    for basis in served_from(basis_of_size(sector.basis_size)):
        values = np.zeros((BASIS_SIZES[basis], 16, 32, 32, 3), np.float32)
        target = device.allocate(values.nbytes)
        resident.fill_volume(box_record(box, sector), box.size, target, resident.converted(basis), basis)
        device.read(target, values)
        assert np.isfinite(values).all()


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(light=lights())
def test_queries_are_finite_and_their_residual_is_a_share(resident, light):
    resident.set_lamps(None)
    found = Relighter(resident.device).converge(resident, light)
    assert np.isfinite(found.cubes).all()
    assert np.isfinite(found.first_bounce).all()
    assert 0 <= found.residual <= 1
