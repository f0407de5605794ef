"""The live world settles to what a query gives, follows what changes, and forgets what was."""

import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import datetime
from itertools import count

import numpy as np
import pytest
from live_run import EAST, GOLDEN, HARMONICS, STREET, Run, at, light_of

from gi_core.constants import VOXEL_SIZE_M
from gi_core.dataset import Dataset
from gi_core.device import shared_device
from gi_core.engine import Engine
from gi_core.errors import InputError
from gi_core.geometry_file import Geometry
from gi_core.grid import SectorIndex
from gi_core.light_blend import LightVector
from gi_core.light_geometry import ShadowGeometry, SharedGeometry
from gi_core.live_sector import FADE_TICKS, LiveLight, LiveSector, fade_ticks
from gi_core.live_world import LiveWorld, TickReport
from gi_core.relight import Relighter
from gi_core.relight_input import relight_input
from gi_core.resident_sector import ResidentSector
from gi_core.settings import NEUTRAL, Settings
from gi_core.world import Lamp


@pytest.mark.parametrize("time_of_day", ["12:00", "23:30"])
def test_a_world_that_stands_still_shows_the_very_bytes_of_a_query(world, engine, time_of_day):
    lighting = engine.lighting(time_of_day, "clear")
    engine.lamps = world.dataset.world.lamps
    found = Run(world).settle(at(STREET), light_of(world, lighting, engine.lamps))
    query = engine.volume(STREET, lighting)
    np.testing.assert_array_equal(found, query.values)
    np.testing.assert_array_equal(world.volumes.of_player["p0"].published.mask, query.mask)


def test_a_volume_that_moved_shows_the_very_bytes_of_one_that_always_stood_there(world, engine):
    run, lighting, rng = Run(world), engine.lighting("12:00", "clear"), np.random.default_rng(5)
    light = light_of(world, lighting)
    run.settle(at(STREET), light)
    place = STREET
    for _ in range(40):
        # Steps along one axis and two, up and down, and jumps to where nothing of the last place is in sight.
        place = STREET + rng.normal(0, 30, 3) if rng.random() < 0.2 else place + rng.integers(-2, 3, 3) * (3.125, rng.random() < 0.3, 3.125)
        run.tick(at(place), light)
        query, shown = engine.volume(place, lighting), world.published("p0")
        np.testing.assert_array_equal(shown.values, query.values)
        np.testing.assert_array_equal(shown.mask, query.mask)


@pytest.mark.parametrize(("axis", "slab"), [(0, 16 * 32), (1, 32 * 32), (2, 16 * 32)])
def test_a_step_of_one_voxel_fills_one_slab(world, engine, monkeypatch, axis, slab):
    """There and back, along each axis: what stays in sight is neither filled nor moved."""
    run, light, filled = Run(world), light_of(world, engine.lighting("12:00", "clear")), []
    here = np.array([5.0, 2.0, 8.0])  # what comes into sight is in a sector
    run.settle(at(here), light)
    fill = ResidentSector.fill_volume

    def counted(sector, record, size, *rest):
        filled.append(int(np.prod(size)))
        fill(sector, record, size, *rest)

    monkeypatch.setattr(ResidentSector, "fill_volume", counted)
    step, most = VOXEL_SIZE_M * np.eye(3)[axis], 0
    for place in (here + step, here, here + step, here):
        filled.clear()
        run.tick(at(place), light)
        assert sum(filled) <= slab
        most = max(most, sum(filled))
        np.testing.assert_array_equal(world.published("p0").values, engine.volume(place, engine.lighting("12:00", "clear")).values)
    assert most > 0


@pytest.mark.parametrize(("axis", "low", "high"), [(0, -45.0, 60.0), (1, 2.0, 80.0), (1, 2.0, 130.0), (2, -15.0, 90.0)])
def test_a_player_who_jumps_by_more_than_a_volume_sees_the_very_bytes_of_a_query(world, engine, axis, low, high):
    run, lighting = Run(world), engine.lighting("12:00", "clear")
    light = light_of(world, lighting)
    run.settle(at(STREET), light)
    for level in (low, high, low):
        place = STREET.copy()
        place[axis] = level
        run.tick(at(place), light)
        query, shown = engine.volume(place, lighting), world.published("p0")
        np.testing.assert_array_equal(shown.values, query.values)
        np.testing.assert_array_equal(shown.mask, query.mask)


