"""Views of what was baked: surfaces in the colours of the surfels that stand for them (slide "Surfel sharing").

A pixel shows the surfel nearest to it, of its own sector, among those that face its way; grey where the sector has none so near, as of what
no probe sees.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from gi_core import relight_twin
from gi_core.arrays import Float32, Float64, Int64, UInt8
from gi_core.constants import MAX_BRICK_LEVEL, SECTOR_SIZE_M, SURFEL_CELL_M
from gi_core.grid import SectorIndex
from gi_core.relight_input import relight_input
from gi_core.sector import Sector
from server import tonemap
from server.preview_seen import Seen

# Sectors that are read for a picture, the eye's and those next to it: others are too far off for single surfels to show.
REACH_SECTORS = 1
# A surfel that faces the other way counts as this much farther off.
TURNED_M = 8.0
NEAR_M = 2.0
NO_SURFEL = (110, 110, 110)
Colours = Callable[[Sector], UInt8]


def drawn(seen: Seen, colours: Colours) -> UInt8:
    """(height, width, 3) sRGB; ``colours`` gives a sector's surfels (S, 3). Raises CorruptFileError."""
    found = np.full((len(seen.position), 3), NO_SURFEL, np.uint8)
    place = np.floor(seen.position[:, [0, 2]] / SECTOR_SIZE_M).astype(np.int64)
    home = np.floor(seen.camera.eye[[0, 2]] / SECTOR_SIZE_M).astype(np.int64)
    near = np.flatnonzero((np.abs(place - home) <= REACH_SECTORS).all(axis=1))
    for x, z in np.unique(place[near], axis=0).tolist():
        index = SectorIndex(x, z)
        if index not in seen.engine.dataset.world.sectors:
            continue
        sector = seen.engine.dataset.sector(index)
        some = near[(place[near] == (x, z)).all(axis=1)]
        surfel = nearest_surfels(sector, seen.position[some] - index.origin, seen.normal[some])
        found[some[surfel >= 0]] = colours(sector)[surfel[surfel >= 0]]
    return np.asarray(seen.picture(found))


def nearest_surfels(sector: Sector, position: Float64, normal: Float32) -> Int64:
    """(n,) the surfel for each of some points (n, 3) [m], sector-local, with normals (n, 3); -1 where there is none within NEAR_M and half
    a cell of its own."""
    # A view for debugging is no reason for every server to hold 24 MB more.
    from scipy.spatial import cKDTree

    if not sector.surfel_count:
        return np.full(len(position), -1, np.int64)
    tree = cKDTree(np.hstack([sector.surfel_position, TURNED_M / 2 * sector.surfel_normal]))
    farthest = NEAR_M + SURFEL_CELL_M * 2**MAX_BRICK_LEVEL
    distance, found = tree.query(np.hstack([position, TURNED_M / 2 * normal]), distance_upper_bound=farthest)
    known = np.flatnonzero(found < sector.surfel_count)
    level = sector.brick_level[np.searchsorted(sector.brick_starts, found[known], side="right") - 1]
    too_far = distance[known] > NEAR_M + SURFEL_CELL_M / 2 * 2.0**level
    result = np.full(len(position), -1, np.int64)
    result[known[~too_far]] = found[known[~too_far]]
    return result


def albedo(seen: Seen) -> UInt8:
    """Surfels' albedo, without snow."""
    return drawn(seen, lambda sector: tonemap.srgb_bytes(sector.surfel_albedo))


def normal(seen: Seen) -> UInt8:
    """Surfels' normals: x, y, z of -1..1 as red, green, blue."""
    return drawn(seen, lambda sector: np.asarray(sector.surfel_normal * 127.5 + 128).clip(0, 255).astype(np.uint8))


def snow(seen: Seen) -> UInt8:
    """How much of the snow that falls stays on surfels, black to white."""
    return drawn(seen, lambda sector: _grey(sector.surfel_snow))


def sun(seen: Seen) -> UInt8:
    """The share of the sun, or the moon while there is no sun, that the baked directions around it say surfels get; black to white."""

    def share(sector: Sector) -> UInt8:
        world = seen.engine.dataset.world
        given = relight_input(seen.lighting, world.sun_table, world.sky, world.sky_patches)
        if not len(given.lights):
            return np.zeros((sector.surfel_count, 3), np.uint8)
        light = given.lights[0]
        nodes = zip(light["plane"].tolist(), light["plane_weight"].tolist(), strict=True)
        return _grey(sum((weight * relight_twin.sun_bits(sector, plane) for plane, weight in nodes), np.zeros(sector.surfel_count)))

    return drawn(seen, share)


def _grey(share: Any) -> UInt8:
    """(n, 3) sRGB of shares (n,), 0 black and 1 white."""
    return np.repeat(np.asarray(np.clip(share, 0, 1) * 255 + 0.5).astype(np.uint8)[:, None], 3, axis=1)
