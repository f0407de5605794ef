"""The live world tick by tick: it settles to what a query gives, forgets what was, never pops, and lives with what cannot be loaded."""

import shutil
import threading
import time
from dataclasses import replace
from datetime import datetime, timedelta
from itertools import count, pairwise
from pathlib import Path
from threading import Lock
from types import SimpleNamespace

import numpy as np
import pytest

from gi_core import stream
from gi_core.basis import brightness
from gi_core.constants import VOXEL_INDOORS, VOXEL_OUTDOORS, VOXEL_SIZE_M
from gi_core.dataset import Dataset, sector_path
from gi_core.device import Device, shared_device
from gi_core.engine import Engine
from gi_core.errors import InputError
from gi_core.grid import SectorIndex
from gi_core.light_blend import LightVector
from gi_core.light_geometry import ShadowGeometry
from gi_core.lighting import Lighting
from gi_core.lights import lamps_on
from gi_core.live_sector import FADE_STEP, FADE_TICKS, UNSHOWN_CHANGE, LiveLight, LiveSector, fade_ticks
from gi_core.live_volume import PublishedVolume
from gi_core.live_volumes import HELD_TICKS
from gi_core.live_world import MOST_PUT_OFF, LiveWorld, TickPlayers, TickReport
from gi_core.relight import Relighter
from gi_core.relight_input import relight_input
from gi_core.resident_sector import ResidentSector
from gi_core.settings import NEUTRAL, Settings
from gi_core.shadow_plan import LOWEST_SUN_DEGREES, is_near
from gi_core.spectrum import LUMINANCE_FROM_RGB
from gi_core.stream_plan import StreamOptions
from gi_core.world import Lamp

GOLDEN = Path(__file__).parents[1] / "golden" / "v1"
HARMONICS = GOLDEN.parent / "v2_sector2"
STREET = np.array([5.0, 2.0, 30.0])  # its volume reads both sectors
EAST = np.array([1.0, 0.0, 0.0])
LATE_S = 30.0


@pytest.fixture
def engine() -> Engine:
    """Without the dataset's lamps, some of which burn by day."""
    made = Engine(Dataset.open(GOLDEN))
    made.lamps = ()
    return made


@pytest.fixture
def world():
    made = LiveWorld(Dataset.open(GOLDEN), shadow_map=False)
    yield made
    made.close()


def light_of(
    world: LiveWorld, lighting: Lighting, lamps: tuple[Lamp, ...] = (), settings: Settings = NEUTRAL, standing: bool = True
) -> LiveLight:
    gained = settings.light(lighting)
    info = world.dataset.world
    given = relight_input(gained, info.sun_table, info.sky, info.sky_patches)
    on = settings.brightened(lamps_on(lamps, lighting))
    return LiveLight(gained, given, LightVector.of(given), on, (), settings, standing)


def at(*places: np.ndarray, velocity=(0.0, 0.0, 0.0)) -> TickPlayers:
    positions = np.array(places, np.float64).reshape(-1, 3)
    return TickPlayers(tuple(f"p{i}" for i in range(len(places))), positions, np.tile(np.array(velocity, np.float64), (len(places), 1)))


def largest_step(before: PublishedVolume, after: PublishedVolume) -> float:
    """By how much a cube's luminance changed on any side, as a share of its brightness, in any voxel of free air that two volumes share;
    the second lies as far along x or further."""
    shift = after.first_voxel - before.first_voxel
    assert shift[0] >= 0
    assert not shift[1:].any()
    count = before.values.shape[3] - int(shift[0])
    free = np.isin(after.mask[:, :, :count], (VOXEL_OUTDOORS, VOXEL_INDOORS))
    return largest_change(before.values[:, :, :, -count:][:, free], after.values[:, :, :, :count][:, free])


def largest_change(before: np.ndarray, after: np.ndarray) -> float:
    """By how much cubes' luminance (6, n, 3) [lx] differs on any side, as a share of the darker cube's brightness."""
    darker = np.minimum(brightness(before, "cube"), brightness(after, "cube"))
    return float((np.abs((after - before) @ LUMINANCE_FROM_RGB).max(axis=0) / darker).max())


