"""Volumes of cascades 1 to 3: each twice as wide as the one before, its voxels the means of the 3.125 m voxels in them.

Voxel i of cascade n holds exactly the lattice's voxels 2^n i .. 2^n (i + 1) - 1 along each axis. Air outdoors counts; where there is
none, air indoors; where there is none either, what solid voxels were filled with.

A mean of blends is a blend of more probes, and which ones no light changes. So a sector's coarse voxels are worked out once, and whatever
lights it later needs only its probes' light: neither its file nor a device.
"""

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gi_core.arrays import Bool, Float32, Int64, UInt8, UInt16
from gi_core.constants import VOLUME_SHAPE, VOXEL_INDOORS, VOXEL_NO_SECTOR, VOXEL_OUTDOORS, VOXEL_SIZE_M, VOXEL_SOLID
from gi_core.grid import SectorIndex
from gi_core.rooms import outdoor_blend
from gi_core.sector import Sector
from gi_core.volume import split_columns

# Classes by what counts, least first.
_CLASSES = np.array([VOXEL_NO_SECTOR, VOXEL_SOLID, VOXEL_INDOORS, VOXEL_OUTDOORS], np.uint8)
_RANK = np.argsort(_CLASSES).astype(np.uint8)
# Coarse voxels that are kept: those of cascade 3 about a few players.
KEPT_BYTES = 1 << 27


@dataclass(frozen=True, eq=False)
class CoarseVoxels:
    """A sector's part of the voxels of one cascade. Below the lowest stored layer of the lattice and above the highest lies one more layer
    here, which stands for all beyond.

    first : (3,) int64, index (x, y, z) of voxel (0, 0, 0) on the cascade's lattice
    kind : (ny, nz, nx) uint8, the best class inside; count : (ny, nz, nx) float32, how many of the lattice's voxels have it
    starts : (voxels,) int64, where each one's probes begin, flat order; empty in a sector without probes
    probe : (n,) uint16; weight : (n,) float32, summed over the voxels that count
    """

    first: Int64
    kind: UInt8
    count: Float32
    starts: Int64
    probe: UInt16
    weight: Float32

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays."""
        return sum(a.nbytes for a in (self.first, self.kind, self.count, self.starts, self.probe, self.weight))

    def light(self, cubes: Float32) -> Float32:
        """Sums (B, ny, nz, nx, 3) [lx] over the voxels that count, of probes' light (P, B, 3) [lx]. Not for sectors without probes."""
        rows = cubes.reshape(len(cubes), -1)[self.probe] * self.weight[:, None]
        sums = np.add.reduceat(rows, self.starts, axis=0)
        return np.moveaxis(sums.reshape(*self.kind.shape, *cubes.shape[1:]), 3, 0)


