"""Where snow lies, by rays: for the bake and for the judge."""

import numpy as np

from bake_jobs.rays import RayScene
from gi_core import snow
from gi_core.arrays import Bool, Float32, Float64, Int64


def snow_attribute(ray_scene: RayScene, start: Float64, normal: Float32) -> Float32:
    """How much of the snow that falls stays: ``gi_core.snow.snow_attribute`` with a ray straight up.

    start : (n, 3) [m], world frame, just off the surface; normal : (n, 3) unit, towards the air
    Returns (n,) float32, 0..1.
    """

    def open_above(flat: Int64) -> Bool:
        return ~ray_scene.occluded(start[flat], np.tile(np.array([[0, 1, 0]], np.float32), (len(flat), 1)))

    return snow.snow_attribute(normal, open_above)
