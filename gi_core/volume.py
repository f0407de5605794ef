"""The irradiance volume around a position: 100 x 50 x 100 m in 32 x 16 x 32 voxels (slide "Irradiance volume"), and how a client
samples it."""

import math
from dataclasses import dataclass

import numpy as np

from gi_core.arrays import AnyArray, Bool, Float32, Float64, Int32, Int64, UInt8, UInt16
from gi_core.basis import basis_of_size, evaluate
from gi_core.constants import ROOM_OUTDOORS, SECTOR_SIZE_M, VOLUME_SHAPE, VOXEL_INDOORS, VOXEL_OUTDOORS, VOXEL_SIZE_M, VOXEL_SOLID
from gi_core.grid import SectorIndex, voxel_centre, voxel_columns
from gi_core.layout import VOLUME_BOX
from gi_core.sector import Sector


@dataclass(frozen=True, eq=False)
class Volume:
    """An irradiance volume.

    values : (B, 16, 32, 32, 3) float32 [lx]: coefficient, y, z, x, channel
    mask : (16, 32, 32) uint8: VOXEL_SOLID, VOXEL_OUTDOORS, VOXEL_INDOORS, VOXEL_NO_SECTOR
    first_voxel : (3,) int64, world lattice index (x, y, z) of voxel (0, 0, 0)
    sectors : those that it was filled from
    expected_error : median relative error that the dataset's error report gives, or None without a report
    cascade : its voxels are VOXEL_SIZE_M times 2 to this
    residual : what later bounces could still add at most, as a share of a sector's brightest value; None of a live volume
    rooms : numbers of the rooms that an interior volume reaches: its mask says VOXEL_INDOORS there and nowhere else; none outdoors
    """

    values: Float32
    mask: UInt8
    first_voxel: Int64
    sectors: tuple[SectorIndex, ...]
    basis: str = "cube"
    expected_error: float | None = None
    cascade: int = 0
    residual: float | None = None
    rooms: tuple[int, ...] = ()

    @property
    def origin(self) -> Float64:
        """World position (3,) [m] of the centre of voxel (0, 0, 0)."""
        return voxel_centre(self.first_voxel, float(self.voxel_size[0]))

    @property
    def voxel_size(self) -> Float64:
        """(3,) [m]."""
        return np.full(3, VOXEL_SIZE_M * 2.0**self.cascade)

    @property
    def valid(self) -> float:
        """Share of voxels in free air, outdoors or indoors."""
        return float(np.isin(self.mask, (VOXEL_OUTDOORS, VOXEL_INDOORS)).mean())

    @property
    def own(self) -> Bool:
        """(16, 32, 32): voxels of the air that the volume is of; what all others hold was taken from the nearest of these."""
        return np.asarray(self.mask == (VOXEL_INDOORS if self.rooms else VOXEL_OUTDOORS), np.bool_)


Voxels = tuple[int, int, int]  # along x, y, z


@dataclass(frozen=True, slots=True)
class SectorBox:
    """The part of a volume that one sector fills, or a part of that: first indices and size along (x, y, z).

    Numbers of Python's: dozens of boxes are made in a tick, and small arrays take longer than what they are for.
    """

    index: SectorIndex
    volume_first: Voxels
    lattice_first: Voxels
    size: Voxels


def plan_boxes(first_voxel: Int64, voxel_size_m: float = VOXEL_SIZE_M) -> list[SectorBox]:
    """Which sectors a volume reads, and where each goes. Pure; together they cover the volume once."""
    ny, nz, nx = VOLUME_SHAPE
    x, y, z = first_voxel.tolist()
    columns, lines = split_columns(x, nx, voxel_size_m), split_columns(z, nz, voxel_size_m)
    return [
        SectorBox(SectorIndex(sector_x, sector_z), (x0 - x, 0, z0 - z), (x0, y, z0), (x1 - x0, ny, z1 - z0))
        for sector_z, z0, z1 in lines
        for sector_x, x0, x1 in columns
    ]


def split_columns(first: int, count: int, voxel_size_m: float) -> list[tuple[int, int, int]]:
    """Runs (sector, first voxel, past the last) of voxel columns along one axis."""
    runs = []
    sector = math.floor((first + 0.5) * voxel_size_m / SECTOR_SIZE_M)
    at = first
    while at < first + count:
        end = min(voxel_columns(sector, voxel_size_m)[1], first + count)
        runs.append((sector, at, end))
        at, sector = end, sector + 1
    return runs


