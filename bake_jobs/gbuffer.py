"""What probes see: one cube map of closest hits per probe (slide "Our approach": a G-buffer cube map)."""

from dataclasses import dataclass

import numpy as np

from bake_jobs.rays import Hits, RayScene
from gi_core.ambient_cube import FACE_DIRECTIONS
from gi_core.arrays import Float32, Float64
from gi_core.basis import projection_weights


@dataclass(frozen=True, eq=False)
class RayPattern:
    """Directions that every probe looks along, and what exitance 1 from each adds to the coefficients of the probe's irradiance.

    direction : (r, 3) float32, unit, world frame
    face_weight : (r, 6) float32, form factors of the cube's faces: each column sums to 1
    weight : (r, B) float32, of the bake's basis
    """

    direction: Float32
    face_weight: Float32
    weight: Float32


def cube_map_pattern(edge: int, basis: str = "cube") -> RayPattern:
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
    face_weight = weight.astype(np.float32)
    if basis != "cube":
        # The texels' solid angles sum to 4 pi exactly, so that a uniform world gives uniform light whatever ``edge`` is.
        weight = projection_weights(basis, direction) * (4 * solid_angle / solid_angle.sum())[:, None]
    return RayPattern(direction.astype(np.float32), face_weight, weight.astype(np.float32))


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
