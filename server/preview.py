"""A picture of the lit city, drawn the way a client draws: direct light by shadow rays, indirect light from served volumes only.

    camera rays -> surface -> direct sun and moon (shadow ray)
                           -> indirect: the volume that covers the pixel, a quarter voxel off the surface
                -> sky radiance, or a plain ground beyond the world's edge

What a picture shows wrong is therefore wrong for clients as well.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from gi_core.arrays import Float32, Float64, Int64
from gi_core.constants import VOLUME_SHAPE, VOXEL_SIZE_M
from gi_core.lighting import Lighting
from gi_core.volume import Volume, sample_volume
from server.preview_scene import PreviewScene

Indirect = Literal["on", "off", "split"]
VolumeAt = Callable[[Float64], Volume]

ASPECT = 9 / 16
SAMPLE_OFFSET_M = VOXEL_SIZE_M / 4
# Neighbouring volumes overlap by 4 voxels along each axis, so that every sample lies between voxel centres even after snapping.
TILE_M = (np.array([VOLUME_SHAPE[2], VOLUME_SHAPE[0], VOLUME_SHAPE[1]]) - 4) * VOXEL_SIZE_M
# The pixels that these do not cover are far away and share their nearest volume's edge.
MAX_VOLUMES = 128
# Sampling holds some 300 bytes a point: 20 MB.
SAMPLES_AT_ONCE = 1 << 16
# What lies beyond the world's edge is drawn as ground of this albedo, in the open; it is not part of the data.
OUTSIDE_ALBEDO = 0.2


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole. eye, look : (3,) float64 [m]; fov_degrees is horizontal; width in pixels."""

    eye: Float64
    look: Float64
    fov_degrees: float
    width: int

    @property
    def height(self) -> int:
        return max(int(self.width * ASPECT), 1)

    def rays(self) -> Float32:
        """(height * width, 3) float32 unit directions through pixel centres, rows from the top, world frame."""
        forward = (self.look - self.eye) / np.linalg.norm(self.look - self.eye)
        up_hint = np.array([0.0, 1.0, 0.0]) if abs(forward[1]) < 0.9999 else np.array([0.0, 0.0, -1.0])
        right = np.cross(forward, up_hint)
        right /= np.linalg.norm(right)
        up = np.cross(right, forward)
        reach = np.tan(np.radians(self.fov_degrees) / 2)
        across = ((np.arange(self.width) + 0.5) / self.width * 2 - 1) * reach
        down = ((np.arange(self.height) + 0.5) * 2 - self.height) / self.width * reach
        directions = forward + across[None, :, None] * right - down[:, None, None] * up
        directions /= np.linalg.norm(directions, axis=2, keepdims=True)
        return np.ascontiguousarray(directions.reshape(-1, 3), np.float32)


def render(camera: Camera, scene: PreviewScene, lighting: Lighting, volume_at: VolumeAt, indirect: Indirect) -> Float32:
    """Radiance (height, width, 3) float32 [cd m^-2]. ``volume_at`` gives the served volume around a world position (3,) [m]."""
    directions = camera.rays()
    if scene.rays is None:
        radiance = background(lighting, directions)
    else:
        surface = scene.rays.first_surface(camera.eye, directions)
        hit, missed = np.flatnonzero(surface.hit), np.flatnonzero(~surface.hit)
        radiance = np.empty((len(directions), 3), np.float32)
        radiance[missed] = background(lighting, directions[missed])
        position, normal, triangle = surface.position[hit], surface.normal[hit], surface.triangle[hit]
        irradiance = np.zeros((len(hit), 3), np.float64)
        for light in lighting.directional_lights:
            cosine = np.maximum(normal @ light.direction, 0) * scene.rays.lit(position, normal, light.direction)
            irradiance += cosine[:, None] * light.irradiance
        wanted = indirect_pixels(hit, camera.width, indirect)
        if len(wanted):
            irradiance[wanted] += indirect_irradiance(position[wanted], normal[wanted], volume_at)
        radiance[hit] = scene.albedo[triangle] / np.pi * irradiance + scene.emission[triangle]
    return radiance.reshape(camera.height, camera.width, 3)


