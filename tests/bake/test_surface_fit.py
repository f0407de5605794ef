"""Voxels in walls are fitted to light at the surfaces that read them: who reads what, and whether it helps."""

from dataclasses import replace

import numpy as np
import pytest

from bake_jobs.config import ADAPTIVE, settings_for
from bake_jobs.reader_probes import APART_M, worst_places
from bake_jobs.scene import ProbeHint
from bake_jobs.sector_job import SectorBaker
from bake_jobs.surface_fit import _mixed, _spread
from gi_core.basis import evaluate
from gi_core.constants import VOXEL_SIZE_M, VOXEL_SOLID
from gi_core.geometry_file import Geometry
from gi_core.grid import SectorIndex, voxel_centre
from gi_core.volume import sample_coefficients

SUNS = np.array(
    [[0.1, 0.99, 0.1], [0.6, 0.75, 0.28], [-0.6, 0.75, 0.28], [0.28, 0.55, 0.79], [0.85, 0.5, 0.17], [-0.85, 0.5, 0.17], [0, 0.3, 0.95]]
)
HERE = SectorIndex(0, 0)


def lattice_from(first, shape):
    z_y_x = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), axis=-1)
    return z_y_x[..., [2, 0, 1]] + np.array(first)


def test_readers_mix_what_a_client_samples():
    rng = np.random.default_rng(5)
    lattice = lattice_from((-3, 2, 7), (5, 6, 4))
    light = rng.random((1, 5, 6, 4, 2)).astype(np.float32)
    low, high = voxel_centre(lattice[0, 0, 0][None])[0], voxel_centre(lattice[-1, -1, -1][None])[0]
    at = rng.uniform(low, high, (50, 3))
    voxel, share = _mixed(at, lattice, VOXEL_SIZE_M)
    sampled = sample_coefficients(light, low, np.full(3, VOXEL_SIZE_M), at)[:, 0]
    assert np.einsum("nk,nkc->nc", share, light.reshape(-1, 2)[voxel]) == pytest.approx(sampled, abs=1e-5)
    assert not _mixed(high[None] + 2 * VOXEL_SIZE_M, lattice, VOXEL_SIZE_M)[1].any()


def test_surfaces_get_readers_by_their_area():
    """Two squares, one of 100 m2 in the plane y = 1, one of 300 m2 in x = 20."""
    corners = [[0, 1, 0], [0, 1, 10], [10, 1, 10], [10, 1, 0], [20, 0, 0], [20, 0, 30], [20, 10, 30], [20, 10, 0]]
    triangles = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], np.int32)
    grey = np.full((4, 3), 0.5, np.float32)
    point, normal = _spread(Geometry(np.array(corners, np.float64), triangles, grey, grey), 2.0)
    level = np.abs(normal[:, 1]) == 1
    assert (level.sum(), (~level).sum()) == (50, 150)
    assert point[level, 1] == pytest.approx(1.0)
    assert point[~level, 0] == pytest.approx(20.0)
    # Evenly: every quarter of the wall has a quarter of its readers, to three.
    quarter, _, _ = np.histogram2d(point[~level, 1], point[~level, 2], bins=2, range=((0, 10), (0, 30)))
    assert np.abs(quarter - 37.5).max() <= 3.5


@pytest.fixture(scope="module")
def yards(build):
    """Houses around yards and alleys of 2 to 5 m, whose walls follow no lattice."""
    houses = build().ground(low=(-100, -100), high=(164, 164), albedo=0.3)
    for low, high in (
        ((5, 0, 5), (21.7, 15, 21)),
        ((24.1, 0, 5), (40.2, 18, 21)),
        ((5, 0, 24.3), (21.7, 12, 44)),
        ((24.1, 0, 26), (40.2, 21, 31.1)),
        ((24.1, 0, 34.4), (40.2, 14, 44)),
        ((44.9, 0, 5), (59, 17, 44)),
        ((5, 0, 46.2), (59, 10, 60)),
    ):
        houses.box(low, high, albedo=0.6)
    return houses.scene()


def baked(scene, wall_weights, **settings):
    suns = SUNS / np.linalg.norm(SUNS, axis=1, keepdims=True)
    knobs = {**ADAPTIVE, "rays_per_face_edge": 4, "trial_rays_per_face_edge": 6, "wall_weights": wall_weights, **settings}
    bench = SectorBaker(scene, replace(settings_for("talk"), **knobs), suns, "test")
    geometry = bench.cutter.cut(HERE)
    return bench, geometry, bench.bake_arrays(HERE, geometry)[0]


