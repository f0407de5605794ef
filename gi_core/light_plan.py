"""Which lamps touch a sector, and how many go into one launch: pure plans, no device."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gi_core.arrays import Float64
from gi_core.lights import area_halves, check_lamp
from gi_core.sector import Sector, counts
from gi_core.world import Lamp

# Records of one launch lie in constant memory, and the shadow bits of its lamps in one buffer: 230 kB at talk size.
MAX_LIGHTS_PER_LAUNCH = 32
# 12 MB of them. A lamp that needs more has a launch of its own.
MAX_TRIANGLES_PER_LAUNCH = 1 << 18
# Shadow rays start a little off their surfel.
_BOX_MARGIN_M = 0.1


@dataclass(frozen=True, eq=False)
class TouchingLamp:
    """A lamp with a surfel in its range, and the box that all shadow rays between the two lie in.

    index : of the lamp in the list that it was given in
    low, high : (3,) float64 [m], world frame
    """

    index: int
    lamp: Lamp
    low: Float64
    high: Float64


class SurfelBounds:
    """Where a sector's surfels are, made once: finding what a lamp touches then looks at bricks first."""

    def __init__(self, sector: Sector) -> None:
        self.origin = sector.index.origin
        self.position = sector.surfel_position.astype(np.float64)
        self.per_brick = counts(sector.brick_starts)
        first = sector.brick_starts[:-1].astype(np.int64)
        empty = np.zeros((0, 3))
        self.brick_low = np.minimum.reduceat(self.position, first) if len(first) else empty
        self.brick_high = np.maximum.reduceat(self.position, first) if len(first) else empty

    def within(self, position: Float64, distance_m: float) -> Float64:
        """Sector-local positions (n, 3) [m] of the surfels closer than a distance to a sector-local position (3,)."""
        beyond = position - np.minimum(np.maximum(position, self.brick_low), self.brick_high)
        near = self.position[np.repeat(_squares(beyond) < distance_m**2, self.per_brick)]
        return np.asarray(near[_squares(near - position) < distance_m**2])


def touching_lamps(lamps: Sequence[Lamp], surfels: SurfelBounds) -> tuple[TouchingLamp, ...]:
    """Lamps that have one of the sector's surfels in range, in their order: by the surfels' box, then their bricks', then one by one.

    Raises InputError for a touching lamp that cannot be lit with.
    """
    if not lamps or not len(surfels.position):
        return ()
    position = np.array([lamp.position for lamp in lamps], np.float64) - surfels.origin
    squared_range = np.array([lamp.range_m for lamp in lamps], np.float64) ** 2
    beyond = position - np.clip(position, surfels.brick_low.min(axis=0), surfels.brick_high.max(axis=0))
    found = []
    for i in np.flatnonzero(_squares(beyond) < squared_range).tolist():
        near = surfels.within(position[i], lamps[i].range_m)
        if len(near):
            check_lamp(lamps[i])
            extent = np.abs(area_halves(lamps[i])).sum(axis=0) if lamps[i].kind == "area" else np.zeros(3)
            low = np.minimum(near.min(axis=0) - _BOX_MARGIN_M, position[i] - extent)
            high = np.maximum(near.max(axis=0) + _BOX_MARGIN_M, position[i] + extent)
            found.append(TouchingLamp(i, lamps[i], low + surfels.origin, high + surfels.origin))
    return tuple(found)


def plan_launches(triangle_counts: Sequence[int]) -> list[range]:
    """Consecutive lamps for each launch, every lamp in one, from how many triangles each lamp has near it."""
    launches, first, held = [], 0, 0
    for i, count in enumerate(triangle_counts):
        if i > first and (i - first == MAX_LIGHTS_PER_LAUNCH or held + count > MAX_TRIANGLES_PER_LAUNCH):
            launches.append(range(first, i))
            first, held = i, 0
        held += count
    if first < len(triangle_counts):
        launches.append(range(first, len(triangle_counts)))
    return launches


def _squares(vectors: Float64) -> Float64:
    """Squared lengths of (n, 3); some times faster than a sum over so short an axis."""
    return np.asarray(np.einsum("ij,ij->i", vectors, vectors))
