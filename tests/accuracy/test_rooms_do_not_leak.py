"""Two rooms behind 10 cm of wall: what is lit on one side of a wall is not seen on the other, in either volume.

The bound is the slides' own regret turned round: 0.1 % of the other side's light. Surfaces are sampled as clients sample them.
"""

import shutil
from dataclasses import replace
from datetime import date

import numpy as np
import pytest

from bake_jobs.config import settings_for
from gi_core import sector_file
from gi_core.constants import VOXEL_INDOORS, VOXEL_OUTDOORS
from gi_core.dataset import Dataset, sector_path
from gi_core.engine import Engine
from gi_core.errors import InputError
from gi_core.volume import sample_volume
from gi_core.world import Lamp, Location, Room

WALL_M = 0.1
DARK = Room("dark", (20.0, 0.1, 20.0), (36.0, 8.0, 44.0))
LIT = Room("lit", (36.1, 0.1, 20.0), (52.0, 8.0, 44.0))  # wall to wall with the dark one
LEAK = 1e-3
QUICK = {
    "rays_per_face_edge": 8,
    "grid_spacing_m": 6.0,
    "wall_spacing_m": 8.0,
    "sun_declination_step_degrees": 40.0,
    "voxel_levels": 2,
}
NIGHT_LAMP = Lamp("bulb", "point", (44.0, 6.0, 32.0), 20_000.0, (1.0, 1.0, 1.0), 40.0)


@pytest.fixture(scope="module")
def engine(build, tmp_path_factory, write_golden) -> Engine:
    """A closed block of two rooms on open ground; the lamp shines in one of them."""
    block = build().ground((-64, -64), (128, 128), albedo=0.4)
    for room in (DARK, LIT):
        block.box(room.minimum, room.maximum, albedo=0.6, inward=True)
    block.box((20 - WALL_M, 0, 20 - WALL_M), (52 + WALL_M, 8 + WALL_M, 44 + WALL_M))
    scene = block.scene(
        rooms=(DARK, LIT), lamps=(NIGHT_LAMP,), location=Location(48.1, 11.6, 500.0, "Europe/Berlin", 0.0, date(2024, 6, 21), "given")
    )
    folder = tmp_path_factory.mktemp("rooms")
    write_golden(folder, replace(settings_for("talk"), **QUICK), scene)
    return Engine(Dataset.open(folder))


def wall_points(side: str, rng: np.random.Generator, count: int = 400) -> tuple[np.ndarray, np.ndarray]:
    """Points on walls and ground as a player sees them, and normals: west of the dark room, east of the lit one, or inside a room."""
    at = rng.random((count, 3))
    if side in ("west", "east"):
        sign, wall_x = (-1.0, 20 - WALL_M) if side == "west" else (1.0, 52 + WALL_M)
        on_wall, points = rng.random(count) < 0.5, 18 * (at - 0.5) + [0, 0, 32]
        points[:, 0] = wall_x + np.where(on_wall, 0, sign * 8 * at[:, 0])
        points[:, 1] = np.where(on_wall, 0.3 + 7 * at[:, 1], 0)
        return points, np.where(on_wall[:, None], [sign, 0, 0], [0, 1.0, 0])
    room = {"dark": DARK, "lit": LIT}[side]
    low, high = np.array(room.minimum), np.array(room.maximum)
    face = rng.integers(0, 6, count)
    points, normals = low + at * (high - low), np.zeros((count, 3))
    rows, axis = np.arange(count), face // 2
    points[rows, axis] = np.where(face % 2, high[axis], low[axis])
    normals[rows, axis] = np.where(face % 2, -1.0, 1.0)
    return points, normals


def seen(volume, side: str) -> np.ndarray:
    points, normals = wall_points(side, np.random.default_rng(5))
    return sample_volume(volume.values, volume.origin, volume.voxel_size, points, normals.astype(np.float32))[:, 1]


