"""Which lamps touch a sector, what must be lit anew when some change, and how much goes into one launch: pure plans, no device."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gi_core.arrays import AnyArray, Float32, Float64
from gi_core.layout import SURFEL_WORD, SURFELS_PER_WORD
from gi_core.lights import area_halves, check_lamp
from gi_core.sector import Sector
from gi_core.world import Lamp

# Records of one launch lie in constant memory, of which a device has 64 kB at least: 12 kB.
MAX_LIGHTS_PER_LAUNCH = 128
# Beyond this many changed lamps, looking for surfels far from all of them costs more than summing all.
MAX_CHANGED = 32
# Shadow rays start a little off their surfel.
_BOX_MARGIN_M = 0.1


@dataclass(frozen=True, eq=False)
class TouchingLamp:
    """A lamp with a surfel in its range, and a box that all shadow rays between the two lie in.

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
        # By coordinate: NumPy's sums over a long axis are some times faster than over one of three.
        self._position = np.ascontiguousarray(sector.surfel_position.T, np.float64)
        first = sector.brick_starts[:-1].astype(np.int64)
        empty = np.zeros((3, 0))
        self._low = np.minimum.reduceat(self._position, first, axis=1) if len(first) else empty
        self._high = np.maximum.reduceat(self._position, first, axis=1) if len(first) else empty
        self.low, self.high = self._low.min(axis=1, initial=np.inf), self._high.max(axis=1, initial=-np.inf)
        """Box (3,) about all surfels, sector-local [m]."""

    def box_within(self, position: Float64, distance_m: float) -> tuple[Float64, Float64] | None:
        """A box (3,), (3,) about the surfels closer than a distance to a position (3,), sector-local [m]; None when there is none.

        It holds whole bricks, and so a little more than it must.
        """
        at = position[:, None]
        squared = _squares(at - np.minimum(np.maximum(at, self._low), self._high))
        bricks = np.flatnonzero(squared < distance_m**2)
        if not len(bricks):
            return None
        low, high = self._low.take(bricks, axis=1), self._high.take(bricks, axis=1)
        # Nearly always some brick is in range to its farthest corner; only where none is, surfels are looked at.
        whole = _squares(np.maximum(at - low, high - at)) < distance_m**2
        if not whole.any() and not (_squares(self._position - at) < distance_m**2).any():
            return None
        low, high = low.min(axis=1), high.max(axis=1)
        return np.maximum(low, position - distance_m), np.minimum(high, position + distance_m)


def touching_lamps(lamps: Sequence[Lamp], surfels: SurfelBounds) -> tuple[TouchingLamp, ...]:
    """Lamps that have one of the sector's surfels in range, in their order: by the surfels' box, then their bricks', then one by one.

    Raises InputError for a touching lamp that cannot be lit with.
    """
    if not lamps:
        return ()
    position = np.array([lamp.position for lamp in lamps], np.float64) - surfels.origin
    squared_range = np.array([lamp.range_m for lamp in lamps], np.float64) ** 2
    beyond = position - np.minimum(np.maximum(position, surfels.low), surfels.high)
    found = []
    for i in np.flatnonzero(_squares(beyond.T) < squared_range).tolist():
        box = surfels.box_within(position[i], lamps[i].range_m)
        if box is not None:
            check_lamp(lamps[i])
            extent = np.abs(area_halves(lamps[i])).sum(axis=0) if lamps[i].kind == "area" else np.zeros(3)
            low = np.minimum(box[0] - _BOX_MARGIN_M, position[i] - extent)
            high = np.maximum(box[1] + _BOX_MARGIN_M, position[i] + extent)
            found.append(TouchingLamp(i, lamps[i], low + surfels.origin, high + surfels.origin))
    return tuple(found)


def changed_spheres(before: Sequence[Lamp], after: Sequence[Lamp], origin: Float64) -> Float32 | None:
    """Centres, local to ``origin`` (3,), and ranges (n, 4) [m] beyond which the sum of lamps in their order stays as it was.

    None when it may change anywhere. Lamps that stand at the same place of both lists, from the start or from the end, are the same.
    """
    if len(before) == len(after):
        changed = [lamp for pair in zip(before, after, strict=True) if pair[0] is not pair[1] and pair[0] != pair[1] for lamp in pair]
    else:
        shorter = min(len(before), len(after))
        head = next((i for i in range(shorter) if before[i] != after[i]), shorter)
        tail = next((i for i in range(shorter - head) if before[-1 - i] != after[-1 - i]), shorter - head)
        changed = [*before[head : len(before) - tail], *after[head : len(after) - tail]]
    if not changed or len(changed) > MAX_CHANGED:
        return None
    x, y, z = origin.tolist()
    spheres = [(lamp.position[0] - x, lamp.position[1] - y, lamp.position[2] - z, lamp.range_m) for lamp in changed]
    return np.array(spheres, np.float32)


def surfel_words(sector: Sector) -> AnyArray:
    """(words,) records of layout.SURFEL_WORD. What fills the last one up has no normal and lies where its first surfel does."""
    words = -(-sector.surfel_count // SURFELS_PER_WORD)
    records = np.zeros(words, SURFEL_WORD.dtype)
    position, normal = np.zeros((2, words * SURFELS_PER_WORD, 3), np.float32)
    position[: sector.surfel_count], normal[: sector.surfel_count] = sector.surfel_position, sector.surfel_normal
    position[sector.surfel_count :] = position[(words - 1) * SURFELS_PER_WORD :][:1]
    position, normal = (values.reshape(words, SURFELS_PER_WORD, 3) for values in (position, normal))
    for axis, name in enumerate("xyz"):
        records[f"position_{name}"], records[f"normal_{name}"] = position[..., axis], normal[..., axis]
    records["low"], records["high"] = position.min(axis=1), position.max(axis=1)
    return records


def _squares(vectors: Float64) -> Float64:
    """Squared lengths of (3, n)."""
    return np.asarray(vectors[0] * vectors[0] + vectors[1] * vectors[1] + vectors[2] * vectors[2])
