"""Which points lie inside something solid: no probe stands there, and a voxel there holds no air.

A closed surface is left once more than it is entered by a ray that starts within it, however many parts of a building overlap. A mesh
may also be open (a house without a floor) or a sheet (a canopy), so several rays vote.

Neighbouring houses share walls, and a ray through two walls in one place would meet only one of them. So triangles are moved outward
for this test, each by a few millimetres of its own: a ray enters the neighbour before it leaves the house, and meets every wall.
"""

import numpy as np

from bake_jobs.rays import RayScene
from gi_core.arrays import Bool, Float32, Float64, Int32, Int64

# A ray that has crossed this many surfaces is believed as it stands: overlapping parts of a tower have some ten.
MAX_CROSSINGS = 64
# Triangles move outward by between these. Cracks open between them that one ray in some thousand slips through.
MOVED_M = (0.003, 0.036)
# Less than most coincident walls are moved apart, more than float32 leaves of a position 2 km away (0.1 mm).
STEP_M = 0.001
# Straight up, four ways steeply, four ways nearly level. Turned away from the axes, since walls run along them and a ray in a wall's
# plane crosses it by luck.
_AZIMUTHS = np.radians([17.0, 107.0, 197.0, 287.0])
_ELEVATIONS = np.radians([58.0, 5.0])
# The upward and the four steep rays under a canopy that is a mere sheet leave it as they would leave a solid; a level ray tells them
# apart. In real cities nearly every point gets at most two votes or at least seven.
VOTES_FOR_SOLID = 7
# Multiples of the golden ratio's fraction spread evenly, and no two near indices come close.
_GOLDEN = 0.6180339887498949


def _voting_directions() -> Float32:
    directions = [(0.0127, 0.9998, 0.0153)]
    for turn, elevation in enumerate(_ELEVATIONS):
        for azimuth in _AZIMUTHS + turn * np.radians(41.0):
            level = np.cos(elevation)
            directions.append((level * np.cos(azimuth), np.sin(elevation), level * np.sin(azimuth)))
    d = np.array(directions)
    return (d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32)


VOTING_DIRECTIONS: Float32 = _voting_directions()


class Solids:
    """A scene's solids, ready to be asked what lies in them."""

    def __init__(self, vertices: Float64, triangles: Int32) -> None:
        """vertices (v, 3) [m], world frame; triangles (m, 3), counter-clockwise seen from outside."""
        corners = np.asarray(vertices, np.float64)[triangles]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
        share = np.arange(len(triangles)) * _GOLDEN % 1
        moved = corners + (normal * (MOVED_M[0] + (MOVED_M[1] - MOVED_M[0]) * share)[:, None])[:, None]
        self._rays = RayScene(moved.reshape(-1, 3), np.arange(3 * len(triangles), dtype=np.int32).reshape(-1, 3))

    def contain(self, points: Float64) -> Bool:
        """(n,) bool for points (n, 3) [m], world frame: VOTES_FOR_SOLID of nine rays leave more surfaces than they enter."""
        inside = np.zeros(len(points), bool)
        # Most air sees straight up, and is done after one ray.
        up = np.tile(np.array([[0, 1, 0]], np.float32), (len(points), 1))
        unsure = np.flatnonzero(self._rays.occluded(points, up))
        rays = len(VOTING_DIRECTIONS)
        net = self.net_exits(np.repeat(points[unsure], rays, axis=0), np.tile(VOTING_DIRECTIONS, (len(unsure), 1)))
        inside[unsure] = (net.reshape(-1, rays) > 0).sum(axis=1) >= VOTES_FOR_SOLID
        return inside

    def net_exits(self, origins: Float64, directions: Float32) -> Int64:
        """Surfaces that each ray leaves (meets from behind) minus those that it enters, until it is out of the scene: (n,) int64."""
        net = np.zeros(len(origins), np.int64)
        going = np.arange(len(origins))
        position = np.array(origins, np.float64)
        for _ in range(MAX_CROSSINGS):
            hits = self._rays.closest(position, directions[going])
            hit = hits.hit
            going = going[hit]
            if len(going) == 0:
                break
            net[going] += np.where(hits.from_back[hit], 1, -1)
            step = hits.distance[hit].astype(np.float64) + STEP_M
            position = position[hit] + directions[going] * step[:, None]
        return net
