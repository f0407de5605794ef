"""Light through the air: the beam of the sun (or moon), and what the air scatters towards the ground.

Single scattering is integrated along each view ray; all further orders come from the tables of ``bounces``. Nothing in it ends at the
horizon: the Earth's shadow climbs the air, ozone turns the zenith blue, and twilight fades by itself.

Spectra are vectors over ``spectrum.WAVELENGTH_NM`` (8 of them), as shares of the sunlight above the air.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from gi_core.air import ColumnsAt, disc_share, distance_to_top
from gi_core.air_optics import AirOptics
from gi_core.arrays import Float64
from gi_core.bounces import BouncesAt
from gi_core.constants import SKY_SHAPE

# Aerosol absorbs a tenth of what it meets: continental average, Hess et al. 1998 (OPAC).
AEROSOL_ALBEDO = 0.9
HIGHEST_PLACE_KM = 8.0

# Against 128 steps and 37 azimuths: 0.7 % of the sky's light.
_RAY_STEPS = 32
_AZIMUTHS = 13  # of the view relative to the sun, 0 to 180 degrees


@dataclass(frozen=True, eq=False)
class SkyScattering:
    """What the sky's light is made of, before phase functions: each (rows, azimuths, 8) [sr^-1], shares of the sunlight above the air.

    rows : the upper half of the sky map's; azimuths : relative to the sun, evenly from 0 to 180 degrees
    """

    air: Float64
    aerosol: Float64
    multiple: Float64


class Atmosphere:
    """The air over one place with one haze. Read-only once built (5 ms, 30 ms more for each new node of haze); safe to share."""

    def __init__(self, haze: float, height_km: float) -> None:
        """haze : aerosol optical depth at 550 nm; height_km : of the place above the sea."""
        self._optics = AirOptics(haze, AEROSOL_ALBEDO)
        polar = np.pi * (np.arange(SKY_SHAPE[0] // 2) + 0.5) / SKY_SHAPE[0]
        sine = np.cos(polar)
        height = np.full(len(sine), height_km)
        self._view = self._optics.march(height, sine, distance_to_top(height, sine), _RAY_STEPS)
        self._place, self._view_columns = ColumnsAt(np.array([height_km]), seen=True), ColumnsAt(self._view.height)
        self._bounces = BouncesAt(haze, AEROSOL_ALBEDO, self._view.height)

    def beam(self, elevation_degrees: float) -> Float64:
        """(8,) share of a light's spectrum that reaches a surface facing it, by its elevation as seen; exactly 0 from the horizon down."""
        columns = self._place.towards(np.sin(np.radians([[elevation_degrees]])))[0, 0]
        return np.asarray(np.exp(-columns @ self._optics.path_depth) * disc_share(np.asarray(elevation_degrees)), np.float64)

    def scattering(self, elevation_degrees: float, ground_albedo: float) -> SkyScattering:
        """What the sky scatters from a light, by its elevation without refraction, above or below the horizon."""
        elevation = np.radians(elevation_degrees)
        relative = np.linspace(0, np.pi, _AZIMUTHS)
        view, arc = self._view, self._view.arc[..., None]
        sine = np.cos(arc) * np.sin(elevation) + np.sin(arc) * (np.cos(elevation) * np.cos(relative))  # (rows, steps, azimuths)
        sunlight = self._optics.sunlight(self._view_columns, sine)
        bounced = self._bounces.towards(sine, ground_albedo)
        return SkyScattering(
            np.einsum("rsk,rsak->rak", view.air, sunlight),
            np.einsum("rsk,rsak->rak", view.aerosol, sunlight),
            np.einsum("rsk,rsak->rak", view.air + view.aerosol, bounced),
        )


@lru_cache(maxsize=8)  # 8 MB each
def atmosphere(haze: float, height_km: float) -> Atmosphere:
    """The air for a haze (aerosol optical depth at 550 nm) over a place at a height above the sea [km], 0..8."""
    return Atmosphere(haze, min(max(height_km, 0.0), HIGHEST_PLACE_KM))
