"""What probes see: one cube map of closest hits per probe (slide "Our approach": a G-buffer cube map)."""

from dataclasses import dataclass

import numpy as np

from bake_jobs.rays import Hits, RayScene
from gi_core.ambient_cube import FACE_DIRECTIONS
from gi_core.arrays import Bool, Float32, Float64

# Half of what a point sees are backs of surfaces, and none of its rays reaches the sky: it lies in something solid. A point under a
# sheet that is modelled from above only sees few backs; one in a building without a floor sees mostly backs.
SOLID_BACK_SHARE = 0.5


@dataclass(frozen=True, eq=False)
class RayPattern:
    """Directions that every probe looks along, and what each contributes to the cube's faces.

    direction : (r, 3) float32, unit, world frame
    weight : (r, 6) float32, form factors: each column sums to 1
    """

    direction: Float32
    weight: Float32


def cube_map_pattern(edge: int) -> RayPattern:
    """Texel centres of a cube map with ``edge`` x ``edge`` texels per face."""
    t = (np.arange(edge) + 0.5) / edge * 2 - 1
    v, u = (a.ravel() for a in np.meshgrid(t, t, indexing="ij"))
    w = np.ones_like(u)
    faces = [(w, v, u), (-w, v, u), (u, w, v), (u, -w, v), (u, v, w), (u, v, -w)]
    direction = np.concatenate([np.stack(face, axis=1) for face in faces])
    distance = np.linalg.norm(direction, axis=1)
    direction /= distance[:, None]
    solid_angle = distance**-3
    weight = np.maximum(direction @ FACE_DIRECTIONS.T.astype(np.float64), 0) * solid_angle[:, None]
    weight /= weight.sum(axis=0)
    return RayPattern(direction.astype(np.float32), weight.astype(np.float32))


@dataclass(frozen=True, eq=False)
class GBuffer:
    """Closest hits of all probes, ray by ray: probe p's ray r is entry p * rays + r.

    position : (P * r, 3) float64 [m], world frame; the probe's own position where the ray left the scene
    """

    hits: Hits
    position: Float64
    probes: int
    rays: int


def render(ray_scene: RayScene, positions: Float64, pattern: RayPattern) -> GBuffer:
    """Cast the pattern from each probe position (P, 3) [m], world frame."""
    probes, rays = len(positions), len(pattern.direction)
    origin = np.repeat(positions, rays, axis=0)
    direction = np.tile(pattern.direction, (probes, 1))
    hits = ray_scene.closest(origin, direction)
    reach = np.where(hits.hit, hits.distance, 0).astype(np.float64)
    return GBuffer(hits, origin + direction * reach[:, None], probes, rays)


# A ring of directions that meets walls, floor and ceiling: the axes, the edges' and the corners' diagonals of a cube.
_LOOK_AROUND = np.array([(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) != (0, 0, 0)], np.float64)
# Turned a little, since walls and edges of cities run along the axes.
_TURN = np.array([[0.9553365, 0.0, 0.2955202], [0.0871012, 0.9555115, -0.2815776], [-0.2823733, 0.2947406, 0.9128551]])
LOOK_AROUND: Float32 = (_LOOK_AROUND / np.linalg.norm(_LOOK_AROUND, axis=1, keepdims=True) @ _TURN.T).astype(np.float32)
LOOK_AROUND /= np.linalg.norm(LOOK_AROUND, axis=1, keepdims=True)


def inside_solid(ray_scene: RayScene, points: Float64) -> Bool:
    """Which points (n, 3) [m] lie inside something solid: they see mostly backs, and no sky. Tolerates open and thin meshes."""
    inside = np.zeros(len(points), bool)
    # Most air sees straight up, and is done after one ray.
    up = np.tile(np.array([[0, 1, 0]], np.float32), (len(points), 1))
    unsure = np.flatnonzero(ray_scene.occluded(points, up))
    if len(unsure) == 0:
        return inside
    rays = len(LOOK_AROUND)
    hits = ray_scene.closest(np.repeat(points[unsure], rays, axis=0), np.tile(LOOK_AROUND, (len(unsure), 1)))
    backs = hits.from_back.reshape(-1, rays).mean(axis=1)
    sees_sky = (~hits.hit & np.tile(LOOK_AROUND[:, 1] > 0, len(unsure))).reshape(-1, rays).any(axis=1)
    inside[unsure] = (backs > SOLID_BACK_SHARE) & ~sees_sky
    return inside
