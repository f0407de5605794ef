"""Where snow lies: one rule for the bake and for the judge."""

import numpy as np

from bake_jobs.rays import RayScene
from gi_core.arrays import Float32, Float64

# Below this slope (cosine from the vertical) snow slides off; it lies fully on what is flatter than 45 degrees.
SNOW_MIN_UP, SNOW_FULL_UP = 0.3, 0.7071


def snow_attribute(ray_scene: RayScene, start: Float64, normal: Float32) -> Float32:
    """How much of the snow that falls stays: up-facing and open to the sky (slide "Procedural snow").

    start : (n, 3) [m], world frame, just off the surface; normal : (n, 3) unit, towards the air
    Returns (n,) float32, 0..1.
    """
    up = normal[:, 1]
    lies = np.clip((up - SNOW_MIN_UP) / (SNOW_FULL_UP - SNOW_MIN_UP), 0, 1)
    flat = np.flatnonzero(lies > 0)
    open_sky = ~ray_scene.occluded(start[flat], np.tile(np.array([[0, 1, 0]], np.float32), (len(flat), 1)))
    snow = np.zeros(len(start), np.float32)
    snow[flat] = lies[flat] * open_sky
    return snow
