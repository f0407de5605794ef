"""The sky's light beside a backward Monte Carlo of the same air: every bounce exact, in air and on the ground."""

import math
from functools import cache

import numpy as np
import pytest

from gi_core.air import EARTH_RADIUS_KM, ColumnsAt, distance_to_top, horizon_sine
from gi_core.air_optics import AirOptics
from gi_core.air_profile import densities
from gi_core.atmosphere import AEROSOL_ALBEDO, Atmosphere
from gi_core.phase import AEROSOL_ASYMMETRY, aerosol_phase, air_phase
from gi_core.sky import clear_sky, horizontal_illuminance
from gi_core.spectrum import LUMINANCE_FROM_RGB, RGB_FROM_SPECTRUM

HAZE, ALBEDO = 0.15, 0.15
ELEVATIONS = (60.0, 20.0, 5.0, 0.0, -0.57, -2.0)
LUX = LUMINANCE_FROM_RGB @ RGB_FROM_SPECTRUM
PATHS, ORDERS, NODES, BATCHES = 10_000, 12, 96, 5
GREEN = 4  # of spectrum.WAVELENGTH_NM: paths are drawn by its optics and weighed for the others


def towards(degrees: float) -> np.ndarray:
    return np.array([math.cos(math.radians(degrees)), math.sin(math.radians(degrees)), 0.0])