def is_exact(world: LiveWorld) -> bool:
    """Whether every resident sector holds a query's bytes."""
    return bool(world._needs.exact[world.streamer.resident_rows()].all())


class Run:
    """Ticks of one world, numbered."""

    def __init__(self, world: LiveWorld) -> None:
        self.world, self.number = world, -1

    def tick(self, players: TickPlayers, light: LiveLight) -> TickReport:
        self.number += 1
        return self.world.tick(self.number, players, light)

    def until(self, players: TickPlayers, light: LiveLight, done, pause_s: float = 0.001) -> int:
        """Ticks until something holds, with a pause after each."""
        before, deadline = self.number, time.monotonic() + LATE_S
        while not done(self.tick(players, light)):
            assert time.monotonic() < deadline, "it never came to hold"
            time.sleep(pause_s)
        return self.number - before

    def settle(self, players: TickPlayers, light: LiveLight) -> np.ndarray:
        """The first player's volume once nothing moves any more."""

        def settled(report: TickReport) -> bool:
            residents = self.world.streamer.residents
            loaded = residents and not self.world.streamer.loading and not report.missing
            return bool(loaded and is_exact(self.world) and not any(s.is_fading for s in residents.values()) and not report.filled)

        self.until(players, light, settled)
        return self.world.volumes.of_player[players.ids[0]].published.values


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


@pytest.mark.parametrize("golden", [GOLDEN, HARMONICS], ids=["cube", "sh2"])
def test_a_sector_takes_no_more_than_the_budget_counts_for_it(golden):
    dataset = Dataset.open(golden)
    world = LiveWorld(dataset, shadow_map=True)
    try:
        lighting = Engine(dataset).lighting("12:00", "clear")
        light = light_of(world, lighting, dataset.world.lamps, Settings(bounce_factor=2.0))
        Run(world).settle(at(STREET), light)
        residents = world.streamer.residents
        assert all(sector.lamps.nbytes and sector.samples and sector._shown and sector._first for sector in residents.values())
        counted = 0
        for index, sector in residents.items():
            most = world.streamer.table.bytes[world._row[index]]
            assert sector.nbytes + sector.host_nbytes <= sector.budget_bytes(lamps=True) <= most
            counted += sector.budget_bytes(lamps=True)
        # What arrived before there was light has been counted with room for all of it.
        assert world.streamer.resident_bytes == counted
    finally:
        world.close()


def test_what_is_kept_of_a_sector_in_memory_is_what_its_arrays_own():
    dataset = Dataset.open(GOLDEN)
    sector = dataset.sector(SectorIndex(0, 0))
    resident = ResidentSector(Device(), sector, dataset.world.sky_patches)
    before = resident.host_nbytes
    assert sector.nbytes <= before <= 1.01 * sector.nbytes  # and what was worked out of them
    resident.release_host_arrays()
    gone = (sector.factor_code, sector.factor_source, sector.surfel_albedo, sector.surfel_snow, sector.sun_visibility)
    gone = (*gone, sector.voxel_probe, sector.voxel_weight)
    assert sum(array.nbytes for array in gone) > before / 2
    assert before - sum(array.nbytes for array in gone) - resident.host_nbytes in range(1024)