def indirect_pixels(pixel: Int64, width: int, indirect: Indirect) -> Int64:
    """Which of the hit pixels get indirect light: all, none, or those of the picture's right half."""
    if indirect == "split":
        return np.flatnonzero(pixel % width >= width // 2)
    return np.arange(len(pixel) if indirect == "on" else 0)


def indirect_irradiance(position: Float64, normal: Float32, volume_at: VolumeAt) -> Float64:
    """Irradiance (n, 3) [lx] at surface points (n, 3) [m] with normals (n, 3), read from as many volumes as they need."""
    result = np.zeros((len(position), 3))
    # sample_volume reads this far off the surface, which may be the next volume's.
    centres, which = plan_volumes(position + SAMPLE_OFFSET_M * normal)
    for i, centre in enumerate(centres):
        volume = volume_at(centre)
        members = np.flatnonzero(which == i)
        for start in range(0, len(members), SAMPLES_AT_ONCE):
            some = members[start : start + SAMPLES_AT_ONCE]
            result[some] = sample_volume(volume.values, volume.origin, volume.voxel_size, position[some], normal[some])
    return result


def plan_volumes(points: Float64) -> tuple[Float64, Int64]:
    """Centres (v, 3) [m] of the volumes that cover points (n, 3) [m], and which one each point reads (n,).

    A fixed lattice of overlapping volumes; when more than MAX_VOLUMES would be needed those with the fewest points are left out, and
    their points read the nearest of the others, at its edge.
    """
    tile = np.floor(points / TILE_M).astype(np.int64)
    first = tile.min(axis=0)
    shape = tuple(tile.max(axis=0) - first + 1)
    # One number per tile: sorting rows would take longer than everything else that a picture needs.
    keys, tile_of, counts = np.unique(np.ravel_multi_index(tuple((tile - first).T), shape), return_inverse=True, return_counts=True)
    centres = (np.stack(np.unravel_index(keys, shape), axis=1) + first + 0.5) * TILE_M
    kept = np.sort(np.argsort(-counts, kind="stable")[:MAX_VOLUMES])
    distance = np.linalg.norm(centres[:, None] - centres[None, kept], axis=2)
    return centres[kept], np.argmin(distance, axis=1)[tile_of]


def background(lighting: Lighting, directions: Float32) -> Float32:
    """Radiance (n, 3) float32 [cd m^-2] along directions (n, 3) that meet nothing: sky, or an open plain below the horizon."""
    sky = lighting.sky_radiance
    rows, columns = sky.shape[0], sky.shape[1]
    polar = np.arccos(np.clip(directions[:, 1], -1, 1)) / np.pi * rows - 0.5
    around = np.arctan2(directions[:, 2], directions[:, 0]) / (2 * np.pi) * columns - 0.5
    # Rows below the horizon are black: interpolating into them would draw a dark line along it.
    row = np.clip(polar, 0, rows // 2 - 1.001)
    row0, column0 = row.astype(np.int64), np.floor(around).astype(np.int64)
    down, right = (row - row0)[:, None], (around - column0)[:, None]
    texel = [[sky[row0 + i, (column0 + j) % columns] for j in (0, 1)] for i in (0, 1)]
    top, bottom = (line[0] * (1 - right) + line[1] * right for line in texel)
    radiance = top * (1 - down) + bottom * down
    open_ground = lighting.sky_cube[2] + sum(light.irradiance * max(light.direction[1], 0.0) for light in lighting.directional_lights)
    radiance[directions[:, 1] < 0] = OUTSIDE_ALBEDO / np.pi * open_ground
    return np.asarray(radiance, np.float32)
