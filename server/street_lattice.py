"""Where one can walk: columns of the voxel lattice whose lowest air is outdoors and stands on something, read sector by sector.

Only the voxel classes of a sector's file are taken, a fifth of the work of reading it whole; what was read is kept, 1.8 kB a sector.
"""

import threading
from array import array

import numpy as np

from gi_core import container, sector_file
from gi_core.constants import SECTOR_SIZE_M, VOXEL_INDOORS, VOXEL_OUTDOORS, VOXEL_SIZE_M, VOXEL_SOLID
from gi_core.dataset import Dataset
from gi_core.errors import CorruptFileError, FormatError
from gi_core.grid import SectorIndex, voxel_columns

# A column's sector is floor((index + 0.5) * voxel / sector size): whole numbers, so that no column is ever on the wrong side of a border.
_NUMERATOR, _DENOMINATOR = (VOXEL_SIZE_M / (2 * SECTOR_SIZE_M)).as_integer_ratio()
_NO_STREET = -(1 << 30)


class StreetLattice:
    """The streets of a dataset. Files are read when a column of theirs is first asked for; safe to share between threads."""

    def __init__(self, dataset: Dataset) -> None:
        self._dataset = dataset
        self._lock = threading.Lock()
        self._sectors: dict[tuple[int, int], _Columns] = {}

    @property
    def sectors_read(self) -> int:
        """How many files have been read."""
        return len(self._sectors)

    def level(self, x: int, z: int) -> int | None:
        """Lattice index y of the air that one stands in, in a column; None where nobody can."""
        key = (2 * x + 1) * _NUMERATOR // _DENOMINATOR, (2 * z + 1) * _NUMERATOR // _DENOMINATOR
        columns = self._sectors.get(key) or self._read(key)
        if columns is None:
            return None
        level = columns.levels[(z - columns.first_z) * columns.width + x - columns.first_x]
        return None if level == _NO_STREET else level

    def eye_height(self, x_m: float, z_m: float) -> float | None:
        """Height of the eyes [m] above a place [m], within 1.6 m of true: the middle of the lowest voxel; None where nobody can stand."""
        level = self.level(int(np.floor(x_m / VOXEL_SIZE_M)), int(np.floor(z_m / VOXEL_SIZE_M)))
        return None if level is None else (level + 0.5) * VOXEL_SIZE_M

    def columns_of(self, index: SectorIndex) -> list[tuple[int, int]]:
        """Columns (x, z) of a sector where one can stand on its lowest ground, so that no roof is among them."""
        columns = self._sectors.get(index) or self._read(index)
        if columns is None:
            return []
        lowest = min((level for level in columns.levels if level != _NO_STREET), default=_NO_STREET + 1)
        at = [i for i, level in enumerate(columns.levels) if level == lowest]
        return [(columns.first_x + i % columns.width, columns.first_z + i // columns.width) for i in at]

    def _read(self, key: tuple[int, int]) -> "_Columns | None":
        """None where no sector was baked: of those there is no end, and nothing of them is kept."""
        if key not in self._dataset.world.sectors:
            return None
        with self._lock:
            if key not in self._sectors:
                self._sectors[key] = _Columns(self._dataset, SectorIndex(*key))
            return self._sectors[key]


class _Columns:
    """levels : of each column of a sector, z after z, _NO_STREET where nobody can stand"""

    def __init__(self, dataset: Dataset, index: SectorIndex) -> None:
        (self.first_x, end_x), (self.first_z, end_z) = voxel_columns(index.x), voxel_columns(index.z)
        self.width = end_x - self.first_x
        shape = (end_z - self.first_z, self.width)
        # Who streams the sector reports a damaged file; nobody walks there.
        try:
            levels: list[int] | None = _levels(dataset, index, shape)
        except (FormatError, OSError):
            levels = None
        self.levels = array("i", [_NO_STREET] * (shape[0] * shape[1]) if levels is None else levels)


def _levels(dataset: Dataset, index: SectorIndex, shape: tuple[int, int]) -> list[int]:
    path = dataset.sector_path(index)
    found = container.decode(container.read_bytes(path), sector_file.KIND, sector_file.VERSIONS, str(path))
    kind = found.take("voxel_class", "u1", 3)
    first = found.meta.get("voxel_first")
    if not isinstance(first, list) or len(first) != 3 or not all(isinstance(n, int) and abs(n) < -_NO_STREET // 2 for n in first):
        raise CorruptFileError(f"{path}: expected the lattice index of its first voxel; bake it again")
    if found.meta.get("sector") != [index.x, index.z] or kind.shape[1:] != shape or len(kind) == 0:
        raise CorruptFileError(f"{path}: expected {shape} columns of voxels of sector {index}; bake it again")
    outdoors = kind == VOXEL_OUTDOORS
    lowest = outdoors.argmax(axis=0)  # 0 too where there is none
    z, x = np.indices(shape)
    # On something solid, with no room below: not on a roof over one, nor in mid-air where the ground ends.
    stands = (lowest > 0) & (kind[np.maximum(lowest - 1, 0), z, x] == VOXEL_SOLID)
    stands &= (np.cumsum(kind == VOXEL_INDOORS, axis=0)[lowest, z, x]) == 0
    return np.asarray(np.where(stands, lowest + first[1], _NO_STREET)).reshape(-1).tolist()
