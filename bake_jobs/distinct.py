"""Groups of many: distinct keys by hashing, and each group's least member. Sorting all of them takes three to six times as long."""

import numpy as np

from gi_core.arrays import Float32, Float64, Int64

# 2 ** 64 over the golden ratio: keys that differ little fall into slots far apart (Knuth's multiplicative hashing).
_FACTOR = np.uint64(0x9E3779B97F4A7C15)


def distinct(keys: Int64) -> tuple[Int64, Int64]:
    """What np.unique gives with ``return_inverse``: the distinct keys, ascending, and of each of (n,) keys which it is."""
    bits = max(len(keys).bit_length(), 4)
    slot = ((keys.view(np.uint64) * _FACTOR) >> np.uint64(64 - bits)).view(np.int64)
    holder, taken = np.empty(1 << bits, np.int64), np.zeros(1 << bits, bool)
    holder[slot], taken[slot] = keys, True
    used = np.flatnonzero(taken)
    # All of a key's occurrences have one slot, and hold it or do not: those that do not are few.
    lost = np.flatnonzero(holder[slot] != keys)
    lost_keys, of_lost = np.unique(keys[lost], return_inverse=True)
    found = np.concatenate([holder[used], lost_keys])
    order = np.argsort(found)
    rank = np.empty(len(found), np.int64)
    rank[order] = np.arange(len(found))
    # What a slot held is not asked for any more.
    holder[used] = rank[: len(used)]
    number = holder[slot]
    number[lost] = rank[len(used) :][of_lost]
    return found[order], number


def least(values: Float32 | Float64, group: Int64, groups: int) -> Int64:
    """Of each of the groups (g,) that values (n,) are of the number of its least value, of equals the first; 0 of a group without any."""
    low = np.full(groups, np.inf, values.dtype)
    np.minimum.at(low, group, values)
    # Backwards: the last that is written stays.
    ends = np.flatnonzero(values == low[group])[::-1]
    found = np.zeros(groups, np.int64)
    found[group[ends]] = ends
    return found
