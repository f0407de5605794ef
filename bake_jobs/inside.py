"""Which points lie inside something solid: no probe stands there, and a voxel there holds no air.

A closed surface is left once more than it is entered by a ray that starts within it, however many parts of a building overlap. A mesh
may also be open (a house without a floor) or a sheet (a canopy), so several rays vote.
"""

import numpy as np

from bake_jobs.rays import RayScene
from gi_core.arrays import Bool, Float32, Float64

# A ray that has crossed this many surfaces is believed as it stands: overlapping parts of a tower have some ten.
MAX_CROSSINGS = 64
# Less than the distance between walls that footprints keep apart (3 mm), more than float32 leaves of a position 2 km away (0.1 mm).
STEP_M = 0.001
# Straight up, four ways steeply, four ways nearly level. Turned away from the axes, since walls run along them and a ray in a wall's
# plane crosses it by luck.
_AZIMUTHS = np.radians([17.0, 107.0, 197.0, 287.0])
_ELEVATIONS = np.radians([58.0, 13.0])


def _voting_directions() -> Float32:
    directions = [(0.0127, 0.9998, 0.0153)]
    for turn, elevation in enumerate(_ELEVATIONS):
        for azimuth in _AZIMUTHS + turn * np.radians(41.0):
            level = np.cos(elevation)
            directions.append((level * np.cos(azimuth), np.sin(elevation), level * np.sin(azimuth)))
    d = np.array(directions)
    return (d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32)


VOTING_DIRECTIONS: Float32 = _voting_directions()


def inside_solid(ray_scene: RayScene, points: Float64) -> Bool:
    """(n,) bool for points (n, 3) [m], world frame: most rays leave more surfaces than they enter."""
    inside = np.zeros(len(points), bool)
    # Most air sees straight up, and is done after one ray.
    up = np.tile(np.array([[0, 1, 0]], np.float32), (len(points), 1))
    unsure = np.flatnonzero(ray_scene.occluded(points, up))
    rays = len(VOTING_DIRECTIONS)
    crossed = _net_exits(ray_scene, np.repeat(points[unsure], rays, axis=0), np.tile(VOTING_DIRECTIONS, (len(unsure), 1)))
    inside[unsure] = (crossed.reshape(-1, rays) > 0).sum(axis=1) > rays // 2
    return inside


def _net_exits(ray_scene: RayScene, origins: Float64, directions: Float32) -> "np.ndarray[tuple[int, ...], np.dtype[np.int64]]":
    """Surfaces that each ray leaves (meets from behind) minus those that it enters, until it is out of the scene: (n,) int64."""
    net = np.zeros(len(origins), np.int64)
    going = np.arange(len(origins))
    position = np.array(origins, np.float64)
    for _ in range(MAX_CROSSINGS):
        hits = ray_scene.closest(position, directions[going])
        hit = hits.hit
        going = going[hit]
        if len(going) == 0:
            break
        net[going] += np.where(hits.from_back[hit], 1, -1)
        step = hits.distance[hit].astype(np.float64) + STEP_M
        position = position[hit] + directions[going] * step[:, None]
    return net
