"""The judge of sun visibility: known shares of known cells, suns where they are said to stand, and a whole city compared."""

import json
import subprocess
import sys
from datetime import date

import numpy as np
import pytest

from bake_jobs.rays import RayScene
from bake_jobs.sun_sources import ELEVATIONS_DEGREES, suns
from bake_jobs.sun_truth import cell_points, true_share
from gi_core.sun_table import SunTable
from gi_core.world import Location

UP = np.array([0.0, 1.0, 0.0])


@pytest.fixture(scope="module")
def under_a_roof(build, bake_arrays):
    """Ground with a roof over x from 20 to 40.5 m, so that its edge halves cells."""
    scene = build().ground().quad((20.0, 8.0, 10.0), (0, 0, 44.0), (20.5, 0, 0)).scene()
    sector, _ = bake_arrays(scene)
    return RayScene(scene.vertices, scene.triangles), sector


def test_points_lie_on_their_surfels_surface_and_in_its_cell(under_a_roof):
    rays, sector = under_a_roof
    points = cell_points(rays, sector)
    ground = sector.surfel_position[points.surfel, 1] < 1
    np.testing.assert_allclose(points.position[ground, 1], 0, atol=1e-4)
    np.testing.assert_allclose(points.position[~ground, 1], 8, atol=1e-4)
    fine = sector.brick_level[np.searchsorted(sector.brick_starts, points.surfel, side="right") - 1] == 0
    apart = points.position[fine] - sector.surfel_position[points.surfel[fine]]
    assert np.abs(apart).max() <= 0.75
    assert 14 < np.bincount(points.surfel[fine & ground]).max() <= 25


def test_a_cell_half_under_a_roof_has_half_of_the_sun(under_a_roof):
    rays, sector = under_a_roof
    share, known = true_share(rays, cell_points(rays, sector), sector.surfel_count, UP)
    x, y, z = sector.surfel_position.T
    of_brick = np.repeat(np.arange(sector.brick_count), np.diff(sector.brick_starts.astype(int)))
    ground = known & (sector.brick_level[of_brick] == 0) & (y < 1) & (sector.surfel_normal[:, 1] > 0.9) & (z > 12) & (z < 52)
    assert (share[ground & (x > 22) & (x < 39)] == 0).all()
    assert (share[ground & ((x < 18) | (x > 43)) & (x > 1) & (x < 63)] == 1).all()
    at_edge = ground & (x > 40) & (x < 41)
    assert at_edge.sum() > 3
    # Four or so columns of points to a cell, so a share is good to an eighth.
    np.testing.assert_allclose(share[at_edge], 0.5, atol=0.26)
    assert share[at_edge].mean() == pytest.approx(0.5, abs=0.13)
    underside = known & (y > 7) & (sector.surfel_normal[:, 1] < -0.9)
    assert underside.sum() > 10
    assert not share[underside].any()


def test_suns_stand_where_they_are_said_to_and_off_the_tables_nodes():
    location = Location(date=date(2024, 6, 21))
    found = suns(location)
    assert [elevation for elevation, _, _ in found] == [e for e in ELEVATIONS_DEGREES for _ in ("morning", "evening")]
    nodes = SunTable.build(location, 15.0, 15.0).directions
    for elevation, now, earlier in found:
        assert np.degrees(np.arcsin(now[1])) == pytest.approx(elevation, abs=0.15)
        assert 0.8 < np.degrees(np.arccos(now @ earlier)) <= 1.0
        assert np.degrees(np.arccos(np.clip(nodes @ now, -1, 1))).min() > 1.5


@pytest.mark.slow
def test_a_city_is_compared_and_the_map_beats_the_table(tmp_path):
    from bake_jobs.runner import bake

    city = tmp_path / "city"
    bake("procedural:midtown?blocks=1x1&seed=1", city, "draft", 1)
    command = [sys.executable, "-m", "bake_jobs.compare_sun", str(city), "--sectors", "1", "--json", str(tmp_path / "out.json")]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "out.json").read_text())
    assert list(report["elevations"]) == ["5", "10", "20", "40", "60"]
    for found in report["elevations"].values():
        assert found["map"]["mae"] < found["table_there"]["mae"]
        assert found["map"]["mae"] < found["stale"]["mae"]
        assert abs(found["map"]["bias"]) < 0.05
        assert found["served"]["n"] == found["table"]["n"] >= found["map"]["n"] > 0.5 * found["table"]["n"]
    assert report["bytes_a_surfel"]["map"] == pytest.approx(19, abs=0.5)  # sample and number on top of four floats
    assert "60 degrees" in done.stdout