@pytest.mark.parametrize("basis", ["cube", "sh1", "sh2"])
@pytest.mark.parametrize("settings", [NEUTRAL, Settings(bounce_factor=2.0, ambient_up=(10.0, 20.0, 30.0))], ids=["neutral", "gains"])
def test_volumes_in_each_basis_are_the_very_bytes_of_a_query(basis, settings):
    dataset = Dataset.open(HARMONICS)
    engine, world = Engine(dataset), LiveWorld(dataset, shadow_map=False, basis=basis)
    engine.lamps = ()
    try:
        world.warm_up()
        lighting = engine.lighting("12:00", "clear")
        found = Run(world).settle(at(STREET), light_of(world, lighting, settings=settings))
        assert found.shape[0] == {"cube": 6, "sh1": 4, "sh2": 9}[basis]
        assert world.volumes.of_player["p0"].published.basis == basis
        query = engine.volume(STREET, lighting, settings, basis=basis).values
        # Gains are applied in a kernel here, in NumPy there: float32 rounds either way.
        np.testing.assert_allclose(found, query, atol=0 if settings is NEUTRAL else 1e-6 * query.max())
    finally:
        world.close()


def test_harmonics_are_converted_where_they_change_and_not_where_they_are_read(monkeypatch):
    dataset = Dataset.open(HARMONICS)
    engine, world = Engine(dataset), LiveWorld(dataset, shadow_map=False)
    engine.lamps, converted, convert = (), [], ResidentSector.converted

    def note(sector, *arguments):
        converted.append(sector.sector.index)
        return convert(sector, *arguments)

    try:
        run = Run(world)
        for hour in ("12:00", "16:00"):
            light = light_of(world, engine.lighting(hour, "clear"))
            run.settle(at(STREET), light)
            for metres in (3.125, 6.25, 0.0):
                place = STREET + np.array([0.0, 0.0, metres])
                with monkeypatch.context() as patched:
                    patched.setattr(ResidentSector, "converted", note)
                    run.tick(at(place), light)
                np.testing.assert_array_equal(world.published("p0").values, engine.volume(place, light.lighting, basis="cube").values)
        assert not converted
    finally:
        world.close()


def test_a_basis_that_the_dataset_does_not_have_is_refused():
    with pytest.raises(InputError, match="this light is in cube"):
        LiveWorld(Dataset.open(GOLDEN), shadow_map=False, basis="sh2")


@pytest.mark.parametrize(
    "place",
    [(0.0, 2.0, 30.0), (-1e-12, 2.0, 30.0), (-63.9, 2.0, 0.0), (25.0, 3.0, 28.0), (5.0, 150.0, 30.0)],
    ids=["border", "just west of it", "edge of the world", "in a wall", "above all roofs"],
)
def test_wherever_a_player_is_its_volume_is_a_querys(world, engine, place):
    lighting = engine.lighting("12:00", "clear")
    found = Run(world).settle(at(np.array(place)), light_of(world, lighting))
    np.testing.assert_array_equal(found, engine.volume(np.array(place), lighting).values)


class FarDataset(Dataset):
    """The golden dataset, 70 km away: by whole sectors that are whole voxels too."""

    SECTORS = (775, -775)
    METRES = np.array([775 * 64.0, 0.0, -775 * 64.0])

    @classmethod
    def shifted(cls) -> "FarDataset":
        near = Dataset.open(GOLDEN)
        moved = {cls.there(index): facts for index, facts in near.world.sectors.items()}
        far = cls(near.path, replace(near.world, sectors=moved, bounds=near.world.bounds + cls.METRES), near.digest)
        far.near = near
        return far

    @classmethod
    def there(cls, index: SectorIndex, sign: int = 1) -> SectorIndex:
        return SectorIndex(index.x + sign * cls.SECTORS[0], index.z + sign * cls.SECTORS[1])

    def sector(self, index: SectorIndex):
        sector = self.near.sector(self.there(index, -1))
        return replace(sector, index=index, voxel_first=sector.voxel_first + (self.METRES / VOXEL_SIZE_M).astype(np.int32))

    def geometry(self, index: SectorIndex):
        geometry = self.near.geometry(self.there(index, -1))
        return replace(geometry, vertices=geometry.vertices + self.METRES)

    def distant(self):
        texels = self.near.distant()
        return replace(texels, origin=self.there(texels.origin))


def test_seventy_kilometres_from_the_origin_nothing_changes(world, engine):
    dataset = FarDataset.shifted()
    far_world, far_engine = LiveWorld(dataset, shadow_map=False), Engine(dataset)
    try:
        lamp = Lamp("lamp", "point", (5.0, 6.0, 30.0), 5000.0)
        far_engine.lamps = (replace(lamp, position=tuple(np.array(lamp.position) + FarDataset.METRES)),)
        engine.lamps = (lamp,)
        lighting = engine.lighting("12:00", "clear")
        query = engine.volume(STREET, lighting)
        far = far_engine.volume(STREET + FarDataset.METRES, lighting)
        np.testing.assert_array_equal(far.values, query.values)
        np.testing.assert_array_equal(far.mask, query.mask)
        streamed = Run(far_world).settle(at(STREET + FarDataset.METRES), light_of(far_world, lighting, far_engine.lamps))
        np.testing.assert_array_equal(streamed, query.values)
    finally:
        far_world.close()


