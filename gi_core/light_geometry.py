"""The triangles between lamps and surfels: a tree for each sector, built from the dataset's geometry file when a lamp needs it."""

from collections import OrderedDict
from collections.abc import Callable, Collection
from concurrent.futures import Executor, Future
from threading import Lock

import numpy as np

from gi_core.arrays import Float64
from gi_core.background import give_way
from gi_core.constants import SECTOR_SIZE_M
from gi_core.device import Device
from gi_core.geometry_file import Geometry
from gi_core.grid import SectorIndex
from gi_core.shadow_tiles import ShadowTiles
from gi_core.shadow_tree import ShadowTree, build_tree

# Trees that are kept for the next lamp, 70 to 110 bytes a triangle: a borough of New York.
KEPT_BYTES = 1 << 28


class UnreadGeometryError(LookupError):
    """Triangles that were not to be read: of which sectors."""

    def __init__(self, sectors: frozenset[SectorIndex]) -> None:
        super().__init__(f"the triangles of {len(sectors)} sectors have not been read")
        self.sectors = sectors


class ShadowGeometry:
    """Trees by sector. One for all of a dataset, so that neighbours share what they read; not for several threads at once."""

    def __init__(self, geometry: Callable[[SectorIndex], Geometry], sectors: Collection[SectorIndex], kept_bytes: int = KEPT_BYTES) -> None:
        """``geometry`` gives a sector's triangles (``Dataset.geometry``), ``sectors`` are those that have any.

        ``kept_bytes`` holds for the host and for each device; one sector's tree is kept however big it is.
        """
        self._geometry = geometry
        self._sectors = frozenset(sectors)
        self._kept_bytes = kept_bytes
        self._kept: OrderedDict[SectorIndex, ShadowTree] = OrderedDict()
        self._tiles: dict[Device, ShadowTiles] = {}

    def read(self, sectors: Collection[SectorIndex], may_read: bool = True) -> None:
        """Have the trees of sectors. Raises UnreadGeometryError where one would have to be read and none ``may_read``, else as ``tree``."""
        unread = frozenset(index for index in sectors if index not in self._kept)
        if unread and not may_read:
            raise UnreadGeometryError(unread)
        for index in unread:
            self.tree(index)

    def sectors_in(self, low: Float64, high: Float64) -> list[SectorIndex]:
        """Sectors with triangles whose columns meet the box from low (3,) to high (3,) [m], world frame, ascending."""
        (x0, z0), (x1, z1) = (np.floor(corner[[0, 2]] / SECTOR_SIZE_M).astype(np.int64).tolist() for corner in (low, high))
        if (x1 - x0 + 1) * (z1 - z0 + 1) > len(self._sectors):
            return sorted(i for i in self._sectors if x0 <= i.x <= x1 and z0 <= i.z <= z1)
        inside = (SectorIndex(x, z) for x in range(x0, x1 + 1) for z in range(z0, z1 + 1))
        return [index for index in inside if index in self._sectors]

    def tree(self, index: SectorIndex) -> ShadowTree:
        """A sector's tree, local to it. Raises CorruptFileError and the like as ``geometry`` does."""
        found = self._kept.get(index)
        if found is None:
            geometry = self._geometry(index)
            found = self._kept[index] = build_tree((geometry.vertices - index.origin)[geometry.triangles])
            while len(self._kept) > 1 and sum(tree.nbytes for tree in self._kept.values()) > self._kept_bytes:
                self._kept.popitem(last=False)
        self._kept.move_to_end(index)
        return found

    def triangles_in(self, low: Float64, high: Float64) -> Float64:
        """Triangles (n, 3, 3) float64 [m], world frame, whose boxes meet the box from low (3,) to high (3,): what the twin looks through.

        Raises as ``tree`` does.
        """
        found = [self.tree(index).corners + index.origin for index in self.sectors_in(low, high)]
        corners = np.concatenate(found) if found else np.zeros((0, 3, 3))
        return corners[((corners.min(axis=1) <= high) & (corners.max(axis=1) >= low)).all(axis=1)]

    def on_device(self, device: Device) -> ShadowTiles:
        """The trees that a device holds; one answer for each device."""
        if device not in self._tiles:
            self._tiles[device] = ShadowTiles(device, self.tree, self._kept_bytes)
        return self._tiles[device]


class SharedGeometry:
    """One ``ShadowGeometry`` for ticks and for the threads that load sectors; ``tracing`` is held by the one that uses it."""

    def __init__(self, geometry: ShadowGeometry, reader: Executor) -> None:
        """``reader`` reads what ticks come to need, in a thread that gives way to them."""
        self.geometry = geometry
        self.tracing = Lock()
        self._reader = reader

    def read_soon(self, sectors: Collection[SectorIndex]) -> Future[None]:
        """Have the trees of sectors read by the thread for that."""
        return self._reader.submit(self._read, sorted(sectors))

    def _read(self, sectors: list[SectorIndex]) -> None:
        for index in sectors:
            give_way()
            with self.tracing:
                self.geometry.tree(index)
