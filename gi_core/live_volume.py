"""A player's irradiance volume in the live world: kept on the device, and filled anew only where light has changed or the player moved."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import pyopencl as cl

from gi_core.arrays import AnyArray, Float32, Int64, UInt8
from gi_core.basis import from_axes
from gi_core.constants import BASIS_SIZES, VOLUME_SHAPE, VOXEL_NO_SECTOR
from gi_core.device import Device
from gi_core.grid import SectorIndex
from gi_core.live_sector import LiveSector
from gi_core.recycled import RecycledArrays
from gi_core.volume import SectorBox, box_mask, box_record, box_slices, nearest_columns, plan_boxes

# Light of a sector to show at this tick, on the device.
ShownCubes = Callable[[LiveSector], cl.Buffer]


@dataclass(frozen=True, eq=False)
class PublishedVolume:
    """What clients see of a player's volume; read-only, and replaced by another when something changes.

    values : (B, 16, 32, 32, 3) float32 [lx] in ``basis``; mask : (16, 32, 32) uint8, as in volume.Volume
    first_voxel : (3,) int64, world lattice index of voxel (0, 0, 0)
    tick : in which it was filled; missing : sectors that it touches and that are not there (yet)
    """

    values: Float32
    mask: UInt8
    first_voxel: Int64
    tick: int
    sectors: tuple[SectorIndex, ...]
    missing: tuple[SectorIndex, ...]
    basis: str = "cube"


@dataclass(frozen=True, eq=False)
class _Layout:
    """What does not change while the volume stays and the same sectors are there.

    boxes : parts that lit sectors fill, with their records; mask : all classes
    placeholders : sectors of the world that are not there, with the columns (z, x) that stand for each
    outside : columns (z, x) without a sector, and for each the column that it copies
    """

    boxes: tuple[tuple[SectorBox, AnyArray], ...]
    mask: UInt8
    sectors: tuple[SectorIndex, ...]
    placeholders: tuple[tuple[SectorIndex, slice, slice], ...]
    outside: tuple[Int64, Int64] | None


class LiveVolume:
    """One player's. The ticker's alone; what it publishes is anybody's."""

    def __init__(self, device: Device, basis: str = "cube", arrays: RecycledArrays | None = None) -> None:
        """``arrays`` : of a volume's shape, shared by volumes."""
        self.basis = basis
        self.published: PublishedVolume | None = None
        self.touched: tuple[SectorIndex, ...] = ()
        """Sectors of the world that it reads, there or not."""
        self._device = device
        self._first: Int64 = np.zeros(3, np.int64)
        self._layout: _Layout | None = None
        self._present: frozenset[SectorIndex] = frozenset()
        self._arrays = arrays or volume_arrays(basis)
        self._buffer = device.allocate(4 * 3 * BASIS_SIZES[basis] * int(np.prod(VOLUME_SHAPE)))
        self._filled_at = -1

    @property
    def nbytes(self) -> int:
        """Bytes on the device."""
        return int(self._buffer.size)

    def move(self, first_voxel: Int64, known: frozenset[SectorIndex]) -> None:
        """Stand elsewhere: the lattice index (3,) of voxel (0, 0, 0). ``known``: sectors of the world."""
        self._first, self._layout = first_voxel, None
        self.touched = tuple(box.index for box in plan_boxes(first_voxel) if box.index in known)

    def enqueue(self, residents: Mapping[SectorIndex, LiveSector], shown: ShownCubes) -> None:
        """Enqueue the filling of what has changed; ``publish`` must follow."""
        present = frozenset(i for i in self.touched if i in residents and residents[i].is_lit)
        fresh = self._layout is None or present != self._present
        if fresh:
            self._present, self._layout = present, _lay_out(self._first, residents, frozenset(self.touched), present)
        assert self._layout is not None
        for box, record in self._layout.boxes:
            sector = residents[box.index]
            if fresh or sector.shown_at > self._filled_at:
                sector.resident.fill_volume(record, tuple(int(n) for n in box.size), self._buffer, shown(sector), self.basis)

    def publish(self, tick: int, placeholder: Callable[[SectorIndex], Float32]) -> PublishedVolume:
        """Read what ``enqueue`` asked for, put placeholders in, and show it."""
        layout = self._layout
        assert layout is not None
        values = self._arrays.take()
        self._device.read(self._buffer, values)
        for index, z, x in layout.placeholders:
            values[:, :, z, x] = (from_axes(self.basis) @ placeholder(index))[:, None, None, None]
        if layout.outside is not None:
            lack, nearest = layout.outside
            values[:, :, lack[:, 0], lack[:, 1]] = values[:, :, nearest[:, 0], nearest[:, 1]]
        values.setflags(write=False)
        self._filled_at = tick
        missing = tuple(index for index, _, _ in layout.placeholders)
        self.published = PublishedVolume(values, layout.mask, self._first, tick, layout.sectors, missing, self.basis)
        return self.published


def volume_arrays(basis: str) -> RecycledArrays:
    """What volumes in a basis are read into."""
    return RecycledArrays((BASIS_SIZES[basis], *VOLUME_SHAPE, 3))


def _lay_out(
    first: Int64, residents: Mapping[SectorIndex, LiveSector], known: frozenset[SectorIndex], present: frozenset[SectorIndex]
) -> _Layout:
    mask = np.full(VOLUME_SHAPE, VOXEL_NO_SECTOR, np.uint8)
    has_light = np.zeros(VOLUME_SHAPE[1:], bool)
    boxes, placeholders = [], []
    for box in plan_boxes(first):
        _, z, x = box_slices(box)
        if box.index in present:
            sector = residents[box.index].resident.sector
            mask[box_slices(box)] = box_mask(box, sector)
            if sector.probe_count:
                boxes.append((box, box_record(box, sector)))
                has_light[z, x] = True
        elif box.index in known:
            placeholders.append((box.index, z, x))
            has_light[z, x] = True
    mask.setflags(write=False)
    outside = None if has_light.all() or not has_light.any() else nearest_columns(has_light)
    return _Layout(tuple(boxes), mask, tuple(sorted(present)), tuple(placeholders), outside)
