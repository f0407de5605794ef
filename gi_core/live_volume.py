"""A player's irradiance volume in the live world: kept on the device, and filled anew only where light has changed or the player moved.

On the device it is rings: a layer's place is y of its lattice index, modulo the volume's layers, a column's in it z * width + x, modulo
the layer's columns. So all that a step leaves in sight stays where it is, only what comes into sight is filled, and it is read in four
pieces.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyopencl as cl

from gi_core.arrays import Float32, Int64, UInt8
from gi_core.basis import from_axes
from gi_core.constants import BASIS_SIZES, VOLUME_SHAPE, VOXEL_NO_SECTOR
from gi_core.device import Device
from gi_core.grid import SectorIndex
from gi_core.live_sector import LiveSector
from gi_core.recycled import RecycledArrays
from gi_core.volume import SectorBox, box_mask, box_record, box_slices, nearest_columns, plan_boxes

_COLUMNS = VOLUME_SHAPE[1] * VOLUME_SHAPE[2]
_OWN_COLUMNS = np.arange(_COLUMNS).reshape(VOLUME_SHAPE[1:])
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

    first : (3,) where it stands; present : sectors that are there
    boxes : parts that they fill, each with the parts of it that the layout before did not have; mask : all classes
    placeholders : sectors of the world that are not there, each with the columns (n,), z * width + x, that show its placeholder
    gathered : (layers * columns,) the place on the rings of each column of each layer; None where all are in the rings' own order. Columns
        without a sector show the nearest that has one
    """

    first: Int64
    present: frozenset[SectorIndex]
    boxes: tuple[tuple[SectorBox, Sequence[SectorBox]], ...]
    mask: UInt8
    placeholders: tuple[tuple[SectorIndex, Int64], ...]
    gathered: Int64 | None


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
        self._boxes: Sequence[SectorBox] = ()
        """Of all sectors around, of the world or not."""
        self._layout: _Layout | None = None
        """Of the last filling."""
        self._arrays = arrays or volume_arrays(basis)
        self._buffer = device.allocate(4 * 3 * BASIS_SIZES[basis] * int(np.prod(VOLUME_SHAPE)))
        self._filled_at = -1
        self._rings: tuple[Any, cl.Event] | None = None
        """The filled buffer, once the event says so: from ``enqueue`` to ``publish``."""

    def move(self, first_voxel: Int64, known: frozenset[SectorIndex]) -> None:
        """Stand elsewhere: the lattice index (3,) of voxel (0, 0, 0). ``known``: sectors of the world."""
        self._first, self._boxes = first_voxel, plan_boxes(first_voxel)
        self.touched = tuple(box.index for box in self._boxes if box.index in known)

    def enqueue(self, residents: Mapping[SectorIndex, LiveSector], shown: ShownCubes) -> None:
        """Enqueue the filling of what has changed; ``publish`` must follow."""
        present = frozenset(index for index in self.touched if index in residents)
        before = self._layout
        is_new = before is None or present != before.present or self._first is not before.first
        if is_new:
            self._layout = _lay_out(self._first, self._boxes, residents, frozenset(self.touched), present, before)
        assert self._layout is not None
        for box, new_parts in self._layout.boxes:
            sector = residents[box.index]
            parts = (box,) if sector.shown_at > self._filled_at else new_parts if is_new else ()
            cubes = shown(sector) if parts else None
            for part in parts:
                x, y, z = part.lattice_first
                line, column = divmod(_on_ring(x, z), VOLUME_SHAPE[2])
                placed = replace(part, volume_first=(column, y % VOLUME_SHAPE[0], line))
                record = box_record(placed, sector.resident.sector)
                sector.resident.fill_volume(record, part.size, self._buffer, cubes, self.basis)
        # Mapped: on a processor that is the device's own memory.
        shape = (BASIS_SIZES[self.basis], VOLUME_SHAPE[0], _COLUMNS, 3)
        self._rings = cl.enqueue_map_buffer(self._device.queue, self._buffer, cl.map_flags.READ, 0, shape, np.float32, is_blocking=False)

    def publish(self, tick: int, placeholder: Callable[[SectorIndex], Float32]) -> PublishedVolume:
        """Read what ``enqueue`` asked for, put placeholders in, and show it."""
        layout = self._layout
        assert layout is not None
        values = self._arrays.take()
        self._read(values)
        for index, columns in layout.placeholders:
            values.reshape(*values.shape[:2], _COLUMNS, 3)[:, :, columns] = (from_axes(self.basis) @ placeholder(index))[:, None, None]
        values.setflags(write=False)
        self._filled_at = tick
        missing = tuple(index for index, _ in layout.placeholders)
        self.published = PublishedVolume(values, layout.mask, layout.first, tick, tuple(sorted(layout.present)), missing, self.basis)
        return self.published

    def _read(self, values: Float32) -> None:
        """Roll the rings out."""
        assert self._layout is not None
        assert self._rings is not None
        (rings, filled), self._rings = self._rings, None
        level, at = _ring_start(self._layout.first)
        rolled, gathered = values.reshape(rings.shape), self._layout.gathered
        filled.wait()
        with rings.base:
            if gathered is not None:
                flat = (len(rings), -1, 3)
                # Clipped, though nothing is out of bounds: else NumPy gathers into an array of its own.
                np.take(rings.reshape(flat), gathered, axis=1, out=rolled.reshape(flat), mode="clip")
                return
            for to, of in (
                (slice(0, VOLUME_SHAPE[0] - level), slice(level, None)),
                (slice(VOLUME_SHAPE[0] - level, None), slice(0, level)),
            ):
                rolled[:, to, : _COLUMNS - at] = rings[:, of, at:]
                rolled[:, to, _COLUMNS - at :] = rings[:, of, :at]


