"""What a tick of the live world does and leaves for later: no work at rest, no kernel built, no volume begun too late."""

import time
from datetime import datetime, timedelta
from itertools import count

import numpy as np
import pytest
from live_run import EAST, GOLDEN, STREET, Run, at, light_of

from gi_core import live_volumes
from gi_core.constants import VOXEL_SIZE_M
from gi_core.dataset import Dataset
from gi_core.grid import SectorIndex
from gi_core.live_sector import UNSHOWN_CHANGE, LiveLight
from gi_core.live_volumes import MOST_PUT_OFF_TICKS, SEEN_CHANGE
from gi_core.live_world import LiveWorld, TickPlayers
from gi_core.resident_sector import ResidentSector
from gi_core.settings import NEUTRAL, Settings


def test_an_idle_world_relights_and_fills_nothing(world, engine):
    run, light = Run(world), light_of(world, engine.lighting("12:00", "clear"))
    run.settle(at(STREET), light)
    for _ in range(5):
        report = run.tick(at(STREET), light)
        assert (report.relit, report.settled, report.filled, report.passes) == ((), (), (), 0)


def far_from_the_change(world, engine) -> tuple[TickPlayers, LiveLight]:
    """A settled world of eight players whose volumes read both sectors: the even ones stand in the eastern one, the odd in the western."""
    players, light = at(*[STREET - EAST * (k % 2 * 10 + k) for k in range(4)] * 2), light_of(world, engine.lighting("12:00", "clear"))
    assert [int(x < 0) for x in players.positions[:, 0]] == [0, 1] * 4
    Run(world).settle(players, light)
    return players, light


def fill(world, light, tick, *, is_busy=False, is_over=lambda: False) -> tuple[tuple[str, ...], int]:
    return world.volumes.fill(tick, is_busy, is_over, lambda sector: world._shown(sector, light), world._placeholder)


def test_whose_own_sector_was_relit_is_served_first_and_nobody_is_forgotten(world, engine):
    players, light = far_from_the_change(world, engine)
    order = []
    for tick in range(1000, 1000 + len(players.ids)):
        world.volumes.follow(tick, players.ids, players.positions)
        world.volumes.note(tick, {SectorIndex(-1, 0): 1.0} if tick == 1000 else {})
        filled, waiting = fill(world, light, tick, is_over=lambda: True)
        assert len(filled) == 1
        order += filled
        assert waiting == len(players.ids) - len(order)
    assert sorted(order) == sorted(players.ids)
    assert set(order[:4]) == {"p1", "p3", "p5", "p7"}


def test_no_volume_is_begun_when_the_ticks_time_for_them_is_over(world, engine):
    players, light = far_from_the_change(world, engine)
    looks = count(1)
    world.volumes.follow(1000, players.ids, players.positions)
    world.volumes.note(1000, {SectorIndex(0, 0): 1.0})
    # A second passes with each look at the clock: the first volume needs none, one begins at 1 s, another at 2 s, none at 3 s.
    filled, waiting = fill(world, light, 1000, is_over=lambda: next(looks) >= 3)
    assert (len(filled), waiting) == (3, 5)


def test_ticks_that_relight_leave_volumes_that_show_no_change_for_a_while(world, engine):
    players, light = far_from_the_change(world, engine)
    one_went_on = players.positions.copy()
    one_went_on[0, 0] += VOXEL_SIZE_M
    world.volumes.follow(1000, players.ids, one_went_on)
    world.volumes.note(1000, {SectorIndex(0, 0): 0.9 * SEEN_CHANGE})
    for tick in range(1000, 1000 + MOST_PUT_OFF_TICKS):
        assert fill(world, light, tick, is_busy=True) == ((), 8)
    filled, waiting = fill(world, light, 1000 + MOST_PUT_OFF_TICKS, is_busy=True)
    assert (sorted(filled), waiting) == (sorted(players.ids), 0)
    world.volumes.note(1010, {SectorIndex(0, 0): 0.9 * SEEN_CHANGE, SectorIndex(-1, 0): SEEN_CHANGE})
    assert len(fill(world, light, 1010, is_busy=True)[0]) == 8
    world.volumes.note(1020, {SectorIndex(0, 0): 0.9 * SEEN_CHANGE})
    assert len(fill(world, light, 1020, is_busy=False)[0]) == 8


def test_a_drifting_sun_never_has_a_tick_relight_and_fill(world, engine):
    run, start, both = Run(world), datetime(2024, 6, 21, 9), 0
    run.settle(at(STREET), light_of(world, engine.lighting(start.isoformat(), "clear")))
    relit = filled = 0
    for tick in range(1, 121):
        lighting = engine.lighting((start + timedelta(seconds=tick)).isoformat(), "clear")
        report = run.tick(at(STREET), light_of(world, lighting, standing=False))
        relit, filled, both = relit + bool(report.relit), filled + bool(report.filled), both + bool(report.relit and report.filled)
    assert relit > 10
    assert filled > 5
    assert both == 0


def test_what_is_seen_is_shown_by_the_tick_that_finds_it(world, engine):
    players, _ = far_from_the_change(world, engine)
    report = world.tick(1000, players, light_of(world, engine.lighting("12:30", "clear"), standing=False))
    assert report.relit
    assert len(report.filled) == len(players.ids)


def test_a_player_for_whom_there_was_no_room_gets_a_volume_later(world, engine, monkeypatch):
    light, room = light_of(world, engine.lighting("12:00", "clear")), live_volumes.LiveVolume

    def full(*_):
        raise MemoryError

    monkeypatch.setattr(live_volumes, "LiveVolume", full)
    with pytest.raises(MemoryError):
        world.tick(1, at(STREET), light)
    monkeypatch.setattr(live_volumes, "LiveVolume", room)
    run = Run(world)
    assert run.until(at(STREET), light, lambda report: world.published("p0") is not None)


def test_without_any_time_left_two_sectors_are_relit_all_the_same(world, engine):
    players, _ = far_from_the_change(world, engine)
    afternoon = light_of(world, engine.lighting("16:00", "clear"), standing=False)
    report = world.tick(1000, players, afternoon, fill_ms=-np.inf)
    assert set(report.relit) == {SectorIndex(0, 0), SectorIndex(-1, 0)}
    assert (len(report.filled), report.waiting) == (1, len(players.ids) - 1)


def test_warming_up_changes_no_light(world, engine):
    world.warm_up()
    lighting = engine.lighting("12:00", "clear")
    found = Run(world).settle(at(STREET), light_of(world, lighting))
    np.testing.assert_array_equal(found, engine.volume(STREET, lighting).values)


def test_warming_up_is_given_up_between_two_kernels(world):
    """A server that is told to stop while it compiles would else be killed before it has ended."""
    already = world._device.built_kernels
    asked = count(1)
    world.warm_up(lambda: next(asked) == 3)
    assert next(asked) == 4, "it asked no more"
    assert world._device.built_kernels > already
    given_up = world._device.built_kernels
    world.warm_up()
    assert world._device.built_kernels > given_up


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
