"""A walk along the streets of a dataset, drawn from a seed: for players who are given no path.

From where the walker stands, rays go out over the lattice of street columns until something is in the way. Where they are longest, there
is a street; one is drawn, long ones and the one straight on more often. The walker follows it to the middle of the first crossing, which
is where the sides open and close again, and draws anew. A ray never leaves outdoor air, so neither does the walk; it turns back only
where nothing else is open. Everything is looked up column by column, so the walk knows nothing of sectors and reads those it sees.
"""

import math
from dataclasses import dataclass

import numpy as np

from gi_core.background import give_way
from gi_core.constants import VOXEL_SIZE_M
from gi_core.dataset import Dataset
from gi_core.errors import InputError
from gi_core.grid import SectorIndex, sector_of
from server.path_walk import Point
from server.street_lattice import StreetLattice

MIN_WALK_M, MAX_WALK_M = 10.0, 20_000.0
# How far one looks ahead; farther ones read more sectors than are walked through.
_SIGHT_M = 96.0
_DIRECTIONS = 48
# Local maxima are tried once more this much to either side, in steps between directions.
_REFINEMENTS = (-1 / 3, 1 / 3)
# A shorter run is no street, and one keeps this far from what ends it.
_SHORTEST_STREET_M, _KEPT_OFF_M = 24.0, 5.0
# A side that is open this far is a side street; one that stays open for longer than this is a square.
_SIDE_STREET_M, _WIDEST_STREET_M = 20.0, 48.0
_STRIDE_M = VOXEL_SIZE_M
_BACK_DEGREES, _STRAIGHT_DEGREES = 60.0, 12.0
_STRAIGHT_ON_BONUS = 3.0
_START_SECTORS, _START_COLUMNS = 8, 6
# On a slope levels change this seldom [columns]; what changes more often is stairs, or roofs.
_LEVEL_RUN = 4
# From good to bad: amid the street on the level; anywhere on the level; up or down too.
_AMID, _LEVEL, _SLOPE = range(3)
Place = tuple[float, float]


@dataclass(frozen=True)
class _Run:
    """A ray's free way: length_m, and where the level changes on it, (distance [m], height [m])."""

    length_m: float
    steps: tuple[tuple[float, float], ...] = ()


def walk_streets(dataset: Dataset, lattice: StreetLattice, seed: int, length_m: float, near: Point | None = None) -> tuple[Point, ...]:
    """Points of a walk of about ``length_m``, from the street closest to ``near`` or, without it, from somewhere in the city.

    Shorter where the streets end, as in a yard. Raises InputError when there is no street to start from.
    """
    rng = np.random.default_rng(seed)
    walker = _Walker(lattice, rng)
    at = _start_near(dataset, lattice, near) if near is not None else _start_anywhere(dataset, lattice, walker, rng)
    points = [_eye(lattice, at)]
    heading: float | None = None
    walked = 0.0
    while walked < length_m:
        leg = walker.next_leg(at, heading)
        if leg is None:
            break
        heading, run = leg
        distance = min(run.length_m, length_m - walked)
        dx, dz = _direction(heading)
        points += [(at[0] + s * dx, y, at[1] + s * dz) for s, y in run.steps if s < distance]
        at = at[0] + distance * dx, at[1] + distance * dz
        points.append(_eye(lattice, at))
        walked += distance
    return tuple(points)


