"""Voxels that blend a sector's probes, beside those of the sector itself: the fine ones, and those of its rooms."""

from dataclasses import dataclass, replace

import numpy as np
import pyopencl as cl

from gi_core.arrays import Float32, Int32, UInt8, UInt16
from gi_core.constants import BASIS_SIZES
from gi_core.device import Device
from gi_core.resident_sector import VOXEL_GROUP
from gi_core.rooms import without_rooms
from gi_core.volume import SectorBox, lattice_record


@dataclass(frozen=True, eq=False)
class VoxelGrid:
    """Voxels of one sector, of any size. K probes a voxel.

    first : (3,) int32, index (x, y, z) of voxel (0, 0, 0) on its lattice
    kind : (ny, nz, nx) uint8, VOXEL_SOLID, VOXEL_OUTDOORS or VOXEL_INDOORS
    probe : (ny, nz, nx, K) uint16, the sector's own probes
    weight : (ny, nz, nx, K) float32, sums to 1, or to 0 where nothing is known
    """

    first: Int32
    kind: UInt8
    probe: UInt16
    weight: Float32

    def outdoors(self, probe_room: UInt16) -> "VoxelGrid":
        """The grid as an outdoor volume blends it, of probes in these rooms (P,)."""
        probe, weight = without_rooms(self.kind, self.probe, self.weight, probe_room)
        return replace(self, probe=probe, weight=weight)


class ResidentGrid:
    """A voxel grid on a device."""

    def __init__(self, device: Device, grid: VoxelGrid) -> None:
        self.first, self.kind = grid.first, grid.kind
        self.has_light = np.asarray(grid.weight.any(axis=3), np.bool_)
        self._device = device
        self._probe, self._weight = device.upload(grid.probe), device.upload(grid.weight)
        self._probes = grid.probe.shape[3]

    @property
    def nbytes(self) -> int:
        """Bytes on the device."""
        return int(self._probe.size + self._weight.size)

    def fill(self, box: SectorBox, target: cl.Buffer, cubes: cl.Buffer, basis: str) -> None:
        """Enqueue this sector's part of a volume from its probes' light, in a basis."""
        kernel = self._device.shared_kernel("fill_volume", BASIS_SIZE=BASIS_SIZES[basis], VOXEL_PROBES=self._probes)
        whole = tuple(-(-count // group) * group for count, group in zip(box.size, VOXEL_GROUP, strict=True))
        record = lattice_record(box, self.first, self.kind.shape)
        kernel.launch(whole, VOXEL_GROUP, record, self._probe, self._weight, cubes, target)