def test_a_lamp_where_there_was_none_has_its_room_counted_before_it_shines(engine):
    dataset = Dataset.open(GOLDEN)
    dataset.world = replace(dataset.world, lamps=())
    world = LiveWorld(dataset, shadow_map=False)
    try:
        run, lighting = Run(world), engine.lighting("12:00", "clear")
        run.settle(at(STREET), light_of(world, lighting))
        before, table = world.streamer.resident_bytes, world.streamer.table
        residents = world.streamer.residents
        # A good part of what is held back while a sector loads is given back once it is there.
        assert before < 0.7 * sum(int(table.bytes[world._row[index]]) for index in residents)
        lamp = Lamp("torch", "point", (10.0, 3.0, 20.0), 2000.0, range_m=500.0)
        world.lamps_moved([(np.array(lamp.position), lamp.range_m)])
        counted = world.streamer.resident_bytes
        assert counted > before
        run.settle(at(STREET), light_of(world, lighting, (lamp,)))
        assert all(sector.lamps.nbytes for sector in residents.values())
        assert sum(sector.nbytes + sector.host_nbytes for sector in residents.values()) <= world.streamer.resident_bytes == counted
        # More shadows than anybody made room for: counted once they are there.
        many = tuple(replace(lamp, name=f"torch {n}", position=(10.0, 3.0, 10.0 + 0.1 * n)) for n in range(70))
        world.lamps_moved([(np.array(lamp.position), lamp.range_m) for lamp in many])
        run.settle(at(STREET), light_of(world, lighting, many))
        assert sum(sector.nbytes + sector.host_nbytes for sector in residents.values()) <= world.streamer.resident_bytes
        assert world.streamer.resident_bytes > counted
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
    live = LiveSector(device, sector, 6, ShadowGeometry({}.__getitem__, []), Lock())
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
            assert 0 <= live.measure() < np.inf
            live.advance(next(number), must_show=True, is_read=True)
        assert live.settle(relighter, light, is_read=True)
        live.advance(next(number), must_show=True, is_read=True)
        device.read(live.shown(panel, lambda: np.zeros((6, 3), np.float32), "cube"), shown)
        assert np.isfinite(shown).all()
        assert shown.any() == (lighting is noon and sector.probe_count > 0)
        assert not live.is_fading


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


def test_an_idle_world_relights_and_fills_nothing(world, engine):
    run, light = Run(world), light_of(world, engine.lighting("12:00", "clear"))
    run.settle(at(STREET), light)
    for _ in range(5):
        report = run.tick(at(STREET), light)
        assert (report.relit, report.settled, report.filled, report.passes) == ((), (), (), 0)


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


def test_a_new_players_first_volume_waits_for_its_sectors(world, engine):
    run, light = Run(world), light_of(world, engine.lighting("12:00", "clear"), standing=False)
    first = None

    def published(report: TickReport) -> bool:
        nonlocal first
        first = world.volumes.of_player["p0"].published
        return first is not None

    assert run.until(at(STREET), light, published, pause_s=1 / 30) < HELD_TICKS
    assert first.missing == ()
    assert set(first.sectors) == {SectorIndex(0, 0), SectorIndex(-1, 0)}
    # What is shown first has its bounces: nothing is left to pop.
    for _ in range(30):
        run.tick(at(STREET), light)
    late = world.volumes.of_player["p0"].published.values
    assert np.abs(late - first.values).max() <= 0.02 * late.max()


def test_a_sector_is_lit_when_it_arrives(world, engine):
    run, light = Run(world), light_of(world, engine.lighting("12:00", "clear"))
    residents = world.streamer.residents
    run.until(at(STREET), light, lambda report: len(residents) == 2)
    arrived = [sector.resident.read_cubes() for sector in residents.values()]
    run.settle(at(STREET), light)
    for before, sector in zip(arrived, residents.values(), strict=True):
        after = sector.resident.read_cubes()
        assert np.abs(before - after).max() <= 0.005 * after.max()


def test_a_lamp_that_was_lit_while_a_sector_loaded_reaches_it(world, engine):
    run, before = Run(world), light_of(world, engine.lighting("23:30", "clear"))
    after = light_of(world, engine.lighting("23:30", "clear"), (Lamp("flare", "point", (5.0, 3.0, 30.0), 1e9),))
    while not world.streamer.loading:
        run.tick(at(STREET), before)
    while world.streamer._done.qsize() < world.streamer.loading:  # loaded, and not taken over
        time.sleep(0.001)
    lit = run.settle(at(STREET), after)
    np.testing.assert_array_equal(lit, Run(world).settle(at(STREET), after))
    assert lit.max() > 100


