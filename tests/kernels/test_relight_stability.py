"""The loop of bounces over many ticks: it never grows, never drifts, and forgets what was."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from gi_core import factor_weights
from gi_core.device import shared_device
from gi_core.layout import DIRECTIONAL_LIGHT
from gi_core.light_blend import LightVector
from gi_core.light_geometry import ShadowGeometry, SharedGeometry
from gi_core.lighting_model import make_lighting
from gi_core.lights import MAX_LUMENS, MAX_RANGE_M
from gi_core.live_sector import LiveLight, LiveSector
from gi_core.relight import Relighter
from gi_core.relight_input import RelightInput, relight_input
from gi_core.resident_sector import ResidentSector
from gi_core.settings import MAX_AMBIENT_LX, MAX_FACTOR, NEUTRAL, Settings
from gi_core.sun_table import SunTable
from gi_core.world import LAMP_KINDS, Lamp, Location

PATCHES = 6
DARK = RelightInput(np.zeros((PATCHES, 3), np.float32), np.zeros(0, DIRECTIONAL_LIGHT.dtype))


def sunlight(strength: float) -> RelightInput:
    sun = np.zeros(1, DIRECTIONAL_LIGHT.dtype)
    sun["direction"][0, :3] = (0.36, 0.8, 0.48)
    sun["irradiance"][0, :3] = np.array([1.0, 0.9, 0.7]) * strength
    sun["plane"], sun["plane_weight"] = (0, 1, 2, 3), (0.4, 0.3, 0.2, 0.1)
    return RelightInput(np.full((PATCHES, 3), strength * 0.1, np.float32), sun)


def closed_white_room(make_sector, seed: int, **sizes):
    """Every probe sees surfels only, and each reflects all that a surface may: the loop loses no more than it must."""
    sector = make_sector(seed, **sizes)
    bricks_only = np.where(sector.factor_source >= sector.brick_count, 0, sector.factor_source).astype(np.uint32)
    codes = factor_weights.encode(sector.factor_weight, sector.factor_starts, np.zeros(sector.factor_count, bool))
    white = np.full_like(sector.surfel_albedo, 0.95)
    return replace(sector, factor_source=bricks_only, **codes._asdict(), surfel_albedo=white)


def run(resident: ResidentSector, given: RelightInput, ticks: int) -> np.ndarray:
    relighter = Relighter(resident.device)
    for _ in range(ticks // 100):
        relighter.relight([resident], given, 100)
        resident.device.queue.finish()
    relighter.relight([resident], given, ticks % 100)
    return resident.read_cubes()


def test_darkness_falls_to_exactly_nothing(make_sector):
    resident = ResidentSector(shared_device(), closed_white_room(make_sector, 1), PATCHES)
    resident.write_cubes(np.full((resident.sector.probe_count, 6, 3), 1e9, np.float32))
    # 0.95 ** 4000 is 1e-89: float32 has long flushed it.
    assert not run(resident, DARK, 4000).any()


def test_the_fixed_point_does_not_depend_on_the_past(make_sector):
    sector = closed_white_room(make_sector, 2)
    ends = []
    for start in (0.0, 1e3, 1e9):
        resident = ResidentSector(shared_device(), sector, PATCHES)
        resident.write_cubes(np.full((sector.probe_count, 6, 3), start, np.float32))
        ends.append(run(resident, sunlight(1e5), 2000))
    # Float32 stops a rounding step short of the fixed point; 20 steps of it when every bounce keeps 95 %.
    for end in ends[1:]:
        np.testing.assert_allclose(end, ends[0], rtol=20 * np.finfo(np.float32).eps)


def test_a_light_switched_on_and_off_leaves_no_trace_but_rounding(make_sector):
    # A query starts from darkness and gives the first bytes back (test_relight_against_twin); a running loop ends where rounding stops it.
    resident = ResidentSector(shared_device(), make_sector(3), PATCHES)
    before = run(resident, sunlight(1e3), 400)
    assert run(resident, sunlight(1e9), 400).max() > before.max()
    np.testing.assert_allclose(run(resident, sunlight(1e3), 400), before, rtol=4 * np.finfo(np.float32).eps)


@pytest.mark.parametrize("strength", [0.0, 1e-6, 1e9, 1e30])
def test_no_strength_of_light_gives_nan_or_infinity(make_sector, strength):
    found = run(ResidentSector(shared_device(), closed_white_room(make_sector, 4), PATCHES), sunlight(strength), 300)
    assert np.isfinite(found).all()
    assert (found >= 0).all()


MOST = {name: (MAX_AMBIENT_LX,) * 3 if isinstance(getattr(NEUTRAL, name), tuple) else MAX_FACTOR for name in vars(NEUTRAL)}
# In the middle of the sector's surfels, with all that a lamp may give.
LAMPS = tuple(Lamp(kind, kind, (30.0, 30.0, 30.0), MAX_LUMENS, range_m=MAX_RANGE_M) for kind in LAMP_KINDS)


@pytest.mark.parametrize("ticks", [3_000, pytest.param(100_000, marks=[pytest.mark.slow, pytest.mark.timeout(900)])])
def test_with_all_gains_and_colours_at_their_maximum_ticks_never_grow(make_sector, ticks):
    """As the live world makes them: light under the panel, lamps, a bounce, and what is shown of it."""
    table = SunTable.build(Location(), 30, 30)
    sector = closed_white_room(make_sector, 5, planes=table.plane_count)
    panel = Settings(**MOST)
    lighting = panel.light(make_lighting(Location(), "12:00", "snow"))
    given = relight_input(lighting, table)
    lamps = panel.brightened(LAMPS)
    light = LiveLight(lighting, given, LightVector.of(given), lamps[:1], lamps[1:], panel, False)
    device = shared_device()
    relighter = Relighter(device)
    live = LiveSector(device, sector, PATCHES, SharedGeometry(ShadowGeometry({}.__getitem__, []), ThreadPoolExecutor(1)))
    shown, kept = np.zeros((2, sector.probe_count, 6, 4), np.float32)
    for tick in range(ticks):
        live.light(light, is_read=True)
        relighter.relight([live.resident], light.given)
        live.measure(live.resident.read_cubes())
        live.advance(tick, must_show=True, is_read=True)
        device.read(live.shown(panel, lambda: np.full((6, 3), MAX_AMBIENT_LX, np.float32), "cube"), shown)
        if tick == 1_000:  # 0.95 ** 1000 is 5e-23: all that bounces will ever add is there
            kept[:] = shown
        elif tick % 1_000 == 0 or tick == ticks - 1:
            assert np.isfinite(shown).all()
            assert (shown >= 0).all()
    assert kept.max() > MAX_FACTOR * MAX_LUMENS / 1e6  # lamps do light it
    np.testing.assert_allclose(shown, kept, rtol=20 * np.finfo(np.float32).eps)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_million_ticks_do_not_drift(make_sector):
    resident = ResidentSector(shared_device(), make_sector(6, probes=8, surfels=60), PATCHES)
    first = run(resident, sunlight(1e5), 400)
    np.testing.assert_array_equal(run(resident, sunlight(1e5), 1_000_000), first)
