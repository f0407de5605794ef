"""Rooms as clients see them beside the path tracer: by day through a window, by night under a lamp, and one that is closed."""

import shutil
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bake_jobs import room_voxel_study
from bake_jobs.compare import compare_dataset
from bake_jobs.compare_points import points_in_rooms
from bake_jobs.compare_report import stored, summarise
from bake_jobs.config import settings_for
from bake_jobs.room_search import world_rooms
from gi_core.dataset import Dataset, write_world
from gi_core.engine import Engine
from gi_core.grid import SectorIndex
from gi_core.rooms import rooms_of
from gi_core.world import Lamp, Location

HERE = SectorIndex(0, 0)
LAMP = Lamp("bulb", "point", (44.0, 3.4, 40.0), 8_000.0, (1.0, 1.0, 1.0), 40.0)
QUICK = replace(settings_for("standard"), sun_declination_step_degrees=20.0)


@pytest.fixture(scope="module")
def city(build, tmp_path_factory, write_golden) -> Path:
    """A room of 16 m by 16 m with a window to the south, 8 m wide, a house across the street, and a closed room of 10 m."""
    block = build().ground((0, 0), (64, 64), albedo=0.3)
    block.wall((36, 30), (52, 30), 4, [(4, 1, 12, 3)])
    for start, end in (((36, 46), (52, 46)), ((36, 29.9), (36, 46.1)), ((52, 29.9), (52, 46.1))):
        block.wall(start, end, 4)
    block.box((35.8, 3.9, 29.8), (52.2, 4.2, 46.2))
    block.box((30, 0, 4), (60, 9, 14), albedo=0.5)
    block.box((8, 0.1, 30), (18, 4, 40), albedo=0.6, inward=True)
    block.box((7.9, 0, 29.9), (18.1, 4.1, 40.1))
    place = Location(48.1, 11.6, 500.0, "Europe/Berlin", 0.0, date(2024, 6, 21), "given")
    scene = block.scene(lamps=(LAMP,), location=place)
    folder = tmp_path_factory.mktemp("daylight")
    write_golden(folder, QUICK, replace(scene, rooms=world_rooms(scene, "all")))
    return folder


@pytest.fixture(scope="module")
def report(city: Path) -> dict[str, Any]:
    return compare_dataset(city, ("noon", "overcast", "night"), sectors=[HERE], points_per_sector=120, samples=4096)


def test_points_lie_on_surfaces_of_rooms_and_face_their_air(city: Path) -> None:
    dataset = Dataset.open(city)
    surface, normal = points_in_rooms(dataset.geometry(HERE), dataset.world.rooms, 200, np.random.default_rng(1))
    assert len(surface) == 200
    assert set(rooms_of(surface + 0.02 * normal, dataset.world.rooms)) == {1, 2}
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1)
    assert [len(part) for part in points_in_rooms(dataset.geometry(HERE), (), 200, np.random.default_rng(1))] == [0, 0]


def test_rooms_are_lit_as_the_path_tracer_says(report: dict[str, Any]) -> None:
    """Floors within a metre or two of a window see the sky, which voxels of 3 m do not resolve: a twentieth of the points is off by two
    thirds, of exact light at the voxels as well."""
    for state, most in {"noon": 0.2, "overcast": 0.2, "night": 0.1}.items():
        stages = report["states"][state]
        assert stages["shaded_rooms"]["n"] == 120
        assert stages["shaded_rooms"]["noise"] < most / 2
        assert stages["shaded_rooms"]["median"] < most, state
        assert stages["shaded_rooms"]["p95"] < 0.8, state
        # What harmonics of the second order say of the six faces is what the cube has of them.
        assert stages["shaded_rooms_cube"]["median"] == pytest.approx(stages["shaded_rooms"]["median"], abs=0.05)


def test_exact_light_in_finer_voxels_is_nearer_to_the_truth(city: Path) -> None:
    found = room_voxel_study.study(Dataset.open(city), ["night"], sectors=1, points=60, samples=1024, cascades=(0, -2))["night"]
    served, coarse, fine = (summarise(samples) for samples in found.values())
    assert served["n"] == coarse["n"] == fine["n"] == 60
    assert fine["median"] < coarse["median"]
    assert fine["median"] < 0.08


def test_what_interior_volumes_may_be_off_by_is_told(report: dict[str, Any], city: Path, tmp_path: Path) -> None:
    shutil.copytree(city, tmp_path / "measured")
    write_world(tmp_path / "measured", replace(Dataset.open(city).world, error_report=stored(report, "sh2")))
    engine = Engine(Dataset.open(tmp_path / "measured"))
    noon = engine.lighting("12:00", "clear")
    for basis, stage in (("sh2", "shaded_rooms"), ("cube", "shaded_rooms_cube")):
        medians = [stages[stage]["median"] for stages in report["states"].values()]
        assert engine.interior(np.array([44.0, 1.5, 38.0]), noon, basis=basis).expected_error == pytest.approx(np.median(medians))