def test_nothing_pops_when_a_sector_arrives_late(tmp_path, engine):
    """It fades in from the distant probe that stood for it: no voxel moves by more than a share of the way in a tick."""
    dataset = Dataset.open(GOLDEN)
    slow = {"hold": True}

    def late(index):
        while slow["hold"] and index == SectorIndex(-1, 0):
            time.sleep(0.005)
        return Dataset.sector(dataset, index)

    dataset.sector = late  # type: ignore[method-assign]
    world = LiveWorld(dataset, shadow_map=False)
    try:
        run, light = Run(world), light_of(world, engine.lighting("12:00", "clear"))
        # The other sector comes first only if it is asked for first.
        run.until(at(STREET + EAST * 30), light, lambda r: SectorIndex(0, 0) in world.streamer.residents)
        run.until(at(STREET), light, lambda r: world.volumes.of_player["p0"].published is not None)
        before = world.volumes.of_player["p0"].published
        assert before.missing == (SectorIndex(-1, 0),)
        assert (before.values[:, :, :, :4] > 0).any()  # the placeholder, not darkness
        slow["hold"] = False
        frames = []

        def arrived(report: TickReport) -> bool:
            frames.append(world.volumes.of_player["p0"].published.values)
            sector = world.streamer.residents.get(SectorIndex(-1, 0))
            return sector is not None and is_exact(world) and not sector.is_fading and not report.filled

        run.until(at(STREET), light, arrived)
        whole_way = np.abs(frames[-1] - before.values)
        largest = max(np.abs(b - a).max() for a, b in zip([before.values, *frames], frames, strict=False))
        assert whole_way.max() > 0
        # A step of the fade, and what the light itself still moves by while it settles.
        assert largest <= 1.5 * whole_way.max() / FADE_TICKS
    finally:
        slow["hold"] = False
        world.close()


def test_a_sector_that_is_not_there_is_lit_like_its_distant_texel_in_full(tmp_path, engine):
    city = tmp_path / "city"
    shutil.copytree(GOLDEN.parent / "v4", city)
    shutil.copy(GOLDEN.parent / "distant_v2" / "distant.gidist", city)
    sector_path(city, SectorIndex(-1, 0)).write_bytes(b"")
    dataset = Dataset.open(city)
    world = LiveWorld(dataset, shadow_map=False)
    try:
        for moment in ("12:00", "09:00"):
            lighting = engine.lighting(moment, "clear")
            run = Run(world)
            run.until(at(STREET), light_of(world, lighting), lambda r: world.published("p0") and "p0" in r.filled)
            texel = Engine(dataset).distant(lighting)
            assert texel.light == "full"
            shown = world.published("p0").values[:, :, :, :4]
            expected = np.broadcast_to(texel.values[0, 0][:, None, None, None], shown.shape)
            np.testing.assert_allclose(shown, expected, rtol=1e-5)
    finally:
        world.close()


def test_a_sector_that_cannot_be_read_leaves_the_distant_probe_and_is_tried_again(tmp_path, engine):
    city = tmp_path / "city"
    shutil.copytree(GOLDEN, city)
    file = sector_path(city, SectorIndex(-1, 0))
    whole = file.read_bytes()
    file.write_bytes(whole[:100])
    world = LiveWorld(Dataset.open(city), shadow_map=False)
    try:
        run, light = Run(world), light_of(world, engine.lighting("12:00", "clear"))
        run.until(at(STREET), light, lambda r: world.streamer.failures and world.volumes.of_player["p0"].published)
        failure = world.streamer.failures[SectorIndex(-1, 0)]
        assert failure.attempts >= 1
        assert "-1_0.gisec" in failure.reason
        published = world.volumes.of_player["p0"].published
        assert published.missing == (SectorIndex(-1, 0),)
        assert np.isfinite(published.values).all()
        file.write_bytes(whole)
        run.until(at(STREET), light, lambda r: not r.missing)
        assert world.streamer.failures == {}
    finally:
        world.close()


def test_the_budget_holds_while_a_player_walks_to_and_fro(engine):
    dataset = Dataset.open(GOLDEN)
    world = LiveWorld(dataset, shadow_map=False)
    largest = max(world.streamer.table.bytes.tolist())
    world.close()
    world = LiveWorld(dataset, shadow_map=False, stream=StreamOptions(int(1.5 * largest)))
    try:
        run, light = Run(world), light_of(world, engine.lighting("12:00", "clear"), standing=False)
        for step in range(80):
            x = 60.0 * np.sin(step / 10)
            run.tick(at(np.array([x, 2.0, 30.0]), velocity=(60 * np.cos(step / 10) * 3, 0, 0)), light)
            taken = sum(sector.nbytes + sector.host_nbytes for sector in world.streamer.residents.values())
            assert taken <= world.streamer.resident_bytes <= 1.5 * largest
            time.sleep(0.004)
        assert world.streamer.loads >= 1
        assert np.isfinite(world.volumes.of_player["p0"].published.values).all()
    finally:
        world.close()


