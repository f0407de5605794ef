"""The light of one moment: a frozen snapshot of sun, moon and sky. All that relighting and an outside path tracer need."""

import hashlib
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from gi_core.arrays import Float32, Float64


@dataclass(frozen=True, eq=False)
class DirectionalLight:
    """Sun or moon.

    direction : (3,) float64, unit, world frame, towards the light
    irradiance : (3,) float64 [lx per channel], linear sRGB, on a surface that faces it; 0 below the horizon
    """

    direction: Float64
    irradiance: Float64


@dataclass(frozen=True, eq=False)
class Lighting:
    """Sun, moon and sky at one time and weather, as they reach the city: clouds and fog have already dimmed and spread them.

    time : ISO 8601 local time; weather : the weather as it was asked for, normalised
    sky_radiance : (64, 128, 3) float32 [cd m^-2 per channel], equirectangular; row i, column j looks along
        (sin t cos p, cos t, sin t sin p), t = pi (i + 0.5) / 64, p = 2 pi (j + 0.5) / 128; zero below the horizon; no sun disc
    sky_cube : (6, 3) float64 [lx]: the unobstructed sky's irradiance along the axes, +X -X +Y -Y +Z -Z
    snow : 0..1, how much of the ground's snow attribute is covered
    fog_density : extinction [m^-1]
    exposure : EV100 that suits the scene
    """

    time: str
    weather: str
    sun: DirectionalLight
    moon: DirectionalLight
    sky_radiance: Float32
    sky_cube: Float64
    snow: float
    fog_density: float
    exposure: float

    @cached_property
    def digest(self) -> str:
        """32 hexadecimal digits that identify everything in the snapshot which changes light; half of an ETag."""
        h = hashlib.blake2b(digest_size=16)
        for light in (self.sun, self.moon):
            h.update(np.asarray(light.direction, np.float64).tobytes())
            h.update(np.asarray(light.irradiance, np.float64).tobytes())
        h.update(np.ascontiguousarray(self.sky_radiance, np.float32).tobytes())
        h.update(np.array([self.snow, self.fog_density], np.float64).tobytes())
        return h.hexdigest()

    @property
    def directional_lights(self) -> tuple[DirectionalLight, ...]:
        """Those of sun and moon that give any light."""
        return tuple(light for light in (self.sun, self.moon) if np.any(light.irradiance > 0))
