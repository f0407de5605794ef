"""Rays through Embree: closest hits with face-forwarded normals, and occlusion.

Triangles block and reflect from both sides. Coordinates are float64 world metres at this interface; inside, geometry is moved to
an anchor near its middle, so that float32 rays are as exact 50 km from the origin as at it.
"""

from dataclasses import dataclass

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from gi_core.arrays import Bool, Float32, Float64, Int32
from gi_core.constants import SECTOR_SIZE_M

# Rays start this far off a surface; above float32's step (0.2 mm at 2 km), below anything a city models.
SURFACE_OFFSET_M = 2e-3
# Embree reports tfar near 1e37 for a ray that meets nothing.
FAR_M = 1e30


@dataclass(frozen=True, eq=False)
class Hits:
    """Closest hits of n rays.

    distance : (n,) float32 [m], inf where the ray leaves the scene
    triangle : (n,) int32, -1 where the ray leaves the scene
    normal : (n, 3) float32, unit geometric normal on the side the ray came from, 0 where it leaves
    from_back : (n,) bool, the ray met the triangle's back (clockwise) side
    """

    distance: Float32
    triangle: Int32
    normal: Float32
    from_back: Bool

    @property
    def hit(self) -> Bool:
        return self.triangle >= 0


class RayScene:
    """A triangle mesh that rays can be cast into. Read-only once built; safe to share between threads."""

    def __init__(self, vertices: Float64, triangles: Int32) -> None:
        """vertices (v, 3) [m], world frame; triangles (m, 3) int32."""
        middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2 if len(vertices) else np.zeros(3)
        self.anchor: Float64 = np.round(middle / SECTOR_SIZE_M) * SECTOR_SIZE_M
        local = (np.asarray(vertices, np.float64) - self.anchor).astype(np.float32)
        a, b, c = (local[triangles[:, corner]] for corner in range(3))
        normal = np.cross(b - a, c - a).astype(np.float32)
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        self.triangle_normal: Float32 = normal / np.maximum(length, np.float32(1e-30))
        # Robust: without it about one ray in four million slips between two triangles and lights a closed room. It costs no time.
        self._scene = EmbreeScene(robust=True)
        if len(triangles):
            TriangleMesh(self._scene, local, np.ascontiguousarray(triangles, np.int32))
        self._empty = len(triangles) == 0

    def closest(self, origins: Float64, directions: Float64 | Float32) -> Hits:
        """First surface along each ray: origins (n, 3) [m], world frame; directions (n, 3), unit."""
        return self.closest_from(self.local(origins), directions)

    def closest_from(self, origin: Float32, directions: Float64 | Float32) -> Hits:
        """``closest`` from origins (n, 3) of ``local``: for points that many rays start from."""
        n = len(origin)
        direction = np.ascontiguousarray(directions, np.float32)
        if self._empty or n == 0:
            return Hits(np.full(n, np.inf, np.float32), np.full(n, -1, np.int32), np.zeros((n, 3), np.float32), np.zeros(n, bool))
        found = self._scene.run(origin, direction, output=True)
        triangle = found["primID"].astype(np.int32)
        hit = triangle >= 0
        distance = np.where(hit, found["tfar"], np.float32(np.inf)).astype(np.float32)
        normal = self.triangle_normal[triangle]
        normal[~hit] = 0
        from_back = np.einsum("ij,ij->i", normal, direction) > 0
        normal[from_back] *= -1
        return Hits(distance, triangle, normal, from_back)

    def local(self, points: Float64) -> Float32:
        """Points (n, 3) [m], world frame, as rays start from them: single precision from the anchor."""
        return np.ascontiguousarray(np.asarray(points, np.float64) - self.anchor, np.float32)

    def occluded(self, origins: Float64, directions: Float64 | Float32, distance: Float64 | Float32 | None = None) -> Bool:
        """Whether anything lies along each ray within ``distance`` (n,) [m]; anywhere when it is None. -> (n,) bool."""
        return self.occluded_from(self.local(origins), directions, distance)

    def occluded_from(self, origin: Float32, directions: Float64 | Float32, distance: Float64 | Float32 | None = None) -> Bool:
        """``occluded`` from origins (n, 3) of ``local``: for points that many rays start from."""
        n = len(origin)
        if self._empty or n == 0:
            return np.zeros(n, bool)
        direction = np.ascontiguousarray(directions, np.float32)
        reach = np.full(n, FAR_M, np.float32) if distance is None else np.ascontiguousarray(distance, np.float32)
        return np.asarray(self._scene.run(origin, direction, dists=reach, query="OCCLUDED") >= 0)
