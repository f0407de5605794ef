"""The triangles between lamps and surfels, read from the dataset's geometry files when a lamp needs them."""

from collections import OrderedDict
from collections.abc import Callable, Collection
from dataclasses import dataclass

import numpy as np

from gi_core.arrays import Float64
from gi_core.constants import SECTOR_SIZE_M
from gi_core.geometry_file import Geometry
from gi_core.grid import SectorIndex

# Triangles of sectors that are kept for the next lamp, 120 bytes each.
KEPT_BYTES = 1 << 27


@dataclass(frozen=True, eq=False)
class _Triangles:
    """corners (n, 3, 3) float64 [m], world frame: triangle, corner, coordinate; low, high (n, 3): each one's box."""

    corners: Float64
    low: Float64
    high: Float64

    @property
    def nbytes(self) -> int:
        return self.corners.nbytes + self.low.nbytes + self.high.nbytes


class ShadowGeometry:
    """Triangles by place. One for all sectors of a dataset, so that neighbours share what they read; not for several threads at once."""

    def __init__(self, geometry: Callable[[SectorIndex], Geometry], sectors: Collection[SectorIndex], kept_bytes: int = KEPT_BYTES) -> None:
        """``geometry`` gives a sector's triangles (``Dataset.geometry``), ``sectors`` are those that have any."""
        self._geometry = geometry
        self._sectors = frozenset(sectors)
        self._kept_bytes = kept_bytes
        self._kept: OrderedDict[SectorIndex, _Triangles] = OrderedDict()

    def triangles_in(self, low: Float64, high: Float64) -> Float64:
        """Triangles (n, 3, 3) float64 [m], world frame, whose boxes meet the box from low (3,) to high (3,): sector by sector, as stored.

        Raises CorruptFileError and the like as ``geometry`` does.
        """
        found = []
        for index in self._sectors_in(low, high):
            triangles = self._load(index)
            meets = ((triangles.low <= high) & (triangles.high >= low)).all(axis=1)
            found.append(triangles.corners[meets])
        return np.concatenate(found) if found else np.zeros((0, 3, 3))

    def _sectors_in(self, low: Float64, high: Float64) -> list[SectorIndex]:
        (x0, z0), (x1, z1) = (np.floor(corner[[0, 2]] / SECTOR_SIZE_M).astype(np.int64).tolist() for corner in (low, high))
        if (x1 - x0 + 1) * (z1 - z0 + 1) > len(self._sectors):
            return sorted(i for i in self._sectors if x0 <= i.x <= x1 and z0 <= i.z <= z1)
        inside = (SectorIndex(x, z) for x in range(x0, x1 + 1) for z in range(z0, z1 + 1))
        return [index for index in inside if index in self._sectors]

    def _load(self, index: SectorIndex) -> _Triangles:
        found = self._kept.get(index)
        if found is None:
            geometry = self._geometry(index)
            corners = geometry.vertices[geometry.triangles]
            found = self._kept[index] = _Triangles(corners, corners.min(axis=1), corners.max(axis=1))
            while len(self._kept) > 1 and sum(t.nbytes for t in self._kept.values()) > self._kept_bytes:
                self._kept.popitem(last=False)
        self._kept.move_to_end(index)
        return found
