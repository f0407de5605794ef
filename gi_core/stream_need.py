"""Which sectors players need, and how soon: the geometry under stream_plan. Pure; arrays in, arrays out.

    the volume now        100 x 100 m, exactly the sectors that volume.plan_boxes reads: needed at once
    + load margin         around the volume as it moves on along its velocity: wanted, by the time at which it gets there
    + keep margin         on all sides, as far as look-ahead reaches: worth keeping, by the time it takes to come back

The load margin is less than the keep margin, so a player who walks to and fro over a border loads nothing twice.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from gi_core.arrays import AnyArray, Bool, Float64, Int64
from gi_core.constants import SECTOR_SIZE_M, VOLUME_SHAPE, VOXEL_SIZE_M
from gi_core.grid import SectorIndex

_HALF_VOLUME_M = VOLUME_SHAPE[1] * VOXEL_SIZE_M / 2
# Sector coordinates stay below this by far: (x, z) is one integer, sorted by x.
_KEY_STRIDE = 1 << 32
# Who stands may start to walk; no gap is further away in time than a walk.
_WALKING_M_S = 1.5
# Slower than this [m/s] a velocity divides like this one: it gets nowhere within any look-ahead.
_STANDING_M_S = 1e-6
# Below any time: what a volume reads is needed now.
_TOUCHED = -1.0
# Larger rectangles around a world are not held in memory; its sectors are searched instead, at ten times the cost.
_MOST_GRID_CELLS = 1 << 22
# Players are told apart by how many sectors they reach: up to this many beyond the first, twice as many, and so on.
_SLOW_REACH, _KINDS = 7, 64
# Fewer pairs of players and sectors than this are not worth telling apart.
_FEW_PAIRS = 4096


@dataclass(frozen=True, eq=False)
class SectorTable:
    """The sectors that a world has; arrays about sectors have one row for each, in this order.

    sectors : in the order of (x, z)
    places : (n, 2) int64, x and z of each
    bytes : (n,) int64, what each takes when it is resident: never less than it turns out to take
    """

    sectors: tuple[SectorIndex, ...]
    places: Int64
    bytes: Int64
    _key: Int64
    # Rows by x and z, with a border of sectors that are not there, and the sector of its first cell.
    _grid: Int64 | None
    _grid_first: tuple[int, int]

    @classmethod
    def of(cls, sizes: Mapping[SectorIndex, int]) -> "SectorTable":
        """The table of sectors and their bytes, each at least 1."""
        sectors = tuple(sorted(sizes))
        if any(sizes[index] < 1 for index in sectors):
            raise ValueError("a resident sector takes at least one byte")
        places = np.array(sectors, np.int64).reshape(-1, 2)
        sizes_in_order = np.array([sizes[index] for index in sectors], np.int64)
        grid = _grid_of(places)
        first = (0, 0) if grid is None else (int(places[:, 0].min()) - 1, int(places[:, 1].min()) - 1)
        return cls(sectors, places, sizes_in_order, _keys(places[:, 0], places[:, 1]), grid, first)

    def rows(self, x: Int64, z: Int64) -> Int64:
        """Rows of sectors (x, z), any shapes that broadcast; n where the world has none."""
        if self._grid is not None:
            width, depth = self._grid.shape
            column = np.minimum(np.maximum(x - self._grid_first[0], 0), width - 1)  # np.clip takes twice as long
            line = np.minimum(np.maximum(z - self._grid_first[1], 0), depth - 1)
            return np.asarray(self._grid.take(column * depth + line))
        key = _keys(x, z)
        row = np.minimum(np.searchsorted(self._key, key), len(self._key) - 1)
        return np.where(self._key[row] == key, row, len(self._key))


@dataclass(frozen=True, eq=False)
class Needs:
    """How much each sector of a table is needed, (n,) each; the least over all players.

    touched : whether a volume reads it now
    ahead_s : when a volume with its load margin gets there, going on as it does [s]; inf beyond the look-ahead
    keep_s : when a volume could need it, whichever way its player turns [s]; 0 where touched, inf beyond the keep margin
    away_m : from the nearest player within whose keep margin it lies, the greater of the distances along x and z [m]; inf without one
    """

    touched: Bool
    ahead_s: Float64
    keep_s: Float64
    away_m: Float64


def sector_needs(
    table: SectorTable, positions: Float64, velocities: Float64, *, look_ahead_s: float, load_margin_m: float, keep_margin_m: float
) -> Needs:
    """What players at finite positions (p, 3) [m] with velocities (p, 3) [m/s] need of a world."""
    # The last row gathers what players would need of sectors that are not there.
    count = len(table.sectors)
    ahead, keep, away = np.full((3, count + 1), np.inf)
    if count:
        at, velocity = (np.ascontiguousarray(vectors[:, [0, 2]].T, np.float64) for vectors in (positions, velocities))
        reach = _HALF_VOLUME_M + keep_margin_m + np.abs(velocity) * look_ahead_s
        first, last = (np.floor((at + side * reach) / SECTOR_SIZE_M).astype(np.int64) for side in (-1, 1))
        for group in _of_like_reach(last - first):
            axes = _Axes.of(at[:, group], velocity[:, group], first[:, group], last[:, group], _HALF_VOLUME_M + load_margin_m, look_ahead_s)
            _gather((ahead, keep, away), table, axes)
    return Needs(keep[:-1] == _TOUCHED, ahead[:-1], np.maximum(keep[:-1], 0.0), away[:-1])


def distance_m(places: Int64, positions: Float64) -> Float64:
    """(n,) [m]: from each sector (n, 2) to the nearest of some players (p, 3), 0 inside it; inf without players.

    The greater of the distances along x and z. n x p work: for the few sectors that something has to be decided about.
    """
    if len(positions) == 0:
        return np.full(len(places), np.inf)
    beyond = np.zeros((len(places), len(positions)))
    for axis, coordinate in enumerate((positions[:, 0], positions[:, 2])):
        low = (places[:, axis] * SECTOR_SIZE_M)[:, None] - coordinate
        np.maximum(beyond, np.maximum(low, -SECTOR_SIZE_M - low), out=beyond)
    return np.asarray(beyond.min(axis=1))


def _keys(x: Int64, z: Int64) -> Int64:
    return x * _KEY_STRIDE + z


def _grid_of(places: Int64) -> Int64 | None:
    """Rows of all sectors of the rectangle around a world; None for a world that is mostly gaps, or empty."""
    if len(places) == 0:
        return None
    low, high = places.min(axis=0) - 1, places.max(axis=0) + 1
    width, depth = (high - low + 1).tolist()
    if width * depth > _MOST_GRID_CELLS:
        return None
    grid = np.full((width, depth), len(places), np.int64)
    grid[places[:, 0] - low[0], places[:, 1] - low[1]] = np.arange(len(places))
    return grid


def _of_like_reach(more: Int64) -> list[Int64 | slice]:
    """Players, grouped so that one who drives does not make all others look as far; more (2, p): sectors beyond the first."""
    players = more.shape[1]
    if players == 0:
        return []
    if more.max() <= _SLOW_REACH or players * int(more.max() + 1) ** 2 <= _FEW_PAIRS:
        return [slice(None)]
    size = np.ceil(np.log2(np.maximum(more / _SLOW_REACH, 1.0))).astype(np.int64)
    kind = size[0] * _KINDS + size[1]
    return [np.flatnonzero(kind == k) for k in np.unique(kind)]


@dataclass(frozen=True, eq=False)
class _Axes:
    """Along x and z, of each of the sectors within reach and each player, (2, k, p). Of the two axes the worse one counts.

    sector : its coordinate; away : how far off it is [m]
    keep : how long the volume takes to it at the player's speed [s]; _TOUCHED where the volume reads it
    enter, leave : when the volume with its load margin meets it, 0 at the earliest, and leaves it, the look-ahead at the latest [s]
    """

    sector: Int64
    away: Float64
    keep: Float64
    enter: Float64
    leave: Float64

    @classmethod
    def of(cls, at: Float64, velocity: Float64, first: Int64, last: Int64, half_m: float, look_ahead_s: float) -> "_Axes":
        sector = np.minimum(first[:, None] + np.arange(int((last - first).max()) + 1)[:, None], last[:, None])
        low = sector * SECTOR_SIZE_M - at[:, None]
        high = low + SECTOR_SIZE_M
        away = np.maximum(np.maximum(low, -high), 0.0)
        keep = np.maximum(away - _HALF_VOLUME_M, 0.0) / np.maximum(np.hypot(*velocity), _WALKING_M_S)
        volume_first, volume_last = _volume_sectors(at)
        np.putmask(keep, (sector >= volume_first[:, None]) & (sector <= volume_last[:, None]), _TOUCHED)
        velocity = np.where(np.abs(velocity) < _STANDING_M_S, _STANDING_M_S, velocity)[:, None]
        a, b = (low - half_m) / velocity, (high + half_m) / velocity
        return cls(sector, away, keep, np.maximum(np.minimum(a, b), 0.0), np.minimum(np.maximum(a, b), look_ahead_s))


def _gather(least: tuple[Float64, Float64, Float64], table: SectorTable, axes: _Axes) -> None:
    """Take a group of players' needs into the least (ahead, keep, away) of all.

    What two axes say of a sector together is (k, k, p): players last, since they are many.
    """

    def across(values: AnyArray) -> tuple[AnyArray, AnyArray]:
        return values[0][:, None], values[1][None]

    row = table.rows(*across(axes.sector)).reshape(-1)
    ahead = np.maximum(*across(axes.enter))
    np.putmask(ahead, ahead > np.minimum(*across(axes.leave)), np.inf)
    keep = np.minimum(np.maximum(*across(axes.keep)), ahead)
    for target, values in zip(least, (ahead, keep, np.maximum(*across(axes.away))), strict=True):
        np.minimum.at(target, row, values.reshape(-1))


def _volume_sectors(at: Float64) -> tuple[Int64, Int64]:
    """First and last sector along each axis that the volume at (2, p) [m] reads, as volume.plan_boxes has it."""
    voxels = VOLUME_SHAPE[1]
    first_voxel = np.round(at / VOXEL_SIZE_M) - voxels // 2
    first, last = (np.floor((first_voxel + k + 0.5) * VOXEL_SIZE_M / SECTOR_SIZE_M).astype(np.int64) for k in (0, voxels - 1))
    return first, last
