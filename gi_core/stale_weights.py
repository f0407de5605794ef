"""Where a moving box stands between a voxel and probes that it blends: baked weights do not know doors and vehicles.

A box that moves shades the sun at once (live_shadows). What it does not do is keep a probe's light from a voxel behind it, so a client may
ask which voxels that concerns, and how much of each.
"""

from collections.abc import Callable, Iterable, Sequence

import numpy as np

from gi_core.arrays import Bool, Float32, Float64, Int64
from gi_core.constants import VOLUME_SHAPE, VOXEL_SIZE_M
from gi_core.grid import SectorIndex, voxel_centre
from gi_core.rooms import outdoor_blend
from gi_core.sector import Sector
from gi_core.shadow_plan import MovingBox, box_axes
from gi_core.volume import box_slices, plan_boxes, sector_slices


def boxes_in_reach(boxes: Sequence[MovingBox], first_voxel: Int64) -> tuple[MovingBox, ...]:
    """Those that may touch a volume whose voxel (0, 0, 0) has the lattice index ``first_voxel`` (3,)."""
    if not boxes:
        return ()
    low = first_voxel * VOXEL_SIZE_M
    high = low + VOXEL_SIZE_M * np.array(VOLUME_SHAPE)[[2, 0, 1]]
    position = np.array([box.position for box in boxes])
    away = np.linalg.norm(position - np.clip(position, low, high), axis=1)
    near = away <= np.linalg.norm([box.half_size for box in boxes], axis=1)
    return tuple(box for box, is_near in zip(boxes, near.tolist(), strict=True) if is_near)


def stale_share(
    sector_of: Callable[[SectorIndex], Sector], sectors: Iterable[SectorIndex], boxes: Sequence[MovingBox], first_voxel: Int64
) -> Float32:
    """Share 0..1 of each voxel's light (16, 32, 32) that comes from probes which a box hides from the voxel's centre, or which lie in one.

    sector_of : reads a sector of ``sectors``, those that the volume was filled from; first_voxel : (3,) lattice index of voxel (0, 0, 0)
    Raises what ``sector_of`` raises.
    """
    share: Float32 = np.zeros(VOLUME_SHAPE, np.float32)
    if not boxes:
        return share
    there = set(sectors)
    for part in plan_boxes(first_voxel):
        if part.index not in there:
            continue
        sector = sector_of(part.index)
        if not sector.probe_count:
            continue
        y, z, x = sector_slices(part, sector)
        probe, weight = (values[y, z, x] for values in outdoor_blend(sector))
        # Sector-local, as probes are: float64 far from the world's origin.
        voxel = voxel_centre(np.moveaxis(np.indices(probe.shape[:3])[[2, 0, 1]], 0, -1) + part.lattice_first) - part.index.origin
        wanted = np.nonzero(weight > 0)
        start = voxel[wanted[:3]]
        hidden: Bool = np.zeros(probe.shape, np.bool_)
        hidden[wanted] = _crossed(start, sector.probe_position[probe[wanted]] - start, boxes, part.index.origin)
        share[box_slices(part)] = (weight * hidden).sum(axis=-1)
    return np.minimum(share, np.float32(1.0))


def _crossed(start: Float64, way: Float64, boxes: Sequence[MovingBox], origin: Float64) -> Bool:
    """Which ways (n, 3) [m] from places (n, 3) [m], local to ``origin`` (3,), touch a box: slab by slab."""
    crossed: Bool = np.zeros(len(start), np.bool_)
    middle, reach = start + way / 2, np.linalg.norm(way, axis=1) / 2
    for box, axes in zip(boxes, box_axes(boxes), strict=True):
        place = np.asarray(box.position) - origin
        near = np.flatnonzero((np.abs(middle - place).max(axis=1) <= reach + np.linalg.norm(box.half_size)) & ~crossed)
        at, step, half = (start[near] - place) @ axes.T, way[near] @ axes.T, np.asarray(box.half_size)
        with np.errstate(divide="ignore", invalid="ignore"):
            sides = np.stack([(-half - at) / step, (half - at) / step])
        # Along an axis that it does not move on, a way is in the slab for good, or never.
        still, inside = step == 0, np.abs(at) <= half
        enter = np.where(still, np.where(inside, -np.inf, np.inf), sides.min(axis=0)).max(axis=1)
        leave = np.where(still, np.where(inside, np.inf, -np.inf), sides.max(axis=0)).min(axis=1)
        crossed[near] = (enter <= leave) & (leave >= 0) & (enter <= 1)
    return crossed
