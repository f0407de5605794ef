"""Light through the air: the beam of the sun (or moon), and what the air scatters towards the ground.

Single scattering is integrated along each view ray; all further orders come from a small table of an infinite series of isotropic
bounces (Hillaire, "A Scalable and Production Ready Sky and Atmosphere Rendering Technique", EGSR 2020). Nothing in it ends at the
horizon: the Earth's shadow climbs the air, ozone turns the zenith blue, and twilight fades by itself.

Spectra are vectors over ``spectrum.WAVELENGTH_NM`` (8 of them), as shares of the sunlight above the air.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from gi_core.air import EARTH_RADIUS_KM, TOP_KM, ColumnsAt, densities, disc_share, distance_to_top, horizon_sine, rows_at
from gi_core.arrays import Float32, Float64
from gi_core.constants import SKY_SHAPE
from gi_core.spectrum import WAVELENGTH_NM, aerosol_depth, ozone_depth, rayleigh_depth

# Aerosol absorbs a tenth of what it meets and scatters forwards: continental average, Hess et al. 1998 (OPAC).
AEROSOL_ALBEDO = 0.9
AEROSOL_ASYMMETRY = 0.7
HIGHEST_PLACE_KM = 8.0

# Against 128 steps and 37 azimuths: 0.6 % of the sky's light.
_RAY_STEPS = 32
_AZIMUTHS = 13  # of the view relative to the sun, 0 to 180 degrees

# Against 30 x 80, 256 directions and 40 steps: 0.3 % of the sky's light by day, 2 % with the sun 6 degrees down.
_BOUNCE_HEIGHTS, _BOUNCE_SUNS = 12, 40
_BOUNCE_DIRECTIONS, _BOUNCE_STEPS = 48, 16
_BOUNCE_REFINEMENT = 2
# Signed square root of the sine of the sun's elevation at the low end of the table (-22.6 degrees); no light there.
_LOWEST_SUN_ROOT = -0.62
_NO_LIGHT = 1e-30


@dataclass(frozen=True, eq=False)
class SkyScattering:
    """What the sky's light is made of, before phase functions: each (rows, azimuths, 8) [sr^-1], shares of the sunlight above the air.

    rows : the upper half of the sky map's; azimuths : relative to the sun, evenly from 0 to 180 degrees
    """

    air: Float64
    aerosol: Float64
    multiple: Float64


@dataclass(frozen=True, eq=False)
class _March:
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


class Atmosphere:
    """The air over one place with one haze. Read-only once built (50 ms); safe to share between threads."""

    def __init__(self, haze: float, height_km: float) -> None:
        """haze : aerosol optical depth at 550 nm; height_km : of the place above the sea."""
        # Vertical optical depths; rows: air, aerosol, ozone.
        self._depth: Float64 = np.stack([rayleigh_depth(), aerosol_depth(haze), ozone_depth()])
        self._scatter: Float64 = self._depth[:2] * np.array([[1.0], [AEROSOL_ALBEDO]])
        place = np.array([height_km])
        self._place = ColumnsAt(place)
        polar = np.pi * (np.arange(SKY_SHAPE[0] // 2) + 0.5) / SKY_SHAPE[0]
        sine = np.cos(polar)
        height = np.full(len(sine), height_km)
        self._view = self._march(height, sine, distance_to_top(height, sine))
        self._view_columns = ColumnsAt(self._view.height)
        self._bounced_air, self._bounced_ground = (_at_heights(table, self._view.height) for table in self._bounces())

    def beam(self, elevation_degrees: float) -> Float64:
        """(8,) share of a light's spectrum that reaches a surface facing it; exactly 0 at and below the horizon."""
        columns = self._place.towards(np.sin(np.radians([[elevation_degrees]])))[0, 0]
        return np.asarray(np.exp(-columns @ self._depth) * disc_share(np.asarray(elevation_degrees)), np.float64)

    def scattering(self, elevation_degrees: float, ground_albedo: float) -> SkyScattering:
        """What the sky scatters from a light at an elevation, above or below the horizon."""
        elevation = np.radians(elevation_degrees)
        relative = np.linspace(0, np.pi, _AZIMUTHS)
        view, arc = self._view, self._view.arc[..., None]
        sine = np.cos(arc) * np.sin(elevation) + np.sin(arc) * (np.cos(elevation) * np.cos(relative))  # (rows, steps, azimuths)
        sunlight = self._sunlight(self._view_columns, sine)
        bounced = rows_at(self._bounced_air + np.float32(ground_albedo) * self._bounced_ground, _bounce_column(sine))
        return SkyScattering(
            np.einsum("rsk,rsak->rak", view.air, sunlight),
            np.einsum("rsk,rsak->rak", view.aerosol, sunlight),
            np.einsum("rsk,rsak->rak", view.air + view.aerosol, bounced),
        )

    def _sunlight(self, columns: ColumnsAt, sine: Float64) -> Float64:
        """(..., a, 8): sunlight at points in the air for sines of the sun's elevation (..., a), the Earth's shadow included."""
        light = np.exp(-columns.towards(sine) @ self._depth)
        light *= disc_share(columns.degrees_above_horizon(sine))[..., None]
        return np.asarray(light, np.float64)

    def _march(self, height: Float64, sine: Float64, length: Float64, steps: int = _RAY_STEPS) -> _March:
        """Steps along rays (n,) from heights, with sines of elevation and lengths [km]; short ones first."""
        edges = np.linspace(0, 1, steps + 1) ** 2
        along = length[:, None] * ((edges[1:] + edges[:-1]) / 2)
        span = length[:, None] * np.diff(edges)
        level = along * np.sqrt(np.maximum(1 - sine * sine, 0.0))[:, None]
        upward = (EARTH_RADIUS_KM + height)[:, None] + along * sine[:, None]
        at = np.maximum(np.hypot(upward, level) - EARTH_RADIUS_KM, 0.0)
        density = densities(at)
        extinction = density @ self._depth
        through = extinction * span[..., None]
        total = np.cumsum(through, axis=1)
        # Light that is scattered along a step also fades within it.
        reach = np.exp(through - total) * -np.expm1(-through) / np.maximum(extinction, 1e-30)
        air, aerosol = (density[..., s, None] * self._scatter[s] * reach for s in range(2))
        return _March(at, np.arctan2(level, upward), air, aerosol, np.exp(-total[:, -1]))

    def _bounces(self) -> tuple[Float64, Float64]:
        """Hillaire's series: light that has bounced twice or more, per unit of scattering, each (heights, suns, 8).

        The second table is the part by way of the ground, for an albedo of 1.
        """
        height = TOP_KM * np.linspace(0, 1, _BOUNCE_HEIGHTS) ** 3
        root = np.linspace(_LOWEST_SUN_ROOT, 1, _BOUNCE_SUNS)
        sun_up = root * np.abs(root)
        sun_level = np.sqrt(1 - sun_up**2)
        second, ground = (np.zeros((_BOUNCE_HEIGHTS, _BOUNCE_SUNS, len(WAVELENGTH_NM))) for _ in range(2))
        again = np.zeros((_BOUNCE_HEIGHTS, 1, len(WAVELENGTH_NM)))
        sea = ColumnsAt(np.zeros(_BOUNCE_HEIGHTS))
        # A golden spiral over the sphere, denser at the horizon: that is where the light of deep twilight comes from.
        spiral = 1 - 2 * (np.arange(_BOUNCE_DIRECTIONS) + 0.5) / _BOUNCE_DIRECTIONS
        shares = np.abs(spiral) / np.abs(spiral).sum()
        for k, share in enumerate(shares.tolist()):
            sine = np.full(_BOUNCE_HEIGHTS, spiral[k] * abs(spiral[k]))
            turned_level = np.cos(k * np.pi * (3 - np.sqrt(5))) * sun_level
            hits_ground = sine < horizon_sine(height)
            length = np.where(hits_ground, _distance_to_ground(height, sine), distance_to_top(height, sine))
            ray = self._march(height, sine, length, _BOUNCE_STEPS)
            scattered = (ray.air + ray.aerosol) * share
            arc = ray.arc[..., None]
            sunlight = self._sunlight(ColumnsAt(ray.height), np.cos(arc) * sun_up + np.sin(arc) * turned_level)
            second += np.einsum("hsk,hsak->hak", scattered, sunlight) / (4 * np.pi)
            again += scattered.sum(axis=1)[:, None]
            arc = np.arctan2(length * np.sqrt(1 - sine**2), EARTH_RADIUS_KM + height + length * sine)[:, None]
            incidence = np.cos(arc) * sun_up + np.sin(arc) * turned_level
            exitance = self._sunlight(sea, incidence) * np.maximum(incidence, 0.0)[..., None]
            ground += np.where(hits_ground[:, None, None], exitance * ray.transmittance[:, None], 0.0) * (share / np.pi)
        series = 1 / (1 - again)
        return second * series, ground * series


