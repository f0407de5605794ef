"""What a relight needs of the light: sky patches and directional lights, in the kernels' own records."""

from dataclasses import dataclass

import numpy as np

from gi_core.arrays import AnyArray, Float32
from gi_core.constants import CUBE_FACES
from gi_core.layout import DIRECTIONAL_LIGHT
from gi_core.lighting import Lighting
from gi_core.sky_patches import patch_exitance
from gi_core.sun_table import SunTable


@dataclass(frozen=True, eq=False)
class RelightInput:
    """patch_exitance : (patches, 3) float32 [lx], pi times the mean radiance of each sky patch
    lights : (n,) records of layout.DIRECTIONAL_LIGHT, only those that shine
    snow : 0..1, how much of each surfel's snow attribute is covered
    sky : scheme of the patches, one of sky_patches.SKY_SCHEMES
    """

    patch_exitance: Float32
    lights: AnyArray
    snow: float = 0.0
    sky: str = "faces"


def relight_input(lighting: Lighting, table: SunTable, sky: str = "faces", patches: int = len(CUBE_FACES)) -> RelightInput:
    """Project a lighting snapshot to what the relighter takes, for a dataset with this sun table and these sky patches."""
    shining = lighting.directional_lights
    lights = np.zeros(len(shining), DIRECTIONAL_LIGHT.dtype)
    for record, light in zip(lights, shining, strict=True):
        planes, weights = table.lookup(light.direction)
        record["direction"][:3] = light.direction
        record["irradiance"][:3] = light.irradiance
        record["plane"], record["plane_weight"] = planes, weights
    return RelightInput(patch_exitance(lighting, sky, patches), lights, lighting.snow, sky)
