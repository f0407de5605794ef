"""The parts of a shared probe's light are all of it but the sky's, and what is added to make them alike does so, and is served."""

from pathlib import Path

import numpy as np

from bake_jobs.seam_parts import PARTS, AlikeEngine, parts_of, shared_probes, to_mean
from gi_core.dataset import Dataset
from gi_core.grid import SectorIndex
from gi_core.relight_input import relight_input
from gi_core.relight_twin import gather_probes

GOLDEN = Path(__file__).parents[1] / "golden" / "v1"


def test_parts_and_the_sky_are_all_light():
    engine = AlikeEngine(Dataset.open(GOLDEN))
    engine.lamps = ()
    world, lighting = engine.dataset.world, engine.lighting("12:00", "clear")
    given = relight_input(lighting, world.sun_table, world.sky, world.sky_patches)
    for index in world.sectors:
        sector, lit = engine.dataset.sector(index), engine.lit_sector(index, lighting)
        black = np.zeros((sector.brick_count, 3), np.float32)
        of_sky = gather_probes(sector, np.concatenate([black, given.patch_exitance]))
        parts = parts_of(engine, index, lighting)
        assert len(parts) == len(PARTS)
        # A query's bounces have settled to 1e-5 of the brightest.
        np.testing.assert_allclose(parts.sum(axis=0) + of_sky, lit, atol=3e-5 * lit.max())


def test_with_the_mean_of_a_part_its_sectors_have_that_part_alike():
    rng = np.random.default_rng(0)
    here, there = SectorIndex(0, 0), SectorIndex(1, 0)
    parts = {here: rng.random((4, 3, 6, 3), np.float32), there: rng.random((4, 5, 6, 3), np.float32)}
    added = to_mean(parts, [[(here, 2), (there, 0)]], (1, 3))
    here_after, there_after = (parts[index][[1, 3], n].sum(axis=0) + added[index][n] for index, n in ((here, 2), (there, 0)))
    np.testing.assert_allclose(here_after, there_after, rtol=1e-6)
    np.testing.assert_allclose(here_after, (parts[here][[1, 3], 2] + parts[there][[1, 3], 0]).sum(axis=0) / 2, rtol=1e-6)
    assert not added[here][:2].any()
    assert not added[there][1:].any()


def test_what_is_added_is_served():
    engine = AlikeEngine(Dataset.open(GOLDEN))
    lighting, (index, *_) = engine.lighting("12:00", "clear"), sorted(engine.dataset.world.sectors)
    before = engine.lit_sector(index, lighting)
    engine.added = {(lighting.digest, index): np.ones_like(before)}
    np.testing.assert_array_equal(engine.lit_sector(index, lighting), before + 1)
    engine.added = {}
    np.testing.assert_array_equal(engine.lit_sector(index, lighting), before)


def test_probes_of_one_place_are_found_in_all_sectors_that_store_them():
    dataset = Dataset.open(GOLDEN)
    sectors = {index: dataset.sector(index) for index in dataset.world.sectors}
    found = shared_probes(sectors)
    assert found
    for copies in found:
        place = np.array([sectors[index].probe_position[number] + index.origin for index, number in copies])
        assert len({index for index, _ in copies}) == len(copies) > 1
        assert np.ptp(place, axis=0).max() < 0.02
