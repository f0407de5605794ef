"""Coarse voxels against plain loops over the lattice's own voxels, and what a second look at them costs."""

from dataclasses import replace

import numpy as np
import pytest

from gi_core.coarse_volume import CoarseSums, KeptCoarse, coarse_voxels, covered_sectors
from gi_core.constants import VOXEL_INDOORS, VOXEL_NO_SECTOR, VOXEL_OUTDOORS, VOXEL_SOLID
from gi_core.grid import SectorIndex, voxel_columns
from gi_core.rooms import outdoor_blend

WEST, EAST = SectorIndex(0, 0), SectorIndex(1, 0)


def at(sector, index, seed):
    """A random sector moved to another place, and light of its probes (P, 6, 3)."""
    shape = [voxel_columns(n)[1] - voxel_columns(n)[0] for n in (index.z, index.x)]
    first = np.array([voxel_columns(index.x)[0], -3, voxel_columns(index.z)[0]], np.int32)
    grow = [(0, 0), (0, shape[0] - 20), (0, shape[1] - 20)]
    fields = ("voxel_class", "voxel_room", "voxel_probe", "voxel_weight")
    grown = {
        f: np.pad(getattr(sector, f), grow[: getattr(sector, f).ndim] + [(0, 0)] * (getattr(sector, f).ndim - 3), "edge") for f in fields
    }
    cubes = np.random.default_rng(seed).uniform(0, 100, (sector.probe_count, 6, 3)).astype(np.float32)
    return replace(sector, index=index, voxel_first=first, **grown), cubes


@pytest.fixture
def pair(make_sector):
    return [at(make_sector(1, probes=9), WEST, 11), at(make_sector(2, probes=7), EAST, 12)]


def filled(parts, first, cascade):
    sums = CoarseSums(first, 6)
    for sector, cubes in parts:
        sums.add(coarse_voxels(sector, cascade), cubes)
    return sums.finish()


def plainly(parts, first, cascade, voxel):
    """Class and mean light (6, 3) of one voxel (x, y, z) of the volume, None where no lit sector has a part in it."""
    low = (first + voxel) << cascade
    seen, lit = [], []
    for x, y, z in np.ndindex(*[1 << cascade] * 3):
        for sector, cubes, (probe, weight) in parts:
            here = low + np.array([x, y, z]) - sector.voxel_first
            sy, sz, sx = sector.voxel_class.shape
            if not (0 <= here[0] < sx and 0 <= here[2] < sz):
                continue
            place = int(np.clip(here[1], 0, sy - 1)), int(here[2]), int(here[0])
            kind = int(sector.voxel_class[place]) if here[1] >= 0 else VOXEL_SOLID
            seen.append(kind)
            if len(cubes):
                lit.append((kind, np.einsum("k,kbc->bc", weight[place], cubes[probe[place]])))
    order = [VOXEL_OUTDOORS, VOXEL_INDOORS, VOXEL_SOLID]
    best = next((kind for kind in order if kind in seen), VOXEL_NO_SECTOR)
    lights = next(([light for kind, light in lit if kind == wanted] for wanted in order if any(k == wanted for k, _ in lit)), None)
    return best, None if lights is None else np.mean(lights, axis=0)


@pytest.mark.parametrize("cascade", [1, 2, 3])
@pytest.mark.parametrize("lit", [(True, True), (True, False)])
def test_a_coarse_voxel_is_the_mean_of_the_best_air_inside(pair, cascade, lit):
    """Where a sector has no probe, what it shares with its neighbour is as bright as the neighbour says."""
    parts = [part if has else (without_probes(part[0]), part[1][:0]) for part, has in zip(pair, lit, strict=True)]
    blended = [(sector, cubes, outdoor_blend(sector)) for sector, cubes in parts]
    step, rng = 1 << cascade, np.random.default_rng(cascade)
    first = np.array([14 // step - 2, -7 // step - 2, -2])
    values, mask, has_light = filled(parts, first, cascade)
    border = 20 // step - first[0]  # the column that both sectors have a part in, or the first of the eastern one's
    near = [[border, y, 3] for y in range(16)]
    anywhere = np.stack([rng.integers(0, min(44 // step + 4, 32), 12), rng.integers(0, 12, 12), rng.integers(0, 8, 12)], axis=1)
    for voxel in np.concatenate([near, anywhere]):
        x, y, z = voxel
        kind, light = plainly(blended, first, cascade, voxel)
        assert mask[y, z, x] == kind
        if light is None:
            assert not values[:, y, z, x].any()
        else:
            assert has_light[z, x]
            # float32 sums of up to 512 voxels' weights
            np.testing.assert_allclose(values[:, y, z, x], light, rtol=2e-5)


def without_probes(sector):
    none = {f: getattr(sector, f)[:0] for f in ("probe_position", "probe_flags", "probe_room")}
    return replace(sector, voxel_probe=0 * sector.voxel_probe, voxel_weight=0 * sector.voxel_weight, **none)


def test_beyond_what_a_sector_stores_its_ends_go_on(pair):
    """Far above is its highest layer, far below its lowest, as solid."""
    sector, cubes = pair[0]
    first = np.array([-12, -60, -12])
    values, mask, _ = filled([(sector, cubes)], first, 1)
    low, high = values[:, 3, 14, 14], filled([(sector, cubes)], np.array([-12, 40, -12]), 1)[0][:, 3, 14, 14]
    assert mask[3, 14, 14] == VOXEL_SOLID
    probe, weight = outdoor_blend(sector)
    for layer, found in ((0, low), (-1, high)):
        light = np.einsum("zxk,zxkbc->zxbc", weight[layer], cubes[probe[layer]])[4:6, 4:6]
        kind = sector.voxel_class[layer, 4:6, 4:6]
        counts = kind == (VOXEL_SOLID if layer == 0 else next(k for k in (VOXEL_OUTDOORS, VOXEL_INDOORS, VOXEL_SOLID) if (kind == k).any()))
        expected = light.mean(axis=(0, 1)) if layer == 0 else light[counts].mean(axis=0)
        np.testing.assert_allclose(found, expected, rtol=2e-5)


@pytest.mark.parametrize("cascade", [1, 2, 3])
def test_every_sector_under_the_volume_is_covered(cascade):
    first = np.array([-5, 0, 3])
    step = 3.125 * 2**cascade
    low, high = (first[[0, 2]] * step) // 64, ((first[[0, 2]] + 32) * step - 1.6) // 64
    expected = {(x, z) for x in np.arange(low[0], high[0] + 1) for z in np.arange(low[1], high[1] + 1)}
    assert {tuple(index) for index in covered_sectors(first, cascade)} == expected


def test_coarse_voxels_are_worked_out_once_and_forgotten_when_there_are_too_many(pair):
    sectors, reads = {sector.index: sector for sector, _ in pair}, []

    def read(index):
        reads.append(index)
        return sectors[index]

    size = coarse_voxels(sectors[WEST], 1).nbytes
    kept = KeptCoarse(int(size * 1.5))
    first = kept.get(WEST, 1, read)
    assert kept.get(WEST, 1, read) is first
    assert reads == [WEST]
    kept.get(EAST, 1, read)
    again = kept.get(WEST, 1, read)
    assert reads == [WEST, EAST, WEST]
    for name in ("kind", "count", "starts", "probe", "weight"):
        np.testing.assert_array_equal(getattr(again, name), getattr(first, name))
