"""Sectors come into the live world, late or never: nothing pops, and nothing waits for what cannot be loaded."""

import shutil
import threading
import time
from itertools import pairwise

import numpy as np
import pytest
from live_run import EAST, GOLDEN, LATE_S, STREET, Run, at, is_exact, light_of

from gi_core import live_world, stream
from gi_core.dataset import Dataset, geometry_path, sector_path
from gi_core.engine import Engine
from gi_core.grid import SectorIndex
from gi_core.live_sector import AHEAD_TIMES, FADE_TICKS, HURRIED_TIMES, LiveSector
from gi_core.live_volumes import HELD_TICKS
from gi_core.live_world import MOST_PUT_OFF, LiveWorld, TickReport
from gi_core.resident_sector import ResidentSector
from gi_core.world import Lamp


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


def test_a_sector_is_lit_when_it_arrives(world, engine, monkeypatch):
    monkeypatch.setattr(live_world, "HURRY_S", -1.0)  # with time for all of its bounces
    run, light = Run(world), light_of(world, engine.lighting("12:00", "clear"))
    residents = world.streamer.residents
    run.until(at(STREET), light, lambda report: len(residents) == 2)
    arrived = [sector.resident.read_cubes() for sector in residents.values()]
    run.settle(at(STREET), light)
    for before, sector in zip(arrived, residents.values(), strict=True):
        after = sector.resident.read_cubes()
        assert np.abs(before - after).max() <= 0.005 * after.max()


def test_sectors_are_read_and_put_on_the_device_beside_the_ticks(engine, monkeypatch):
    """Reading, decompressing, checking and uploading are a loader's; a tick takes over what is whole."""
    threads = {"read": set(), "upload": set()}

    def noting(what, method):
        def noted(*args):
            threads[what].add(threading.current_thread().name)
            return method(*args)

        return noted

    monkeypatch.setattr(Dataset, "sector", noting("read", Dataset.sector))
    world = LiveWorld(Dataset.open(GOLDEN), shadow_map=False)
    monkeypatch.setattr(ResidentSector, "__init__", noting("upload", ResidentSector.__init__))
    try:
        Run(world).settle(at(STREET), light_of(world, engine.lighting("12:00", "clear")))
    finally:
        world.close()
    assert threads == {"read": {"sector-loader_0"}, "upload": {"sector-loader_0"}}


@pytest.mark.parametrize(("hurry_s", "times"), [(-1.0, AHEAD_TIMES), (np.inf, HURRIED_TIMES)])
def test_who_is_waited_for_leaves_bounces_to_ticks(world, engine, monkeypatch, hurry_s, times):
    """A sector that a volume already looks for comes after two bounces; in the end it shows the same."""
    monkeypatch.setattr(live_world, "HURRY_S", hurry_s)
    asked = []
    light_ahead = LiveSector.light_ahead

    def noted(sector, relighter, light, times):
        asked.append(times)
        light_ahead(sector, relighter, light, times)

    monkeypatch.setattr(LiveSector, "light_ahead", noted)
    lighting = engine.lighting("12:00", "clear")
    found = Run(world).settle(at(STREET), light_of(world, lighting))
    assert asked == 2 * [times]
    np.testing.assert_array_equal(found, engine.volume(STREET, lighting).values)


def test_a_damaged_geometry_file_costs_shadows_and_no_tick(tmp_path, engine, caplog):
    shutil.copytree(GOLDEN, tmp_path / "city")
    path = geometry_path(tmp_path / "city", SectorIndex(0, 0))
    path.write_bytes(path.read_bytes()[:200])
    world = LiveWorld(Dataset.open(tmp_path / "city"), shadow_map=False)
    try:
        run, flare = Run(world), Lamp("flare", "point", (5.0, 3.0, 30.0), 1e9)
        lit = run.settle(at(STREET), light_of(world, engine.lighting("23:30", "clear"), (flare,)))
        assert lit.max() > 1000
        assert [record.getMessage() for record in caplog.records if "no shadows of sector 0,0" in record.getMessage()]
    finally:
        world.close()


def test_a_lamp_that_was_lit_while_a_sector_loaded_reaches_it(world, engine):
    run, before = Run(world), light_of(world, engine.lighting("23:30", "clear"))
    after = light_of(world, engine.lighting("23:30", "clear"), (Lamp("flare", "point", (5.0, 3.0, 30.0), 1e9),))
    while not world.streamer.loading:  # a long tick puts planning off
        run.tick(at(STREET), before)
    deadline = time.monotonic() + LATE_S
    while world.streamer._done.qsize() < world.streamer.loading:  # loaded, and not taken over
        assert time.monotonic() < deadline, "they were never loaded"
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
