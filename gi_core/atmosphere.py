"""Light through a spherical atmosphere: the beam of the sun (or moon), and what the air scatters towards the ground.

Single scattering is integrated along each view ray; all further orders come from a small table of an infinite series of isotropic
bounces (Hillaire, "A Scalable and Production Ready Sky and Atmosphere Rendering Technique", EGSR 2020). Nothing in it ends at the
horizon: the Earth's shadow climbs the air, ozone turns the zenith blue, and twilight fades by itself.

Heights are in kilometres above the sea, optical columns in units of the vertical column from the sea (so a vertical path from the
sea has 1). Spectra are vectors over ``spectrum.WAVELENGTH_NM`` (8 of them), as shares of the sunlight above the air.
"""

from dataclasses import dataclass
from functools import cache, lru_cache

import numpy as np

from gi_core.arrays import Float64
from gi_core.constants import SKY_SHAPE
from gi_core.spectrum import WAVELENGTH_NM, aerosol_depth, ozone_depth, rayleigh_depth

EARTH_RADIUS_KM = 6360.0
TOP_KM = 100.0
# Scale heights of air and of aerosol; Hillaire 2020, section 4.
RAYLEIGH_HEIGHT_KM, AEROSOL_HEIGHT_KM = 8.0, 1.2
# Ozone as a tent; ibid.
OZONE_PEAK_KM, OZONE_HALF_WIDTH_KM = 25.0, 15.0
# Aerosol absorbs a tenth of what it meets and scatters forwards: continental average, Hess et al. 1998 (OPAC).
AEROSOL_ALBEDO = 0.9
AEROSOL_ASYMMETRY = 0.7
# The discs of sun and moon have the same mean radius.
DISC_RADIUS_DEGREES = 0.2666

_RAY_STEPS = 32
_AZIMUTHS = 13  # of the view relative to the sun, 0 to 180 degrees
_COLUMN_SHAPE = (40, 64)  # heights, sun elevations
_BOUNCE_SHAPE = (12, 20)
_BOUNCE_DIRECTIONS, _BOUNCE_STEPS = 32, 20


def densities(height_km: Float64) -> Float64:
    """(..., 3): air, aerosol and ozone at a height, so that each integrates to 1 over height [km^-1]."""
    air = np.exp(-height_km / RAYLEIGH_HEIGHT_KM) / RAYLEIGH_HEIGHT_KM
    aerosol = np.exp(-height_km / AEROSOL_HEIGHT_KM) / AEROSOL_HEIGHT_KM
    ozone = np.maximum(0.0, 1 - np.abs(height_km - OZONE_PEAK_KM) / OZONE_HALF_WIDTH_KM) / OZONE_HALF_WIDTH_KM
    return np.stack([air, aerosol, ozone], axis=-1)


def disc_share(elevation_degrees: Float64) -> Float64:
    """Share 0..1 of a light's disc that has cleared the horizon. Exactly 0 where its centre has not risen.

    The light is a single direction, its centre, and nothing may shine from below the ground: so the fade runs over the disc's
    diameter above the horizon, not around it.
    """
    x = np.clip(elevation_degrees / DISC_RADIUS_DEGREES - 1, -1, 1)
    share = 0.5 + (np.arcsin(x) + x * np.sqrt(1 - x * x)) / np.pi
    return np.where(np.asarray(elevation_degrees) <= 0, 0.0, share)


def _distance_to_top(radius_km: Float64, sine: Float64) -> Float64:
    """Length [km] from a radius, along a direction with that sine of elevation, to the top of the air."""
    top = EARTH_RADIUS_KM + TOP_KM
    inside = np.maximum(top * top - radius_km**2 * (1 - sine * sine), 0.0)
    return np.asarray(np.sqrt(inside) - radius_km * sine, np.float64)


def _horizon_sine(height_km: Float64) -> Float64:
    """Sine of the elevation (negative) of the geometric horizon seen from a height."""
    ratio = EARTH_RADIUS_KM / (EARTH_RADIUS_KM + height_km)
    return np.asarray(-np.sqrt(np.maximum(1 - ratio * ratio, 0.0)), np.float64)


