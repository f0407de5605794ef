"""The air as a spherical shell that bends light: how much of it lies on the way to space, and where to look for a light beyond it.

Heights are in kilometres above the sea. Columns are amounts of air, haze and ozone along a path, in units of the vertical column
from the sea, so that a vertical path from the sea has 1 of each; times the vertical optical depths they are optical depths. A fourth
number is the logarithm of how much refraction spreads the light: near the horizon it thins a beam by a fifth.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np

from gi_core.air_profile import TOP_KM, densities
from gi_core.arrays import Float32, Float64

EARTH_RADIUS_KM = 6360.0
# Of air at the sea less 1, in green light at 15 C. Ciddor, "Refractive index of air", Applied Optics 35, 1996.
REFRACTIVITY = 2.78e-4
# The discs of sun and moon have the same mean radius.
DISC_RADIUS_DEGREES = 0.2666

_HEIGHTS, _ELEVATIONS = 40, 64  # of the table of columns
_GAUSS_POINTS = 48
_FINENESS = 4  # steps between two elevations of the table, for the one by true elevation


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


@dataclass(frozen=True, eq=False)
class _Table:
    """Columns from heights (_HEIGHTS, cubic, finest at the ground) to space, at elevations (cubic, finest at the horizon).

    seen, true : (heights, elevations, 4), by elevations as they are seen there, and as they would be without air
    seen_horizon, true_horizon : (heights,), sines of the lowest
    """

    seen: Float64
    true: Float64
    seen_horizon: Float64
    true_horizon: Float64


@cache
def _table() -> _Table:
    height = TOP_KM * np.linspace(0, 1, _HEIGHTS)[:, None] ** 3
    horizon = horizon_sine(height)
    even = np.linspace(0, 1, _ELEVATIONS)
    fine = np.linspace(0, 1, _FINENESS * (_ELEVATIONS - 1) + 1)
    sine = horizon + (1 - horizon) * fine**3
    columns = _columns(height, sine)
    # A ray through level shells turns by what it crosses times the cosine of its elevation there, most of it where it is lowest:
    # refractivity is in proportion to density.
    seen = np.arcsin(sine)
    true = seen - REFRACTIVITY * columns[..., 0] * np.cos(np.maximum(seen, 0.0))
    # Refraction also spreads the light: what crosses an angle d(seen) at the top crosses d(true) here.
    spread = np.stack([np.gradient(t, s) for t, s in zip(true, seen, strict=True)])
    columns = np.concatenate([columns, np.log(spread)[..., None]], axis=-1)
    true_horizon = np.sin(true[:, :1])
    wanted = np.arcsin(true_horizon + (1 - true_horizon) * even**3)
    by_true = [[np.interp(w, t, column) for column in c.T] for w, t, c in zip(wanted, true, columns, strict=True)]
    return _Table(columns[:, ::_FINENESS], np.moveaxis(np.array(by_true), 1, 2), horizon[:, 0], true_horizon[:, 0])


def _columns(height: Float64, sine: Float64) -> Float64:
    """(heights, elevations, 3): along straight rays from heights (heights, 1)."""
    length, radius = distance_to_top(height, sine), EARTH_RADIUS_KM + height
    # Points crowd around the lowest point of the ray: somewhere on it for rays that dip, its start for the rest.
    lowest = np.maximum(-radius * sine, 0.0)
    nodes, weights = np.polynomial.legendre.leggauss(_GAUSS_POINTS)
    total = np.zeros((*sine.shape, 3))
    for span in (-lowest, length - lowest):
        for node, weight in zip((nodes + 1) / 2, weights / 2, strict=True):
            along = lowest + span * node**2
            at = np.sqrt(radius**2 + along**2 + 2 * radius * along * sine) - EARTH_RADIUS_KM
            total += densities(np.maximum(at, 0.0)) * (np.abs(span) * 2 * node * weight)[..., None]
    return total


class ColumnsAt:
    """Columns to space from some fixed heights [km] (any shape), for any elevation of the light."""

    def __init__(self, height_km: Float64, seen: bool = False) -> None:
        """seen : elevations are those that an observer at the height sees, not those without air."""
        table = _table()
        rows, horizon = (table.seen, table.seen_horizon) if seen else (table.true, table.true_horizon)
        row = np.cbrt(np.clip(height_km / TOP_KM, 0, 1)) * (_HEIGHTS - 1)
        first = np.minimum(row.astype(np.intp), _HEIGHTS - 2)
        share = row - first
        self._horizon = horizon[first] + share * (horizon[first + 1] - horizon[first])
        share = share[..., None, None]
        self._rows = rows[first] * (1 - share) + rows[first + 1] * share

    def towards(self, sine: Float64) -> Float64:
        """(..., a, 4) for sines of elevation (..., a) at the heights (...). Below the horizon: as at it."""
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
