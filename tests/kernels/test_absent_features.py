"""What a scene does not have has no buffer on the device, and no kernel is built for it."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pyopencl as cl
import pytest

from gi_core.bench_relight import made_up_city
from gi_core.device import Device
from gi_core.layout import DIRECTIONAL_LIGHT
from gi_core.light_geometry import ShadowGeometry, SharedGeometry
from gi_core.live_sector import LiveSector
from gi_core.relight import Relighter
from gi_core.relight_input import RelightInput
from gi_core.resident_sector import ResidentSector
from gi_core.world import Lamp

PATCHES = 6
FEATURES = ("HAS_GLOW", "HAS_SNOW", "HAS_SUN_MAP")


@pytest.fixture
def fresh() -> Device:
    """A device for which nothing has been built yet; a processor, as relight_sector is for those."""
    device = Device()
    device.is_processor = True
    return device


def light(lights: int, snow: float = 0.0) -> RelightInput:
    records = np.zeros(lights, DIRECTIONAL_LIGHT.dtype)
    records["direction"][:, 1], records["irradiance"], records["plane_weight"] = 1, 1e5, 0.25
    return RelightInput(np.full((PATCHES, 3), 1e4, np.float32), records, snow)


def plain(make_sector):
    sector = make_sector(3)
    one = np.ones_like(sector.feedback_weight)
    return replace(sector, surfel_snow=np.zeros_like(sector.surfel_snow), feedback_weight=one)


def lit(device: Device, sector, given: RelightInput, **features) -> ResidentSector:
    resident = ResidentSector(device, sector, PATCHES)
    if "lamps" in features:
        resident.set_lamps(device.upload(np.ones((sector.surfel_count, 4), np.float32)))
    if "sample" in features:
        resident.set_sun_sample(device.upload(np.zeros(-(-sector.surfel_count // 8) * 8, np.uint8)))
    Relighter(device).relight([resident], given)
    device.queue.finish()
    return resident


def defines_of(device: Device, kernel: str) -> dict[str, int]:
    (found,) = (defines for name, defines in device.built_kernels if name == kernel)
    return found


def test_a_sector_under_the_sky_alone_has_nothing_else(fresh, make_sector):
    resident = lit(fresh, plain(make_sector), light(0))
    for absent in ("sun_visibility", "sun_share", "sun_sample", "brick_emission", "lamps_on_bricks"):
        assert getattr(resident, absent) is None, absent
    assert {name for name, _ in fresh.built_kernels} == {"collect_bounces", "relight_sector"}
    assert defines_of(fresh, "relight_sector") == {"DIRECTIONAL_LIGHTS": 0, "BASIS_SIZE": 6} | dict.fromkeys(FEATURES, 0)
    assert defines_of(fresh, "collect_bounces") == {
        "BASIS_SIZE": 6,
        "BOUNCE_ALBEDO_PERMILLE": 950,
        "FEEDBACK_PROBES": 1,
        "HAS_FEEDBACK_WEIGHTS": 0,
        "HAS_SNOW": 0,
    }


def test_the_sun_alone_brings_its_own_buffers_and_no_shadow_map(fresh, make_sector):
    resident = lit(fresh, plain(make_sector), light(1))
    assert resident.sun_visibility is not None
    assert resident.sun_share is not None
    assert resident.sun_sample is None
    assert defines_of(fresh, "relight_sector") == {"DIRECTIONAL_LIGHTS": 1, "BASIS_SIZE": 6} | dict.fromkeys(FEATURES, 0)


@pytest.mark.parametrize("snow_on_surfels", [False, True])
def test_snowfall_builds_code_only_where_snow_can_lie(fresh, make_sector, snow_on_surfels):
    sector = make_sector(3) if snow_on_surfels else plain(make_sector)
    lit(fresh, sector, light(1, snow=0.5))
    assert defines_of(fresh, "relight_sector")["HAS_SNOW"] == snow_on_surfels
    assert defines_of(fresh, "collect_bounces")["HAS_SNOW"] == snow_on_surfels


def test_lamps_and_samples_are_the_code_that_they_ask_for_and_their_makers_bytes(fresh, make_sector):
    sector = plain(make_sector)
    without = lit(fresh, sector, light(1))
    lamps = lit(fresh, sector, light(1), lamps=True)
    assert lamps.nbytes - without.nbytes == 16 * sector.brick_count
    sampled = lit(fresh, sector, light(1), sample=True)
    assert sampled.nbytes == without.nbytes
    assert {defines["HAS_GLOW"] for name, defines in fresh.built_kernels if name == "relight_sector"} == {0, 1}
    assert defines_of(fresh, "lamps_on_bricks") == {"HAS_EMISSION": 0, "HAS_SNOW": 0}
    assert {defines["HAS_SUN_MAP"] for name, defines in fresh.built_kernels if name == "relight_sector"} == {0, 1}


def test_a_live_sector_counts_each_buffer_once(fresh, make_sector):
    sector = plain(make_sector)
    live = LiveSector(
        fresh, sector, PATCHES, SharedGeometry(ShadowGeometry(lambda _: made_up_city(), {sector.index}), ThreadPoolExecutor(1))
    )
    x, y, z = (sector.index.origin + sector.surfel_position[0] + sector.surfel_normal[0]).tolist()
    live.lamps.set_static([Lamp("lamp", "point", (x, y, z), 1e3)])
    live.resident.set_lamps(live.lamps.buffer)
    live.make_room_for_samples()
    live.resident.set_sun_sample(live.samples.sun_sample)
    Relighter(fresh).relight([live.resident], light(1))
    held = [vars(part).values() for part in (live.resident, live.lamps, live.lamps._bits, live.samples)]
    buffers = {buffer.int_ptr: buffer.size for values in held for buffer in values if isinstance(buffer, cl.Buffer)}
    assert live.resident.sun_sample.int_ptr in buffers
    assert live.lamps.buffer.int_ptr in buffers
    assert live.nbytes == sum(buffers.values())