def far_from_the_change(world, engine) -> tuple[TickPlayers, LiveLight]:
    """A settled world of eight players whose volumes read both sectors: the even ones stand in the eastern one, the odd in the western."""
    players, light = at(*[STREET - EAST * (k % 2 * 10 + k) for k in range(4)] * 2), light_of(world, engine.lighting("12:00", "clear"))
    assert [int(x < 0) for x in players.positions[:, 0]] == [0, 1] * 4
    Run(world).settle(players, light)
    return players, light


def test_whose_own_sector_was_relit_is_served_first_and_nobody_is_forgotten(world, engine):
    players, light = far_from_the_change(world, engine)
    order = []
    for tick in range(1000, 1000 + len(players.ids)):
        world.volumes.note(tick, players.ids, players.positions, [SectorIndex(-1, 0)] if tick == 1000 else [])
        filled, waiting = world.volumes.fill(tick, -np.inf, lambda sector: world._shown(sector, light), world._placeholder)
        assert len(filled) == 1
        order += filled
        assert waiting == len(players.ids) - len(order)
    assert sorted(order) == sorted(players.ids)
    assert set(order[:4]) == {"p1", "p3", "p5", "p7"}


def test_no_volume_is_begun_when_the_ticks_time_for_them_is_over(world, engine, monkeypatch):
    players, light = far_from_the_change(world, engine)
    looks = count(1)
    monkeypatch.setattr("gi_core.live_volumes.time", SimpleNamespace(perf_counter=lambda: float(next(looks))))
    world.volumes.note(1000, players.ids, players.positions, [SectorIndex(0, 0)])
    # A second passes with each look at the clock: the first volume needs none, one begins at 1 s, another at 2 s, none at 3 s.
    filled, waiting = world.volumes.fill(1000, 3.0, lambda sector: world._shown(sector, light), world._placeholder)
    assert (len(filled), waiting) == (3, 5)


def test_without_any_time_left_two_sectors_are_relit_all_the_same(world, engine):
    players, _ = far_from_the_change(world, engine)
    afternoon = light_of(world, engine.lighting("16:00", "clear"), standing=False)
    report = world.tick(1000, players, afternoon, fill_ms=-np.inf)
    assert set(report.relit) == {SectorIndex(0, 0), SectorIndex(-1, 0)}
    assert (len(report.filled), report.waiting) == (1, len(players.ids) - 1)


def test_players_share_sectors_and_leave_nothing_behind(world, engine):
    run, light = Run(world), light_of(world, engine.lighting("12:00", "clear"))
    run.settle(at(STREET, STREET + EAST * 3.2, STREET), light)
    assert len(world.streamer.residents) == 2
    np.testing.assert_array_equal(world.volumes.of_player["p0"].published.values, world.volumes.of_player["p2"].published.values)
    run.tick(at(STREET), light)
    assert list(world.volumes.of_player) == ["p0"]


def test_warming_up_changes_no_light(world, engine):
    world.warm_up()
    lighting = engine.lighting("12:00", "clear")
    found = Run(world).settle(at(STREET), light_of(world, lighting))
    np.testing.assert_array_equal(found, engine.volume(STREET, lighting).values)


def test_no_tick_builds_a_kernel_once_warm(engine):
    dataset = Dataset.open(GOLDEN)
    world = LiveWorld(dataset)
    try:
        world.warm_up()
        built = world._device.built_kernels
        run = Run(world)
        states = [
            ("12:00", "clear", NEUTRAL),
            ("12:10", "snow", NEUTRAL),
            ("21:50", "clear", Settings(bounce_factor=2.0)),
            ("23:30", "clear", NEUTRAL),
        ]
        for time_of_day, weather, settings in states:
            light = light_of(world, engine.lighting(time_of_day, weather), dataset.world.lamps, settings=settings, standing=False)
            for step in range(60):
                run.tick(at(STREET + 0.2 * step * EAST), light)
                time.sleep(0.002)
        assert len(world.streamer.residents) == 2
        assert world._device.built_kernels == built
    finally:
        world.close()


