"""Light that has bounced in the air twice or more: tables of an infinite series of isotropic bounces, at nodes of haze, blended between.

Hillaire, "A Scalable and Production Ready Sky and Atmosphere Rendering Technique", EGSR 2020. A table takes 40 ms, a blend 1 ms: so a
haze that changes all the time meets no more than the 15 nodes, and ``prepare_bounces`` can build them before it starts to change.
"""

import math
from functools import lru_cache

import numpy as np

from gi_core.air import EARTH_RADIUS_KM, TOP_KM, ColumnsAt, distance_to_top, horizon_sine, rows_at
from gi_core.air_optics import AirOptics
from gi_core.arrays import Float32, Float64
from gi_core.spectrum import WAVELENGTH_NM

# Nodes at 0.15 * 2^(k / 2): the hazes of the presets, 0.15 and 0.6, are among them. Between nodes the sky's light is within 0.3 % of
# that by a table of its own up to a haze of 1, within 0.8 % up to 2, at all elevations of the sun.
_NODE_HAZE, _NODES_PER_OCTAVE = 0.15, 2
_FIRST_NODE, _LAST_NODE = -6, 8  # 0.019 .. 2.4

# Against 30 x 80, 256 directions and 40 steps: 0.3 % of the sky's light by day, 2 % with the sun 6 degrees down.
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
        row = np.cbrt(np.clip(height_km / TOP_KM, 0, 1)) * (_HEIGHTS - 1)
        first = np.minimum(row.astype(np.intp), _HEIGHTS - 2)
        share = (row - first)[..., None, None].astype(np.float32)
        self.air, self.ground = (_rows(table, first, share) for table in np.exp(tables).astype(np.float32))

    def towards(self, sine: Float64, ground_albedo: float) -> Float64:
        """(..., a, 8) for sines (..., a) of the sun's elevation at the points."""
        root = np.sign(sine) * np.sqrt(np.abs(sine))
        column = (root - _LOWEST_SUN_ROOT) / (1 - _LOWEST_SUN_ROOT) * (_REFINEMENT * (_SUNS - 1))
        return rows_at(self.air + np.float32(ground_albedo) * self.ground, column)


def prepare_bounces(aerosol_albedo: float) -> None:
    """Build all nodes now (half a second), so that no later haze has to wait for one."""
    for node in range(_FIRST_NODE, _LAST_NODE + 1):
        _log_tables(node, aerosol_albedo)


def _rows(table: Float32, first: np.ndarray[tuple[int, ...], np.dtype[np.intp]], share: Float32) -> Float32:
    low = table[first]
    return np.asarray(low + share * (table[first + 1] - low), np.float32)


@lru_cache(maxsize=2 * (_LAST_NODE - _FIRST_NODE + 1))  # 120 kB each
def _log_tables(node: int, aerosol_albedo: float) -> Float64:
    """(2, heights, refined suns, 8): logarithms, because twilight falls by a factor of ten every three degrees."""
    haze = _NODE_HAZE * 2 ** (node / _NODES_PER_OCTAVE)
    logarithm = np.log(np.maximum(np.stack(_bounces(AirOptics(haze, aerosol_albedo))), _NO_LIGHT))
    column = np.linspace(0, _SUNS - 1, _REFINEMENT * (_SUNS - 1) + 1)
    return rows_at(logarithm, np.broadcast_to(column, (2, _HEIGHTS, len(column))))


def _bounces(optics: AirOptics) -> tuple[Float64, Float64]:
    """Hillaire's series: light that has bounced twice or more, per unit of scattering, each (heights, suns, 8).

    The second table is the part by way of the ground, for an albedo of 1.
    """
    height = TOP_KM * np.linspace(0, 1, _HEIGHTS) ** 3
    root = np.linspace(_LOWEST_SUN_ROOT, 1, _SUNS)
    sun_up = root * np.abs(root)
    sun_level = np.sqrt(1 - sun_up**2)
    second, ground = (np.zeros((_HEIGHTS, _SUNS, len(WAVELENGTH_NM))) for _ in range(2))
    again = np.zeros((_HEIGHTS, 1, len(WAVELENGTH_NM)))
    sea = ColumnsAt(np.zeros(_HEIGHTS))
    # A golden spiral over the sphere, denser at the horizon: that is where the light of deep twilight comes from.
    spiral = 1 - 2 * (np.arange(_DIRECTIONS) + 0.5) / _DIRECTIONS
    shares = np.abs(spiral) / np.abs(spiral).sum()
    for k, share in enumerate(shares.tolist()):
        sine = np.full(_HEIGHTS, spiral[k] * abs(spiral[k]))
        turned_level = np.cos(k * np.pi * (3 - np.sqrt(5))) * sun_level
        hits_ground = sine < horizon_sine(height)
        length = np.where(hits_ground, _distance_to_ground(height, sine), distance_to_top(height, sine))
        ray = optics.march(height, sine, length, _STEPS)
        scattered = (ray.air + ray.aerosol) * share
        arc = ray.arc[..., None]
        sunlight = optics.sunlight(ColumnsAt(ray.height), np.cos(arc) * sun_up + np.sin(arc) * turned_level)
        second += np.einsum("hsk,hsak->hak", scattered, sunlight) / (4 * np.pi)
        again += scattered.sum(axis=1)[:, None]
        arc = np.arctan2(length * np.sqrt(1 - sine**2), EARTH_RADIUS_KM + height + length * sine)[:, None]
        incidence = np.cos(arc) * sun_up + np.sin(arc) * turned_level
        exitance = optics.sunlight(sea, incidence) * np.maximum(incidence, 0.0)[..., None]
        ground += np.where(hits_ground[:, None, None], exitance * ray.transmittance[:, None], 0.0) * (share / np.pi)
    series = 1 / (1 - again)
    return second * series, ground * series


def _distance_to_ground(height: Float64, sine: Float64) -> Float64:
    radius = EARTH_RADIUS_KM + height
    return np.asarray(-radius * sine - np.sqrt(np.maximum(EARTH_RADIUS_KM**2 - radius**2 * (1 - sine * sine), 0.0)), np.float64)
