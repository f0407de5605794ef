"""Where air lies under something: the only places that rooms can be in, and few in a city of solid blocks.

Columns are looked through from below. Between two surfaces may lie air when nothing closed has been entered and not left; a test from all
sides (bake_jobs.inside) then tells: it takes a hundred times as long, and in a city of solid blocks next to nothing is left to it.
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_dilation, find_objects, label

from bake_jobs.clean import closed_components
from bake_jobs.inside import Solids
from bake_jobs.ray_lines import cross
from bake_jobs.rays import RayScene
from bake_jobs.scene import Scene
from gi_core.arrays import Float64, Int64
from gi_core.constants import ROOM_CELL_M

# A column meets every room that is wider than this.
COLUMN_CELLS = 4
COLUMN_M = COLUMN_CELLS * ROOM_CELL_M
# Lower, nobody stands in it; what is higher is no ceiling but the roof of a hall that should be authored, or a dome around the world.
MIN_HEIGHT_M, MAX_CEILING_M = 1.8, 30.0
# Around covered air, so that what its openings lead to is seen too: 4.7 m.
MARGIN_COLUMNS = 3
_START_BELOW_M = 1.0


@dataclass(frozen=True, eq=False)
class Gaps:
    """Air between two surfaces of columns, one above the other.

    line : (k,) int64, which column; bottom, top : (k,) float64 [m]
    sky : (n,) float64 [m], where the open air above each column begins; minus infinity where it has no surface
    """

    line: Int64
    bottom: Float64
    top: Float64
    sky: Float64


class AirColumns:
    """A scene, ready to be asked for the air in its columns."""

    def __init__(self, scene: Scene, rays: RayScene) -> None:
        self.bounds = scene.bounds
        self.rays = rays
        component, closed = closed_components(scene.triangles.astype(np.int64))
        self._closed = closed[component]
        self._solids = Solids(scene.vertices, scene.triangles)

    def gaps(self, place: Float64, least_m: float) -> Gaps:
        """Air under something, at least so high [m], in columns at x, z (n, 2) [m]."""
        floor = self.bounds[0, 1] - _START_BELOW_M
        starts = np.stack([place[:, 0], np.full(len(place), floor), place[:, 1]], axis=1)
        # Through solids that have grown: where one stands on another, a line would meet but one of two surfaces and count wrong.
        found = cross(self._solids.grown, starts, 1, float(self.bounds[1, 1] - floor) + _START_BELOW_M)
        line, height = found.line, floor + found.distance
        sky = np.full(len(place), -np.inf)
        np.maximum.at(sky, line, height)
        entered = np.where(self._closed[found.triangle], np.where(found.from_back, -1, 1), 0)
        depth, begin = np.cumsum(entered), np.searchsorted(line, line)
        depth = depth - (depth[begin] - entered[begin])
        is_gap = np.flatnonzero((line[1:] == line[:-1]) & (np.diff(height) >= least_m) & (depth[:-1] <= 0))
        bottom, top, line = height[is_gap], height[is_gap + 1], line[is_gap]
        # Few are left; among them are solids that are open below, or of which a line met but one of two faces that coincide.
        x, z = place[line].T
        is_air = ~self._solids.contain(np.stack([x, (bottom + top) / 2, z], axis=1))
        return Gaps(line[is_air], bottom[is_air], top[is_air], sky)


@dataclass(frozen=True, eq=False)
class CoveredRegion:
    """Columns near each other that have covered air, and a margin of others.

    columns : (n, 2) int64, lattice indices (x, z) of COLUMN_M; low, high : [m] of the covered air in them
    """

    columns: Int64
    low: float
    high: float


def covered_regions(columns: AirColumns) -> list[CoveredRegion]:
    """Regions of a scene that rooms may be in, in order of place."""
    low, high = columns.bounds
    first = np.floor(low[[0, 2]] / COLUMN_M).astype(np.int64)
    nx, nz = (np.floor(high[[0, 2]] / COLUMN_M).astype(np.int64) - first + 1).tolist()
    z, x = np.divmod(np.arange(nz * nx), nx)
    gaps = columns.gaps((np.stack([x, z], axis=1) + first + 0.5) * COLUMN_M, MIN_HEIGHT_M)
    kept = gaps.top - gaps.bottom <= MAX_CEILING_M
    column, bottom, top = gaps.line[kept], gaps.bottom[kept], gaps.top[kept]
    covered = np.zeros((nz, nx), bool)
    covered.reshape(-1)[column] = True
    around = np.ones((2 * MARGIN_COLUMNS + 1,) * 2, bool)
    numbers, count = label(binary_dilation(np.pad(covered, MARGIN_COLUMNS), around), np.ones((3, 3), bool))
    of_gap = numbers[z[column] + MARGIN_COLUMNS, x[column] + MARGIN_COLUMNS] - 1
    lowest, highest = np.full(count, np.inf), np.full(count, -np.inf)
    np.minimum.at(lowest, of_gap, bottom)
    np.maximum.at(highest, of_gap, top)
    regions = []
    for number, place in enumerate(find_objects(numbers)):
        rows, along = np.nonzero(numbers[place] == number + 1)
        at = np.stack([along + place[1].start, rows + place[0].start], axis=1) - MARGIN_COLUMNS + first
        regions.append(CoveredRegion(at, float(lowest[number]), float(highest[number])))
    return regions
