"""Rooms that the bake found, baked and lit: dark where they are closed, smooth where they are open, one room on both sides of a border."""

from dataclasses import replace
from datetime import date

import numpy as np
import pytest

from bake_jobs.config import settings_for
from bake_jobs.door_study import largest_step, walk_through
from bake_jobs.room_search import world_rooms
from bake_jobs.sector_job import SectorBaker
from gi_core import sector_file
from gi_core.constants import OPENING_LEAST_VIEW, VOXEL_INDOORS
from gi_core.dataset import Dataset
from gi_core.engine import Engine
from gi_core.grid import SectorIndex
from gi_core.rooms import light_shares
from gi_core.volume import sample_volume
from gi_core.world import Lamp, Location

LEAK = 1e-3
QUICK = replace(settings_for("talk"), rays_per_face_edge=8, grid_spacing_m=6.0, wall_spacing_m=8.0, sun_declination_step_degrees=40.0)
LAMP = Lamp("bulb", "point", (26.0, 4.0, 14.0), 20_000.0, (1.0, 1.0, 1.0), 40.0)
DARK, LIT, HALL = 1, 2, 3
DOOR, WAY = np.array([44.0, 1.5, 30.0]), np.array([0.0, 0.0, 6.0])


@pytest.fixture(scope="module")
def engine(build, tmp_path_factory, write_golden) -> Engine:
    """On a sector of ground two closed rooms with 10 cm between them, a lamp in one, and a hall with a door; no author said so."""
    block = build().ground((0, 0), (64, 64), albedo=0.4)
    for low, high in (((6, 0.1, 6), (18, 6, 22)), ((18.1, 0.1, 6), (30.1, 6, 22))):
        block.box(low, high, albedo=0.6, inward=True)
    block.box((5.9, 0, 5.9), (30.2, 6.1, 22.1))
    block.wall((36, 30), (52, 30), 5, [(7.2, -0.1, 8.8, 2.5)])
    for start, end in (((36, 46), (52, 46)), ((36, 29.9), (36, 46.1)), ((52, 29.9), (52, 46.1))):
        block.wall(start, end, 5)
    block.box((35.8, 4.9, 29.8), (52.2, 5.2, 46.2))
    place = Location(48.1, 11.6, 500.0, "Europe/Berlin", 0.0, date(2024, 6, 21), "given")
    scene = block.scene(lamps=(LAMP,), location=place)
    scene = replace(scene, rooms=world_rooms(scene, "all"))
    folder = tmp_path_factory.mktemp("found")
    write_golden(folder, QUICK, scene)
    return Engine(Dataset.open(folder))


def beside_walls(low, high, sign: float) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals on the four walls of a box, from inside (1) or outside (-1); and on the floor up to 2 m from them, as far."""
    rng = np.random.default_rng(3)
    low, high, count = np.array(low), np.array(high), 200
    points, normals = rng.uniform(low, high, (4 * count, 3)), np.zeros((4 * count, 3))
    for wall, (axis, end, inward) in enumerate(((0, low, 1.0), (0, high, -1.0), (2, low, 1.0), (2, high, -1.0))):
        rows = slice(wall * count, (wall + 1) * count)
        points[rows, axis], normals[rows, axis] = end[axis], sign * inward
    floor, up = points + normals * rng.uniform(0, 2, (4 * count, 1)), np.tile([0.0, 1.0, 0.0], (4 * count, 1))
    floor[:, 1] = low[1]
    return np.concatenate([points, floor]), np.concatenate([normals, up])


def seen(engine: Engine, lighting, room: int, where: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Light [lx] as clients see it at points with normals: each mixed from the volumes of a room and of the open air."""
    points, normals = where[0], where[1].astype(np.float32)
    outdoor = engine.volume(np.array([24.0, 3.0, 20.0]), lighting)
    indoor = engine.interior(np.array([24.0, 3.0, 20.0]), lighting, room=str(room))
    at = points + indoor.voxel_size / 4 * normals
    share = light_shares(at, engine.dataset.world.rooms, points).of(room, len(points))
    light = [sample_volume(v.values, v.origin, v.voxel_size, points, normals)[:, 1] for v in (outdoor, indoor)]
    return light[0] + share * (light[1] - light[0])


def test_what_was_found_is_what_was_built(engine):
    rooms = engine.dataset.world.rooms
    assert [(room.name, len(room.openings)) for room in rooms] == [("found-1", 0), ("found-2", 0), ("found-3", 1)]
    built = (((6, 0.1, 6), (18, 6, 22)), ((18.1, 0.1, 6), (30.1, 6, 22)), ((36.1, 0, 30.1), (51.9, 4.9, 45.9)))
    for room, (low, high) in zip(rooms, built, strict=True):
        np.testing.assert_allclose(room.minimum, low, atol=2e-3)
        np.testing.assert_allclose(room.maximum, high, atol=2e-3)
    sector = engine.dataset.sector(SectorIndex(0, 0))
    assert set(np.unique(sector.probe_room)) == set(np.unique(sector.voxel_room)) == {0, DARK, LIT, HALL}
    assert ((sector.voxel_class == VOXEL_INDOORS) == (sector.voxel_room > 0)).all()


