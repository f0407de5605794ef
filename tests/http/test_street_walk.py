"""Walks along streets: in outdoor air all the way, straight where the street is, the same for a seed, over borders of sectors."""

import math
import shutil
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gi_core.constants import VOXEL_OUTDOORS, VOXEL_SIZE_M
from gi_core.dataset import Dataset
from gi_core.errors import InputError
from gi_core.grid import SectorIndex, sector_of, voxel_centre, voxel_columns
from server.path_walk import Point
from server.players import Player
from server.street_lattice import StreetLattice
from server.street_walk import walk_streets

Level = Callable[[int, int], int | None]


class DrawnLattice(StreetLattice):
    """Streets by a rule instead of by files."""

    def __init__(self, level: Level) -> None:
        self.level = level  # type: ignore[method-assign, assignment]

    def columns_of(self, index: SectorIndex) -> list[tuple[int, int]]:
        (x0, x1), (z0, z1) = voxel_columns(index.x), voxel_columns(index.z)
        return [(x, z) for z in range(z0, z1) for x in range(x0, x1) if self.level(x, z) == 0]


def world(*sectors: SectorIndex) -> Any:
    return SimpleNamespace(path=Path("drawn"), world=SimpleNamespace(sectors={index: SimpleNamespace(surfels=100) for index in sectors}))


def grid_city(x: int, z: int) -> int | None:
    """Streets five columns wide, 94 m apart one way and 62 m the other; an edge far out."""
    return 0 if (x % 30 < 5 or z % 20 < 5) and max(abs(x), abs(z)) < 400 else None


def turned_city(x: int, z: int) -> int | None:
    """The same at 30 degrees to the axes."""
    u, v = 0.866 * x + 0.5 * z, 0.866 * z - 0.5 * x
    return 0 if u % 30 < 6 or v % 24 < 6 else None


def hill_city(x: int, z: int) -> int | None:
    """Along x it rises by a voxel in 12: a slope of 8 %."""
    return x // 12 if grid_city(x, z) is not None else None


HERE = world(SectorIndex(0, 0), SectorIndex(1, -1), SectorIndex(-2, 1))


def samples(points: tuple[Point, ...]) -> np.ndarray:
    """Places every quarter of a metre."""
    corners = np.array(points)
    parts = [a + np.linspace(0, 1, max(int(math.dist(a, b) * 4), 2))[:, None] * (b - a) for a, b in pairwise(corners)]
    return np.concatenate(parts)


def length(points: tuple[Point, ...]) -> float:
    return sum(math.dist(a, b) for a, b in pairwise(points))


def assert_stays_in_air(points: tuple[Point, ...], level: Level) -> None:
    for x, y, z in samples(points) / VOXEL_SIZE_M:
        found = level(math.floor(x), math.floor(z))
        assert found is not None
        assert found - 1e-9 <= y <= found + 1 + 1e-9


@pytest.mark.parametrize("city", [grid_city, turned_city, hill_city])
@pytest.mark.parametrize("seed", range(3))
def test_a_walk_stays_in_the_street_and_goes_as_far_as_asked(city: Level, seed: int) -> None:
    points = walk_streets(HERE, DrawnLattice(city), seed, 1500.0)
    assert length(points) == pytest.approx(1500, rel=0.02)  # a slope is a little longer than its plan
    assert_stays_in_air(points, city)
    assert len({sector_of(place) for place in samples(points)}) >= 8


def test_a_walk_is_decided_by_its_seed() -> None:
    walks = [walk_streets(HERE, DrawnLattice(grid_city), seed, 400.0) for seed in (1, 1, 2, 3)]
    assert walks[0] == walks[1]
    assert len(set(walks)) == 3
    # A longer walk begins with the shorter one.
    assert walk_streets(HERE, DrawnLattice(grid_city), 1, 800.0)[: len(walks[0]) - 1] == walks[0][:-1]


def turns_degrees(points: tuple[Point, ...]) -> np.ndarray:
    legs = np.diff(np.array(points), axis=0)
    heading = np.degrees(np.arctan2(legs[:, 0], -legs[:, 2]))
    return np.abs((np.diff(heading) + 180) % 360 - 180)


def test_a_walk_goes_straight_and_turns_at_crossings() -> None:
    turns: list[float] = []
    for seed in range(6):
        points = walk_streets(HERE, DrawnLattice(grid_city), seed, 2000.0)
        found = turns_degrees(points)
        turns += found.tolist()
        for (x, _, z), turn in zip(points[1:-1], found, strict=True):
            # Amid the crossing: both streets' middle columns.
            assert turn < 1e-6 or (math.floor(x / VOXEL_SIZE_M) % 30 in (1, 2, 3) and math.floor(z / VOXEL_SIZE_M) % 20 in (1, 2, 3))
    turned = sum(turn > 12 for turn in turns)
    # 12 km past some 160 crossings: at a good many one turns, most are crossed straight on, and nowhere one goes back.
    assert 20 < turned < 0.6 * len(turns)
    assert max(turns) < 91


