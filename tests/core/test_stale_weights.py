"""Which voxels a moving box belies, beside points walked along every line from a voxel to its probes."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from gi_core.constants import VOLUME_SHAPE, VOXEL_SIZE_M
from gi_core.dataset import Dataset
from gi_core.grid import SectorIndex, volume_first_voxel, voxel_centre
from gi_core.rooms import outdoor_blend
from gi_core.shadow_plan import MovingBox
from gi_core.stale_weights import boxes_in_reach, stale_share

GOLDEN = Path(__file__).parents[1] / "golden" / "v1"
STREET = np.array([5.0, 2.0, 30.0])
FIRST = volume_first_voxel(STREET)
EAST = np.array([1.0, 0.0, 0.0])
STEPS = 400


@pytest.fixture(scope="module")
def dataset() -> Dataset:
    return Dataset.open(GOLDEN)


def share_of(dataset: Dataset, *boxes: MovingBox) -> np.ndarray:
    return stale_share(dataset.sector, dataset.world.sectors, boxes, FIRST)


def inside(points: np.ndarray, box: MovingBox, wider: float) -> np.ndarray:
    turn = np.radians(box.turned_degrees)
    away = points - box.position
    own = [away @ axis for axis in ((np.cos(turn), 0, -np.sin(turn)), (0, 1, 0), (np.sin(turn), 0, np.cos(turn)))]
    return np.all([np.abs(part) <= half + wider for part, half in zip(own, box.half_size, strict=True)], axis=0)


@pytest.mark.parametrize("turned", [0.0, 30.0, 90.0, -135.0])
def test_a_door_hides_what_lies_behind_it_and_no_more(dataset, turned):
    box = MovingBox((7.0, 3.0, 28.0), (6.0, 2.5, 0.05), turned)
    share = share_of(dataset, box)
    assert 0 < np.count_nonzero(share) < share.size / 2
    sector = dataset.sector(SectorIndex(0, 0))
    probe, weight = outdoor_blend(sector)
    ny, nz, nx = sector.voxel_class.shape
    lattice = np.argwhere(np.ones((nx, ny, nz))) + sector.voxel_first
    seen_by_player = ((lattice >= FIRST) & (lattice < FIRST + np.array(VOLUME_SHAPE)[[2, 0, 1]])).all(axis=1)
    near = np.linalg.norm(voxel_centre(lattice) - box.position, axis=1) < 12.0
    places = np.random.default_rng(1).permutation(lattice[seen_by_player & near])[:300]
    seen = {True: 0, False: 0}
    for place in places:
        stored = tuple((place - sector.voxel_first)[[1, 2, 0]])
        shown = tuple((place - FIRST)[[1, 2, 0]])
        way = np.linspace(0, 1, STEPS)[:, None, None]
        start, end = voxel_centre(place), sector.probe_position[probe[stored]].astype(float)
        points = start + way * (end - start)
        step = np.linalg.norm(end - start, axis=1) / STEPS
        # A point in the box proves that it is crossed; where none comes within a step of it, it is not.
        least = (weight[stored] * inside(points, box, 0.0).any(axis=0)).sum()
        most = (weight[stored] * np.stack([inside(points[:, k], box, step[k]).any() for k in range(len(step))])).sum()
        assert least - 1e-6 <= share[shown] <= most + 1e-6
        seen[bool(least > 0)] += 1
    assert min(seen.values()) >= 20


def test_a_box_around_everything_hides_everything(dataset):
    share = share_of(dataset, MovingBox((0.0, 0.0, 0.0), (100.0, 100.0, 100.0)))
    assert np.isclose(share[share > 0], 1.0, atol=1e-5).all()
    assert (share > 0).mean() > 0.5


def test_without_boxes_or_far_from_them_nothing_is_stale(dataset):
    assert not share_of(dataset).any()
    assert not share_of(dataset, MovingBox((0.0, 80.0, 0.0), (1.0, 1.0, 1.0))).any()
    assert not stale_share(dataset.sector, (), [MovingBox((5.0, 2.0, 30.0), (9.0, 9.0, 9.0))], FIRST).any()


def test_boxes_in_reach_are_those_that_may_touch_the_volume():
    low = FIRST * VOXEL_SIZE_M
    high = low + np.array(VOLUME_SHAPE)[[2, 0, 1]] * VOXEL_SIZE_M
    touching = MovingBox(tuple(high + EAST * 0.9), (1.0, 0.1, 0.1), 45.0)
    boxes = (MovingBox(tuple(STREET), (0.1, 0.1, 0.1)), touching, dataclasses.replace(touching, position=tuple(high + EAST * 1.2)))
    assert boxes_in_reach(boxes, FIRST) == boxes[:2]
