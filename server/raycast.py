"""Embree for pictures: what a camera sees and what the sun reaches. Float32 around an anchor; float64 world metres outside."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from gi_core.arrays import Bool, Float32, Float64, Int32
from gi_core.constants import SECTOR_SIZE_M
from gi_core.layout import SHADOW_END_M

# A shadow ray starts this far off its surface: above the step of a file's vertices (2 mm), far below what a pixel shows.
SHADOW_OFFSET_M = 0.01
# Embree takes it for no bound.
FAR_M = 1e30


@dataclass(frozen=True, eq=False)
class Surface:
    """What n camera rays hit.

    triangle : (n,) int32, -1 where a ray meets nothing
    distance : (n,) float64 [m], inf where nothing is met
    position : (n, 3) float64 [m], world frame; undefined where nothing is met
    normal : (n, 3) float32, unit, towards the camera; zero where nothing is met
    """

    triangle: Int32
    distance: Float64
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
        self.anchor: Float64 = np.round(middle / SECTOR_SIZE_M) * SECTOR_SIZE_M
        self.low: Float64 = vertices.min(axis=0)
        self.high: Float64 = vertices.max(axis=0)
        local = np.ascontiguousarray(vertices - self.anchor, np.float32)
        corner_a, corner_b, corner_c = (local[triangles[:, i]] for i in range(3))
        cross = np.cross(corner_b - corner_a, corner_c - corner_a)
        self._normal = (cross / np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), 1e-30)).astype(np.float32)
        self._scene = EmbreeScene()
        TriangleMesh(self._scene, local, np.ascontiguousarray(triangles, np.int32))

    def first_surface(self, origin: Float64, directions: Float32) -> Surface:
        """Closest surface along rays from one point (3,) [m] along directions (n, 3), unit."""
        origins = np.repeat((origin - self.anchor).astype(np.float32)[None], len(directions), axis=0)
        found = self._scene.run(origins, directions, output=True)
        triangle = found["primID"].astype(np.int32)
        hit = triangle >= 0
        distance = np.where(hit, found["tfar"], np.inf).astype(np.float64)
        normal = np.where(hit[:, None], self._normal[triangle], np.float32(0))
        # Surfaces have two sides: show the one that faces the camera.
        normal = np.where((normal * directions).sum(axis=1, keepdims=True) > 0, -normal, normal)
        return Surface(triangle, distance, origin + np.where(hit, distance, 0)[:, None] * directions, normal)

    def contains(self, position: Float64) -> bool:
        """Whether a place (3,) [m] lies in the box around all triangles."""
        return bool((position >= self.low).all() and (position <= self.high).all())

    def lit(self, surface_position: Float64, surface_normal: Float32, direction: Float64) -> Bool:
        """Whether nothing stands between points (n, 3) [m] with normals (n, 3) and a far light towards ``direction`` (3,). -> (n,) bool"""
        facing = surface_normal @ direction.astype(np.float32) > 0
        towards = np.repeat(direction.astype(np.float32)[None], int(facing.sum()), axis=0)
        return self._reach(facing, surface_position, surface_normal, towards, FAR_M)

    def sees(self, surface_position: Float64, surface_normal: Float32, target: Float64) -> Bool:
        """Whether nothing stands between points (n, 3) [m] with normals (n, 3) and a place (3,) [m] nearby. -> (n,) bool"""
        way = (target - surface_position).astype(np.float32)
        facing = np.einsum("ij,ij->i", surface_normal, way) > 0
        # In units of the way itself: what stops short of the target by SHADOW_END_M does not block.
        length = np.sqrt(np.einsum("ij,ij->i", way[facing], way[facing]))
        return self._reach(facing, surface_position, surface_normal, way[facing], 1 - SHADOW_END_M / np.maximum(length, SHADOW_END_M))

    def free_share(self, surface_position: Float64, surface_normal: Float32, ways: Iterable[Float32]) -> Float32:
        """How much of their ways points (n, 3) [m] with normals (n, 3) get on the mean before they meet a surface. -> (n,) 0..1

        ways : one or more (n, 3) [m]
        """
        origins = np.ascontiguousarray(surface_position + SHADOW_OFFSET_M * surface_normal - self.anchor, np.float32)
        whole = np.ones(len(origins), np.float32)
        found = [np.minimum(self._scene.run(origins, way, dists=whole.copy(), query="DISTANCE"), whole) for way in ways]
        return np.asarray(np.mean(found, axis=0), np.float32)

    def sees_from(self, eye: Float64, target: Float64) -> bool:
        """Whether nothing stands between two places (3,) [m] in the air."""
        way = (target - eye).astype(np.float32)
        # The way itself is the normal: the eye has no surface to lie on.
        length = max(float(np.linalg.norm(way)), 1e-6)
        return bool(self.sees(eye[None], way[None] / np.float32(length), target)[0])

    def _reach(self, facing: Bool, position: Float64, normal: Float32, way: Float32, share: Float32 | float) -> Bool:
        """Of the points that face a light, which ones reach a share of their way (f, 3) towards it. -> (n,) bool, False for the others."""
        free = facing.copy()
        if len(way):
            origins = np.ascontiguousarray(position[facing] + SHADOW_OFFSET_M * normal[facing] - self.anchor, np.float32)
            reach = np.array(np.broadcast_to(share, len(way)), np.float32)  # Embree wants to be able to write
            free[facing] = self._scene.run(origins, np.ascontiguousarray(way), dists=reach, query="OCCLUDED") < 0
        return free