def test_a_closed_room_is_dark_at_noon(engine):
    engine.lamps = ()
    noon = engine.lighting("12:00", "clear")
    dark = seen(engine.interior(np.array([28.0, 4.0, 32.0]), noon, room="dark"), "dark")
    outside = seen(engine.volume(np.array([15.0, 2.0, 32.0]), noon), "west")
    assert outside.min() > 1000
    assert dark.max() <= LEAK * np.median(outside)


def test_a_lit_room_does_not_light_the_street_or_the_room_next_door(engine):
    engine.lamps = (NIGHT_LAMP,)
    night = engine.lighting("2024-11-01T00:30", "overcast")
    lit = seen(engine.interior(np.array([44.0, 4.0, 32.0]), night, room="lit"), "lit")
    assert lit.min() > 5
    dark = seen(engine.interior(np.array([28.0, 4.0, 32.0]), night, room="dark"), "dark")
    assert dark.max() <= LEAK * np.median(lit)
    for cascade in (-1, 0, 1):
        engine.lamps = ()
        without = seen(engine.volume(np.array([57.0, 2.0, 32.0]), night, cascade=cascade), "east")
        engine.lamps = (NIGHT_LAMP,)
        outside = seen(engine.volume(np.array([57.0, 2.0, 32.0]), night, cascade=cascade), "east")
        np.testing.assert_allclose(outside, without, atol=LEAK * np.median(lit))


def test_day_does_not_darken_the_outside_of_a_dark_house(engine):
    """The same place with the house's inside out of the way: voxels indoors used to hold the dark that walls were sampled with."""
    engine.lamps = ()
    noon = engine.lighting("12:00", "clear")
    volume = engine.volume(np.array([15.0, 2.0, 32.0]), noon)
    beside = seen(volume, "west")
    air = volume.values[:, volume.mask == VOXEL_OUTDOORS][..., 1]
    assert (volume.mask == VOXEL_INDOORS).any()
    assert volume.values[:, volume.mask == VOXEL_INDOORS][..., 1].min() >= air.min()
    assert beside.min() > 0.2 * np.median(beside)


def test_a_room_of_planes_without_thickness_is_dark_at_noon_and_its_outside_bright(build, tmp_path, write_golden):
    scene = build().ground((-64, -64), (128, 128), albedo=0.4).box(DARK.minimum, DARK.maximum, albedo=0.6, inward=True)
    write_golden(tmp_path, replace(settings_for("talk"), **QUICK), scene.scene(rooms=(DARK,)))
    sheets = Engine(Dataset.open(tmp_path))
    noon = sheets.lighting("12:00", "clear")
    dark = seen(sheets.interior(np.array([28.0, 4.0, 32.0]), noon, room="dark"), "dark")
    for cascade in (-1, 0, 1):
        outside = seen(sheets.volume(np.array([15.0, 2.0, 32.0]), noon, cascade=cascade), "west")
        assert outside.min() > 1000
        assert dark.max() <= LEAK * np.median(outside)


def test_a_room_without_a_probe_does_not_show_the_light_that_it_borrowed(engine, tmp_path):
    city = tmp_path / "city"
    shutil.copytree(engine.dataset.path, city)
    bake_id, basis_size = engine.dataset.world.bake_id, 6
    for index in engine.dataset.world.sectors:
        sector = engine.dataset.sector(index)
        if (sector.voxel_room == 1).any():
            borrowed = replace(sector, probe_room=np.where(sector.probe_room == 1, 0, sector.probe_room).astype(np.uint16))
            sector_path(city, index).write_bytes(sector_file.encode(borrowed, {"bake_id": bake_id}, basis_size))
    other = Engine(Dataset.open(city))
    noon = other.lighting("12:00", "clear")
    with pytest.raises(InputError, match="has no probe in room 'dark'"):
        other.interior(np.array([28.0, 4.0, 32.0]), noon, room="dark")
    # Of both rooms, the one that has light lends it.
    both, lit = (other.interior(np.array([57.0, 4.0, 32.0]), noon, room=room) for room in (None, "lit"))
    assert (both.rooms, lit.rooms) == ((1, 2), (2,))
    np.testing.assert_array_equal(both.values, lit.values)
    assert (both.mask == VOXEL_INDOORS).sum() > (lit.mask == VOXEL_INDOORS).sum()
