"""The volume as a client of a stream has it. Both ends keep one and change it in the same way, so they hold the same bits.

The server compares new light with its mirror, not with the light it had before: what quantisation and thresholds leave out is
never lost twice, and can't add up.
"""

import numpy as np

from gi_core.arrays import AnyArray, Bool, Float32, Int64, UInt8, UInt16
from gi_core.constants import VOXEL_NO_SECTOR
from server.half_floats import floats_from_half
from server.stream_header import StreamHeader

Move = tuple[int, int, int]  # whole voxels along x, y, z


class Mirror:
    """A volume at a tick.

    values : (B, N, 3) float32 [lx], N = voxels in the order y, z, x
    mask : (N,) uint8 voxel classes
    first_voxel : (3,) int64, world lattice index (x, y, z) of voxel (0, 0, 0)
    tick : of the frame that made it so, or -1 before the first
    """

    def __init__(self, header: StreamHeader) -> None:
        self.shape = header.shape[1:]
        self.voxels = header.voxels
        self.values: Float32 = np.zeros((header.shape[0], header.voxels, 3), np.float32)
        self.mask: UInt8 = np.full(header.voxels, VOXEL_NO_SECTOR, np.uint8)
        self.first_voxel: Int64 = np.zeros(3, np.int64)
        self.tick = -1

    def move_to(self, first_voxel: Int64) -> Move | None:
        """How far a new place is; None when the two volumes have no voxel in common."""
        ny, nz, nx = self.shape
        x, y, z = (int(n) for n in np.asarray(first_voxel, np.int64) - self.first_voxel)
        return (x, y, z) if abs(x) < nx and abs(y) < ny and abs(z) < nz else None

    def move(self, step: Move, first_voxel: Int64) -> None:
        """Take the volume elsewhere: voxels keep their place in the world. Those that ``entering`` names are left undefined."""
        _, nz, nx = self.shape
        x, y, z = step
        # In flat order every voxel that stays moves by the same distance; what wraps around an edge is entering.
        distance = (y * nz + z) * nx + x
        to, of = _overlap(len(self.mask), -distance), _overlap(len(self.mask), distance)
        for coefficient in self.values:
            coefficient[to] = coefficient[of]  # NumPy sees that the two overlap
        self.mask[to] = self.mask[of]
        self.first_voxel = np.array(first_voxel, np.int64)

    def write(self, chosen: Int64 | slice, classes: UInt8, halves: UInt16, scale: float) -> None:
        """Set voxels: ``chosen`` among N, their classes (n,) and halves (B, n, 3) times ``scale`` [lx]."""
        light = floats_from_half(halves, scale)
        _texels(self.values)[:, chosen] = _texels(light)
        self.mask[chosen] = classes


def _texels(values: Float32) -> AnyArray:
    """(B, n, 3) float32 as (B, n) items of three: NumPy then moves twelve bytes at a time instead of four."""
    return values.view("V12").reshape(values.shape[:2])


def entering(shape: tuple[int, int, int], step: Move) -> Bool:
    """(N,) which voxels of a volume (y, z, x) were outside it before a step of whole voxels (x, y, z)."""
    outside = np.ones(shape, np.bool_)
    x, y, z = step
    outside[_overlap(shape[0], -y), _overlap(shape[1], -z), _overlap(shape[2], -x)] = False
    return outside.reshape(-1)


def _overlap(count: int, step: int) -> slice:
    """The part of 0..count that is still inside 0..count after a step backwards."""
    return slice(max(step, 0), count + min(step, 0))
