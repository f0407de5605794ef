"""Light on the way through a door between two rooms, of which one is lit: it changes as the path tracer's does, not in one step."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bake_jobs.config import settings_for
from bake_jobs.door_study import largest_step, walk_through
from bake_jobs.scene_source import load_scene
from gi_core.constants import OPENING_LEAST_VIEW
from gi_core.dataset import Dataset
from gi_core.engine import Engine

SOURCE = Path(__file__).parents[2] / "docs" / "two_rooms.toml"
QUICK = replace(settings_for("talk"), rays_per_face_edge=8, sun_declination_step_degrees=40.0)
HALL, STUDY = 1, 2
DOOR, WAY = np.array([30.1, 1.5, 24.0]), np.array([6.0, 0.0, 0.0])


@pytest.fixture(scope="module")
def engine(tmp_path_factory, write_golden) -> Engine:
    """The scene of MATH.md's table: a hall with windows and a lamp, a study without, and a door between them."""
    folder = tmp_path_factory.mktemp("doors")
    write_golden(folder, QUICK, load_scene(SOURCE))
    return Engine(Dataset.open(folder))


def test_the_door_is_kept_and_leads_both_ways(engine):
    world = engine.dataset.world
    assert world.version == 6
    assert [[opening.to for opening in room.openings] for room in world.rooms] == [[0, 0, 0, STUDY], [HALL]]


@pytest.mark.parametrize(("time", "weather"), [("12:00", "overcast"), ("2024-11-01T23:30", "overcast")], ids=["by day", "at night"])
def test_a_step_through_a_door_between_rooms_is_smooth(engine, time, weather):
    """By MATH.md's bound the share of a room changes by at most 8.7 % in 0.1 m of the way through this door, 1 m wide, 2.1 m high and as
    far below the floor; off the middle of its height by an eighth more. With a third as much again for what each volume changes itself."""
    a, b = 0.5, 2.1
    bound = 0.1 * np.hypot(a, b) / (a * b) / (np.pi * (1 - OPENING_LEAST_VIEW))
    assert bound == pytest.approx(0.087, abs=5e-4)
    walk = walk_through(engine, DOOR - WAY, DOOR + WAY, engine.lighting(time, weather))
    assert list(walk.volumes) == [HALL, STUDY]
    assert walk.volumes[HALL].min() > 3 * walk.volumes[STUDY].max()
    hard, blended = largest_step(walk.hard), largest_step(walk.blended)
    assert hard > 0.5 * np.ptp(walk.hard)
    assert blended < 1.5 * bound * hard
    far = np.abs(walk.place[:, 0] - DOOR[0]) > 2.0
    np.testing.assert_allclose(walk.blended[far], walk.hard[far], rtol=1e-6)