def box_record(box: SectorBox, sector: Sector) -> AnyArray:
    """The box as fill_volume.cl reads it from a sector's voxels: (1,) layout.VOLUME_BOX."""
    return lattice_record(box, sector.voxel_first, sector.voxel_class.shape)


def lattice_record(box: SectorBox, first: Int32, shape: tuple[int, ...]) -> AnyArray:
    """The box as fill_volume.cl reads it from voxels (y, z, x) that begin at a lattice index (3,)."""
    ny, nz, nx = VOLUME_SHAPE
    sy, sz, sx = shape
    box_size, volume_first, volume_size = (*box.size, 0), (*box.volume_first, 0), (nx, ny, nz, 0)
    sector_first, sector_size = (*_counted_from(box.lattice_first, first), 0), (sx, sy, sz, 0)
    return np.array([(box_size, volume_first, volume_size, sector_first, sector_size)], VOLUME_BOX.dtype)


def _counted_from(lattice: Voxels, first: AnyArray) -> Voxels:
    (x, y, z), (first_x, first_y, first_z) = lattice, first.tolist()
    return x - first_x, y - first_y, z - first_z


def sector_slices(box: SectorBox, sector: Sector) -> tuple[AnyArray, slice, slice]:
    """Indices (y, z, x) into a sector's voxel arrays that a box reads; heights beyond its layers read the lowest or highest."""
    y = np.clip(int(box.lattice_first[1] - sector.voxel_first[1]) + np.arange(box.size[1]), 0, sector.voxel_class.shape[0] - 1)
    return y, *_columns(box, sector)


def _columns(box: SectorBox, sector: Sector) -> tuple[slice, slice]:
    """The columns (z, x) of a sector's voxel arrays that a box reads."""
    (x, _, z), (nx, _, nz) = _counted_from(box.lattice_first, sector.voxel_first), box.size
    return slice(z, z + nz), slice(x, x + nx)


def box_mask(box: SectorBox, sector: Sector) -> UInt8:
    """Voxel classes (y, z, x) of a box. Below what a sector stores is solid."""
    nx, height, nz = box.size
    mask: UInt8 = np.empty((height, nz, nx), np.uint8)
    first, layers = box.lattice_first[1] - int(sector.voxel_first[1]), len(sector.voxel_class)
    z, x = _columns(box, sector)
    # Layers that are stored, what lies below them, and above them the highest again.
    low, high = min(max(-first, 0), height), min(max(layers - first, 0), height)
    mask[:low] = VOXEL_SOLID
    mask[low:high] = sector.voxel_class[first + low : first + high, z, x]
    mask[max(low, high) :] = sector.voxel_class[-1, z, x]
    return mask


def box_rooms(box: SectorBox, sector: Sector, voxel_room: UInt16) -> UInt16:
    """Rooms (y, z, x) of a box's voxels, from those of a sector's; what lies below what a sector stores is in none."""
    y, z, x = sector_slices(box, sector)
    rooms: UInt16 = np.take(voxel_room[:, z, x], y, axis=0)
    rooms[: max(int(sector.voxel_first[1] - box.lattice_first[1]), 0)] = ROOM_OUTDOORS
    return rooms


def box_slices(box: SectorBox) -> tuple[slice, slice, slice]:
    """Where a box lies in its volume's (y, z, x)."""
    (x, y, z), (nx, ny, nz) = box.volume_first, box.size
    return slice(y, y + ny), slice(z, z + nz), slice(x, x + nx)


def nearest_columns(has_light: Bool) -> tuple[Int64, Int64]:
    """Columns (n, 2), (z, x), without light, and for each the nearest that has some, of which there is one at least: a volume has no black
    edge."""
    lack, (nz, nx) = np.argwhere(~has_light), has_light.shape
    lines, columns = np.flatnonzero(has_light.any(axis=1)), np.flatnonzero(has_light.any(axis=0))
    low, high = np.array([lines[0], columns[0]]), np.array([lines[-1], columns[-1]])
    if nz * nx - len(lack) == np.prod(high - low + 1):  # a rectangle, as at the edge of most worlds, for a tenth of the time
        return lack, np.clip(lack, low, high)
    # First along z, then, of what that found, along x: squares of distances add. Each carries its column, so that the least tells which.
    square, line = np.divmod(_least_beside(np.where(has_light, np.int32(0), np.int32(nz * nz + nx * nx))), nz)
    column = _least_beside(square.T).T % nx
    z, x = lack.T
    return lack, np.stack([line[z, column[z, x]], column[z, x]], axis=1).astype(np.int64)


