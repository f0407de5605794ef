"""Embree for pictures: what a camera sees and what the sun reaches. Float32 around an anchor; float64 world metres outside."""

from dataclasses import dataclass

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from gi_core.arrays import Bool, Float32, Float64, Int32
from gi_core.constants import SECTOR_SIZE_M

# A shadow ray starts this far off its surface: above the step of a file's vertices (2 mm), far below what a pixel shows.
SHADOW_OFFSET_M = 0.01


@dataclass(frozen=True, eq=False)
class Surface:
    """What n camera rays hit.

    triangle : (n,) int32, -1 where a ray meets nothing
    position : (n, 3) float64 [m], world frame; undefined where nothing is met
    normal : (n, 3) float32, unit, towards the camera; zero where nothing is met
    """

    triangle: Int32
    position: Float64
    normal: Float32

    @property
    def hit(self) -> Bool:
        return self.triangle >= 0


class RayCaster:
    """Triangles that rays can be cast into; read-only, safe to share between threads."""

    def __init__(self, vertices: Float64, triangles: Int32) -> None:
        """vertices : (v, 3) [m], world frame; triangles : (m, 3), m > 0."""
        middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
        self._anchor: Float64 = np.round(middle / SECTOR_SIZE_M) * SECTOR_SIZE_M
        local = np.ascontiguousarray(vertices - self._anchor, np.float32)
        corner_a, corner_b, corner_c = (local[triangles[:, i]] for i in range(3))
        cross = np.cross(corner_b - corner_a, corner_c - corner_a)
        self._normal = (cross / np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), 1e-30)).astype(np.float32)
        self._scene = EmbreeScene()
        TriangleMesh(self._scene, local, np.ascontiguousarray(triangles, np.int32))

    def first_surface(self, origin: Float64, directions: Float32) -> Surface:
        """Closest surface along rays from one point (3,) [m] along directions (n, 3), unit."""
        origins = np.repeat((origin - self._anchor).astype(np.float32)[None], len(directions), axis=0)
        found = self._scene.run(origins, directions, output=True)
        triangle = found["primID"].astype(np.int32)
        hit = triangle >= 0
        distance = np.where(hit, found["tfar"], 0.0).astype(np.float64)
        normal = np.where(hit[:, None], self._normal[triangle], np.float32(0))
        # Surfaces have two sides: show the one that faces the camera.
        normal = np.where((normal * directions).sum(axis=1, keepdims=True) > 0, -normal, normal)
        return Surface(triangle, origin + distance[:, None] * directions, normal)

    def lit(self, surface_position: Float64, surface_normal: Float32, direction: Float64) -> Bool:
        """Whether nothing stands between points (n, 3) [m] with normals (n, 3) and a far light towards ``direction`` (3,). -> (n,) bool"""
        facing = surface_normal @ direction.astype(np.float32) > 0
        origins = np.ascontiguousarray(surface_position[facing] + SHADOW_OFFSET_M * surface_normal[facing] - self._anchor, np.float32)
        free = facing.copy()
        if len(origins):
            towards = np.repeat(direction.astype(np.float32)[None], len(origins), axis=0)
            free[facing] = self._scene.run(origins, towards, query="OCCLUDED") < 0
        return free