def came_into_sight(box: SectorBox, first: Int64, before: Int64) -> list[SectorBox]:
    """The parts of a box that a volume at ``first`` (3,) [lattice] shows and one at ``before`` did not."""
    here, there, low = first.tolist(), before.tolist(), list(box.lattice_first)
    if here == there:
        return []
    high = [at + count for at, count in zip(low, box.size, strict=True)]
    parts = []
    for axis, count in ((1, VOLUME_SHAPE[0]), (0, VOLUME_SHAPE[2]), (2, VOLUME_SHAPE[1])):
        # What lies on one side of where the volume was, then on the other; the next axis cuts what is left.
        seen = max(low[axis], there[axis]), min(high[axis], there[axis] + count)
        for start, stop in ((low[axis], min(high[axis], there[axis])), (max(low[axis], there[axis] + count), high[axis])):
            if start < stop:
                corner, end = low.copy(), high.copy()
                corner[axis], end[axis] = start, stop
                (x, y, z), (x1, y1, z1) = corner, end
                at = x - here[0], y - here[1], z - here[2]
                parts.append(SectorBox(box.index, at, (x, y, z), (x1 - x, y1 - y, z1 - z)))
        low[axis], high[axis] = seen
        if low[axis] >= high[axis]:
            break
    return parts


def _on_ring(x: int, z: int) -> int:
    """The place of a column of the lattice in its layer's ring."""
    return (z * VOLUME_SHAPE[2] + x) % _COLUMNS


def _ring_start(first: Int64) -> tuple[int, int]:
    """The places on their rings of the first layer, and of its first column, of a volume whose voxel (0, 0, 0) is at (3,)."""
    x, y, z = first.tolist()
    return y % VOLUME_SHAPE[0], _on_ring(x, z)


def volume_arrays(basis: str) -> RecycledArrays:
    """What volumes in a basis are read into."""
    return RecycledArrays((BASIS_SIZES[basis], *VOLUME_SHAPE, 3))


def _lay_out(
    first: Int64,
    around: Sequence[SectorBox],
    residents: Mapping[SectorIndex, LiveSector],
    known: frozenset[SectorIndex],
    present: frozenset[SectorIndex],
    before: _Layout | None,
) -> _Layout:
    """``around`` : the volume's boxes; ``before`` : of the same volume, whose classes of the same sectors are taken over."""
    mask = np.full(VOLUME_SHAPE, VOXEL_NO_SECTOR, np.uint8)
    has_light = np.zeros(VOLUME_SHAPE[1:], bool)
    if before is not None:
        _copy_moved(before.mask, mask, first - before.first)
    boxes, placeholders = [], []
    for box in around:
        slices = box_slices(box)
        if box.index in present:
            sector = residents[box.index].resident.sector
            # One that has just arrived is new as a whole.
            new_parts = [box] if before is None or box.index not in before.present else came_into_sight(box, first, before.first)
            for part in new_parts:
                mask[box_slices(part)] = box_mask(part, sector)
            if sector.probe_count:
                boxes.append((box, new_parts))
                has_light[slices[1:]] = True
        else:
            mask[slices] = VOXEL_NO_SECTOR
            if box.index in known:
                placeholders.append((box.index, slices[1:]))
                has_light[slices[1:]] = True
    mask.setflags(write=False)
    shown, gathered = _OWN_COLUMNS, None
    if not has_light.all() and has_light.any():
        lack, nearest = nearest_columns(has_light)
        shown = shown.copy()
        shown[tuple(lack.T)] = _OWN_COLUMNS[tuple(nearest.T)]
        gathered = _on_rings(shown.reshape(-1), first)
    columns = tuple((index, np.flatnonzero(np.isin(shown, _OWN_COLUMNS[part]))) for index, part in placeholders)
    return _Layout(first, present, tuple(boxes), mask, columns, gathered)


def _on_rings(columns: Int64, first: Int64) -> Int64:
    """(layers * n,) places on the rings of columns (n,), z * width + x, in each layer of a volume whose voxel (0, 0, 0) is at (3,)."""
    level, at = _ring_start(first)
    layers = (np.arange(VOLUME_SHAPE[0]) + level) % VOLUME_SHAPE[0]
    return (layers[:, None] * _COLUMNS + (columns + at) % _COLUMNS).reshape(-1)


def _copy_moved(source: UInt8, target: UInt8, step: Int64) -> None:
    """What two volumes (y, z, x) both show, where the second stands a step (x, y, z) from the first."""
    pairs = [
        # A slice that ended below 0 would count from the far end.
        (slice(max(by, 0), max(count + min(by, 0), 0)), slice(max(-by, 0), max(count - max(by, 0), 0)))
        for by, count in zip(step[[1, 2, 0]].tolist(), source.shape, strict=True)
    ]
    target[tuple(to for _, to in pairs)] = source[tuple(of for of, _ in pairs)]
