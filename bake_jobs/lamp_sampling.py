"""Lamps for the judge: at each point of a path one lamp is drawn, and one point on it.

Which lamp is drawn depends on the cell of space that the point lies in: with a probability in proportion to intensity over squared
distance from the cell's centre, among the lamps whose range reaches into the cell. So hundreds of lamps cost no more shadow rays than
one, and every lamp that can shine somewhere has a chance there: the estimate is unbiased, and facing, shadow and cone are noise only.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gi_core.arrays import Float32, Float64, Int64
from gi_core.layout import LOCAL_AREA, LOCAL_SPOT
from gi_core.lights import light_records, unit_direction
from gi_core.spectrum import LUMINANCE_FROM_RGB
from gi_core.world import Lamp

# Within a cell the true odds differ from the drawn ones; street lamps hang 4 to 10 m up, so they do not differ by much.
CELL_M = 4.0
_HALF_DIAGONAL_M = CELL_M * np.sqrt(3.0) / 2
# A path may end in a lamp; closer than this its light counts as from here.
NEAREST_M = 1e-3
# Entries of a table of cells by lamps: 8 MB.
_TABLE_ENTRIES = 1 << 20


@dataclass(frozen=True, eq=False)
class LampSamples:
    """One drawn lamp for each point that any lamp may reach.

    point : (m,) int64, which of the points asked for
    direction : (m, 3) float32, unit, towards the drawn point of the lamp
    distance : (m,) float32 [m]
    irradiance : (m, 3) float32 [lx] on a surface that faces it, without shadow, over the probability of the draw
    """

    point: Int64
    direction: Float32
    distance: Float32
    irradiance: Float32


class LampSampler:
    """Draws from a set of lamps. Read-only once built; safe to share between threads."""

    def __init__(self, lamps: Sequence[Lamp]) -> None:
        """The lamps that are on, each as ``check_lamp`` wants it."""
        records = light_records(lamps, np.zeros(3))
        self.count = len(lamps)
        self._position = np.array([lamp.position for lamp in lamps], np.float64).reshape(-1, 3)
        self._range = np.array([lamp.range_m for lamp in lamps], np.float64)
        self._axis = np.array([unit_direction(lamp) for lamp in lamps], np.float64).reshape(-1, 3)
        self._kind = records["kind"]
        self._cos_outer, self._cos_inner = records["cos_outer"].astype(np.float64), records["cos_inner"].astype(np.float64)
        # From one corner of an area along its sides; a point's are 0.
        self._sides = 2 * np.stack([records["half_u"][:, :3], records["half_v"][:, :3]], axis=1).astype(np.float64)
        area = np.linalg.norm(np.cross(self._sides[:, 0], self._sides[:, 1]), axis=1)
        # What an area sends along its normal is its radiance times its surface [cd].
        self._intensity = records["intensity"][:, :3] * np.where(self._kind == LOCAL_AREA, area, 1.0)[:, None]
        self._strength = self._intensity @ LUMINANCE_FROM_RGB

    def draw(self, points: Float64, rng: np.random.Generator) -> LampSamples:
        """Draw a lamp, and a point on it, for each of the points (n, 3) [m], world frame, that one may reach."""
        lamp, probability = self._choose(points, rng.random(len(points)))
        reached = np.flatnonzero(probability > 0)
        lamp = lamp[reached]
        from_middle = self._position[lamp] - points[reached]
        on_lamp = rng.random((len(reached), 2)) - 0.5
        towards = from_middle + np.einsum("ni,nij->nj", on_lamp, self._sides[lamp])
        distance = np.maximum(np.linalg.norm(towards, axis=1), NEAREST_M)
        towards /= distance[:, None]
        window = 1 - (np.linalg.norm(from_middle, axis=1) / self._range[lamp]) ** 4
        share = self._share_sent(lamp, -towards) * np.maximum(window, 0) ** 2 / (distance * distance * probability[reached])
        irradiance = self._intensity[lamp] * share[:, None]
        return LampSamples(reached, towards.astype(np.float32), distance.astype(np.float32), irradiance.astype(np.float32))

    def _share_sent(self, lamp: Int64, direction: Float64) -> Float64:
        """The share (n,) of each lamp's intensity that goes along a direction (n, 3), unit, away from it."""
        cosine = np.einsum("ij,ij->i", self._axis[lamp], direction)
        outer, inner = self._cos_outer[lamp], self._cos_inner[lamp]
        is_spot, is_area = self._kind[lamp] == LOCAL_SPOT, self._kind[lamp] == LOCAL_AREA
        edge = np.clip((cosine - outer) / np.where(is_spot, inner - outer, 1.0), 0, 1)
        return np.where(is_spot, edge * edge * (3 - 2 * edge), np.where(is_area, np.maximum(cosine, 0), 1.0))

    def _choose(self, points: Float64, chance: Float64) -> tuple[Int64, Float64]:
        """A lamp for each of the points (n, 3), by chances (n,) in [0, 1), and its probability (n,): 0 where no lamp reaches."""
        cell, cell_of_point = _cells(points)
        lamp, probability = np.zeros(len(points), np.int64), np.zeros(len(points))
        order = np.argsort(cell_of_point, kind="stable")
        cells_at_once = max(1, _TABLE_ENTRIES // max(self.count, 1))
        for first in range(0, len(cell) if self.count else 0, cells_at_once):
            odds = self._odds((cell[first : first + cells_at_once] + 0.5) * CELL_M)
            here = order[np.searchsorted(cell_of_point[order], first) : np.searchsorted(cell_of_point[order], first + len(odds))]
            here = here[odds[cell_of_point[here] - first].any(axis=1)]
            lamp[here], probability[here] = _pick(odds, cell_of_point[here] - first, chance[here])
        return lamp, probability

    def _odds(self, centre: Float64) -> Float64:
        """(c, lamps): intensity over squared distance from the centres (c, 3) of cells, 0 where no point of the cell is in range."""
        distance = np.linalg.norm(centre[:, None] - self._position, axis=2)
        reaches = distance <= self._range + _HALF_DIAGONAL_M
        return np.asarray(np.where(reaches, self._strength / np.maximum(distance, CELL_M) ** 2, 0.0))


def _cells(points: Float64) -> tuple[Float64, Int64]:
    """Cells (c, 3) that points (n, 3) lie in, as multiples of CELL_M, and the cell of each (n,)."""
    index = np.floor(points / CELL_M).astype(np.int64)
    low = index.min(axis=0, initial=0)
    # A world is at most 1e6 m across: 18 bits an axis.
    span = index.max(axis=0, initial=0) - low + 1
    key, of_point = np.unique(np.ravel_multi_index(tuple((index - low).T), tuple(span)), return_inverse=True)
    return (np.stack(np.unravel_index(key, tuple(span)), axis=1) + low).astype(np.float64), of_point.reshape(-1)


def _pick(odds: Float64, row: Int64, chance: Float64) -> tuple[Int64, Float64]:
    """Column of a table of odds (c, k) for each of the rows (n,), none of them all zero, by chances (n,), and its probability (n,)."""
    upper = np.cumsum(odds, axis=1)
    total = upper[:, -1:]
    # Row r's bounds lie in r..r + 1, so that one search serves all rows. A row's last bound is the next row's start to the last bit:
    # no chance reaches an entry without odds.
    upper = np.arange(len(odds))[:, None] + upper / np.where(total > 0, total, 1)
    value = np.minimum(row + chance, np.nextafter(row + 1.0, 0))
    column = np.searchsorted(upper.reshape(-1), value, side="right") - row * odds.shape[1]
    return column, odds[row, column] / total[row, 0]
