"""A bake that cannot be right is refused; one of an unusual place is not."""

from dataclasses import replace

import numpy as np
import pytest

from bake_jobs.config import settings_for
from bake_jobs.sanity import NonsenseError, expect_normals, expect_sense
from bake_jobs.sector_job import SectorBaker
from gi_core.dataset import SectorFacts
from gi_core.grid import SectorIndex

HERE = SectorIndex(0, 0)
QUICK = {"rays_per_face_edge": 4, "grid_spacing_m": 8.0, "wall_spacing_m": 16.0}


def sense(sector, **changed):
    counts = {"probes": sector.probe_count, "surfels": sector.surfel_count, "triangles": 12} | changed
    rest = dict.fromkeys(("bytes", "geometry_bytes", "factors", "bricks", "voxels", "probes_dead", "probes_dropped", "voxels_blind"), 1)
    expect_sense({HERE: SectorFacts(digest="", **rest, **counts)}, lambda _: sector, 6)


def test_a_street_makes_sense(build, bake_arrays):
    sense(bake_arrays(build().ground().box((20, 0, 20), (36, 12, 30)).scene(), **QUICK)[0])


def test_an_empty_plaza_makes_sense(build, bake_arrays):
    sense(bake_arrays(build().ground().scene(), **QUICK)[0])


def test_no_probe_and_nothing_at_all_make_sense(make_sector):
    sense(make_sector(1, probes=0))
    expect_sense({}, lambda _: pytest.fail("nothing to read"), 6)


def test_probes_that_see_only_sky_do_not(make_sector):
    with pytest.raises(NonsenseError, match=r"in 1 of 1 sectors 40 probes see nothing but sky, and there are triangles"):
        sense(make_sector(1), probes=40, surfels=0)


def test_probes_that_see_no_light_do_not(build, bake_arrays):
    sector, _ = bake_arrays(build().ground().scene(), **QUICK)
    with pytest.raises(NonsenseError, match=r"under an even sky \d+ of \d+ outdoor probes of sector 0,0 get no light at all"):
        sense(replace(sector, factor_scale=np.zeros_like(sector.factor_scale)))


def test_surfels_without_a_normal_do_not(build, bake_arrays):
    sector, _ = bake_arrays(build().ground().scene(), **QUICK)
    for broken in (0.0, np.nan):
        with pytest.raises(NonsenseError, match="sector 0,0 has surfels without a normal"):
            expect_normals(replace(sector, surfel_normal=np.full_like(sector.surfel_normal, broken)))


def test_a_baker_refuses_surfels_without_a_normal(build, monkeypatch):
    scene = build().ground().scene()
    baker = SectorBaker(scene, replace(settings_for("draft"), **QUICK), np.array([[0.0, 1.0, 0.0]]), "test")
    sector, meta = baker.bake_arrays(HERE, baker.cutter.cut(HERE))
    flat = replace(sector, surfel_normal=np.zeros_like(sector.surfel_normal))
    monkeypatch.setattr(baker, "_bake", lambda *_: (None, None, flat, meta))
    with pytest.raises(NonsenseError, match="sector 0,0 has surfels without a normal"):
        baker.bake(HERE)


def test_some_sectors_may_see_nothing_but_not_most(make_sector):
    sector = make_sector(1)
    rest = dict.fromkeys(("bytes", "geometry_bytes", "factors", "bricks", "voxels", "probes_dead", "probes_dropped", "voxels_blind"), 1)
    seeing = SectorFacts(digest="", probes=sector.probe_count, surfels=sector.surfel_count, triangles=12, **rest)
    facts = {SectorIndex(x, 0): seeing if x < 2 else replace(seeing, surfels=0) for x in range(5)}
    with pytest.raises(NonsenseError, match=r"in 3 of 5 sectors [\d,]+ probes see nothing but sky"):
        expect_sense(facts, lambda _: sector, 6)
    facts[SectorIndex(2, 0)] = seeing
    expect_sense(facts, lambda _: sector, 6)
