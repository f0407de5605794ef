"""What voxels blend, for a file: each list of probes and weights once, as most of the solid ones repeat a neighbour's.

Lists are numbered in the order in which voxels first have them. A voxel's code is 0 where its list is a new one, and otherwise how many
lists back it is, 1 being the last one there was. The order of a list's probes means nothing, so each stays in the place that it had in
the list before: differences are then mostly 0.
"""

import numpy as np

from gi_core.arrays import AnyArray, Float32, Int64, UInt8, UInt16
from gi_core.errors import CorruptFileError

WEIGHT_STEPS = 31
# What an absent probe is while lists are compared.
_NONE = 0xFFFF


def pack(probe: AnyArray, weight: Float32) -> tuple[Int64, UInt16, UInt8]:
    """probe, weight (..., K) -> codes (...), and probe and weight (K, L) of each list, in steps of its largest.

    A probe without weight is no part of a list.
    """
    shape, slots = weight.shape[:-1], weight.shape[-1]
    probes, weights = _ascending(probe.reshape(-1, slots), weight.reshape(-1, slots))
    for k in range(slots - 1, 0, -1):  # a probe that a list has twice
        again = (probes[:, k] == probes[:, k - 1]) & (weights[:, k] > 0)
        weights[again, k - 1] += weights[again, k]
        weights[again, k] = 0
    steps = np.rint(weights / np.maximum(weights.max(axis=1, keepdims=True), 1e-30) * WEIGHT_STEPS)
    rows = np.concatenate(_ascending(probes, steps.astype(np.uint16)), axis=1)
    lists, first, which = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    by_place = np.argsort(first)
    number = np.empty(len(lists), np.int64)
    number[by_place] = np.arange(len(lists))
    is_new = np.zeros(len(rows), bool)
    is_new[first] = True
    codes = np.where(is_new, 0, np.cumsum(is_new) - number[which.reshape(-1)])
    ordered = _in_place(lists[by_place, :slots].tolist(), lists[by_place, slots:].tolist(), slots)
    kept = np.array(ordered, np.uint16).reshape(-1, 2, slots)
    return codes.reshape(shape), np.ascontiguousarray(kept[:, 0].T), kept[:, 1].T.astype(np.uint8)


def numbers(codes: AnyArray, lists: int) -> Int64:
    """The list of each voxel, of as many as there are. Raises CorruptFileError for a list that there is none of."""
    flat = codes.reshape(-1).astype(np.int64)
    so_far = np.cumsum(flat == 0)
    if (so_far[-1] if len(so_far) else 0) != lists or (flat > so_far).any():
        raise CorruptFileError(f"expected voxels to have {lists} lists of probes, each a new one or one that was there before")
    return np.asarray((so_far - np.maximum(flat, 1)).reshape(codes.shape))


def _ascending(probes: AnyArray, weights: AnyArray) -> tuple[UInt16, AnyArray]:
    """Lists (n, K) in the order of their probes, those without weight last."""
    marked = np.where(weights > 0, probes, _NONE).astype(np.uint16)
    order = np.argsort(marked, axis=1, kind="stable")
    return np.take_along_axis(marked, order, axis=1), np.take_along_axis(weights, order, axis=1)


def _in_place(probes: list[list[int]], weights: list[list[int]], slots: int) -> list[list[list[int]]]:
    """Of each list its probes and weights, each probe where the list before has it. Places left over keep that one's, without weight."""
    now, found = [0] * slots, []
    for probe, weight in zip(probes, weights, strict=True):
        fresh = dict(zip(probe, weight, strict=True))
        fresh.pop(_NONE, None)
        # Out of ``fresh``, so once: the list before has a probe more than once where nothing came to take a place.
        given = [fresh.pop(p, 0) for p in now]
        now = now.copy()
        if fresh:
            free = (k for k, w in enumerate(given) if not w)
            for k, (p, w) in zip(free, fresh.items(), strict=False):
                now[k], given[k] = p, w
        found.append([now, given])
    return found
