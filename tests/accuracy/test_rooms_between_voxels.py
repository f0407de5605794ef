"""Rooms that hold no voxel's centre, low storeys and closets, and rooms of a city with hundreds: none leaks, each has its own light.

Voxels' centres lie 3.125 m apart, so a storey of 2.8 m may have none.
"""

from dataclasses import replace
from datetime import date
from pathlib import Path

import numpy as np
import pytest

from bake_jobs.config import settings_for
from bake_jobs.path_tracer import PathTracer
from bake_jobs.placement import has_voxels
from gi_core.client_light import Look, ServedLight
from gi_core.constants import VOXEL_INDOORS
from gi_core.dataset import Dataset
from gi_core.engine import Engine
from gi_core.volume import sample_volume
from gi_core.world import Lamp, Location, Room

LEAK = 1e-3
QUICK = {"rays_per_face_edge": 8, "trial_rays_per_face_edge": 5, "sun_declination_step_degrees": 40.0, "sun_hour_step_degrees": 30.0}
GRID = {"grid_spacing_m": 6.0, "wall_spacing_m": 8.0}
STOREY = Room("third floor", (10.3, 8.0, 10.3), (30.7, 10.8, 26.4))
CLOSET = Room("closet", (40.2, 0.1, 10.2), (41.5, 6.0, 20.0))
NOWHERE = Location(48.1, 11.6, 500.0, "Europe/Berlin", 0.0, date(2024, 6, 21), "given")


def engine_of(scene, preset: str, folder: Path, write_golden) -> Engine:
    settings = settings_for(preset)
    knobs = {**QUICK, **({} if settings.placement == "adaptive" else GRID)}
    write_golden(folder, replace(settings, **knobs), scene)
    return Engine(Dataset.open(folder))


def inner_points(room: Room, count: int = 200) -> tuple[np.ndarray, np.ndarray]:
    """Points on a room's faces, and normals into it."""
    rng = np.random.default_rng(3)
    low, high = np.array(room.minimum), np.array(room.maximum)
    points, normals, face = low + rng.random((count, 3)) * (high - low), np.zeros((count, 3)), rng.integers(0, 6, count)
    rows, axis = np.arange(count), face // 2
    points[rows, axis] = np.where(face % 2, high[axis], low[axis])
    normals[rows, axis] = np.where(face % 2, -1.0, 1.0)
    return points, normals.astype(np.float32)


@pytest.fixture(scope="module", params=["talk", "standard"])
def between(request, build, tmp_path_factory, write_golden):
    """A closed storey and a closed closet, neither with a voxel, a lamp in the storey."""
    block = build().ground((-16, -16), (80, 80), albedo=0.4).box((10.2, 0, 10.2), (30.8, 12, 26.5), albedo=0.5)
    block.box((40.1, 0, 10.1), (41.6, 6.1, 20.1), albedo=0.5)
    for room in (STOREY, CLOSET):
        block.box(room.minimum, room.maximum, albedo=0.6, inward=True)
    lamp = Lamp("bulb", "point", (20.0, 9.4, 18.0), 20_000.0, (1.0, 1.0, 1.0), 40.0)
    scene = block.scene(rooms=(STOREY, CLOSET), lamps=(lamp,), location=NOWHERE)
    return engine_of(scene, request.param, tmp_path_factory.mktemp("between"), write_golden), scene, lamp


def test_they_have_no_voxel_and_a_probe(between):
    engine, _, _ = between
    assert not has_voxels(STOREY)
    assert not has_voxels(CLOSET)
    assert has_voxels(Room("hall", (0.0, 0.0, 0.0), (4.0, 4.0, 4.0)))
    sectors = [engine.dataset.sector(index) for index in engine.dataset.world.sectors]
    assert not any((sector.voxel_class == VOXEL_INDOORS).any() for sector in sectors)
    assert {1, 2} <= set(np.concatenate([sector.probe_room for sector in sectors]).tolist())


@pytest.mark.parametrize("room", [STOREY, CLOSET])
def test_closed_ones_are_dark_at_noon(between, room):
    engine, _, _ = between
    engine.lamps = ()
    noon, middle = engine.lighting("12:00", "clear"), (np.array(room.minimum) + room.maximum) / 2
    found = engine.interior(middle, noon, room=room.name)
    points, normals = inner_points(room)
    outside = engine.volume(np.array([5.0, 2.0, 5.0]), noon)
    bright = sample_volume(
        outside.values, outside.origin, outside.voxel_size, np.array([[5.0, 0.0, 5.0]]), np.array([[0, 1, 0]], np.float32)
    )
    served = ServedLight.of(engine, noon, Look(), middle).irradiance(points, normals)
    for light in (sample_volume(found.values, found.origin, found.voxel_size, points, normals), served):
        assert light.max() <= LEAK * bright.max()


def test_a_lamp_lights_one(between):
    engine, scene, lamp = between
    engine.lamps = (lamp,)
    night, middle = engine.lighting("2024-11-01T00:30", "overcast"), np.array([20.0, 9.4, 18.0])
    points, normals = inner_points(STOREY)
    served = ServedLight.of(engine, night, Look(), middle).irradiance(points, normals)[:, 1]
    tracer = PathTracer(scene.vertices, scene.triangles, scene.albedo, scene.emission, threads=1)
    truth = tracer.surface_irradiance(points + 1e-3 * normals, normals, night, (lamp,), samples=64).mean[:, 1]
    # Probes stand halfway up, between the bright patches of floor and ceiling: surfaces beside them are darker than what these see.
    assert 0.5 < np.median(served) / np.median(truth) < 3
    probes = engine.probes(middle, 20.0, night)
    inside = probes.room == 1
    exact = tracer.cube_irradiance(probes.position[inside], night, (lamp,), samples=256).mean[..., 1]
    assert 0.7 < np.median(probes.cubes[inside][..., 1] / exact) < 1.4


def test_more_rooms_than_a_brick_tells_apart_do_not_share_light(build, tmp_path, write_golden):
    """A dark room and a lit one wall to wall within a surfel's cell, and sixty-two rooms elsewhere numbered between them."""
    dark, lit = Room("dark", (20.0, 0.1, 20.0), (30.4, 8.0, 36.0)), Room("lit", (30.5, 0.1, 20.0), (44.0, 8.0, 36.0))
    far = [Room(f"far {n}", (200.0 + 4 * n, 0.1, 200.0), (203.0 + 4 * n, 3.5, 203.0)) for n in range(62)]
    block = build().ground((-16, -16), (80, 80), albedo=0.4).box((19.9, 0, 19.9), (44.1, 8.1, 36.1))
    for room in (dark, lit):
        block.box(room.minimum, room.maximum, albedo=0.6, inward=True)
    lamp = Lamp("bulb", "point", (38.0, 6.0, 28.0), 20_000.0, (1.0, 1.0, 1.0), 40.0)
    engine = engine_of(block.scene(rooms=(dark, *far, lit), lamps=(lamp,), location=NOWHERE), "talk", tmp_path, write_golden)
    night = engine.lighting("2024-11-01T00:30", "overcast")
    found = [engine.interior(np.array([30.0, 4.0, 28.0]), night, room=room.name).values for room in (dark, lit)]
    assert found[1].max() > 10
    assert found[0].max() <= LEAK * np.median(found[1])
