"""Light that has bounced in the air twice or more: tables of an infinite series of isotropic bounces, at nodes of haze, blended between.

Hillaire, "A Scalable and Production Ready Sky and Atmosphere Rendering Technique", EGSR 2020. A table takes 50 ms, a blend 1 ms: so a
haze that changes all the time meets no more than the 15 nodes.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from gi_core.air import EARTH_RADIUS_KM, ColumnsAt, distance_to_top, horizon_sine, rows_at
from gi_core.air_optics import AirOptics, March
from gi_core.air_profile import TOP_KM
from gi_core.arrays import Bool, Float32, Float64
from gi_core.phase import aerosol_phase, air_phase

# Nodes at 0.15 * 2^(k / 2): the hazes of the presets, 0.15 and 0.6, are among them. Between nodes the sky's light is within 0.3 % of
# that by a table of its own up to a haze of 1, within 0.8 % up to 2, at all elevations of the sun.
_NODE_HAZE, _NODES_PER_OCTAVE = 0.15, 2
_FIRST_NODE, _LAST_NODE = -6, 8  # 0.019 .. 2.4

# Against 30 x 80, 256 directions and 40 steps: 0.7 % of the sky's light by day, 5 % with the sun 6 degrees down.
_HEIGHTS, _SUNS = 12, 40
_DIRECTIONS, _STEPS = 48, 16
_REFINEMENT = 2
# Signed square root of the sine of the sun's elevation at the low end of the table (-22.6 degrees); no light there.
_LOWEST_SUN_ROOT = -0.62
_NO_LIGHT = 1e-30


class BouncesAt:
    """Bounced light at points at some heights, for one haze.

    air, ground : (..., refined suns, 8) float32, per unit of scattering; ground is the part by way of the ground, for an albedo of 1
    """

    def __init__(self, haze: float, aerosol_albedo: float, height_km: Float64) -> None:
        """height_km : (...), 2.6 MB of tables for the view's 1024 heights."""
        at = min(max(_NODES_PER_OCTAVE * math.log2(haze / _NODE_HAZE), _FIRST_NODE), _LAST_NODE)
        node = min(math.floor(at), _LAST_NODE - 1)
        tables = _log_tables(node, aerosol_albedo)
        if at > node:
            tables = tables + (at - node) * (_log_tables(node + 1, aerosol_albedo) - tables)
        self.air, self.ground = (_at_heights(table, height_km) for table in np.exp(tables).astype(np.float32))

    def towards(self, sine: Float64, ground_albedo: float) -> Float64:
        """(..., a, 8) for sines (..., a) of the sun's elevation at the points."""
        return rows_at(self.air + np.float32(ground_albedo) * self.ground, _REFINEMENT * _column(sine))


def _at_heights(table: Float32, height_km: Float64) -> Float32:
    """(..., suns, 8): rows of a table (heights, suns, 8) at heights (...)."""
    row = np.cbrt(np.clip(height_km / TOP_KM, 0, 1)) * (_HEIGHTS - 1)
    first = np.minimum(row.astype(np.intp), _HEIGHTS - 2)
    share = (row - first)[..., None, None].astype(np.float32)
    low = table[first]
    return np.asarray(low + share * (table[first + 1] - low), np.float32)


@lru_cache(maxsize=2 * (_LAST_NODE - _FIRST_NODE + 1))  # 120 kB each
def _log_tables(node: int, aerosol_albedo: float) -> Float64:
    """(2, heights, refined suns, 8): logarithms, because twilight falls by a factor of ten every three degrees."""
    haze = _NODE_HAZE * 2 ** (node / _NODES_PER_OCTAVE)
    logarithm = _logarithm(np.stack(_bounces(AirOptics(haze, aerosol_albedo))))
    column = np.linspace(0, _SUNS - 1, _REFINEMENT * (_SUNS - 1) + 1)
    return rows_at(logarithm, np.broadcast_to(column, (2, _HEIGHTS, len(column))))


@dataclass(frozen=True, eq=False)
class _Ray:
    """One direction from all heights of a table, for all its suns.

    up : its sine; share : of the sphere that it stands for; length [km] and hits_ground : (heights,)
    turned_level : (suns,), the sun's share along the direction's level part
    sun_sine : (heights, steps, suns), of the sun's elevation at each step; once : (heights, suns, 8), light that arrives scattered once
    """

    up: float
    share: float
    length: Float64
    hits_ground: Bool
    turned_level: Float64
    march: March
    sun_sine: Float64
    once: Float64

    @property
    def scattered(self) -> Float64:
        """(heights, steps, 8): how much of the light at each step arrives, by scattering."""
        return self.march.air + self.march.aerosol


