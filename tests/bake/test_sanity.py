"""A bake that cannot be right is refused; one of an unusual place is not."""

from dataclasses import replace

import numpy as np
import pytest

from bake_jobs.sanity import NonsenseError, expect_sense
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
    with pytest.raises(NonsenseError, match=r"its 40 probes see nothing but sky, and its sectors have triangles"):
        sense(make_sector(1), probes=40, surfels=0)


def test_probes_that_see_no_light_do_not(build, bake_arrays):
    sector, _ = bake_arrays(build().ground().scene(), **QUICK)
    with pytest.raises(NonsenseError, match=r"under an even sky \d+ of \d+ outdoor probes of sector 0,0 get no light at all"):
        sense(replace(sector, factor_scale=np.zeros_like(sector.factor_scale)))


def test_surfels_without_a_normal_do_not(build, bake_arrays):
    sector, _ = bake_arrays(build().ground().scene(), **QUICK)
    for broken in (0.0, np.nan):
        with pytest.raises(NonsenseError, match="sector 0,0 has surfels without a normal"):
            sense(replace(sector, surfel_normal=np.full_like(sector.surfel_normal, broken)))
