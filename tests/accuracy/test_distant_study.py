"""Distant texels of a small street beside the path tracer: what all bounces are worth, by day, and at night under its lamps."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from bake_jobs.distant_study import texel_errors
from bake_jobs.path_tracer import PathTracer
from gi_core.dataset import Dataset
from gi_core.engine import Engine
from gi_core.grid import SectorIndex

GOLDEN = Path(__file__).parents[1] / "golden"
SECTORS = (SectorIndex(-1, 0), SectorIndex(0, 0))


@pytest.fixture(scope="module")
def engine(tmp_path_factory) -> Engine:
    city = tmp_path_factory.mktemp("distant") / "city"
    shutil.copytree(GOLDEN / "v4", city)
    shutil.copy(GOLDEN / "distant_v2" / "distant.gidist", city)
    return Engine(Dataset.open(city))


@pytest.fixture(scope="module")
def tracer(engine) -> PathTracer:
    parts = [engine.dataset.geometry(index) for index in SECTORS]
    first = len(parts[0].vertices)
    vertices = np.concatenate([part.vertices for part in parts])
    triangles = np.concatenate([parts[0].triangles, parts[1].triangles + first]).astype(np.int32)
    albedo, emission = (np.concatenate([getattr(part, name) for part in parts]) for name in ("albedo", "emission"))
    return PathTracer(vertices, triangles, albedo, emission)


# At night a sign and two lamps light parts of bricks, and the golden bake has a probe in 16 m.
@pytest.mark.parametrize(("moment", "most"), [(("12:00", "clear"), 0.06), (("23:30", "clear"), 0.2)])
def test_a_texel_in_full_is_near_the_path_tracer_and_by_the_sky_alone_far_from_it(engine, tracer, moment, most):
    found = texel_errors(tracer, engine, SECTORS, engine.lighting(*moment), samples=128)
    assert found["full"]["n"] == 12
    assert abs(found["full"]["bias"]) < most
    assert found["sky"]["bias"] < -0.4
    assert found["full"]["median"] < found["sky"]["median"] / 2
    # Two lights of the same probes: suns between the table's are all that tells them apart.
    assert found["relit"]["bias"] == pytest.approx(found["full"]["bias"], abs=0.005)
