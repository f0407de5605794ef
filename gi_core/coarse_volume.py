"""Volumes of cascades 1 to 3: each twice as wide as the one before, its voxels the means of the 3.125 m voxels in them.

Voxel i of cascade n holds exactly the lattice's voxels 2^n i .. 2^n (i + 1) - 1 along each axis. Air outdoors counts; where there is
none, air indoors; where there is none either, what solid voxels were filled with.
"""

from dataclasses import dataclass

import numpy as np

from gi_core.arrays import Bool, Float32, Int64, UInt8
from gi_core.constants import VOLUME_SHAPE, VOXEL_INDOORS, VOXEL_NO_SECTOR, VOXEL_OUTDOORS, VOXEL_SIZE_M, VOXEL_SOLID
from gi_core.grid import SectorIndex
from gi_core.sector import Sector
from gi_core.volume import split_columns

# What may count, best first, and what a voxel of nothing better is.
_CLASSES = (VOXEL_OUTDOORS, VOXEL_INDOORS, VOXEL_SOLID)


def covered_sectors(first_voxel: Int64, cascade: int) -> list[SectorIndex]:
    """Sectors that the volume from ``first_voxel`` (3,), on its own lattice, reads. Row by row."""
    _, nz, nx = (count << cascade for count in VOLUME_SHAPE)
    first = np.asarray(first_voxel) << cascade
    rows, columns = split_columns(int(first[2]), nz, VOXEL_SIZE_M), split_columns(int(first[0]), nx, VOXEL_SIZE_M)
    return [SectorIndex(x, z) for z, _, _ in rows for x, _, _ in columns]


@dataclass(frozen=True, eq=False)
class _Axes:
    """Which of a sector's stored voxels lie in which of the volume's, as matrices of counts: (16, sy), (rows, sz), (columns, sx).

    y_air : as y, without layers below the lowest that is stored, which are solid
    """

    y: Float32
    y_air: Float32
    z: Float32
    x: Float32
    rows: slice
    columns: slice


class CoarseSums:
    """Sums over the lattice's voxels in each of a coarse volume's, sector by sector."""

    def __init__(self, first_voxel: Int64, cascade: int, coefficients: int) -> None:
        self._first, self._cascade = first_voxel, cascade
        self._light: dict[int, Float32] = {}
        self._count = {kind: np.zeros(VOLUME_SHAPE, np.float32) for kind in _CLASSES}
        self._shape = (coefficients, *VOLUME_SHAPE, 3)

    def add(self, sector: Sector, light: Float32 | None) -> None:
        """Add a sector's own voxels: light (B, ny, nz, nx, 3) [lx], or None where it has no probe, and so none."""
        axes = self._axes(sector)
        for kind in _CLASSES:
            counts = sector.voxel_class == kind if kind != VOXEL_SOLID else np.ones(sector.voxel_class.shape, bool)
            if not counts.any():
                continue
            weight = counts.astype(np.float32)
            y = axes.y if kind == VOXEL_SOLID else axes.y_air
            self._count[kind][:, axes.rows, axes.columns] += _summed(weight[None, ..., None], y, axes)[0, ..., 0]
            if light is not None:
                sums = self._light.setdefault(kind, np.zeros(self._shape, np.float32))
                sums[:, :, axes.rows, axes.columns] += _summed(light * weight[None, ..., None], y, axes)

    def finish(self) -> tuple[Float32, UInt8, Bool]:
        """Light (B, 16, 32, 32, 3) [lx], classes (16, 32, 32), and which columns (32, 32) have light."""
        values = np.zeros(self._shape, np.float32)
        mask = np.full(VOLUME_SHAPE, VOXEL_NO_SECTOR, np.uint8)
        for kind in reversed(_CLASSES):
            there = self._count[kind] > 0
            mask[there] = kind
            if kind in self._light:
                values[:, there] = self._light[kind][:, there] / self._count[kind][there][:, None]
        return values, mask, np.asarray(values.any(axis=(0, 1, 4)), np.bool_)

    def _axes(self, sector: Sector) -> _Axes:
        sy, sz, sx = sector.voxel_class.shape
        n = self._cascade
        # Above the highest layer that is stored, it is repeated; so it is below the lowest, which counts as solid.
        layer = (int(self._first[1]) << n) + np.arange(VOLUME_SHAPE[0] << n) - int(sector.voxel_first[1])
        y, y_air = np.zeros((2, VOLUME_SHAPE[0], sy), np.float32)
        at = np.arange(len(layer)) >> n, np.clip(layer, 0, sy - 1)
        np.add.at(y, at, 1)
        np.add.at(y_air, at, layer >= 0)
        z, rows = self._columns(int(sector.voxel_first[2]), sz, int(self._first[2]), VOLUME_SHAPE[1])
        x, columns = self._columns(int(sector.voxel_first[0]), sx, int(self._first[0]), VOLUME_SHAPE[2])
        return _Axes(y, y_air, z, x, rows, columns)

    def _columns(self, first: int, count: int, volume_first: int, size: int) -> tuple[Float32, slice]:
        """The matrix along x or z, and the volume's columns that it is for."""
        of_column = ((first + np.arange(count)) >> self._cascade) - volume_first
        low, high = max(int(of_column[0]), 0), min(int(of_column[-1]) + 1, size)
        matrix = of_column == np.arange(low, max(high, low))[:, None]
        return matrix.astype(np.float32), slice(low, max(high, low))


def _summed(values: Float32, y: Float32, axes: _Axes) -> Float32:
    """(B, sy, sz, sx, C) -> (B, 16, rows, columns, C)."""
    coefficients, sy, sz, sx, channels = values.shape
    layers = np.matmul(y, values.reshape(coefficients, sy, -1)).reshape(coefficients * len(y), sz, sx * channels)
    rows = np.matmul(axes.z, layers).reshape(-1, sx, channels)
    return np.asarray(np.matmul(axes.x, rows).reshape(coefficients, len(y), len(axes.z), len(axes.x), channels), np.float32)