def test_found_rooms_leak_no_more_than_authored_ones(engine):
    engine.lamps = ()
    noon = engine.lighting("12:00", "clear")
    inside, outside = beside_walls((6, 0.1, 6), (18, 6, 22), 1.0), beside_walls((5.9, 0, 5.9), (30.2, 6.1, 22.1), -1.0)
    by_day = seen(engine, noon, LIT, outside)
    assert by_day.min() > 1000
    assert seen(engine, noon, DARK, inside).max() <= LEAK * np.median(by_day)

    night = engine.lighting("2024-11-01T00:30", "overcast")
    without = seen(engine, night, LIT, outside)
    engine.lamps = (LAMP,)
    lit = seen(engine, night, LIT, beside_walls((18.1, 0.1, 6), (30.1, 6, 22), 1.0))
    assert lit.min() > 5
    assert seen(engine, night, DARK, inside).max() <= LEAK * np.median(lit)
    np.testing.assert_allclose(seen(engine, night, LIT, outside), without, atol=LEAK * np.median(lit))


def test_a_step_through_a_door_is_smooth(engine):
    """Before a rectangle of half sides a, b the share falls by at most sqrt(a^2 + b^2) / (a b) / (pi 0.75) a metre: of this door, 1.6 m
    wide, 2.5 m high above the floor and as far below, by 5.6 % of the difference between the volumes in 0.1 m. With half as much again for
    what each changes on its own, a tenth of the hard step."""
    a, b = 0.8, 2.5
    assert 0.1 * np.hypot(a, b) / (a * b) / (np.pi * (1 - OPENING_LEAST_VIEW)) == pytest.approx(0.056, abs=5e-4)
    engine.lamps = ()
    for time, weather in (("12:00", "clear"), ("12:00", "overcast")):
        walk = walk_through(engine, DOOR - WAY, DOOR + WAY, engine.lighting(time, weather))
        hard, blended = largest_step(walk.hard), largest_step(walk.blended)
        assert hard > 0.5 * np.ptp(walk.hard)
        assert blended < 0.1 * hard
        # Far from the door each has its own light alone.
        far = np.abs(walk.place[:, 2] - DOOR[2]) > 2.0
        np.testing.assert_array_equal(walk.blended[far], walk.hard[far])


def test_walls_stay_sharp_beside_a_door(engine):
    """On either side of a wall, and on one that has a door."""
    rooms = engine.dataset.world.rooms
    within = np.array([[36.15, 1, 40], [51.85, 1, 40], [44, 1, 45.85], [44, 4.85, 40], [38, 1, 30.15]])
    beyond = np.array([[35.85, 1, 40], [52.15, 1, 40], [44, 1, 46.15], [44, 5.25, 40], [38, 1, 29.85]])
    assert light_shares(within, rooms).of(HALL, 5).tolist() == [1.0] * 5
    assert light_shares(beyond, rooms).of(0, 5).tolist() == [1.0] * 5
    # On the wall itself not even a hand's breadth from the door: surfaces do not see what lies in their own plane.
    jamb = np.array([[43.1, 1, 30.12], [43.1, 1, 29.88], [44.9, 1, 30.12], [44, 2.6, 30.12]])
    off = jamb + np.array([[0, 0, 0.78], [0, 0, -0.78], [0, 0, 0.78], [0, 0, 0.78]])
    assert light_shares(off, rooms, jamb).of(HALL, 4).tolist() == [1.0, 0.0, 1.0, 1.0]


def test_a_room_across_a_border_is_one_and_its_bytes_depend_on_no_order(build):
    block = build().ground((0, 0), (128, 64), albedo=0.4)
    block.wall((56, 30), (72, 30), 5, [(7.2, -0.1, 8.8, 2.5)])
    for start, end in (((56, 46), (72, 46)), ((56, 29.9), (56, 46.1)), ((72, 29.9), (72, 46.1))):
        block.wall(start, end, 5)
    scene = block.box((55.8, 4.9, 29.8), (72.2, 5.2, 46.2)).scene()
    rooms = world_rooms(scene, "open")
    assert world_rooms(scene, "open") == rooms
    assert len(rooms) == 1
    sides = [SectorIndex(0, 0), SectorIndex(1, 0)]
    baked = []
    for sequence in (sides, sides[::-1]):
        baker = SectorBaker(replace(scene, rooms=rooms), replace(QUICK, grid_spacing_m=8.0), np.array([[0.0, 1, 0]]), "0" * 32)
        baked.append({index: baker.bake(index).sector_bytes for index in sequence})
    assert baked[0] == baked[1]
    for index in sides:
        sector, _ = sector_file.decode(baked[0][index], "a sector")
        assert set(np.unique(sector.probe_room)) == set(np.unique(sector.voxel_room)) == {0, 1}
