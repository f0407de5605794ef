"""Air cut where it is narrow: a watershed on the distance to what is solid, so that doors and windows become the seams between rooms.

Air is looked at from its widest places down. Where the ground that two of them have claimed meets, they are one when the air between them
is nearly as wide as the narrower of the two, and two otherwise: a passage as wide as its room is part of it, a door is not.
"""

from collections import defaultdict

import numpy as np
from scipy.ndimage import distance_transform_edt, label

from gi_core.arrays import Bool, Float32, Int32, Int64

# Air between two places at least this share as wide as the narrower of them makes them one.
SEAM_SHARE = 0.75
# Wider is not told apart: 8 m across, in cells of ROOM_CELL_M.
MAX_WIDTH_CELLS = 10.0
_STEP_CELLS = 0.5


def find_basins(free: Bool) -> Int32:
    """Numbers (ny, nz, nx) from 1 of the basins that free cells (ny, nz, nx) fall into, in the order of their first cells; 0 elsewhere.

    Beyond the array lies air. Cells belong together through their faces.
    """
    width = np.full(free.shape, MAX_WIDTH_CELLS) if free.all() else np.minimum(distance_transform_edt(free), MAX_WIDTH_CELLS)
    padded = np.pad(width.astype(np.float32), 1)
    found = _flood(padded).reshape(padded.shape)[1:-1, 1:-1, 1:-1]
    used, first, of_cell = np.unique(found, return_index=True, return_inverse=True)
    order = np.where(used > 0, first, -1).argsort()  # what is no air comes first, and keeps its 0
    numbers = np.empty(len(used), np.int32)
    numbers[order] = np.arange(len(used)) + (0 if (used == 0).any() else 1)
    return numbers[of_cell.reshape(found.shape)]


def _flood(width: Float32) -> Int32:
    """Labels (flat) of cells by their width (ny, nz, nx), 0 of those of no width, which all at the border are."""
    flat, shape = width.reshape(-1), width.shape
    steps = neighbour_steps(shape)
    basin = np.zeros(flat.size, np.int32)
    birth, parent = [0.0], [0]
    for level in np.arange(MAX_WIDTH_CELLS, 1 - _STEP_CELLS, -_STEP_CELLS):
        waiting = np.flatnonzero((flat >= level) & (basin == 0))
        changed = waiting
        while len(waiting):
            # Of several that reach a cell at once, the oldest has it.
            beside = basin[waiting[:, None] + steps]
            least = np.where(beside == 0, np.iinfo(np.int32).max, beside).min(axis=1)
            reached = least < np.iinfo(np.int32).max
            if not reached.any():
                peaks, count = label(_mask(waiting, flat.size).reshape(shape))
                basin[waiting] = peaks.reshape(-1)[waiting] + len(birth) - 1
                parent += range(len(birth), len(birth) + count)
                birth += [float(level)] * count
                break
            basin[waiting[reached]] = least[reached]
            waiting = waiting[~reached]
        for one, other in _touching(basin, changed, steps):
            a, b = sorted((_root(parent, one), _root(parent, other)))
            # A cell's own half is not air that is known.
            if a != b and level - 0.5 >= SEAM_SHARE * (min(birth[a], birth[b]) - 0.5):
                parent[b], birth[a] = a, max(birth[a], birth[b])
    roots = np.array([_root(parent, number) for number in range(len(birth))], np.int32)
    return roots[basin]


def contacts(basin: Int32) -> dict[int, dict[int, int]]:
    """How many faces the cells of each number (ny, nz, nx) share with those of each other one, 0 included."""
    found: dict[int, dict[int, int]] = defaultdict(dict)
    scale = int(basin.max()) + 1
    total: dict[int, int] = defaultdict(int)
    for axis in range(3):
        along = np.moveaxis(basin, axis, 0).astype(np.int64)
        key = np.minimum(along[:-1], along[1:]) * scale + np.maximum(along[:-1], along[1:])
        keys, counts = np.unique(key[along[:-1] != along[1:]], return_counts=True)
        for pair, count in zip(keys.tolist(), counts.tolist(), strict=True):
            total[pair] += count
    for pair, count in total.items():
        one, other = divmod(pair, scale)
        found[one][other] = found[other][one] = count
    return found


def neighbour_steps(shape: tuple[int, ...]) -> Int64:
    """(6,): from a cell's flat index to those of its neighbours across faces."""
    _, nz, nx = shape
    return np.array([-nz * nx, nz * nx, -nx, nx, -1, 1], np.int64)


def _mask(chosen: Int64, size: int) -> Bool:
    mask = np.zeros(size, np.bool_)
    mask[chosen] = True
    return mask


def _root(parent: list[int], number: int) -> int:
    """The number that a union goes by; ways there are made short."""
    while parent[number] != number:
        parent[number] = number = parent[parent[number]]
    return number


def _touching(basin: Int32, cells: Int64, steps: Int64) -> list[tuple[int, int]]:
    """Pairs of numbers, the lower first, that meet at a face of some cells; in order."""
    own, beside = basin[cells][:, None], basin[cells[:, None] + steps]
    differ = (beside != own) & (beside > 0)
    low, high = np.minimum(own, beside)[differ].astype(np.int64), np.maximum(own, beside)[differ].astype(np.int64)
    keys = np.unique(low << 32 | high)
    return [(key >> 32, key & 0xFFFFFFFF) for key in keys.tolist()]
