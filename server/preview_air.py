"""What a picture shows where no surface is, and the fog before all of it.

Fog takes light away by its extinction and gives back the sky's mean radiance, as droplets would that are lit evenly from everywhere:

    L(d) = L(0) exp(-k d) + L_sky (1 - exp(-k d))

That holds in the open. What a street does to it is ``preview_fog``'s. Left out: its glow around the sun, and what lamps give it.
"""

import numpy as np

from gi_core.arrays import Float32, Float64
from gi_core.lighting import Lighting
from gi_core.sky import ROWS, row_solid_angle
from gi_core.snow import whitened

# What lies beyond the world's edge is drawn as ground of this albedo, in the open; it is not part of the data.
OUTSIDE_ALBEDO = 0.2


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
    radiance[directions[:, 1] < 0] = open_ground_radiance(lighting)
    return np.asarray(radiance, np.float32)


def open_ground_radiance(lighting: Lighting) -> Float64:
    """(3,) [cd m^-2]: of the open plain."""
    irradiance = lighting.sky_cube[2] + sum(light.irradiance * max(light.direction[1], 0.0) for light in lighting.directional_lights)
    albedo = whitened(np.full((1, 3), OUTSIDE_ALBEDO, np.float32), np.array([lighting.snow], np.float32))[0]
    return np.asarray(albedo / np.pi * irradiance, np.float64)


def plain_distance(eye: Float64, directions: Float32, ground: float) -> Float64:
    """How far the open plain at height ``ground`` [m] is from an eye (3,) along directions (n, 3): (n,) [m].

    0 where there is sky, whose radiance has its fog already.
    """
    falls = directions[:, 1] < 0
    return np.where(falls, max(float(eye[1]) - ground, 0.0) / np.where(falls, -directions[:, 1].astype(np.float64), 1.0), 0.0)


def mean_sky(lighting: Lighting) -> Float64:
    """(3,) [cd m^-2]: the mean radiance above the horizon."""
    share = row_solid_angle() / (2 * np.pi)
    return np.asarray(share @ lighting.sky_radiance[:ROWS].sum(axis=1, dtype=np.float64))


def through_fog(radiance: Float32, distance: Float64, lighting: Lighting) -> Float32:
    """Radiance (n, 3) [cd m^-2] seen from distances (n,) [m]."""
    if lighting.fog_density == 0:
        return radiance
    kept = np.exp(-lighting.fog_density * distance)[:, None].astype(np.float32)
    return np.asarray(radiance * kept + mean_sky(lighting).astype(np.float32) * (1 - kept), np.float32)