@pytest.mark.slow
def test_surfaces_that_read_the_wall_are_lit_better_than_from_the_nearest_air(yards):
    """At points where no reader stands, most of whose light is sampled within solids."""
    error = {}
    for wall_weights in ("nearest", "fitted"):
        bench, geometry, sector = baked(yards, wall_weights)
        assert sector.voxel_weight.sum(axis=3) == pytest.approx(1.0, abs=1e-5)
        # One for 1.7 m2: they stand in other places than readers.
        point, normal = _spread(geometry, 1.7)
        point, normal = np.concatenate([point, point]), np.concatenate([normal, -normal])
        at = point + 0.25 * VOXEL_SIZE_M * normal
        voxel, share = _mixed(at, lattice_from(sector.voxel_first, sector.voxel_class.shape), VOXEL_SIZE_M)
        in_wall = (share * (sector.voxel_class.reshape(-1) == VOXEL_SOLID)[voxel]).sum(axis=1)
        seen = (in_wall > 0.5) & (share.sum(axis=1) > 0.999) & (point[:, 1] < 12) & ~bench._solids.contain(at)
        at, towards, voxel, share = at[seen], normal[seen].astype(np.float32), voxel[seen], share[seen]
        cube = bench.trial.light(sector.probe_position.astype(np.float64) + HERE.origin).cube
        probe, weight = (a.reshape(-1, a.shape[3])[voxel] for a in (sector.voxel_probe, sector.voxel_weight))
        served = evaluate("cube", np.einsum("nv,nvk,nvksf->nfs", share, weight, cube[probe]).astype(np.float32), towards)
        exact = evaluate("cube", bench.trial.light(at).cube.transpose(0, 2, 1), towards)
        relative = np.abs(served - exact) / np.maximum(exact, 0.02 * exact.mean(axis=0))
        error[wall_weights] = np.quantile(relative, (0.5, 0.75, 0.9))
    # Seen: 0.79, 0.82 and 0.87 of what the nearest air's blends err.
    assert (error["fitted"] < 0.92 * error["nearest"]).all()


@pytest.mark.slow
def test_only_voxels_without_light_of_their_own_change(yards):
    near, fitted = (baked(yards, choice)[2] for choice in ("nearest", "fitted"))
    changed = (near.voxel_weight != fitted.voxel_weight).any(axis=3) | (near.voxel_probe != fitted.voxel_probe).any(axis=3)
    assert changed.any()
    assert (near.voxel_class[changed] == VOXEL_SOLID).all()
    assert (near.probe_position == fitted.probe_position).all()


def test_the_worst_place_gets_the_first_probe_and_its_neighbours_none():
    """A row of places a metre apart, wrong around x = 3 and more so around x = 20, and one alone that no probe may stand at."""
    place = np.stack([np.arange(40.0), np.zeros(40), np.zeros(40)], axis=1)
    error = np.zeros(40)
    error[2:5], error[19:22], error[35] = (0.1, 0.3, 0.1), (0.1, 1.0, 0.1), 1.5
    may = np.abs(place[:, 0] - 35) > 3
    assert place[worst_places(place, error, may, 10), 0].tolist() == [20.0, 3.0]
    assert place[worst_places(place, error, may, 1), 0].tolist() == [20.0]
    assert not len(worst_places(place, np.full(40, 0.05), may, 10))
    everywhere = worst_places(place, np.full(40, 1.0), np.ones(40, bool), 40)
    assert np.diff(np.sort(place[everywhere, 0])).min() > APART_M


@pytest.mark.slow
def test_reader_probes_stand_in_air_within_the_margins(yards):
    few, more = (baked(yards, "fitted", reader_probes=count)[2] for count in (0, 12))
    old = {tuple(p) for p in few.probe_position.tolist()}
    new = np.array([p for p in more.probe_position.tolist() if tuple(p) not in old])
    assert len(old) + len(new) == more.probe_count
    assert 0 < len(new) <= 12
    assert ((new > 3.2) & (new < 60.8))[:, [0, 2]].all()
    bench = SectorBaker(yards, settings_for("talk"), SUNS[:1], "test")
    assert not bench._solids.contain(new + HERE.origin).any()
    there = ProbeHint("forbid", (0.0, -1.0, 0.0), (64.0, 60.0, 64.0))
    none = baked(replace(yards, hints=(there,)), "fitted", reader_probes=12)[2].probe_position
    assert not ((none >= there.minimum) & (none <= there.maximum)).all(axis=1).any()