def coarse_voxels(sector: Sector, cascade: int) -> CoarseVoxels:
    """The voxels of a cascade that a sector has a part in, blending outdoor light (gi_core.rooms)."""
    stored = sector.voxel_first.astype(np.int64)
    sy, sz, sx = sector.voxel_class.shape
    first, last = stored >> cascade, (stored + np.array([sx, sy, sz]) - 1) >> cascade
    first[1], last[1] = first[1] - 1, last[1] + 1
    nx, ny, nz = (last - first + 1).tolist()
    lattice_y = np.arange(first[1] << cascade, (last[1] + 1) << cascade)
    layer = np.clip(lattice_y - stored[1], 0, sy - 1)
    column = ((((stored[2] + np.arange(sz)) >> cascade) - first[2])[:, None] * nx) + ((stored[0] + np.arange(sx)) >> cascade) - first[0]
    probe, weight = outdoor_blend(sector)
    probes = sector.probe_count
    kind, count = np.zeros((ny, nz * nx), np.uint8), np.zeros((ny, nz * nx), np.float32)
    lengths, found = [], []
    for y in range(ny):
        of_layer = slice(y << cascade, (y + 1) << cascade)
        rank = _RANK[sector.voxel_class[layer[of_layer]]]
        rank[lattice_y[of_layer] < stored[1]] = _RANK[VOXEL_SOLID]
        best = np.zeros(nz * nx, np.uint8)
        np.maximum.at(best, np.broadcast_to(column, rank.shape), rank)
        counts = rank == best[column]
        of_voxel = np.broadcast_to(column, rank.shape)[counts].astype(np.int64)
        kind[y], count[y] = _CLASSES[best], np.bincount(of_voxel, minlength=nz * nx)
        if probes:
            pair = of_voxel[:, None] * probes + probe[layer[of_layer]][counts]
            sums = np.bincount(pair.reshape(-1), weight[layer[of_layer]][counts].reshape(-1), nz * nx * probes)
            pairs = np.flatnonzero(sums)
            lengths.append(np.bincount(pairs // probes, minlength=nz * nx))
            found.append((pairs % probes, sums[pairs]))
    starts = np.cumsum(np.concatenate([[0], *lengths]))[:-1] if probes else np.zeros(0, np.int64)
    return CoarseVoxels(
        first=first,
        kind=kind.reshape(ny, nz, nx),
        count=count.reshape(ny, nz, nx),
        starts=starts.astype(np.int64),
        probe=np.concatenate([np.zeros(0), *(numbers for numbers, _ in found)]).astype(np.uint16),
        weight=np.concatenate([np.zeros(0), *(weights for _, weights in found)]).astype(np.float32),
    )


class KeptCoarse:
    """Coarse voxels of the sectors that were asked for last, bounded in bytes. Its caller's lock guards it."""

    def __init__(self, max_bytes: int = KEPT_BYTES) -> None:
        self._max_bytes, self._bytes = max_bytes, 0
        self._kept: OrderedDict[tuple[SectorIndex, int], CoarseVoxels] = OrderedDict()

    def get(self, index: SectorIndex, cascade: int, read: Callable[[SectorIndex], Sector]) -> CoarseVoxels:
        """A sector's voxels of a cascade; the sector is only read when they are not kept."""
        found = self._kept.get((index, cascade))
        if found is None:
            found = self._kept[index, cascade] = coarse_voxels(read(index), cascade)
            self._bytes += found.nbytes
            while self._bytes > self._max_bytes and len(self._kept) > 1:
                self._bytes -= self._kept.popitem(last=False)[1].nbytes
        self._kept.move_to_end((index, cascade))
        return found


def covered_sectors(first_voxel: Int64, cascade: int) -> list[SectorIndex]:
    """Sectors that the volume from ``first_voxel`` (3,), on its own lattice, reads. Row by row."""
    _, nz, nx = (count << cascade for count in VOLUME_SHAPE)
    first = np.asarray(first_voxel) << cascade
    rows, columns = split_columns(int(first[2]), nz, VOXEL_SIZE_M), split_columns(int(first[0]), nx, VOXEL_SIZE_M)
    return [SectorIndex(x, z) for z, _, _ in rows for x, _, _ in columns]


class CoarseSums:
    """Sums over the lattice's voxels in each of a coarse volume's, sector by sector: voxels at a border are of several."""

    def __init__(self, first_voxel: Int64, coefficients: int) -> None:
        self._first = first_voxel
        self._rank, self._lit_rank = np.zeros((2, *VOLUME_SHAPE), np.uint8)
        self._count = np.zeros(VOLUME_SHAPE, np.float32)
        self._light = np.zeros((coefficients, *VOLUME_SHAPE, 3), np.float32)

    def add(self, voxels: CoarseVoxels, cubes: Float32) -> None:
        """Add a sector's part, lit by its probes (P, B, 3) [lx]; without a probe it has its classes and no light."""
        source_y = np.clip(self._first[1] + np.arange(VOLUME_SHAPE[0]) - voxels.first[1], 0, len(voxels.kind) - 1)
        source_z, rows = _overlap(int(voxels.first[2] - self._first[2]), voxels.kind.shape[1], VOLUME_SHAPE[1])
        source_x, columns = _overlap(int(voxels.first[0] - self._first[0]), voxels.kind.shape[2], VOLUME_SHAPE[2])
        here = (slice(None), rows, columns)
        rank = _RANK[voxels.kind[source_y, source_z, source_x]]
        self._rank[here] = np.maximum(self._rank[here], rank)
        if not len(cubes):
            return
        # What a better class displaces counts no more, and what is worse than one is never counted.
        lit, count, light = self._lit_rank[here], self._count[here], self._light[:, :, rows, columns]
        better, as_good = rank > lit, rank >= lit
        count[better], light[:, better] = 0, 0
        count[as_good] += voxels.count[source_y, source_z, source_x][as_good]
        light[:, as_good] += voxels.light(cubes)[:, source_y, source_z, source_x][:, as_good]
        lit[better] = rank[better]

    def finish(self) -> tuple[Float32, UInt8, Bool]:
        """Light (B, 16, 32, 32, 3) [lx], classes (16, 32, 32), and which columns (32, 32) have light."""
        values = self._light / np.maximum(self._count, np.float32(1))[..., None]
        return np.asarray(values, np.float32), _CLASSES[self._rank], np.asarray(self._lit_rank.any(axis=0), np.bool_)


def _overlap(offset: int, count: int, size: int) -> tuple[slice, slice]:
    """Where ``count`` voxels from ``offset`` on meet a volume of ``size``: of themselves, and of the volume."""
    low, high = min(max(offset, 0), size), min(max(offset + count, 0), size)
    return slice(low - offset, high - offset), slice(low, high)
