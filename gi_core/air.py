"""The air as a spherical shell: what it holds at each height, and how much of it lies on the way to space.

Heights are in kilometres above the sea. Columns are amounts of air, aerosol and ozone along a path, in units of the vertical column
from the sea, so that a vertical path from the sea has 1 of each; times the vertical optical depths they are optical depths.
"""

from functools import cache

import numpy as np

from gi_core.arrays import Float32, Float64

EARTH_RADIUS_KM = 6360.0
TOP_KM = 100.0
# Scale heights of air and of aerosol; Hillaire 2020, section 4.
AIR_HEIGHT_KM, AEROSOL_HEIGHT_KM = 8.0, 1.2
# Ozone as a tent; ibid.
OZONE_PEAK_KM, OZONE_HALF_WIDTH_KM = 25.0, 15.0
# The discs of sun and moon have the same mean radius.
DISC_RADIUS_DEGREES = 0.2666

_HEIGHTS, _ELEVATIONS = 40, 64  # of the table of columns
_GAUSS_POINTS = 48


def densities(height_km: Float64) -> Float64:
    """(..., 3): air, aerosol and ozone at a height, so that each integrates to 1 over height [km^-1]."""
    air = np.exp(-height_km / AIR_HEIGHT_KM) / AIR_HEIGHT_KM
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
    # Exactly 0, whatever the last bit of the arc sine is.
    return np.where(np.asarray(elevation_degrees) <= 0, 0.0, share)


def distance_to_top(height_km: Float64, sine: Float64) -> Float64:
    """Length [km] from a height, along a direction with that sine of elevation, to the top of the air."""
    radius, top = EARTH_RADIUS_KM + height_km, EARTH_RADIUS_KM + TOP_KM
    inside = np.maximum(top * top - radius**2 * (1 - sine * sine), 0.0)
    return np.asarray(np.sqrt(inside) - radius * sine, np.float64)


def horizon_sine(height_km: Float64) -> Float64:
    """Sine of the elevation (0 or less) of the sea's horizon seen from a height."""
    ratio = EARTH_RADIUS_KM / (EARTH_RADIUS_KM + height_km)
    return np.asarray(-np.sqrt(np.maximum(1 - ratio * ratio, 0.0)), np.float64)


@cache
def _table() -> Float64:
    """(heights, elevations, 3): columns from a height to space. Both axes are cubic, finest at the ground and at the horizon."""
    height = TOP_KM * np.linspace(0, 1, _HEIGHTS)[:, None] ** 3
    horizon = horizon_sine(height)
    sine = horizon + (1 - horizon) * np.linspace(0, 1, _ELEVATIONS)[None, :] ** 3
    length, radius = distance_to_top(height, sine), EARTH_RADIUS_KM + height
    # Points crowd around the lowest point of the ray: somewhere on it for rays that dip, its start for the rest.
    lowest = np.maximum(-radius * sine, 0.0)
    nodes, weights = np.polynomial.legendre.leggauss(_GAUSS_POINTS)
    total = np.zeros((_HEIGHTS, _ELEVATIONS, 3))
    for span in (-lowest, length - lowest):
        for node, weight in zip((nodes + 1) / 2, weights / 2, strict=True):
            along = lowest + span * node**2
            at = np.sqrt(radius**2 + along**2 + 2 * radius * along * sine) - EARTH_RADIUS_KM
            total += densities(np.maximum(at, 0.0)) * (np.abs(span) * 2 * node * weight)[..., None]
    return total


class ColumnsAt:
    """Columns to space from some fixed heights [km] (any shape), for any elevation of the light."""

    def __init__(self, height_km: Float64) -> None:
        self._horizon = horizon_sine(height_km)
        row = np.cbrt(np.clip(height_km / TOP_KM, 0, 1)) * (_HEIGHTS - 1)
        first = np.minimum(row.astype(np.intp), _HEIGHTS - 2)
        share = (row - first)[..., None, None]
        self._rows = _table()[first] * (1 - share) + _table()[first + 1] * share

    def towards(self, sine: Float64) -> Float64:
        """(..., a, 3) for sines of elevation (..., a) at the heights (...). Below the horizon: as at it."""
        horizon = self._horizon[..., None]
        column = np.cbrt(np.clip((sine - horizon) / (1 - horizon), 0, 1)) * (_ELEVATIONS - 1)
        return rows_at(self._rows, column)

    def degrees_above_horizon(self, sine: Float64) -> Float64:
        """(..., a): how far lights at sines of elevation (..., a) stand above the sea's horizon."""
        return np.asarray(np.degrees(np.arcsin(np.clip(sine, -1, 1)) - np.arcsin(self._horizon)[..., None]), np.float64)


def rows_at(rows: Float32 | Float64, column: Float64) -> Float64:
    """Linear samples of rows (..., columns, k) at fractional columns (..., a), clamped -> (..., a, k)."""
    columns, k = rows.shape[-2:]
    column = np.clip(column, 0, columns - 1)
    first = np.minimum(column.astype(np.intp), columns - 2)
    share = (column - first)[..., None]
    row_starts = np.arange(rows.size // (columns * k)).reshape(*rows.shape[:-2], 1) * columns
    flat, at = rows.reshape(-1, k), row_starts + first
    low = flat.take(at, axis=0)
    return np.asarray(low + share * (flat.take(at + 1, axis=0) - low), np.float64)