@cache
def _columns() -> Float64:
    """(heights, elevations, 3): columns of air, aerosol, ozone from a height to space. Finer near the ground and the horizon."""
    height = TOP_KM * np.linspace(0, 1, _COLUMN_SHAPE[0])[:, None] ** 3
    horizon = _horizon_sine(height)
    sine = horizon + (1 - horizon) * np.linspace(0, 1, _COLUMN_SHAPE[1])[None, :] ** 3
    length = _distance_to_top(EARTH_RADIUS_KM + height, sine)
    # Points crowd around the lowest point of the ray: its middle for rays that dip, its start for the rest.
    lowest = np.maximum(-(EARTH_RADIUS_KM + height) * sine, 0.0)
    nodes, weights = np.polynomial.legendre.leggauss(48)
    total = np.zeros((*_COLUMN_SHAPE, 3))
    for span in (-lowest, length - lowest):
        for node, weight in zip((nodes + 1) / 2, weights / 2, strict=True):
            along = lowest + span * node**2
            radius = np.sqrt((EARTH_RADIUS_KM + height) ** 2 + along**2 + 2 * (EARTH_RADIUS_KM + height) * along * sine)
            total += densities(np.maximum(radius - EARTH_RADIUS_KM, 0.0)) * (np.abs(span) * 2 * node * weight)[..., None]
    return total


def _bilinear(table: Float64, row: Float64, column: Float64) -> Float64:
    """Samples of table (rows, columns, k) at fractional indices of any equal shape -> (..., k). Clamped."""
    rows, columns = table.shape[:2]
    row, column = np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)
    i, j = np.minimum(row.astype(np.intp), rows - 2), np.minimum(column.astype(np.intp), columns - 2)
    u, v = (row - i)[..., None], (column - j)[..., None]
    flat = table.reshape(rows * columns, -1)
    at = i * columns + j
    upper = flat[at] * (1 - v) + flat[at + 1] * v
    lower = flat[at + columns] * (1 - v) + flat[at + columns + 1] * v
    return np.asarray(upper * (1 - u) + lower * u, np.float64)


def columns_to_space(height_km: Float64, sine: Float64) -> Float64:
    """Columns (..., 3) of air, aerosol and ozone from a height towards a sine of elevation. Below the horizon: as at it."""
    horizon = _horizon_sine(height_km)
    column = (np.clip((sine - horizon) / (1 - horizon), 0, 1)) ** (1 / 3)
    row = np.clip(height_km / TOP_KM, 0, 1) ** (1 / 3)
    return _bilinear(_columns(), row * (_COLUMN_SHAPE[0] - 1), column * (_COLUMN_SHAPE[1] - 1))


