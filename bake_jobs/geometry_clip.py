"""Cuts a scene's triangles at a sector's borders, so that each sector carries its own surface and no more."""

import numpy as np

from bake_jobs.scene import Scene
from gi_core.arrays import Bool, Float64, Int64
from gi_core.constants import SECTOR_SIZE_M
from gi_core.geometry_file import Geometry
from gi_core.grid import SectorIndex


class SectorCutter:
    """Finds and cuts the triangles of any sector of a scene."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        corners = scene.vertices[scene.triangles][:, :, [0, 2]]
        self._low: Float64 = corners.min(axis=1)
        self._high: Float64 = corners.max(axis=1)

    def sectors(self) -> list[SectorIndex]:
        """Every sector that some triangle's surface reaches into, by z, then x."""
        low = np.floor(self._low / SECTOR_SIZE_M).astype(np.int64)
        # A triangle that ends on a border does not reach into the next sector.
        high = np.maximum(np.ceil(self._high / SECTOR_SIZE_M).astype(np.int64) - 1, low)
        found = {(int(x), int(z)) for x, z in low[(low == high).all(axis=1)]}
        for triangle in np.flatnonzero((low != high).any(axis=1)):
            (x0, z0), (x1, z1) = low[triangle], high[triangle]
            for x in range(x0, x1 + 1):
                for z in range(z0, z1 + 1):
                    if (x, z) not in found and self._reaches(int(triangle), x, z):
                        found.add((x, z))
        return [SectorIndex(x, z) for x, z in sorted(found, key=lambda s: (s[1], s[0]))]

    def cut(self, index: SectorIndex) -> Geometry:
        """The scene's triangles inside one sector, world frame."""
        box_low = index.origin[[0, 2]]
        box_high = box_low + SECTOR_SIZE_M
        # A wall that stands on the border belongs to the sector whose range holds it: [64 x, 64 x + 64).
        inside = ((self._low < box_high) & (self._high >= box_low)).all(axis=1)
        chosen = np.flatnonzero(inside)
        corners = self._scene.vertices[self._scene.triangles[chosen]]
        corners, source = clip_to_sector(corners, index)
        chosen = chosen[source]
        triangles = np.arange(3 * len(corners), dtype=np.int32).reshape(-1, 3)
        return Geometry(corners.reshape(-1, 3), triangles, self._scene.albedo[chosen], self._scene.emission[chosen])

    def _reaches(self, triangle: int, x: int, z: int) -> bool:
        corners = self._scene.vertices[self._scene.triangles[triangle]][None]
        return len(clip_to_sector(corners, SectorIndex(x, z))[0]) > 0


def clip_to_sector(corners: Float64, index: SectorIndex) -> tuple[Float64, Int64]:
    """What of triangles (n, 3, 3) lies in a sector's column: -> (m, 3, 3) and the source triangle (m,) of each."""
    source = np.arange(len(corners))
    for axis in (0, 2):
        low = float(index.origin[axis])
        for edge, keep_above in ((low, True), (low + SECTOR_SIZE_M, False)):
            corners, cut_from = clip(corners, axis, edge, keep_above)
            source = source[cut_from]
    return corners, source


def clip(corners: Float64, axis: int, edge: float, keep_above: bool) -> tuple[Float64, Int64]:
    """Keep what of triangles (n, 3, 3) lies at or above (or below) a plane: -> (m, 3, 3) and the source triangle (m,) of each.

    A cut triangle becomes one or two. Winding is kept. What touches the plane in a line or point only is kept whole or dropped whole.
    """
    side = corners[:, :, axis] - edge if keep_above else edge - corners[:, :, axis]
    out: Bool = side < 0
    outside = out.sum(axis=1)
    whole = np.flatnonzero(outside == 0)
    pieces, sources = [corners[whole]], [whole]
    for lone_is_out in (False, True):
        cut = np.flatnonzero(outside == (1 if lone_is_out else 2))
        if len(cut) == 0:
            continue
        lone = np.argmax(out[cut] == lone_is_out, axis=1)
        a, b, c = (corners[cut, (lone + turn) % 3] for turn in range(3))
        sa, sb, sc = (side[cut, (lone + turn) % 3][:, None] for turn in range(3))
        ab = a + (b - a) * (sa / (sa - sb))
        ac = a + (c - a) * (sa / (sa - sc))
        ab[:, axis] = ac[:, axis] = edge
        if lone_is_out:
            pieces += [np.stack([ab, b, c], axis=1), np.stack([ab, c, ac], axis=1)]
            sources += [cut, cut]
        else:
            pieces.append(np.stack([a, ab, ac], axis=1))
            sources.append(cut)
    kept, source = np.concatenate(pieces), np.concatenate(sources)
    area = np.linalg.norm(np.cross(kept[:, 1] - kept[:, 0], kept[:, 2] - kept[:, 0]), axis=1)
    real = np.flatnonzero(area > 1e-9)
    order = real[np.argsort(source[real], kind="stable")]
    return kept[order], source[order]