def test_warming_up_reads_no_voxel_beyond_the_sector(world, monkeypatch):
    read = []

    def fill(sector, box, size, *_):
        level = [0, 2]  # heights are clamped
        first = box["sector_first"][0, level]
        read.append((first, first + box["box_size"][0, level], box["sector_size"][0, level]))

    monkeypatch.setattr(ResidentSector, "fill_volume", fill)
    world.warm_up()
    assert read
    for first, end, held in read:
        assert (first >= 0).all()
        assert (end <= held).all()


def test_a_shadow_map_is_drawn_around_players_and_used(engine):
    world = LiveWorld(Dataset.open(GOLDEN))
    try:
        run, light = Run(world), light_of(world, engine.lighting("15:00", "clear"))
        residents = world.streamer.residents
        run.until(at(STREET), light, lambda r: len(residents) == 2 and all(s.sampled_of for s in residents.values()))
        sampled = [sector.samples.read()[0] for sector in residents.values()]
        assert all((sample != 255).mean() > 0.9 for sample in sampled)
        by_day = run.settle(at(STREET), light)
        # At night there is no sun whose shadows could be kept.
        run.settle(at(STREET), light_of(world, engine.lighting("23:30", "clear")))
        assert all(sector.samples is None for sector in residents.values())
        run.until(at(STREET), light, lambda r: all(s.sampled_of for s in residents.values()))
        np.testing.assert_array_equal(run.settle(at(STREET), light), by_day)
    finally:
        world.close()


@pytest.fixture
def shaded():
    """A world with a shadow map, and an event: until that is set, nothing is read for the map."""
    made = LiveWorld(Dataset.open(GOLDEN))
    read, may_read = made._shadows._read, threading.Event()
    made._shadows._read = lambda index: may_read.wait(LATE_S) and read(index)
    yield made, may_read
    may_read.set()
    made.close()


def sampled(world: LiveWorld, count: int = 2) -> bool:
    """Whether as many sectors are resident, and each has samples that are bound."""
    residents = world.streamer.residents.values()
    return len(residents) == count and all(s.sampled_of and s.resident.sun_sample for s in residents)


def unbound(world: LiveWorld) -> bool:
    """Whether no resident sector has samples that are bound."""
    return all(s.sampled_of is None and s.resident.sun_sample is None for s in world.streamer.residents.values())


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


def way_to_query(run: "Run", light: LiveLight, place: np.ndarray, engine) -> float:
    """The largest change between a settled world with a shadow map and a query, which has none, in the free air around a place."""
    query = engine.volume(place, light.lighting)
    free = np.isin(query.mask, (VOXEL_OUTDOORS, VOXEL_INDOORS))
    return largest_change(query.values[:, free], run.settle(at(place), light)[:, free])


def test_nothing_pops_on_a_walk_when_the_shadow_map_takes_over(shaded, engine):
    """What each sector shows goes over from baked visibility to the map's: no voxel moves by more than a share of the way in a tick."""
    world, may_read = shaded
    run, lighting = Run(world), engine.lighting("15:00", "clear")
    light = light_of(world, lighting, standing=False)
    places = [STREET + EAST * x for x in np.arange(-20.0, 30.0, 0.4)]
    run.settle(at(places[0]), light_of(world, lighting))
    frames = [world.published("p0")]
    may_read.set()
    for place in places:
        run.tick(at(place), light)
        frames.append(world.published("p0"))
        time.sleep(0.002)
    assert sampled(world)
    assert len({frame.first_voxel[0] for frame in frames}) > 10
    whole_way = max(way_to_query(run, light_of(world, lighting), place, engine) for place in (places[0], places[-1]))
    largest = max(largest_step(before, after) for before, after in pairwise(frames))
    # A step of the fade, and what the light itself still moves by while it settles.
    assert whole_way > 2 * FADE_STEP
    assert 0.5 * FADE_STEP <= largest <= 1.5 * max(FADE_STEP, whole_way / FADE_TICKS)