def _least_beside(square: Int32) -> Int32:
    """(n, m) for (n, m): along the first axis the least of square + distance^2, times n, plus where that was."""
    place = np.arange(len(square), dtype=np.int32)
    beside = np.subtract.outer(place, place) ** 2 * np.int32(len(square)) + place[:, None]
    return np.asarray((beside[:, :, None] + square[:, None] * np.int32(len(square))).min(axis=0), np.int32)


def sample_volume(values: Float32, origin: Float64, voxel_size: Float64, points: Float64, normals: Float32) -> Float32:
    """Irradiance [lx] as a client reconstructs it: trilinear, a quarter voxel off the surface, the basis along the normal.

    Parameters
    ----------
    values : (B, ny, nz, nx, 3) float32 [lx], in the basis of B coefficients; origin : (3,) [m], centre of voxel (0, 0, 0)
    voxel_size : (3,) [m]
    points : (n, 3) [m], world frame, on surfaces; normals : (n, 3) unit

    Returns
    -------
    irradiance : (n, 3) float32 [lx]

    Beyond the volume's outermost voxel centres its edge is read, as with a clamped texture.
    """
    normals = np.asarray(normals, np.float32)
    basis = basis_of_size(len(values))
    if basis != "cube":
        there = sample_coefficients(values, origin, voxel_size, points + 0.25 * voxel_size * normals)
        return np.asarray(evaluate(basis, there, normals), np.float32)
    texel, weight = _corners(values.shape[1:4], origin, voxel_size, points + 0.25 * voxel_size * normals)
    texels = values.reshape(-1, values.shape[4])
    total = np.zeros((len(points), values.shape[4]), np.float32)
    # Of the six faces a normal reads those that it turns to, one where it follows an axis: most of a city's surfaces do.
    for axis in range(3):
        turned = np.flatnonzero(normals[:, axis])
        along = normals[turned, axis]
        first = np.where(along >= 0, 2 * axis, 2 * axis + 1) * (len(texels) // 6)
        face = np.zeros((len(turned), values.shape[4]), np.float32)
        for corner in range(8):
            face += weight[corner, turned, None] * texels.take(texel[corner, turned] + first, axis=0)
        total[turned] += (along * along)[:, None] * face
    return total


def sample_coefficients(values: Float32, origin: Float64, voxel_size: Float64, points: Float64) -> Float32:
    """All coefficients (n, B, C) at points (n, 3) [m], trilinear and clamped to the edge. values is (B, ny, nz, nx, C)."""
    texel, weight = _corners(values.shape[1:4], origin, voxel_size, points)
    texels = np.moveaxis(values, 0, 3).reshape(-1, values.shape[0], values.shape[4])
    total = np.zeros((len(points), *texels.shape[1:]), np.float32)
    for corner in range(8):
        total += weight[corner, :, None, None] * texels[texel[corner]]
    return total


def _corners(shape: tuple[int, ...], origin: Float64, voxel_size: Float64, points: Float64) -> tuple[Int64, Float32]:
    """The eight voxels around points (n, 3) [m] and what each weighs: row-major numbers (8, n) in (ny, nz, nx), and (8, n)."""
    ny, nz, nx = shape
    top = np.array([nx, ny, nz]) - 1
    at = np.clip((points - origin) / voxel_size, 0, top).T
    low = np.minimum(at.astype(np.int64), np.maximum(top - 1, 0)[:, None])
    share = (at - low).astype(np.float32)
    pairs = [(1 - s, s) for s in share]
    first = (low[1] * nz + low[2]) * nx + low[0]
    # A volume of one voxel along an axis has no second one; its share is 0.
    step = np.minimum(top, 1) * (1, nz * nx, nx)
    number, weight = np.empty((8, len(points)), np.int64), np.empty((8, len(points)), np.float32)
    for corner in range(8):
        offset = (corner & 1, corner >> 1 & 1, corner >> 2 & 1)
        number[corner] = first + step @ offset
        np.multiply(pairs[0][offset[0]] * pairs[1][offset[1]], pairs[2][offset[2]], out=weight[corner])
    return number, weight