def _bounces(optics: AirOptics) -> tuple[Float64, Float64]:
    """Hillaire's series: light that has bounced twice or more, per unit of scattering, each (heights, suns, 8).

    The second table is the part by way of the ground, for an albedo of 1. The first bounce goes where the phase functions send it, later
    ones evenly: were it even too, a low sun's later light would be a tenth less.
    """
    # A golden spiral over the sphere, denser at the horizon: that is where the light of deep twilight comes from.
    spiral = 1 - 2 * (np.arange(_DIRECTIONS) + 0.5) / _DIRECTIONS
    shares = np.abs(spiral) / np.abs(spiral).sum()
    rays = [_ray(optics, float(spiral[k] * abs(spiral[k])), k * np.pi * (3 - np.sqrt(5)), float(shares[k])) for k in range(_DIRECTIONS)]
    again = np.sum([ray.share * ray.scattered.sum(axis=1) for ray in rays], axis=0)[:, None]
    air = np.sum([ray.share * ray.once for ray in rays], axis=0) / (1 - again)

    sky_on_ground = _logarithm(_sky_on_ground(rays, air))
    sea, sun_up = ColumnsAt(np.zeros(_HEIGHTS)), _sines_of_suns()
    ground = np.zeros_like(air)
    for ray in rays:
        arc = np.arctan2(ray.length * math.sqrt(1 - ray.up**2), EARTH_RADIUS_KM + _table_heights() + ray.length * ray.up)[:, None]
        incidence = np.cos(arc) * sun_up + np.sin(arc) * ray.turned_level
        exitance = optics.sunlight(sea, incidence) * np.maximum(incidence, 0.0)[..., None]
        exitance += np.exp(rows_at(sky_on_ground, _column(incidence).ravel())).reshape(exitance.shape)
        seen = exitance * ray.march.transmittance[:, None]
        ground += np.where(ray.hits_ground[:, None, None], seen, 0.0) * (ray.share / np.pi)
    return air, ground / (1 - again)


def _ray(optics: AirOptics, up: float, azimuth: float, share: float) -> _Ray:
    height, sun_up = _table_heights(), _sines_of_suns()
    sine = np.full(_HEIGHTS, up)
    turned_level = np.cos(azimuth) * np.sqrt(1 - sun_up**2)
    hits_ground = sine < horizon_sine(height)
    length = np.where(hits_ground, _distance_to_ground(height, sine), distance_to_top(height, sine))
    march = optics.march(height, sine, length, _STEPS)
    arc = march.arc[..., None]
    sun_sine = np.cos(arc) * sun_up + np.sin(arc) * turned_level
    sunlight = optics.sunlight(ColumnsAt(march.height), sun_sine)
    turn = (up * sun_up + math.sqrt(1 - up * up) * turned_level)[:, None]
    once = np.einsum("hsk,hsak->hak", march.air, sunlight) * air_phase(turn)
    once += np.einsum("hsk,hsak->hak", march.aerosol, sunlight) * aerosol_phase(turn)
    return _Ray(up, share, length, hits_ground, turned_level, march, sun_sine, once)


def _sky_on_ground(rays: list[_Ray], air: Float64) -> Float64:
    """(suns, 8): what the sky gives to a black ground."""
    logarithm = _logarithm(air).astype(np.float32)
    total = np.zeros(air.shape[1:])
    for ray in rays:
        if ray.up > 0:
            later = np.exp(rows_at(_at_heights(logarithm, ray.march.height[0]), _column(ray.sun_sine[0])))
            arriving = ray.once[0] + np.einsum("sk,sak->ak", ray.scattered[0], later)
            total += arriving * (4 * np.pi * ray.share * ray.up)
    return total


def _logarithm(light: Float64) -> Float64:
    return np.asarray(np.log(np.maximum(light, _NO_LIGHT)), np.float64)


def _table_heights() -> Float64:
    return np.asarray(TOP_KM * np.linspace(0, 1, _HEIGHTS) ** 3, np.float64)


def _sines_of_suns() -> Float64:
    root = np.linspace(_LOWEST_SUN_ROOT, 1, _SUNS)
    return np.asarray(root * np.abs(root), np.float64)


def _column(sine: Float64) -> Float64:
    """Where a sine of the sun's elevation lies among the suns of a table."""
    root = np.sign(sine) * np.sqrt(np.abs(sine))
    return np.asarray((root - _LOWEST_SUN_ROOT) / (1 - _LOWEST_SUN_ROOT) * (_SUNS - 1), np.float64)


def _distance_to_ground(height: Float64, sine: Float64) -> Float64:
    radius = EARTH_RADIUS_KM + height
    return np.asarray(-radius * sine - np.sqrt(np.maximum(EARTH_RADIUS_KM**2 - radius**2 * (1 - sine * sine), 0.0)), np.float64)
