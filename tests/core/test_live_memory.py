"""What the live world's sectors take of memory is what the budget counts for them."""

import time
from dataclasses import replace

import numpy as np
import pytest
from live_run import GOLDEN, HARMONICS, STREET, Run, at, light_of

from gi_core.dataset import Dataset
from gi_core.device import Device
from gi_core.engine import Engine
from gi_core.grid import SectorIndex
from gi_core.live_world import LiveWorld
from gi_core.resident_sector import ResidentSector
from gi_core.settings import Settings
from gi_core.stream_plan import StreamOptions
from gi_core.world import Lamp


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


def test_the_budget_holds_while_a_player_walks_to_and_fro(engine):
    dataset = Dataset.open(GOLDEN)
    world = LiveWorld(dataset, shadow_map=False)
    largest = max(world.streamer.table.bytes.tolist())
    world.close()
    world = LiveWorld(dataset, shadow_map=False, stream=StreamOptions(int(1.5 * largest)))
    try:
        run, light, arrived = Run(world), light_of(world, engine.lighting("12:00", "clear"), standing=False), 0
        for step in range(80):
            x = 60.0 * np.sin(step / 10)
            report = run.tick(at(np.array([x, 2.0, 30.0]), velocity=(60 * np.cos(step / 10) * 3, 0, 0)), light)
            taken = sum(sector.nbytes + sector.host_nbytes for sector in world.streamer.residents.values())
            assert taken <= world.streamer.resident_bytes <= 1.5 * largest
            arrived += len(report.loaded)
            time.sleep(0.004)
        assert arrived >= 1
        assert np.isfinite(world.volumes.of_player["p0"].published.values).all()
    finally:
        world.close()