SIZES = [
    {"probes": 0, "surfels": 0},
    {"probes": 0},
    {"probes": 1},
    {"surfels": 0},
    {"surfels": 1},
    {"probes": 1000, "surfels": 3000},
]


@pytest.mark.parametrize("panel", [NEUTRAL, Settings(bounce_factor=2.0, lights_factor=0.5)], ids=["neutral", "gains"])
@pytest.mark.parametrize("size", SIZES, ids=str)
def test_a_sector_of_any_size_is_lit_shown_and_dark_again(make_sector, engine, size, panel):
    """Under the sun of noon, its shadow map's samples, and a lamp; then without any of it."""
    device, table = shared_device(), engine.dataset.world.sun_table
    sector = make_sector(3, planes=table.plane_count, **size)
    live = LiveSector(device, sector, 6, SharedGeometry(ShadowGeometry({}.__getitem__, []), ThreadPoolExecutor(1)))
    noon = engine.lighting("12:00", "snow")
    dark = replace(
        noon,
        sun=replace(noon.sun, irradiance=np.zeros(3)),
        moon=replace(noon.moon, irradiance=np.zeros(3)),
        sky_radiance=0 * noon.sky_radiance,
        sky_cube=0 * noon.sky_cube,
    )
    relighter, shown = Relighter(device), np.zeros((sector.probe_count, 6, 4), np.float32)
    lamp = Lamp("lamp", "point", (32.0, 32.0, 32.0), 1e9, range_m=1e4)
    number = count()
    for lighting, lamps in ((noon, (lamp,)), (dark, ()), (noon, (lamp,))):
        given = relight_input(lighting, table)
        light = LiveLight(lighting, given, LightVector.of(given), panel.brightened(lamps), (), panel, False)
        for _ in range(FADE_TICKS):
            live.light(light, is_read=True)
            relighter.relight([live.resident], light.given, 3)
            assert 0 <= live.measure(live.resident.read_cubes()) < np.inf
            live.advance(next(number), must_show=True, is_read=True)
        assert live.settle(relighter, light, is_read=True)
        live.advance(next(number), must_show=True, is_read=True)
        device.read(live.shown(panel, lambda: np.zeros((6, 3), np.float32), "cube"), shown)
        assert np.isfinite(shown).all()
        assert shown.any() == (lighting is noon and sector.probe_count > 0)
        assert not live.is_fading


def test_ticks_read_no_triangles_for_a_lamp(make_sector, engine):
    """A tick goes on without the lamp until another thread has read them, however long that takes; then it is lit as ever."""
    sector = make_sector(3)
    readers, may_read = set(), threading.Event()
    roof = Geometry(
        np.array([[0, 60, 0], [64, 60, 0], [0, 60, 64.0]]), np.array([[0, 1, 2]], np.int32), *2 * (np.ones((1, 3), np.float32),)
    )

    def read(_: SectorIndex) -> Geometry:
        assert may_read.wait(10)
        readers.add(threading.current_thread().name)
        return roof

    def live_sector(read: Callable[[SectorIndex], Geometry]) -> LiveSector:
        shared = SharedGeometry(ShadowGeometry(read, [sector.index]), ThreadPoolExecutor(1, thread_name_prefix="reader"))
        return LiveSector(shared_device(), sector, 6, shared)

    x, y, z = (sector.index.origin + 32.0).tolist()
    lamp = Lamp("lamp", "point", (x, y + 70.0, z), 1e9, range_m=1e4)
    lighting = engine.lighting("12:00", "clear")
    given = relight_input(lighting, engine.dataset.world.sun_table)
    light = LiveLight(lighting, given, LightVector.of(given), (lamp,), (), NEUTRAL, False)
    live = live_sector(read)
    for _ in range(3):
        assert not live.set_lamps(light, wait=False)
        assert live.lamps.given == ((), ())
    may_read.set()
    give_up_at = time.monotonic() + 10
    while not live.set_lamps(light, wait=False):
        assert time.monotonic() < give_up_at
        time.sleep(0.01)
    assert readers == {"reader_0"}
    at_once = live_sector(lambda _: roof)
    assert at_once.set_lamps(light, wait=True)
    lit = [np.zeros((sector.surfel_count, 4), np.float32) for _ in range(2)]
    for found, one in zip(lit, (live, at_once), strict=True):
        shared_device().read(one.lamps.buffer, found)
    assert lit[0].any()
    np.testing.assert_array_equal(*lit)


