"""What a relight needs of the light: sky patches and directional lights, in the kernels' own records."""

from dataclasses import dataclass

import numpy as np

from gi_core.ambient_cube import FACE_DIRECTIONS
from gi_core.arrays import AnyArray, Float32
from gi_core.layout import DIRECTIONAL_LIGHT
from gi_core.lighting import Lighting
from gi_core.sun_table import SunTable

# The share of each cube face's cosine-weighted view that lies above the horizon: all of +Y, half of the sides, none of -Y.
_ABOVE_HORIZON = np.where(FACE_DIRECTIONS[:, 1] > 0, 1.0, np.where(FACE_DIRECTIONS[:, 1] < 0, 0.0, 0.5))


@dataclass(frozen=True, eq=False)
class RelightInput:
    """patch_exitance : (patches, 3) float32 [lx], pi times the mean radiance of each sky patch
    lights : (n,) records of layout.DIRECTIONAL_LIGHT, only those that shine
    snow : 0..1, how much of each surfel's snow attribute is covered
    """

    patch_exitance: Float32
    lights: AnyArray
    snow: float = 0.0


def sky_face_exitance(lighting: Lighting) -> Float32:
    """The talk's six sky scalars (slide "Sky visibility"), as patches: (6, 3) [lx].

    Each is what the face's irradiance would be if the radiance that it sees of the sky filled its whole view, so that multiplying
    by the share of the view that sees sky gives back the sky's irradiance where nothing is in the way.
    """
    share = _ABOVE_HORIZON[:, None]
    return np.where(share > 0, lighting.sky_cube / np.maximum(share, 1e-9), 0).astype(np.float32)


def relight_input(lighting: Lighting, table: SunTable) -> RelightInput:
    """Project a lighting snapshot to what the relighter takes, for a dataset with this sun table."""
    shining = lighting.directional_lights
    lights = np.zeros(len(shining), DIRECTIONAL_LIGHT.dtype)
    for record, light in zip(lights, shining, strict=True):
        planes, weights = table.lookup(light.direction)
        record["direction"][:3] = light.direction
        record["irradiance"][:3] = light.irradiance
        record["plane"], record["plane_weight"] = planes, weights
    return RelightInput(sky_face_exitance(lighting), lights, lighting.snow)
