"""What voxels near a border of sectors may blend: towards it they give up probes that the sector beyond does not hold, so that at the
border line both sectors choose among the same (gi_core/MATH.md, "Steps across borders")."""

import numpy as np

from gi_core.arrays import Float64
from gi_core.constants import SECTOR_SIZE_M, VOXEL_SIZE_M

# Over the last two voxels before a border.
FADE_M = 2 * VOXEL_SIZE_M


def to_border(position: Float64) -> Float64:
    """(..., 2) [m]: how far positions (..., 3) [m] are from the nearest border line across x, and across z."""
    place = position[..., [0, 2]] / SECTOR_SIZE_M
    return np.asarray(np.abs(place - np.round(place)) * SECTOR_SIZE_M)


def kept_at_border(centre: Float64, probes: Float64, margin_m: float) -> Float64:
    """(V, c), 0 to 1: what voxels (V, 3) keep of the weights of candidates (V, c, 3).

    All of it where both sectors at a voxel's nearest border line hold the probe, otherwise a share that falls with the way to the line.
    """
    line = np.round(centre[:, [0, 2]] / SECTOR_SIZE_M) * SECTOR_SIZE_M
    held_by_both = np.abs(probes[:, :, [0, 2]] - line[:, None]) < margin_m
    share = np.minimum(to_border(centre) / FADE_M, 1)[:, None]
    return np.asarray(np.where(held_by_both, 1, share).prod(axis=2))