class _Walker:
    """Sees and chooses. Headings are in degrees, 0 along -Z and 90 along +X."""

    def __init__(self, lattice: StreetLattice, rng: np.random.Generator) -> None:
        self._lattice = lattice
        self._rng = rng
        self._amid: dict[tuple[int, int], bool] = {}

    def next_leg(self, at: Place, heading: float | None) -> tuple[float, _Run] | None:
        """Where to go from a place that was reached with a heading, and how far; None when there is no way at all."""
        # Going back comes last, but before nothing.
        for back in (False, True):
            for kind in (_AMID, _LEVEL, _SLOPE):
                ways = [
                    (way, run)
                    for way, run in self._streets(at, kind)
                    if back or heading is None or abs(_turned(way - heading)) <= 180 - _BACK_DEGREES
                ]
                if ways:
                    way, run = self._drawn(ways, heading)
                    return way, self._to_crossing(at, way, run, kind)
        return None

    def sight_m(self, at: Place) -> float:
        """How far one sees along the longest street [m]."""
        return max((run.length_m for _, run in self._streets(at, _AMID)), default=0.0)

    def _drawn(self, ways: list[tuple[float, _Run]], heading: float | None) -> tuple[float, _Run]:
        odds = np.array([run.length_m**2 for _, run in ways])
        if heading is not None:
            odds *= [_STRAIGHT_ON_BONUS if abs(_turned(way - heading)) <= _STRAIGHT_DEGREES else 1.0 for way, _ in ways]
        return ways[int(self._rng.choice(len(ways), p=odds / odds.sum()))]

    def _streets(self, at: Place, kind: int) -> list[tuple[float, _Run]]:
        """Directions in which the way is free for longer than in those beside them."""
        step = 360 / _DIRECTIONS
        runs = [self._run(at, k * step, kind, _SIGHT_M) for k in range(_DIRECTIONS)]
        found = []
        for k, run in enumerate(runs):
            before, after = runs[k - 1].length_m, runs[(k + 1) % _DIRECTIONS].length_m
            if run.length_m >= _SHORTEST_STREET_M and run.length_m >= before and run.length_m > after:
                beside = [((k + part) * step % 360, self._run(at, (k + part) * step, kind, _SIGHT_M)) for part in _REFINEMENTS]
                found.append(max([(k * step, run), *beside], key=lambda way: way[1].length_m))
        if not found and (best := max(runs, key=lambda run: run.length_m)).length_m >= _SHORTEST_STREET_M:
            found.append((runs.index(best) * step, best))  # an open field
        return found

    def _to_crossing(self, at: Place, way: float, run: _Run, kind: int) -> _Run:
        """The part of a run up to the middle of the first crossing; without one, most of it."""
        dx, dz = _direction(way)
        open_since: float | None = None
        walled = False
        for k in range(1, int(run.length_m / _STRIDE_M)):
            s = k * _STRIDE_M
            place = at[0] + s * dx, at[1] + s * dz
            sides = (self._run(place, way + side, min(kind, _LEVEL), _SIDE_STREET_M).length_m for side in (-90.0, 90.0))
            if any(length >= _SIDE_STREET_M for length in sides):
                open_since = s if open_since is None else open_since
            else:
                if walled and open_since is not None and s - open_since <= _WIDEST_STREET_M:
                    return _Run((open_since + s - _STRIDE_M) / 2, run.steps)
                walled, open_since = True, None
        if walled and open_since is not None and run.length_m < _SIGHT_M and run.length_m - open_since <= _WIDEST_STREET_M:
            return _Run((open_since + run.length_m) / 2, run.steps)  # the street ends in another
        # What lies beyond sight is looked at from closer by.
        most = run.length_m * 0.75 if run.length_m >= _SIGHT_M else run.length_m - _KEPT_OFF_M
        return _Run(most, run.steps)

    def _run(self, at: Place, way: float, kind: int, most_m: float) -> _Run:
        """How far a ray gets from a place before it leaves the street (Amanatides and Woo's walk over the columns it crosses)."""
        give_way()
        (px, pz), (dx, dz) = (at[0] / VOXEL_SIZE_M, at[1] / VOXEL_SIZE_M), _direction(way)
        x, z = math.floor(px), math.floor(pz)
        step_x, next_x, per_x = _axis(px, x, dx)
        step_z, next_z, per_z = _axis(pz, z, dz)
        level = self._lattice.level(x, z)
        if level is None:
            return _Run(0.0)
        most = most_m / VOXEL_SIZE_M
        columns = _LEVEL_RUN
        steps: list[tuple[float, float]] = []
        while (t := min(next_x, next_z)) < most:
            if next_x < next_z:
                x, next_x = x + step_x, next_x + per_x
            else:
                z, next_z = z + step_z, next_z + per_z
            there = self._lattice.level(x, z)
            columns += 1
            if there is None or (kind == _AMID and not self._is_amid(x, z)):
                return _Run(t * VOXEL_SIZE_M, tuple(steps))
            if there != level:
                if kind != _SLOPE or abs(there - level) > 1 or columns < _LEVEL_RUN:
                    return _Run(t * VOXEL_SIZE_M, tuple(steps))
                # The edge that both voxels share.
                steps.append((t * VOXEL_SIZE_M, max(there, level) * VOXEL_SIZE_M))
                columns, level = 0, there
        return _Run(most_m, tuple(steps))

    def _is_amid(self, x: int, z: int) -> bool:
        """Whether a column has street on its four sides too."""
        found = self._amid.get((x, z))
        if found is None:
            level = self._lattice.level(x, z)
            found = self._amid[x, z] = all(self._lattice.level(x + i, z + k) == level for i, k in ((1, 0), (-1, 0), (0, 1), (0, -1)))
        return found


