"""The sun's shadow map in the live world: samples come, grow old and go without a pop."""

import threading
import time
from concurrent.futures import Future
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pyopencl as cl
import pytest
from live_run import EAST, GOLDEN, LATE_S, STREET, Run, at, is_exact, largest_change, largest_step, light_of, sampled, unbound

from gi_core.constants import VOXEL_INDOORS, VOXEL_OUTDOORS
from gi_core.dataset import Dataset
from gi_core.engine import Engine
from gi_core.light_needs import WHOLLY
from gi_core.live_sector import FADE_STEP, FADE_TICKS, LiveLight
from gi_core.live_world import LiveWorld, TickReport
from gi_core.shadow_plan import LOWEST_SUN_DEGREES, is_near


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


def test_a_plan_that_failed_costs_one_tick(shaded, engine):
    world, _ = shaded
    run, light = Run(world), light_of(world, engine.lighting("15:00", "clear"), standing=False)
    run.tick(at(STREET), light)
    failed: Future = Future()
    failed.set_exception(MemoryError())
    world._shadows._planning = failed
    with pytest.raises(MemoryError):
        run.tick(at(STREET), light)
    assert run.tick(at(STREET), light)


def test_nothing_pops_when_other_samples_say_otherwise(shaded, engine):
    """As where only a later map covers a tower: samples are there, all of them dark, and another map is drawn."""
    world, may_read = shaded
    may_read.set()
    run, lighting = Run(world), engine.lighting("15:00", "clear")
    light, residents = light_of(world, lighting), world.streamer.residents
    run.until(at(STREET), light, lambda r: sampled(world))
    lit = run.settle(at(STREET), light)
    for sector in residents.values():
        samples = sector.samples
        cl.enqueue_fill_buffer(world._device.queue, samples.sun_sample, np.uint8(0), 0, samples.sun_sample.size)
        sector.resident.set_sun_sample(samples.sun_sample)
        sector.sampled_of = replace(sector.sampled_of, to_sun=-sector.sampled_of.to_sun)
        world._needs.disturb(world._row[sector.resident.sector.index], WHOLLY)
    moving = light_of(world, lighting, standing=False)
    dark = run.tick(at(STREET), moving) and world.published("p0")
    assert largest_change(dark.values.reshape(6, -1, 3), lit.reshape(6, -1, 3)) > 10 * FADE_STEP
    frames = [dark]
    for _ in range(3 * FADE_TICKS):
        run.tick(at(STREET), moving)
        frames.append(world.published("p0"))
        time.sleep(0.002)
    whole_way = largest_step(dark, frames[-1])
    assert whole_way > 10 * FADE_STEP
    assert max(largest_step(*pair) for pair in pairwise(frames)) <= 1.5 * max(FADE_STEP, whole_way / FADE_TICKS)


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