@dataclass(frozen=True, eq=False)
class SkyScattering:
    """What the sky's light is made of, before phase functions: each (rows, azimuths, 8) [sr^-1], shares of the sunlight above the air.

    rows : the upper half of the sky map's; azimuths : relative to the sun, evenly from 0 to 180 degrees
    """

    rayleigh: Float64
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
    """The air over one place with one haze. Read-only; safe to share between threads."""

    def __init__(self, haze: float, height_km: float) -> None:
        self.height_km = height_km
        # Rows: air, aerosol, ozone.
        self._depth: Float64 = np.stack([rayleigh_depth(), aerosol_depth(haze), ozone_depth()])
        self._scatter: Float64 = self._depth[:2] * np.array([[1.0], [AEROSOL_ALBEDO]])
        self._bounce_air, self._bounce_ground = self._bounces()
        self._rays()

    def beam(self, elevation_degrees: float) -> Float64:
        """(8,) share of a light's spectrum that reaches a surface facing it; exactly 0 at and below the horizon."""
        columns = columns_to_space(np.asarray(self.height_km), np.asarray(np.sin(np.radians(elevation_degrees))))
        return np.asarray(np.exp(-columns @ self._depth) * disc_share(np.asarray(elevation_degrees)), np.float64)

    def scattering(self, elevation_degrees: float, ground_albedo: float) -> SkyScattering:
        """What the sky scatters from a light at an elevation, above or below the horizon."""
        elevation = np.radians(elevation_degrees)
        relative = np.linspace(0, np.pi, _AZIMUTHS)[None, :, None]
        view, arc = self._view, self._view.arc[:, None, :]
        sine = np.cos(arc) * np.sin(elevation) + np.sin(arc) * np.cos(elevation) * np.cos(relative)  # (rows, azimuths, steps)
        height = np.broadcast_to(view.height[:, None, :], sine.shape)
        sunlight = self._sunlight(height, sine)
        bounced = self._bounced(height, sine, ground_albedo)
        return SkyScattering(
            np.einsum("rsk,rask->rak", view.air, sunlight),
            np.einsum("rsk,rask->rak", view.aerosol, sunlight),
            np.einsum("rsk,rask->rak", view.air + view.aerosol, bounced),
        )

    def _sunlight(self, height: Float64, sine: Float64) -> Float64:
        """(..., 8): sunlight at points in the air, the Earth's shadow included."""
        above_horizon = np.degrees(np.arcsin(np.clip(sine, -1, 1)) - np.arcsin(_horizon_sine(height)))
        return np.asarray(np.exp(-columns_to_space(height, sine) @ self._depth) * disc_share(above_horizon)[..., None], np.float64)

    def _march(self, height: Float64, sine: Float64, length: Float64, steps: int) -> "_March":
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

    def _rays(self) -> None:
        """The view rays of the sky map's upper rows; they don't depend on the sun."""
        polar = np.pi * (np.arange(SKY_SHAPE[0] // 2) + 0.5) / SKY_SHAPE[0]
        sine = np.cos(polar)
        height = np.full(len(sine), self.height_km)
        length = _distance_to_top(EARTH_RADIUS_KM + height, sine)
        self._view = self._march(height, sine, length, _RAY_STEPS)

    def _bounces(self) -> tuple[Float64, Float64]:
        """Hillaire's series: light that has bounced twice or more, per unit of scattering, (heights, elevations, 8) each.

        The second table is the part by way of the ground, for an albedo of 1.
        """
        rows, columns = _BOUNCE_SHAPE
        height = np.repeat(TOP_KM * np.linspace(0, 1, rows) ** 3, columns)
        sun_sine = np.tile(_bounce_sines(columns), rows)
        sun_level = np.sqrt(1 - sun_sine**2)
        count = _BOUNCE_DIRECTIONS
        second, ground, again = (np.zeros((rows * columns, len(WAVELENGTH_NM))) for _ in range(3))
        for k in range(count):  # directions spread over the sphere on a golden spiral
            sine = 1 - 2 * (k + 0.5) / count
            turn = np.cos(k * np.pi * (3 - np.sqrt(5)))
            sines = np.full(len(height), sine)
            down = sines < _horizon_sine(height)
            radius = EARTH_RADIUS_KM + height
            to_ground = -radius * sines - np.sqrt(np.maximum(EARTH_RADIUS_KM**2 - radius**2 * (1 - sine * sine), 0.0))
            length = np.where(down, to_ground, _distance_to_top(radius, sines))
            ray = self._march(height, sines, length, _BOUNCE_STEPS)
            scattered = ray.air + ray.aerosol
            sun_at = np.cos(ray.arc) * sun_sine[:, None] + np.sin(ray.arc) * turn * sun_level[:, None]
            second += np.einsum("nsk,nsk->nk", scattered, self._sunlight(ray.height, sun_at)) / (4 * np.pi * count)
            again += scattered.sum(axis=1) / count
            end = np.arctan2(length * np.sqrt(1 - sine * sine), radius + length * sine)
            sun_below = np.cos(end) * sun_sine + np.sin(end) * turn * sun_level
            lit = self._sunlight(np.zeros(len(height)), sun_below) * np.maximum(sun_below, 0.0)[:, None] / np.pi
            ground += np.where(down[:, None], lit * ray.transmittance, 0.0) / count
        series = 1 / (1 - np.minimum(again, 0.99))
        shape = (rows, columns, len(WAVELENGTH_NM))
        return (second * series).reshape(shape), (ground * series).reshape(shape)

    def _bounced(self, height: Float64, sine: Float64, ground_albedo: float) -> Float64:
        rows, columns = _BOUNCE_SHAPE
        table = self._bounce_air + ground_albedo * self._bounce_ground
        row = np.clip(height / TOP_KM, 0, 1) ** (1 / 3) * (rows - 1)
        return _bilinear(table, row, _bounce_column(sine, columns))


def _bounce_sines(columns: int) -> Float64:
    """Sines of the sun's elevation that bounces are tabulated for: finest where twilight is, around the horizon."""
    x = np.linspace(-1, 1, columns)
    return np.asarray(np.sign(x) * x * x, np.float64)


def _bounce_column(sine: Float64, columns: int) -> Float64:
    return np.asarray((np.sign(sine) * np.sqrt(np.abs(sine)) + 1) / 2 * (columns - 1), np.float64)


@lru_cache(maxsize=32)
def atmosphere(haze: float, height_km: float) -> Atmosphere:
    """The air for a haze (aerosol optical depth at 550 nm) over a place at a height above the sea [km]."""
    return Atmosphere(haze, min(max(height_km, 0.0), 8.0))
