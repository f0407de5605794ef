"""Rooms drawn as meshes, baked and lit: no light crosses their walls, and the yard in an L's corner is not in the room."""

from dataclasses import replace
from datetime import date

import numpy as np
import pytest

from bake_jobs.config import settings_for
from bake_jobs.room_meshes import mesh_room
from bake_jobs.room_search import world_rooms
from bake_jobs.scene import Mesh
from bake_jobs.solids import prism
from gi_core.constants import VOXEL_INDOORS
from gi_core.dataset import Dataset
from gi_core.engine import Engine
from gi_core.grid import SectorIndex
from gi_core.rooms import light_shares, rooms_of
from gi_core.volume import sample_volume
from gi_core.world import Lamp, Location

LEAK = 1e-3  # of the other side's light, as in test_rooms_do_not_leak
QUICK = replace(settings_for("talk"), rays_per_face_edge=8, grid_spacing_m=6.0, wall_spacing_m=8.0, sun_declination_step_degrees=40.0)
L_SHAPE = np.array([(6, 6), (30, 6), (30, 18), (18, 18), (18, 30), (6, 30)], float)
OUTWARD = np.array([(-1, -1), (1, -1), (1, 1), (1, 1), (1, 1), (-1, 1)], float)
WALL_M, FLOOR, CEILING = 0.1, 0.1, 6.0
MIDDLE, RADIUS = np.array([44.0, 44.0]), 9.0
LAMP = Lamp("bulb", "point", (44.0, 4.0, 44.0), 20_000.0, (1.0, 1.0, 1.0), 40.0)
HALL, TOWER = 1, 2


def round_plan(radius: float) -> np.ndarray:
    turn = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    return MIDDLE + radius * np.stack([np.cos(turn), np.sin(turn)], axis=1)


@pytest.fixture(scope="module")
def engine(build, tmp_path_factory, write_golden) -> Engine:
    """On a sector of ground a closed L, dark, and a closed round tower with a lamp in it; both have walls of 10 cm."""
    block = build().ground((0, 0), (64, 64), albedo=0.4)
    rooms = []
    for name, inner, outer in (
        ("hall", L_SHAPE, L_SHAPE + WALL_M * OUTWARD),
        ("tower", round_plan(RADIUS), round_plan(RADIUS + WALL_M)),
    ):
        vertices, triangles, _ = prism([inner], FLOOR, CEILING)
        rooms.append(mesh_room(name, Mesh.of_colour(vertices, triangles, (0.5, 0.5, 0.5)), name))
        block.add(vertices, triangles[:, ::-1], albedo=0.6)
        block.add(*prism([outer], 0, CEILING + WALL_M)[:2])
    place = Location(48.1, 11.6, 500.0, "Europe/Berlin", 0.0, date(2024, 6, 21), "given")
    scene = block.scene(lamps=(LAMP,), location=place, rooms=tuple(rooms))
    folder = tmp_path_factory.mktemp("meshes")
    write_golden(folder, QUICK, replace(scene, rooms=world_rooms(scene, "none")))
    return Engine(Dataset.open(folder))


def on_walls(plan: np.ndarray, sign: float) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals on the upright walls over a plan (n, 2), seen from inside (1) or outside (-1)."""
    rng = np.random.default_rng(3)
    start, along = plan, np.roll(plan, -1, axis=0) - plan
    count = np.ceil(np.linalg.norm(along, axis=1) * 10).astype(int)
    of = np.repeat(np.arange(len(plan)), count)
    place = start[of] + rng.random((len(of), 1)) * along[of]
    inward = np.stack([-along[of, 1], along[of, 0]], axis=1) / np.linalg.norm(along[of], axis=1)[:, None]
    height = rng.uniform(FLOOR, CEILING, len(of))
    points = np.stack([place[:, 0], height, place[:, 1]], axis=1)
    return points, sign * np.stack([inward[:, 0], np.zeros(len(of)), inward[:, 1]], axis=1)


def seen(engine: Engine, lighting, room: int, where: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Light [lx] as clients see it at points with normals: each from the volume of a room or of the open air."""
    points, normals = where[0], where[1].astype(np.float32)
    outdoor = engine.volume(np.array([32.0, 3.0, 32.0]), lighting)
    indoor = engine.interior(np.array([32.0, 3.0, 32.0]), lighting, room=str(room))
    share = light_shares(points + indoor.voxel_size / 4 * normals, engine.dataset.world.rooms, points).of(room, len(points))
    light = [sample_volume(v.values, v.origin, v.voxel_size, points, normals)[:, 1] for v in (outdoor, indoor)]
    return light[0] + share * (light[1] - light[0])


def test_probes_and_voxels_know_the_shape(engine):
    sector = engine.dataset.sector(SectorIndex(0, 0))
    at = sector.probe_position.astype(float)
    plan, storey = at[:, [0, 2]], (at[:, 1] > 0) & (at[:, 1] < CEILING)
    in_l = ((plan > 6) & (plan < 30)).all(axis=1) & ~(plan > 18).all(axis=1) & storey
    in_tower = (np.linalg.norm(plan - MIDDLE, axis=1) < RADIUS) & storey
    assert min(in_l.sum(), in_tower.sum()) > 3
    np.testing.assert_array_equal(sector.probe_room, np.where(in_l, HALL, np.where(in_tower, TOWER, 0)))
    assert ((sector.voxel_class == VOXEL_INDOORS) == (sector.voxel_room > 0)).all()
    assert set(np.unique(sector.voxel_room)) == {0, HALL, TOWER}
    # The yard, and a corner of the tower's box, are inside boxes but in no room.
    assert rooms_of(np.array([[24.0, 2, 24], [36.5, 2, 36.5]]), engine.dataset.world.rooms).tolist() == [0, 0]
    assert all(room.openings == () for room in engine.dataset.world.rooms)


def test_a_closed_l_is_dark_at_noon_and_its_yard_bright(engine):
    engine.lamps = ()
    noon = engine.lighting("12:00", "clear")
    outside = seen(engine, noon, HALL, on_walls(L_SHAPE + WALL_M * OUTWARD, -1.0))
    assert outside.min() > 1000
    assert seen(engine, noon, HALL, on_walls(L_SHAPE, 1.0)).max() <= LEAK * np.median(outside)


def test_a_lit_round_room_lights_neither_the_street_nor_the_hall(engine):
    night = engine.lighting("2024-11-01T00:30", "overcast")
    around, hall = on_walls(round_plan(RADIUS + WALL_M), -1.0), on_walls(L_SHAPE, 1.0)
    engine.lamps = ()
    without = seen(engine, night, TOWER, around)
    engine.lamps = (LAMP,)
    lit = seen(engine, night, TOWER, on_walls(round_plan(RADIUS), 1.0))
    assert lit.min() > 5
    np.testing.assert_allclose(seen(engine, night, TOWER, around), without, atol=LEAK * np.median(lit))
    assert seen(engine, night, HALL, hall).max() <= LEAK * np.median(lit)
