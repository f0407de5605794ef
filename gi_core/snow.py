"""Where snow lies and how white it makes: one rule for the bake, the judge and pictures."""

from collections.abc import Callable

import numpy as np

from gi_core.arrays import Bool, Float32, Int64
from gi_core.constants import SNOW_ALBEDO

# Below this slope (cosine from the vertical) snow slides off; it lies fully on what is flatter than 45 degrees.
SNOW_MIN_UP, SNOW_FULL_UP = 0.3, 0.7071


def snow_attribute(normal: Float32, open_above: Callable[[Int64], Bool]) -> Float32:
    """How much of the snow that falls stays: on what is up-facing and open to the sky (slide "Procedural snow").

    normal : (n, 3) unit, towards the air, world frame
    open_above : for row numbers (k,) of points that are flat enough, whether nothing stands above each
    Returns (n,) float32, 0..1.
    """
    lies = np.clip((normal[:, 1] - SNOW_MIN_UP) / (SNOW_FULL_UP - SNOW_MIN_UP), 0, 1)
    flat = np.flatnonzero(lies > 0)
    snow = np.zeros(len(normal), np.float32)
    snow[flat] = lies[flat] * open_above(flat)
    return snow


def whitened(albedo: Float32, cover: Float32) -> Float32:
    """Albedo (n, 3) blended to fresh snow's by how much of each surface is covered, (n,) of 0..1. As snow.h does."""
    return np.asarray(albedo + cover[:, None] * (np.float32(SNOW_ALBEDO) - albedo), np.float32)
