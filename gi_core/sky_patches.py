"""The sky as a few patches, each a source like any brick: where they lie, and what a sky map gives each of them.

Two schemes, by name in world.json:

    faces     six: patch s is the sky as cube face s sees it (the talk's six scalars, slide "Sky visibility")
    patches   the dome cut into rows of equal solid angle per patch: a cap around the zenith, then rings, each cut evenly in azimuth
              from +X on, and numbered in that order

Bake and run time both take the layout from here, so a scheme's name must never change its meaning.
"""

from functools import cache

import numpy as np

from gi_core.ambient_cube import FACE_DIRECTIONS
from gi_core.arrays import AnyArray, Float32, Float64, Int64
from gi_core.constants import CUBE_FACES, MAX_SKY_PATCHES, SKY_SHAPE
from gi_core.errors import InputError
from gi_core.lighting import Lighting

SKY_SCHEMES = ("faces", "patches")
# A cap and one ring.
MIN_PATCHES = 4
_ROWS, _COLUMNS = SKY_SHAPE[0] // 2, SKY_SHAPE[1]
# The share of each cube face's cosine-weighted view that lies above the horizon: all of +Y, half of the sides, none of -Y.
_ABOVE_HORIZON = np.where(FACE_DIRECTIONS[:, 1] > 0, 1.0, np.where(FACE_DIRECTIONS[:, 1] < 0, 0.0, 0.5))


@cache
def patches_in_rows(patches: int) -> tuple[int, ...]:
    """How many patches each row has, from the zenith down; their sum is ``patches``.

    A ring has as many as make them about as wide as high (Leopardi, "A partition of the unit sphere into regions of equal area and small
    diameter", ETNA 2006). Raises InputError for a number that makes no dome.
    """
    if not MIN_PATCHES <= patches <= MAX_SKY_PATCHES:
        raise InputError(f"sky patches: expected {MIN_PATCHES} to {MAX_SKY_PATCHES}, got {patches}")
    cap = np.arccos(1 - 1 / patches)
    rings = max(1, round((np.pi / 2 - cap) / np.sqrt(2 * np.pi / patches)))
    edges = np.cos(cap + (np.pi / 2 - cap) * np.arange(rings + 1) / rings)
    ideal = (edges[:-1] - edges[1:]) * patches
    counts, owed = [1], 0.0
    for wanted in ideal.tolist():
        count = max(1, round(wanted + owed))
        owed += wanted - count
        counts.append(count)
    counts[-1] += patches - sum(counts)
    return tuple(counts)


@cache
def _edges(patches: int) -> Float64:
    """(rows + 1,): the heights (y of unit directions) between rows, from 1 down to 0. Equal heights are equal solid angles."""
    return 1 - np.concatenate([[0], np.cumsum(patches_in_rows(patches))]) / patches


def patch_of(directions: AnyArray, patches: int) -> Int64:
    """The patch that each direction above the horizon looks at: unit directions (n, 3), y > 0, world frame -> (n,)."""
    count = np.array(patches_in_rows(patches))
    edges = _edges(patches)
    # Heights fall from row to row; searchsorted wants them to rise.
    row = np.clip(len(count) - np.searchsorted(edges[::-1], directions[:, 1], side="left"), 0, len(count) - 1)
    turn = np.arctan2(directions[:, 2], directions[:, 0]) / (2 * np.pi) % 1.0
    first = np.concatenate([[0], np.cumsum(count)[:-1]])
    return np.asarray(first[row] + np.minimum((turn * count[row]).astype(np.int64), count[row] - 1))


@cache
def patch_centres(patches: int) -> Float64:
    """(patches, 3), unit: the middle of each patch in height and azimuth; of the cap, and of fewer patches than make a dome, the zenith."""
    middles = np.zeros((patches, 3))
    middles[:, 1] = 1
    if patches < MIN_PATCHES:
        return middles
    first, edges = 1, _edges(patches)
    for row, count in enumerate(patches_in_rows(patches)[1:], start=1):
        turn, height = 2 * np.pi * (np.arange(count) + 0.5) / count, (edges[row] + edges[row + 1]) / 2
        radius = np.sqrt(1 - height * height)
        middles[first : first + count] = np.stack([radius * np.cos(turn), np.full(count, height), radius * np.sin(turn)], axis=1)
        first += count
    return middles


def patch_radiance(sky_radiance: Float32, patches: int) -> Float64:
    """(patches, 3) [cd m^-2]: the mean radiance of each, by exact solid angle. ``sky_radiance`` is a map as in ``Lighting``."""
    texel_edges = np.cos(np.pi * np.arange(_ROWS + 1) / SKY_SHAPE[0])
    texel_edges[-1] = 0.0
    heights = _overlaps(-_edges(patches), -texel_edges)
    bands = np.tensordot(heights, np.asarray(sky_radiance[:_ROWS], np.float64), axes=(1, 0))  # (rows, columns, 3)
    around = np.arange(_COLUMNS + 1) / _COLUMNS
    return np.concatenate([_overlaps(np.arange(n + 1) / n, around) @ band for n, band in zip(patches_in_rows(patches), bands, strict=True)])


def _overlaps(edges: Float64, of: Float64) -> Float64:
    """(n, m): of each interval between rising ``edges`` (n + 1,), the share that lies in each of the intervals ``of`` (m + 1,)."""
    low = np.maximum(edges[:-1, None], of[None, :-1])
    high = np.minimum(edges[1:, None], of[None, 1:])
    return np.maximum(high - low, 0) / np.diff(edges)[:, None]


def face_exitance(lighting: Lighting) -> Float32:
    """The talk's six sky scalars (slide "Sky visibility"), as patches: (6, 3) [lx].

    Each is what the face's irradiance would be if the radiance that it sees of the sky filled its whole view, so that multiplying
    by the share of the view that sees sky gives back the sky's irradiance where nothing is in the way.
    """
    share = _ABOVE_HORIZON[:, None]
    return np.where(share > 0, lighting.sky_cube / np.maximum(share, 1e-9), 0).astype(np.float32)


def patch_exitance(lighting: Lighting, scheme: str, patches: int) -> Float32:
    """(patches, 3) [lx]: what a dataset's factors of the sky multiply; pi times the mean radiance of each patch of a dome."""
    if scheme == "faces":
        return face_exitance(lighting)
    return np.asarray(np.pi * patch_radiance(lighting.sky_radiance, patches), np.float32)


@cache
def level_shares(scheme: str, patches: int) -> Float64:
    """(patches,): how much of each patch's exitance level ground in the open receives; they sum to 1."""
    if scheme == "faces":
        return np.array([float(face == (0, 1, 0)) for face in CUBE_FACES])
    squares = -np.diff(_edges(patches) ** 2)
    return np.concatenate([np.full(n, share / n) for n, share in zip(patches_in_rows(patches), squares.tolist(), strict=True)])