def test_light_on_and_off_again_gives_the_first_bytes_back(world, engine):
    run, lighting = Run(world), engine.lighting("12:00", "clear")
    before = run.settle(at(STREET), light_of(world, lighting))
    lamp = Lamp("flare", "point", (5.0, 3.0, 30.0), 1e9)
    world.lamps_moved([(np.array(lamp.position), lamp.range_m)])
    lit = run.settle(at(STREET), light_of(world, lighting, (lamp,)))
    assert lit.max() > 2 * before.max()
    world.lamps_moved([(np.array(lamp.position), lamp.range_m)])
    np.testing.assert_array_equal(run.settle(at(STREET), light_of(world, lighting)), before)


def test_another_hour_and_back_gives_the_first_bytes_back(world, engine):
    run, noon = Run(world), light_of(world, engine.lighting("12:00", "clear"))
    before = run.settle(at(STREET), noon)
    assert not np.array_equal(run.settle(at(STREET), light_of(world, engine.lighting("21:00", "snow"))), before)
    np.testing.assert_array_equal(run.settle(at(STREET), noon), before)


@pytest.mark.parametrize(
    "settings", [Settings(bounce_factor=3.0), Settings(ambient_up=(10.0, 20.0, 30.0), interior_ambient_scale=2.0), Settings(sun_factor=0.2)]
)
def test_settings_show_what_a_query_under_them_gives(world, engine, settings):
    lighting = engine.lighting("12:00", "clear")
    found = Run(world).settle(at(STREET), light_of(world, lighting, settings=settings))
    expected = engine.volume(STREET, lighting, settings).values
    # The gains are applied by the device here and by NumPy there: one rounding more or less.
    np.testing.assert_allclose(found, expected, rtol=3e-6, atol=3e-6 * expected.max())


def test_a_lamp_that_moves_is_followed_within_a_few_ticks(world, engine):
    """Peers: 9 ticks until light is within 1e-3 of its fixed point."""
    run, lighting = Run(world), engine.lighting("23:30", "clear")
    lamp = Lamp("torch", "point", (10.0, 3.0, 20.0), 2000.0)
    run.settle(at(STREET), light_of(world, lighting, (lamp,)))
    moved = replace(lamp, position=(10.0, 3.0, 17.0))
    engine.lamps = (moved,)
    goal = engine.volume(STREET, lighting).values
    world.lamps_moved([(np.array(lamp.position), lamp.range_m), (np.array(moved.position), moved.range_m)])
    light = light_of(world, lighting, (moved,), standing=False)

    def close(_: TickReport) -> bool:
        return float(np.abs(world.volumes.of_player["p0"].published.values - goal).max()) <= 1e-3 * goal.max()

    assert not close(TickReport(0))
    assert run.until(at(STREET), light, close) <= 5


def test_players_share_sectors_and_leave_nothing_behind(world, engine):
    run, light = Run(world), light_of(world, engine.lighting("12:00", "clear"))
    run.settle(at(STREET, STREET + EAST * 3.2, STREET), light)
    assert len(world.streamer.residents) == 2
    np.testing.assert_array_equal(world.volumes.of_player["p0"].published.values, world.volumes.of_player["p2"].published.values)
    run.tick(at(STREET), light)
    assert list(world.volumes.of_player) == ["p0"]


@pytest.mark.parametrize(
    ("factor", "ticks"),
    [(1.0, 1), (1.02, 1), (1.24, 5), (1 / 1.24, 5), (3.0, FADE_TICKS), (np.inf, FADE_TICKS), (0.0, FADE_TICKS)],
)
def test_small_changes_fade_sooner(factor, ticks):
    """One of five probes changes; or all were dark."""
    before = np.full((5, 6, 3), 1000.0, np.float32)
    after = before.copy()
    if np.isinf(factor):
        before[:] = 0.0
    else:
        after[2] *= factor
    assert fade_ticks(before, after) == ticks
    assert fade_ticks(before[:0], after[:0]) == FADE_TICKS


def test_a_running_clock_is_followed(world, engine):
    run = Run(world)
    run.settle(at(STREET), light_of(world, engine.lighting("08:00", "clear")))
    changes = []
    for minute in range(1, 30):
        lighting = engine.lighting(datetime(2024, 6, 21, 8, minute).isoformat(), "clear")
        light = light_of(world, lighting, standing=False)
        run.tick(at(STREET), light)
        run.tick(at(STREET), light)
        expected = engine.volume(STREET, lighting).values
        changes.append(np.abs(world.volumes.of_player["p0"].published.values - expected).max() / expected.max())
    # A minute a tick is 1800 x: a relight behind, two of which make up a volume's two sectors.
    assert np.median(changes) < 0.02
