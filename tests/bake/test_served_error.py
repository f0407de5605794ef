"""What a bake measures of its own light, by errors that are known, and how many probes that leaves a target error."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from bake_jobs.config import settings_for
from bake_jobs.path_tracer import PathTracer
from bake_jobs.served_error import ServedError
from bake_jobs.target_error import ENOUGH, TargetSearch
from gi_core.sun_table import SunTable

PATCHES = 96


@pytest.fixture(scope="module")
def plain(build, bake_arrays):
    """A black plain, on which probes get the sky's light alone: its sector, voxels over it, and what measures it."""
    scene = build().ground(albedo=0.0).scene()
    table = SunTable.build(scene.location)
    sector, _ = bake_arrays(scene, sun_directions=table.directions, sky="patches", sky_patches=PATCHES)
    tracer = PathTracer(scene.vertices, scene.triangles, scene.albedo, scene.emission, threads=1)
    voxels = np.stack(np.meshgrid(np.arange(2, 18), [0], np.arange(2, 18)), axis=-1).reshape(-1, 3)
    return sector, voxels, ServedError(tracer, scene.location, table, "patches", PATCHES)


def test_a_known_error_of_probes_is_found(plain):
    sector, voxels, measure = plain
    right = measure.of(sector, voxels)
    # Rays of 16 x 16 a face and patches of a fourteenth of the sky are not exact either.
    assert right < 0.02
    for factor in (0.8, 1.3):
        wrong = replace(sector, factor_scale=sector.factor_scale * np.float32(factor))
        assert measure.of(wrong, voxels) == pytest.approx(abs(factor - 1), abs=0.02)


def test_it_is_the_same_every_time_and_none_of_nothing(plain):
    sector, voxels, measure = plain
    assert measure.of(sector, voxels) == measure.of(sector, voxels)
    assert measure.of(sector, voxels[:0]) is None
    assert measure.of(sector, voxels + 1000) is None


@pytest.fixture
def search(monkeypatch):
    """A sector in which n probes interpolate to within 1 / n, and at most 500 can be had."""
    monkeypatch.setattr(TargetSearch, "interpolation", lambda self, count: 1 / count)
    ranking = SimpleNamespace(position=np.zeros((500, 3)), fixed=20)
    return lambda target: TargetSearch(None, ranking, None, None, None, replace(settings_for("standard"), target_error=target))


def test_what_probes_err_by_themselves_is_taken_off_the_target(search):
    alone, with_own = search(0.01).probes(), search(0.01).probes(0.008)
    assert 1 / alone <= 0.01 < 1.15 / (alone - 1)
    assert np.hypot(1 / with_own, 0.008) <= 0.01 < np.hypot(1.16 / with_own, 0.008)


def test_a_target_that_probes_miss_by_themselves_spends_no_more_than_helps(search):
    spent = search(0.01).probes(0.02)
    assert spent < 500
    assert 1 / spent <= ENOUGH * 0.02 < 1.16 / spent
    assert search(0.001).probes() == search(0.001).probes(0.0009) == 500