def _distance_to_ground(height: Float64, sine: Float64) -> Float64:
    radius = EARTH_RADIUS_KM + height
    return np.asarray(-radius * sine - np.sqrt(np.maximum(EARTH_RADIUS_KM**2 - radius**2 * (1 - sine * sine), 0.0)), np.float64)


def _at_heights(bounces: Float64, height_km: Float64) -> Float32:
    """Bounces (heights, suns, 8) at given heights (...) -> (..., refined suns, 8), 2.6 MB for the view's 1024 heights.

    Refined by the logarithm, because twilight falls by a factor of ten every three degrees.
    """
    logarithm = np.log(np.maximum(bounces, _NO_LIGHT))
    column = np.linspace(0, _BOUNCE_SUNS - 1, _BOUNCE_REFINEMENT * (_BOUNCE_SUNS - 1) + 1)
    fine = np.exp(rows_at(logarithm, np.broadcast_to(column, (_BOUNCE_HEIGHTS, len(column)))))
    row = np.cbrt(np.clip(height_km / TOP_KM, 0, 1)) * (_BOUNCE_HEIGHTS - 1)
    first = np.minimum(row.astype(np.intp), _BOUNCE_HEIGHTS - 2)
    share = (row - first)[..., None, None]
    return np.asarray(fine[first] * (1 - share) + fine[first + 1] * share, np.float32)


def _bounce_column(sine: Float64) -> Float64:
    """Where a sine of the sun's elevation lies among the refined suns."""
    root = np.sign(sine) * np.sqrt(np.abs(sine))
    return np.asarray((root - _LOWEST_SUN_ROOT) / (1 - _LOWEST_SUN_ROOT) * (_BOUNCE_REFINEMENT * (_BOUNCE_SUNS - 1)), np.float64)


@lru_cache(maxsize=8)  # 8 MB each
def atmosphere(haze: float, height_km: float) -> Atmosphere:
    """The air for a haze (aerosol optical depth at 550 nm) over a place at a height above the sea [km], 0..8."""
    return Atmosphere(haze, min(max(height_km, 0.0), HIGHEST_PLACE_KM))