def _start_anywhere(dataset: Dataset, lattice: StreetLattice, walker: _Walker, rng: np.random.Generator) -> Place:
    """A place with a long view in one of a few sectors, drawn with odds by how much is built there."""
    sectors = sorted(dataset.world.sectors)
    built = np.array([1.0 + dataset.world.sectors[index].surfels for index in sectors])
    best, best_sight = None, -1.0
    for k in rng.choice(len(sectors), _START_SECTORS, p=built / built.sum()) if sectors else ():
        columns = lattice.columns_of(sectors[k])
        for c in rng.choice(len(columns), _START_COLUMNS) if columns else ():
            place = (columns[c][0] + 0.5) * VOXEL_SIZE_M, (columns[c][1] + 0.5) * VOXEL_SIZE_M
            sight = walker.sight_m(place)
            if sight > best_sight:
                best, best_sight = place, sight
        if best_sight >= _SIGHT_M * 0.75:
            break
    if best is None:
        raise InputError(f"{dataset.path}: expected a street to walk along, found none in {_START_SECTORS} sectors; give a path")
    return best


def _start_near(dataset: Dataset, lattice: StreetLattice, near: Point) -> Place:
    here = sector_of(np.array(near))
    columns = [c for i in (-1, 0, 1) for k in (-1, 0, 1) for c in lattice.columns_of(SectorIndex(here.x + i, here.z + k))]
    if not columns:
        raise InputError(f"{dataset.path}: expected a street near ({near[0]:g}, {near[2]:g}), found none; give a path")
    places = [((x + 0.5) * VOXEL_SIZE_M, (z + 0.5) * VOXEL_SIZE_M) for x, z in columns]
    return min(places, key=lambda place: (place[0] - near[0]) ** 2 + (place[1] - near[2]) ** 2)


def _eye(lattice: StreetLattice, at: Place) -> Point:
    height = lattice.eye_height(*at)
    assert height is not None, "a walk never leaves the street"
    return at[0], height, at[1]


def _direction(heading: float) -> Place:
    """Unit (x, z)."""
    return math.sin(math.radians(heading)), -math.cos(math.radians(heading))


def _turned(degrees: float) -> float:
    return (degrees + 180) % 360 - 180


def _axis(at: float, column: int, direction: float) -> tuple[int, float, float]:
    """Along an axis: which way columns go, how far the next one is, and how far apart they are."""
    if abs(direction) < 1e-9:
        return 0, math.inf, math.inf
    step = 1 if direction > 0 else -1
    return step, ((column + (direction > 0)) - at) / direction, 1 / abs(direction)