@pytest.mark.parametrize(("speed", "from_m"), [(5.0, 48.0), (30.0, 75.0)])
def test_a_sector_has_samples_before_somebody_who_comes_sees_it(engine, speed, from_m):
    world = LiveWorld(Dataset.open(GOLDEN))
    try:
        run, light, velocity = Run(world), light_of(world, engine.lighting("15:00", "clear"), standing=False), -speed * EAST
        coming = [at(STREET + EAST * x, velocity=velocity) for x in np.arange(from_m, 40.0, -speed / 20)]
        residents = world.streamer.residents
        run.until(coming[0], light, lambda r: sampled(world) and not any(s.is_fading or s.has_other_source for s in residents.values()))
        assert len(world.volumes.looked_at) == 1
        for place in coming:
            run.tick(place, light)
            assert not any(residents[index].is_fading for index in world.volumes.looked_at)
        assert len(world.volumes.looked_at) == 2
    finally:
        world.close()


def test_nothing_pops_when_samples_grow_too_old(shaded, engine, monkeypatch):
    world, may_read = shaded
    may_read.set()
    run, lighting = Run(world), engine.lighting("2024-06-21T15:00:00", "clear")
    run.until(at(STREET), light_of(world, lighting), lambda r: sampled(world))
    whole_way = way_to_query(run, light_of(world, lighting), STREET, engine)
    monkeypatch.setattr(world._shadows, "_plan", lambda *_: None)  # as if other players took all of its time
    steps = {True: [], False: []}
    frame = world.volumes.of_player["p0"].published
    for seconds in range(0, 480, 5):
        moved = light_of(world, engine.lighting(f"2024-06-21T15:{seconds // 60:02d}:{seconds % 60:02d}", "clear"), standing=False)
        run.tick(at(STREET), moved)
        last, frame = frame, world.volumes.of_player["p0"].published
        steps[sampled(world)].append(largest_step(last, frame))
    assert unbound(world)
    assert len(steps[True]) > 10 < len(steps[False])
    assert max(steps[False]) <= 1.5 * max(steps[True]) + 1.5 * max(FADE_STEP, whole_way / FADE_TICKS)


def test_a_clock_that_jumps_leaves_no_old_samples_bound(shaded, engine):
    world, may_read = shaded
    may_read.set()
    run, afternoon = Run(world), light_of(world, engine.lighting("15:00", "clear"))
    run.until(at(STREET), afternoon, lambda r: sampled(world))
    run.settle(at(STREET), afternoon)
    may_read.clear()
    world._shadows._casters.clear()
    morning = light_of(world, engine.lighting("09:00", "clear"), standing=False)
    residents = world.streamer.residents

    def fresh(report: TickReport) -> bool:
        for index in report.relit:
            of = residents[index].sampled_of
            assert of is None or is_near(of.to_sun, morning.to_sun)
        return sampled(world)

    assert not fresh(run.tick(at(STREET), morning))
    assert unbound(world)
    # It follows at once, without a fade; and what it shows then has nothing of the afternoon.
    assert not any(sector.is_fading for sector in residents.values())
    may_read.set()
    run.until(at(STREET), morning, fresh)
    np.testing.assert_array_equal(run.settle(at(STREET), light_of(world, engine.lighting("09:00", "clear"))), fresh_volume("09:00", engine))


def fresh_volume(time_of_day: str, engine: Engine) -> np.ndarray:
    """What a world that has known no other hour shows of the street, with a shadow map."""
    world = LiveWorld(Dataset.open(GOLDEN))
    try:
        run, light = Run(world), light_of(world, engine.lighting(time_of_day, "clear"))
        run.until(at(STREET), light, lambda r: sampled(world))
        return run.settle(at(STREET), light)
    finally:
        world.close()


def test_samples_that_a_player_has_left_behind_grow_old(shaded, engine):
    world, may_read = shaded
    may_read.set()
    run, evening = Run(world), engine.lighting("17:00", "clear")
    run.until(at(STREET), light_of(world, engine.lighting("15:00", "clear")), lambda r: sampled(world))
    run.until(at(), light_of(world, evening), lambda r: unbound(world) and is_exact(world))
    assert len(world.streamer.residents) == 2
    # Whoever comes then sees the bake's visibility, as a query does, until there is a map.
    may_read.clear()
    world._shadows._casters.clear()
    run.until(at(STREET), light_of(world, evening), lambda r: r.filled)
    np.testing.assert_array_equal(world.volumes.of_player["p0"].published.values, engine.volume(STREET, evening).values)