def around(axis: np.ndarray, cosine: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(n, 3) directions at those cosines to axes (n, 3), at random azimuths."""
    other = np.where(np.abs(axis[:, 1:2]) < 0.9, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
    across = np.cross(other, axis)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    azimuth = 2 * np.pi * rng.random(len(axis))
    sine = np.sqrt(np.maximum(1 - cosine**2, 0))[:, None]
    level = np.cos(azimuth)[:, None] * across + np.sin(azimuth)[:, None] * np.cross(axis, across)
    return axis * cosine[:, None] + sine * level


def phase_cosines(of_air: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Turns drawn from the phase functions: Rayleigh's by Cardano's formula, Henyey's and Greenstein's by theirs."""
    u, g = rng.random(len(of_air)), AEROSOL_ASYMMETRY
    d = np.cbrt(4 * u - 2 + np.sqrt((4 * u - 2) ** 2 + 1))
    s = (1 - g * g) / (1 - g + 2 * g * u)
    return np.where(of_air, d - 1 / d, (1 + g * g - s * s) / (2 * g))


def edges_of(start: np.ndarray, lowest: np.ndarray, length: np.ndarray) -> np.ndarray:
    """(n, NODES + 1) lengths [km] along rays, crowded around the lowest point."""
    e = np.linspace(0, 1, NODES + 1)
    crowded = np.where(e < 0.5, lowest * (1 - (1 - 2 * e) ** 2), lowest + (length - lowest) * (2 * e - 1) ** 2)
    return np.where(lowest > 1e-6, crowded, length * e**2)


def bounces_of_paths(seed: int) -> np.ndarray:
    """(ORDERS, elevations) [lx]: what light of each number of bounces gives to level ground."""
    rng, optics = np.random.default_rng(seed), AirOptics(HAZE, AEROSOL_ALBEDO)
    suns = np.array([towards(e) for e in ELEVATIONS])
    position = np.tile([0.0, EARTH_RADIUS_KM + 1e-6, 0.0], (PATHS, 1))
    direction = around(position / EARTH_RADIUS_KM, np.sqrt(rng.random(PATHS)), rng)
    weight = np.full((PATHS, 8), np.pi)
    each, total = np.arange(PATHS), np.zeros((ORDERS, len(ELEVATIONS)))
    for order in range(ORDERS):
        radius = np.linalg.norm(position, axis=1)
        sine = (position * direction).sum(axis=1) / radius
        height = np.maximum(radius - EARTH_RADIUS_KM, 0)
        hits = sine < horizon_sine(height) - 1e-12
        ground = -radius * sine - np.sqrt(np.maximum(EARTH_RADIUS_KM**2 - radius**2 * (1 - sine**2), 0))
        length = np.where(hits, np.maximum(ground, 0), distance_to_top(height, sine))[:, None]
        edges = edges_of(height, np.clip(-radius * sine, 0, length[:, 0])[:, None], length)
        middle, step = (edges[:, 1:] + edges[:, :-1]) / 2, np.diff(edges, axis=1)
        at = np.sqrt(radius[:, None] ** 2 + middle**2 + 2 * radius[:, None] * middle * sine[:, None]) - EARTH_RADIUS_KM
        density = densities(np.maximum(at, 0))
        columns = np.concatenate([np.zeros((PATHS, 1, 3)), np.cumsum(density * step[..., None], axis=1)], axis=1)
        depth = columns @ optics.depth[:, GREEN]
        # Every ray scatters somewhere, or goes on to the ground that it meets.
        scatters = -np.expm1(-depth[:, -1])
        to_ground = np.where(hits, np.maximum(np.exp(-depth[:, -1]), 0.05) / 2, 0.0)
        grounded = rng.random(PATHS) < to_ground
        drawn = -np.log1p(-rng.random(PATHS) * scatters)
        j = np.clip((depth[:, 1:] < drawn[:, None]).sum(axis=1), 0, NODES - 1)
        share = np.clip((drawn - depth[each, j]) / np.maximum(depth[each, j + 1] - depth[each, j], 1e-300), 0, 1)
        along = edges[each, j] + share * step[each, j]
        here, column = density[each, j], columns[each, j] + density[each, j] * (share * step[each, j])[:, None]
        odds = here @ optics.depth[:, GREEN] * np.exp(-drawn) / np.maximum(scatters, 1e-300) * (1 - to_ground)
        in_air = weight * np.exp(-column @ optics.depth) / np.maximum(odds, 1e-300)[:, None]
        on_ground = weight * np.exp(-columns[:, -1] @ optics.depth) * ALBEDO / np.maximum(to_ground, 1e-9)[:, None]
        point, foot = position + direction * along[:, None], position + direction * length
        up, foot_up = (p / np.linalg.norm(p, axis=1, keepdims=True) for p in (point, foot))
        by_air, by_haze = here[:, :1] * optics.scatter[0], here[:, 1:2] * optics.scatter[1]
        # What the sun adds at this bounce.
        sunlight = optics.sunlight(ColumnsAt(np.maximum(np.linalg.norm(point, axis=1) - EARTH_RADIUS_KM, 0)), up @ suns.T)
        turn = (direction @ suns.T)[..., None]
        lit = (by_air[:, None] * air_phase(turn) + by_haze[:, None] * aerosol_phase(turn)) * sunlight
        incidence = foot_up @ suns.T
        foot_lit = optics.sunlight(ColumnsAt(np.zeros(PATHS)), incidence) * np.maximum(incidence, 0)[..., None] / np.pi
        added = np.where(grounded[:, None, None], on_ground[:, None] * foot_lit, in_air[:, None] * lit) @ LUX
        alive = length > 0
        total[order] = np.where(alive, added, 0).mean(axis=0)
        # Where the path goes on, backwards.
        air_share = by_air[:, GREEN] / np.maximum(by_air[:, GREEN] + by_haze[:, GREEN], 1e-300)
        cosine = phase_cosines(rng.random(PATHS) < air_share, rng)
        whole = by_air * air_phase(cosine)[:, None] + by_haze * aerosol_phase(cosine)[:, None]
        mixed = air_share * air_phase(cosine) + (1 - air_share) * aerosol_phase(cosine)
        onward, risen = around(direction, cosine, rng), around(foot_up, np.sqrt(rng.random(PATHS)), rng)
        ground_again = grounded[:, None]
        position = np.where(ground_again, foot_up * (EARTH_RADIUS_KM + 1e-6), point)
        direction = np.where(ground_again, risen, onward)
        weight = np.where(alive, np.where(ground_again, on_ground, in_air * whole / mixed[:, None]), 0)
    return total


@cache
def monte_carlo() -> np.ndarray:
    """(batches, ORDERS, elevations) [lx]."""
    return np.stack([bounces_of_paths(seed) for seed in range(BATCHES)])


def of_model(monkeypatch: pytest.MonkeyPatch, single: bool) -> np.ndarray:
    air = Atmosphere(HAZE, 0.0)
    if single:
        monkeypatch.setattr(air._bounces, "towards", lambda sine, albedo: np.zeros((*sine.shape, 8)))
    skies = [clear_sky(air, towards(e), np.ones(8), ALBEDO) for e in ELEVATIONS]
    return np.array([LUMINANCE_FROM_RGB @ horizontal_illuminance(sky) for sky in skies])


@pytest.mark.slow
def test_light_scattered_once_is_exact(monkeypatch: pytest.MonkeyPatch) -> None:
    # Noise of 50 000 paths: 0.7 %; the model's own steps and azimuths: 0.6 %.
    np.testing.assert_allclose(of_model(monkeypatch, single=True), monte_carlo()[:, 0].mean(axis=0), rtol=0.02)


@pytest.mark.slow
def test_all_skylight_is_within_a_twelfth(monkeypatch: pytest.MonkeyPatch) -> None:
    expected = monte_carlo().sum(axis=1).mean(axis=0)
    found = of_model(monkeypatch, single=False)
    print("skylight beside the Monte Carlo's", dict(zip(ELEVATIONS, (found / expected).round(3).tolist(), strict=True)))
    later = (found - of_model(monkeypatch, single=True)) / monte_carlo()[:, 1:].sum(axis=1).mean(axis=0)
    print("of two bounces and more", dict(zip(ELEVATIONS, later.round(3).tolist(), strict=True)))
    assert (found / expected > 0.92).all()  # worst seen 0.933, at -2 degrees: the second bounce's shape is left out
    assert (found / expected < 1.03).all()
