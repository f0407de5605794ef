"""In which order volumes are filled when a tick has no time for all of them. Pure: arrays in, rows out.

A volume is behind from the tick in which its player moved on, or a sector that it reads was relit, until it is filled:

    need = ticks for which it has been behind, this one included  x  how near to its player that was

So under load the rate of those falls first whose light has changed at their rim only, to a quarter; from then on everybody's falls alike.

Nobody starves: nearness is a weight within 1 .. 1 / WEIGHT_RATIO, while the wait grows without bound. By the argument of tick_plan, with
f volumes filled a tick and q = floor((n - 1) / f) for n players, none is behind for more than

    (WEIGHT_RATIO + 1) q + 1 ticks
"""

import numpy as np

from gi_core.arrays import Float64, Int64
from gi_core.constants import VOLUME_SHAPE, VOXEL_SIZE_M

_LEAST_WEIGHT = 0.25
WEIGHT_RATIO = 1 / _LEAST_WEIGHT
# A volume's rim, from its player.
RIM_M = VOLUME_SHAPE[1] * VOXEL_SIZE_M / 2


def fill_order(tick: int, behind_since: Int64, away_m: Float64) -> Int64:
    """Rows of volumes (n,) in the order in which to fill them; rows that need it alike stay in their order.

    behind_since : (n,) int64, the first tick of each, up to ``tick``, in which it was behind
    away_m : (n,) float64 [m], from its player to the nearest sector that has changed since; 0 where it stands in one, or has moved on
    """
    need = (tick - behind_since + 1) * np.maximum(1 - away_m / RIM_M, _LEAST_WEIGHT)
    return np.argsort(-need, kind="stable")


def longest_wait(players: int, *, filled: int = 1) -> int:
    """Ticks within which each of so many players' volumes is filled, with so many filled in each. See the top of this file."""
    return int(WEIGHT_RATIO + 1) * ((players - 1) // filled) + 1
