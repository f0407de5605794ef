"""What one haze does to light on its way: how much is scattered towards the start of a ray, and how much sunlight arrives where.

Spectra are vectors over ``spectrum.WAVELENGTH_NM`` (8 of them), as shares of the sunlight above the air.
"""

from dataclasses import dataclass

import numpy as np

from gi_core.air import EARTH_RADIUS_KM, ColumnsAt, disc_share
from gi_core.air_profile import densities
from gi_core.arrays import Float64
from gi_core.spectrum import aerosol_depth, ozone_depth, rayleigh_depth


@dataclass(frozen=True, eq=False)
class March:
    """Steps along n rays.

    height [km], arc [rad] from the start, seen from the Earth's centre : (n, steps), of each step's middle
    air, aerosol : (n, steps, 8), how much of the light scattered there arrives at the start
    transmittance : (n, 8), of the whole ray
    """

    height: Float64
    arc: Float64
    air: Float64
    aerosol: Float64
    transmittance: Float64


class AirOptics:
    """Optical depths of the whole air for one haze.

    depth : (3, 8), vertical, of air, aerosol and ozone; scatter : (2, 8), the part of the first two that scatters
    """

    def __init__(self, haze: float, aerosol_albedo: float) -> None:
        """haze : aerosol optical depth at 550 nm; aerosol_albedo : share of what aerosol meets that it scatters."""
        self.depth: Float64 = np.stack([rayleigh_depth(), aerosol_depth(haze), ozone_depth()])
        # Along light's way its spreading counts as another depth, the same at all wavelengths.
        self.path_depth: Float64 = np.concatenate([self.depth, np.ones((1, self.depth.shape[1]))])
        self.scatter: Float64 = self.depth[:2] * np.array([[1.0], [aerosol_albedo]])

    def sunlight(self, columns: ColumnsAt, sine: Float64) -> Float64:
        """(..., a, 8): sunlight at points in the air for sines of the sun's elevation (..., a), the Earth's shadow included."""
        light = np.exp(-columns.towards(sine) @ self.path_depth)
        light *= disc_share(columns.degrees_above_horizon(sine))[..., None]
        return np.asarray(light, np.float64)

    def march(self, height: Float64, sine: Float64, length: Float64, steps: int) -> March:
        """Steps along rays (n,) from heights, with sines of elevation and lengths [km]; short ones first."""
        edges = np.linspace(0, 1, steps + 1) ** 2
        along = length[:, None] * ((edges[1:] + edges[:-1]) / 2)
        span = length[:, None] * np.diff(edges)
        level = along * np.sqrt(np.maximum(1 - sine * sine, 0.0))[:, None]
        upward = (EARTH_RADIUS_KM + height)[:, None] + along * sine[:, None]
        at = np.maximum(np.hypot(upward, level) - EARTH_RADIUS_KM, 0.0)
        density = densities(at)
        extinction = density @ self.depth
        through = extinction * span[..., None]
        total = np.cumsum(through, axis=1)
        # Light that is scattered along a step also fades within it.
        reach = np.exp(through - total) * -np.expm1(-through) / np.maximum(extinction, 1e-30)
        air, aerosol = (density[..., s, None] * self.scatter[s] * reach for s in range(2))
        return March(at, np.arctan2(level, upward), air, aerosol, np.exp(-total[:, -1]))
