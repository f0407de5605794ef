"""Where harmonics' factors are expected to point: from the probe to the middle of what it sees. Files hold the difference.

The numbers are whole steps, and reader and writer must find the same ones: single precision, each operation rounded once, in the
order that FORMAT.md gives.
"""

import numpy as np

from gi_core.arrays import AnyArray, Float32, Float64, Int8
from gi_core.factor_weights import DIRECTION_STEPS
from gi_core.sector import counts
from gi_core.sky_patches import patch_centres

# Patches of the sky are as good as infinitely far [1/512 m].
_SKY_DISTANCE = 2.0**40
_AXES = (1, 2, 0)  # y, z, x: the order of the first band


def brick_centres(brick_cell: AnyArray, brick_level: AnyArray, brick_starts: AnyArray, in_cell: AnyArray) -> Float64:
    """(3, N) [1/512 m]: the mean over each brick's surfels of their places, of which it has one or more.

    brick_cell (N, 3), brick_level (N,), in_cell (3, S) : as stored, of the file
    """
    if not len(brick_cell):
        return np.zeros((3, 0))
    sums = np.add.reduceat(in_cell, brick_starts[:-1].astype(np.int64), axis=1, dtype=np.int64)
    number = counts(brick_starts)
    step = 4.0 * 2.0**brick_level  # half of one 256th of a cell
    return np.asarray(512 * step * brick_cell.T + step * (2 * sums + number) / number)


def expected_directions(
    probe_position: AnyArray, centres: Float64, factor_starts: AnyArray, factor_source: AnyArray, sky_patches: int
) -> Int8:
    """(3, F): y, z, x in DIRECTION_STEPS. probe_position (3, P) [1/512 m]; centres : of ``brick_centres``.

    Raises IndexError for a source that there is none of.
    """
    sky = (_SKY_DISTANCE * patch_centres(sky_patches)).T
    places: Float32 = np.concatenate([centres, sky], axis=1).astype(np.float32)
    per_probe = counts(factor_starts)
    source = factor_source.astype(np.int64)  # what ``take`` would make of it for each axis
    offsets = [places[k].take(source) for k in _AXES]
    for k, offset in zip(_AXES, offsets, strict=True):
        offset -= np.repeat(probe_position[k].astype(np.float32), per_probe)
    y, z, x = offsets
    squared = x * x
    squared += y * y
    squared += z * z
    np.maximum(squared, np.float32(1), out=squared)
    np.sqrt(squared, out=squared)
    per_length = np.divide(np.float32(DIRECTION_STEPS), squared, out=squared)
    found = np.empty((3, len(factor_source)), np.int8)
    for row, offset in zip(found, offsets, strict=True):
        offset *= per_length
        row[:] = np.rint(offset, out=offset)
    return found