def test_a_sun_below_a_degree_is_the_bakes_once_its_samples_are_old(shaded, engine):
    world, may_read = shaded
    may_read.set()
    evening = [engine.lighting(f"2024-06-21T{minute // 60}:{minute % 60:02d}:00", "clear") for minute in range(19 * 60, 22 * 60)]
    is_higher = np.array([light.sun.direction[1] > np.sin(np.radians(LOWEST_SUN_DEGREES)) for light in evening])
    last = int(is_higher.argmin()) - 1
    # The sun goes 15 degrees in an hour: three minutes later samples are fresh, five minutes later they are not.
    before, fresh, old = (evening[last + minutes] for minutes in (0, 3, 5))
    assert old.sun.irradiance.any()
    run = Run(world)
    run.until(at(STREET), light_of(world, before), lambda r: sampled(world))
    for _ in range(4):
        run.tick(at(STREET), light_of(world, fresh, standing=False))
    assert sampled(world)
    found = run.settle(at(STREET), light_of(world, old))
    assert unbound(world)
    np.testing.assert_array_equal(found, engine.volume(STREET, old).values)


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


def test_light_that_hardly_moves_is_followed_without_filling_volumes_at_every_relight(world, engine):
    run = Run(world)
    start = datetime(2024, 6, 21, 9)
    run.settle(at(STREET), light_of(world, engine.lighting(start.isoformat(), "clear")))
    relit, filled, behind = 0, 0, []
    for tick in range(1, 121):
        lighting = engine.lighting((start + timedelta(seconds=tick)).isoformat(), "clear")
        report = run.tick(at(STREET), light_of(world, lighting, standing=False))
        relit, filled = relit + len(report.relit), filled + len(report.filled)
        if tick % 20 == 0:
            expected = engine.volume(STREET, lighting).values
            behind.append(np.abs(world.published("p0").values - expected).max() / expected.max())
    # A second of the sun a tick, 30 times its pace at 30 Hz: what is shown is at most UNSHOWN_CHANGE of a sector's brightest probe old,
    # and 1e-3 lies between its light and a query's, by a relight that is a tick late.
    assert 20 < relit < 60  # at what a LightVector says might have changed, 120
    assert 0 < filled < relit / 2
    assert max(behind) < UNSHOWN_CHANGE + 1e-3


def test_a_plan_holds_while_somebody_drives_straight_on(world, engine, monkeypatch):
    run, light, plans, now = Run(world), light_of(world, engine.lighting("12:00", "clear")), [], [time.monotonic()]
    run.settle(at(STREET), light)
    made = stream.plan_streaming
    monkeypatch.setattr(stream, "plan_streaming", lambda *given, **more: plans.append(given[2]) or made(*given, **more))
    monkeypatch.setattr(stream, "PLAN_HOLDS_S", LATE_S)
    monkeypatch.setattr(stream.time, "monotonic", lambda: now[0])
    for step in range(30):
        now[0] += 1 / 30
        run.tick(at(STREET + step * EAST, velocity=30 * EAST), light)
    assert len(plans) == 1
    for _ in range(2 + MOST_PUT_OFF):  # it does not go on
        now[0] += 1 / 30
        run.tick(at(STREET + 29 * EAST, velocity=30 * EAST), light)
    assert len(plans) > 1


def test_a_plan_holds_until_somebody_has_gone_a_metre_or_a_sector_arrives(world, engine, monkeypatch):
    run, light, plans = Run(world), light_of(world, engine.lighting("12:00", "clear")), []
    run.settle(at(STREET), light)
    made = stream.plan_streaming
    monkeypatch.setattr(stream, "plan_streaming", lambda *given, **more: plans.append(given[2]) or made(*given, **more))
    monkeypatch.setattr(stream, "PLAN_HOLDS_S", LATE_S)
    for step in range(50):
        run.tick(at(STREET + 0.1 * step * EAST), light)
    assert 4 <= len(plans) <= 5
    assert all(np.abs(later - earlier).max() > stream.PLAN_HOLDS_M for earlier, later in pairwise(plans))
    run.tick(at(STREET + 4.9 * EAST, velocity=(3.0, 0.0, 0.0)), light)
    assert len(plans) <= 6
    assert plans[-1][0, 0] == pytest.approx(STREET[0] + 4.9)
