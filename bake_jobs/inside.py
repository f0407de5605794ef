"""Which points lie inside something solid: no probe stands there, and a voxel there holds no air.

A closed surface is left once more than it is entered by a ray that starts within it, however many parts of a building overlap. A mesh
may also be open (a house without a floor) or a sheet (a canopy), so several rays vote.

Neighbouring houses share walls, and a ray through two walls in one place would meet only one of them. So solids grow for this test,
each by some millimetres other than its neighbours': a ray enters the next house before it leaves this one, and meets every wall.
"""

import numpy as np

from bake_jobs.clean import closed_components
from bake_jobs.rays import RayScene
from gi_core.arrays import Bool, Float32, Float64, Int32, Int64

# A ray that has crossed this many surfaces is believed as it stands: overlapping parts of a tower have some ten.
MAX_CROSSINGS = 64
# A solid grows by 1 to GROWTH_STEPS of these; the parts of a building follow one another, so their walls stay apart.
GROWTH_STEP_M, GROWTH_STEPS = 0.003, 12
# Less than a growth step, more than float32 leaves of a position 2 km away (0.1 mm).
STEP_M = 0.001
# Straight up, four ways steeply, four ways nearly level. Turned away from the axes, since walls run along them and a ray in a wall's
# plane crosses it by luck.
_AZIMUTHS = np.radians([17.0, 107.0, 197.0, 287.0])
_ELEVATIONS = np.radians([58.0, 13.0])
# In real cities nearly every point gets at most two of the nine votes or at least seven.
VOTES_FOR_SOLID = 6
# Under a canopy that is a mere sheet all nine rays may leave it as they would a solid. But a solid has sides, which flat rays leave
# too; or it is the earth, and there is no floor below. Steeper than streets are, so that these rays do not enter the ground.
FLAT_RAYS, FLAT_ELEVATION, SIDES_FOR_SOLID = 8, np.radians(7.0), 3
# A corner goes out by at most this factor more than its faces (cosine between the two).
_SHARPEST = 0.3


def _voting_directions() -> Float32:
    directions = [(0.0127, 0.9998, 0.0153)]
    for turn, elevation in enumerate(_ELEVATIONS):
        for azimuth in _AZIMUTHS + turn * np.radians(41.0):
            level = np.cos(elevation)
            directions.append((level * np.cos(azimuth), np.sin(elevation), level * np.sin(azimuth)))
    d = np.array(directions)
    return (d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32)


VOTING_DIRECTIONS: Float32 = _voting_directions()
_FLAT_TURNS = 2 * np.pi * (np.arange(FLAT_RAYS) + 0.31) / FLAT_RAYS
_FLAT_DIRECTIONS: Float32 = np.stack(
    [
        np.cos(FLAT_ELEVATION) * np.cos(_FLAT_TURNS),
        np.full(FLAT_RAYS, np.sin(FLAT_ELEVATION)),
        np.cos(FLAT_ELEVATION) * np.sin(_FLAT_TURNS),
    ],
    axis=1,
).astype(np.float32)


def _fan(points: Float64, directions: Float32) -> tuple[Float64, Float32]:
    """Every direction from every point: origins (n * r, 3) and directions (n * r, 3), point by point."""
    return np.repeat(points, len(directions), axis=0), np.tile(directions, (len(points), 1))


class Solids:
    """A scene's solids, ready to be asked what lies in them."""

    def __init__(self, vertices: Float64, triangles: Int32) -> None:
        """vertices (v, 3) [m], world frame; triangles (m, 3), counter-clockwise seen from outside."""
        self._rays = RayScene(*_grown(np.asarray(vertices, np.float64), triangles))

    def contain(self, points: Float64) -> Bool:
        """(n,) bool for points (n, 3) [m], world frame: rays leave more surfaces than they enter, and it is no sheet that they leave."""
        inside = np.zeros(len(points), bool)
        # Most air sees straight up, and is done after one ray.
        up = np.tile(np.array([[0, 1, 0]], np.float32), (len(points), 1))
        unsure = np.flatnonzero(self._rays.occluded(points, up))
        net = self.net_exits(*_fan(points[unsure], VOTING_DIRECTIONS))
        unsure = unsure[(net.reshape(-1, len(VOTING_DIRECTIONS)) > 0).sum(axis=1) >= VOTES_FOR_SOLID]
        sides = self.net_exits(*_fan(points[unsure], _FLAT_DIRECTIONS)).reshape(-1, FLAT_RAYS) > 0
        below = self._rays.closest(points[unsure], -up[unsure])
        inside[unsure] = (sides.sum(axis=1) >= SIDES_FOR_SOLID) | ~below.hit | below.from_back
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


def _grown(vertices: Float64, triangles: Int32) -> tuple[Float64, Int32]:
    """Vertices and triangles of the scene with each connected surface moved outward as a whole, so that no crack opens in it."""
    if len(triangles) == 0:
        return vertices, triangles
    component, _ = closed_components(triangles.astype(np.int64))
    corners = vertices[triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    edge = np.roll(corners, -1, axis=1) - corners
    edge /= np.maximum(np.linalg.norm(edge, axis=2, keepdims=True), 1e-30)
    # By the angle that a triangle has at a vertex, so that it does not matter how a face was cut into triangles.
    angle = np.arccos(np.clip(-(edge * np.roll(edge, 1, axis=1)).sum(axis=2), -1, 1))
    used, corner = np.unique(component[:, None] * len(vertices) + triangles, return_inverse=True)
    corner = corner.reshape(-1)
    weighted = (normal[:, None] * angle[:, :, None]).reshape(-1, 3)
    outward = np.stack([np.bincount(corner, weighted[:, axis], len(used)) for axis in range(3)], axis=1)
    outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-30)
    # A face moves by less than its corners, which go out at an angle to it: the sharper the corner, the further it has to go.
    straight = np.full(len(used), 1.0)
    np.minimum.at(straight, corner, np.einsum("ij,ij->i", outward[corner], np.repeat(normal, 3, axis=0)))
    amount = GROWTH_STEP_M * (1 + used // len(vertices) % GROWTH_STEPS) / np.maximum(straight, _SHARPEST)
    return vertices[used % len(vertices)] + outward * amount[:, None], corner.reshape(-1, 3).astype(np.int32)
