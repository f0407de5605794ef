"""Which points lie inside something solid: no probe stands there, and a voxel there holds no air.

Along a ray that starts within a closed surface there comes a point at which surfaces were left once more than entered, however many
parts of a building overlap; along one that starts in air there never does. A mesh may also be open (a house without a floor) or a
sheet (a canopy), so several rays vote.

Neighbouring houses share walls, and a ray through two walls in one place would meet only one of them. So solids grow for this test,
each by some millimetres other than its neighbours': a ray enters the next house before it leaves this one, and meets every wall.
"""

import numpy as np

from bake_jobs.clean import closed_components
from bake_jobs.rays import RayScene
from gi_core.arrays import Bool, Float32, Float64, Int32

# A ray that has crossed this many surfaces is believed as it stands: overlapping parts of a tower have some ten.
MAX_CROSSINGS = 64
# A solid grows by 1 to GROWTH_STEPS of these; the parts of a building follow one another, so their walls stay apart.
GROWTH_STEP_M, GROWTH_STEPS = 0.003, 12
# Less than a growth step, more than float32 leaves of a position 2 km away (0.1 mm).
STEP_M = 0.001
# Straight up and four ways steeply: out of the city in few crossings. Turned away from the axes, since walls run along them and a ray in
# a wall's plane crosses it by luck. Of 28 000 points in three cities one got 1 to 3 of the five votes.
_STEEP_ELEVATION = np.radians(58.0)
VOTES_FOR_SOLID = 4
# Under a canopy that is a mere sheet all of these may leave it as they would a solid. But a solid has sides, which flat rays leave too; or
# it is the earth, and there is no floor below. Steeper than streets are, so that these rays do not enter the ground.
_FLAT_ELEVATION = np.radians(7.0)
SIDES_FOR_SOLID = 3
# A corner goes out by at most this factor more than its faces (cosine between the two).
_SHARPEST = 0.3


def _ring(count: int, elevation: float, turn: float) -> Float64:
    """(count, 3) unit directions all round, at one elevation and starting at azimuth ``turn`` [rad]."""
    azimuth = turn + 2 * np.pi * np.arange(count) / count
    level = np.cos(elevation)
    return np.stack([level * np.cos(azimuth), np.full(count, np.sin(elevation)), level * np.sin(azimuth)], axis=1)


_UPWARD = np.array([[0.0127, 0.9998021, 0.0153]])
STEEP_DIRECTIONS: Float32 = np.concatenate([_UPWARD, _ring(4, _STEEP_ELEVATION, 0.297)]).astype(np.float32)
FLAT_DIRECTIONS: Float32 = _ring(8, _FLAT_ELEVATION, 0.243).astype(np.float32)


class Solids:
    """A scene's solids, ready to be asked what lies in them. ``grown`` : they, each a little larger, so that no two surfaces coincide."""

    def __init__(self, vertices: Float64, triangles: Int32) -> None:
        """vertices (v, 3) [m], world frame; triangles (m, 3), counter-clockwise seen from outside."""
        self.grown = RayScene(*_grown(np.asarray(vertices, np.float64), triangles))

    def contain(self, points: Float64) -> Bool:
        """(n,) bool for points (n, 3) [m], world frame."""
        inside = np.zeros(len(points), bool)
        # Most air sees straight up, and is done after one ray.
        up = np.tile(np.array([[0, 1, 0]], np.float32), (len(points), 1))
        unsure = np.flatnonzero(self.grown.occluded(points, up))
        unsure = unsure[self.have_votes(points[unsure], STEEP_DIRECTIONS, VOTES_FOR_SOLID)]
        below = self.grown.closest(points[unsure], -up[unsure])
        inside[unsure] = ~below.hit | below.from_back
        on_floor = unsure[~inside[unsure]]
        inside[on_floor] = self.have_votes(points[on_floor], FLAT_DIRECTIONS, SIDES_FOR_SOLID)
        return inside

    def have_votes(self, points: Float64, directions: Float32, enough: int) -> Bool:
        """(n,) bool: whether rays from each point (n, 3) leave more than they have entered along at least ``enough`` of directions (r, 3).

        Direction by direction: for points that are decided, no more rays are cast.
        """
        votes = np.zeros(len(points), np.int64)
        open_ = np.arange(len(points))
        for left, direction in zip(range(len(directions))[::-1], directions, strict=True):
            votes[open_] += self._leaves(points[open_], np.tile(direction, (len(open_), 1)))
            open_ = open_[(votes[open_] < enough) & (votes[open_] + left >= enough)]
        return votes >= enough

    def _leaves(self, origins: Float64, directions: Float32) -> Bool:
        """(n,) bool: each ray comes to a point where it has met more surfaces from behind than from the front."""
        net = np.zeros(len(origins), np.int64)
        going = np.arange(len(origins))
        position = np.array(origins, np.float64)
        for _ in range(MAX_CROSSINGS):
            hits = self.grown.closest(position, directions[going])
            net[going[hits.hit]] += np.where(hits.from_back[hits.hit], 1, -1)
            on = np.flatnonzero(hits.hit & (net[going] <= 0))
            if len(on) == 0:
                break
            going = going[on]
            position = position[on] + directions[going] * (hits.distance[on].astype(np.float64) + STEP_M)[:, None]
        return net > 0


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
    outward = outward / np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-30)
    # A face moves by less than its corners, which go out at an angle to it: the sharper the corner, the further it has to go.
    straight = np.full(len(used), 1.0)
    np.minimum.at(straight, corner, np.einsum("ij,ij->i", outward[corner], np.repeat(normal, 3, axis=0)))
    amount = GROWTH_STEP_M * (1 + used // len(vertices) % GROWTH_STEPS) / np.maximum(straight, _SHARPEST)
    return vertices[used % len(vertices)] + outward * amount[:, None], corner.reshape(-1, 3).astype(np.int32)