def test_a_walk_in_a_yard_turns_back_and_one_in_a_shaft_stands() -> None:
    def yard(x: int, z: int) -> int | None:
        return 0 if 0 <= x < 12 and 4 <= z < 9 else None

    points = walk_streets(HERE, DrawnLattice(yard), 5, 300.0)
    assert_stays_in_air(points, yard)
    assert length(points) == pytest.approx(300)
    shaft = DrawnLattice(lambda x, z: 0 if (x, z) == (3, 3) else None)
    assert len(walk_streets(HERE, shaft, 5, 300.0, near=(10.0, 1.6, 10.0))) == 1


def test_a_walk_needs_a_street_to_start_from() -> None:
    nowhere = DrawnLattice(lambda _x, _z: None)
    for place, near in ((HERE, None), (world(), None), (HERE, (5.0, 1.6, 5.0))):
        with pytest.raises(InputError, match=r"street.*give a path"):
            walk_streets(place, nowhere, 1, 100.0, near)


def test_a_walk_starts_where_it_is_asked_to() -> None:
    for near in ((10.0, 1.6, 140.0), (-300.0, 1.6, 77.0)):
        x, _, z = walk_streets(HERE, DrawnLattice(grid_city), 1, 100.0, near)[0]
        assert math.dist((x, z), near[::2]) < 50


def test_a_baked_citys_walk_is_in_outdoor_air(city: Path) -> None:
    dataset = Dataset.open(city)
    voxels = {index: dataset.sector(index) for index in dataset.world.sectors}
    for seed in range(3):
        lattice = StreetLattice(dataset)
        points = walk_streets(dataset, lattice, seed, 500.0)
        assert length(points) == pytest.approx(500)
        assert lattice.sectors_read <= len(voxels)
        for place in samples(points):
            voxel = np.floor(place / VOXEL_SIZE_M).astype(int)
            sector = voxels[sector_of(voxel_centre(voxel))]  # on a border not always the one that holds the place
            x, y, z = voxel - sector.voxel_first
            assert sector.voxel_class[y, z, x] == VOXEL_OUTDOORS
            assert sector.voxel_class[y - 1, z, x] != VOXEL_OUTDOORS
        assert len({sector_of(place) for place in samples(points)}) >= 2


def test_the_lattice_is_what_the_sectors_say(city: Path) -> None:
    dataset = Dataset.open(city)
    lattice = StreetLattice(dataset)
    for index in dataset.world.sectors:
        sector = dataset.sector(index)
        x0, y0, z0 = sector.voxel_first.tolist()
        for z, x in np.ndindex(sector.voxel_class.shape[1:]):
            column = sector.voxel_class[:, z, x]
            lowest = int(np.flatnonzero(column)[0]) if column.any() else 0
            expected = y0 + lowest if lowest > 0 and column[lowest] == VOXEL_OUTDOORS else None
            assert lattice.level(x0 + x, z0 + z) == expected
    assert lattice.level(10**6, 0) is None
    assert lattice.eye_height(1e7, 0.0) is None
    assert lattice.columns_of(SectorIndex(900, 900)) == []
    assert lattice.sectors_read == len(dataset.world.sectors)  # what lies beyond them is not kept: of that there is no end
    middle = lattice.eye_height(5.0, 30.0)
    assert middle is not None
    assert 0 < middle < 4


def test_nobody_walks_in_a_sector_whose_file_is_damaged(city: Path, tmp_path: Path) -> None:
    shutil.copytree(city, tmp_path / "city")
    dataset = Dataset.open(tmp_path / "city")
    whole = StreetLattice(dataset)
    first, second = [index for index in sorted(dataset.world.sectors) if whole.columns_of(index)][:2]
    path = dataset.sector_path(first)
    path.write_bytes(path.read_bytes()[:-7])
    lattice = StreetLattice(dataset)
    assert lattice.columns_of(first) == []
    assert lattice.columns_of(second) == whole.columns_of(second)


def test_a_player_without_a_path_walks_back_and_forth_along_streets(city: Path) -> None:
    dataset = Dataset.open(city)
    lattice = StreetLattice(dataset)
    walk = Player("p", speed=5.0, seed=3, walk_m=200.0, loop=True).walk(dataset, lattice)
    assert walk.length_m == pytest.approx(400)
    assert walk.lap_s == pytest.approx(80)
    assert walk.at(0).position == walk_streets(dataset, lattice, 3, 200.0)[0]
    assert math.dist(walk.at(30.0).position, walk.at(50.0).position) < 1e-6
    given = Player("p", speed=5.0, path=((0, 1, 0), (10, 1, 0), (10, 1, 10)), loop=True).walk(dataset, lattice)
    assert given.length_m == pytest.approx(20 + math.hypot(10, 10))
