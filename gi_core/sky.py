"""The sky as a map of radiance: clear by the atmosphere's scattering, clouded, veiled by fog, and the night's own glow.

A map is (32, 128, 3) float64 [cd m^-2 per channel]: the upper half of the contract's equirectangular sky. ``cube_of_sky`` and all
energies use the exact solid angle of each texel, so that a cloud or fog redistributes light without making any.
"""

from functools import cache

import numpy as np

from gi_core.air import EARTH_RADIUS_KM
from gi_core.ambient_cube import FACE_DIRECTIONS
from gi_core.arrays import Float64
from gi_core.atmosphere import Atmosphere, SkyScattering
from gi_core.constants import SKY_SHAPE
from gi_core.phase import aerosol_phase, air_phase
from gi_core.spectrum import RGB_FROM_SPECTRUM

ROWS, COLUMNS = SKY_SHAPE[0] // 2, SKY_SHAPE[1]

# Darkest natural zenith, 21.9 mag per square arc second: airglow, zodiacal light, stars. Leinert et al. 1998.
NIGHT_ZENITH_CD_M2 = 1.9e-4
# Airglow shines in a layer this high; stars and dust fade towards the horizon.
AIRGLOW_HEIGHT_KM = 90.0
# Slightly warmer than the day: green and red oxygen lines on starlight. Linear sRGB of luminance 1.
NIGHT_COLOUR = np.array([1.08, 0.995, 0.81])

# Light that leaves a cloud base has crossed more air, up and down between ground and cloud, than the light above: overcast daylight
# measures 6000-6500 K where sun and clear sky together measure 5500 K (Judd, MacAdam and Wyszecki 1964). Luminance 1.
CLOUD_COLOUR = np.array([0.92, 1.0134, 1.1])

# A ground fog is about this deep; the vertical path through it.
FOG_LAYER_M = 100.0
# Water droplets scatter forwards; two-stream transmittance is 1 / (1 + 3/4 (1 - g) depth). Liou, "Radiation and Cloud Processes".
DROPLET_ASYMMETRY = 0.85


@cache
def map_directions() -> Float64:
    """(32, 128, 3): where each texel looks, world frame."""
    polar = np.pi * (np.arange(ROWS) + 0.5) / SKY_SHAPE[0]
    azimuth = 2 * np.pi * (np.arange(COLUMNS) + 0.5) / COLUMNS
    shape = (ROWS, COLUMNS)
    x, z = np.outer(np.sin(polar), np.cos(azimuth)), np.outer(np.sin(polar), np.sin(azimuth))
    return np.stack([x, np.broadcast_to(np.cos(polar)[:, None], shape), z], axis=-1)


@cache
def row_solid_angle() -> Float64:
    """(32,) [sr]: what a texel of each row covers."""
    edges = np.cos(np.pi * np.arange(ROWS + 1) / SKY_SHAPE[0])
    return (edges[:-1] - edges[1:]) * (2 * np.pi / COLUMNS)


def horizontal_illuminance(sky: Float64) -> Float64:
    """(3,) [lx]: what a map gives to level ground."""
    weight = row_solid_angle() * map_directions()[:, 0, 1]
    return np.asarray(weight @ sky.sum(axis=1), np.float64)


@cache
def _cube_weights() -> Float64:
    """(6, 32 * 128) [sr]: what each texel's radiance gives to each face."""
    cosine = np.maximum(FACE_DIRECTIONS.astype(np.float64) @ map_directions().reshape(-1, 3).T, 0.0)
    return cosine * np.repeat(row_solid_angle(), COLUMNS)


def cube_of_sky(sky: Float64) -> Float64:
    """(6, 3) [lx]: a map's irradiance along the axes, +X -X +Y -Y +Z -Z; none from below."""
    return np.asarray(_cube_weights() @ sky.reshape(-1, 3), np.float64)


def clear_sky(
    air: Atmosphere, direction: Float64, spectrum: Float64, ground_albedo: float, true_elevation_degrees: float | None = None
) -> Float64:
    """The map that a light (sun or moon) makes of clear air.

    direction : (3,), unit, world frame, towards the light; it may lie below the horizon
    spectrum : (8,), the light above the air, as shares of the sun's at 1 au
    true_elevation_degrees : the light's without refraction, which the air above bends by itself; the direction's when None
    """
    elevation = true_elevation_degrees
    if elevation is None:
        elevation = float(np.degrees(np.arcsin(np.clip(direction[1], -1, 1))))
    parts = air.scattering(elevation, ground_albedo)
    rgb_from_share = RGB_FROM_SPECTRUM * spectrum
    cosine = np.clip(map_directions() @ direction, -1, 1)[..., None]
    air_map, aerosol_map, multiple_map = _around(parts, rgb_from_share, direction)
    # Deep sunset colours lie outside sRGB.
    return np.maximum(air_map * air_phase(cosine) + aerosol_map * aerosol_phase(cosine) + multiple_map, 0.0)


def _around(parts: SkyScattering, rgb_from_share: Float64, direction: Float64) -> list[Float64]:
    """The parts in RGB, turned to where the light stands: (32, 128, 3) each."""
    azimuths = parts.air.shape[1]
    towards = np.arctan2(direction[2], direction[0])
    columns = 2 * np.pi * (np.arange(COLUMNS) + 0.5) / COLUMNS
    relative = np.abs((columns - towards + np.pi) % (2 * np.pi) - np.pi)
    at = relative / np.pi * (azimuths - 1)
    first = np.minimum(at.astype(np.intp), azimuths - 2)
    share = (at - first)[:, None]
    maps = []
    for part in (parts.air, parts.aerosol, parts.multiple):
        rgb = part @ rgb_from_share.T
        maps.append(rgb[:, first] * (1 - share) + rgb[:, first + 1] * share)
    return maps


@cache
def night_sky() -> Float64:
    """The map of a moonless night: airglow brightens towards the horizon (van Rhijn), extinction dims it there."""
    sine = map_directions()[..., 1]
    ratio = EARTH_RADIUS_KM / (EARTH_RADIUS_KM + AIRGLOW_HEIGHT_KM)
    thickness = 1 / np.sqrt(1 - ratio * ratio * (1 - sine * sine))
    air_mass = 1 / (sine + 0.025 * np.exp(-11 * sine))  # Rozenberg 1966; 40 at the horizon
    glow = NIGHT_ZENITH_CD_M2 * thickness * np.exp(-0.15 * (air_mass - 1))
    return glow[..., None] * NIGHT_COLOUR


def with_clouds(clear: Float64, beam_on_ground: Float64, cover: float, transmission: float) -> Float64:
    """The map under clouds that hide a share of it and let a share of all light through, spread as the CIE overcast sky.

    beam_on_ground : (3,) [lx], what sun and moon would add on level ground; clouds spread it too
    """
    gradation = (1 + 2 * map_directions()[..., 1:2]) / 3 * np.ones(3)  # Moon and Spencer 1942; CIE S 011
    above = horizontal_illuminance(clear) + beam_on_ground
    clouds = gradation * (CLOUD_COLOUR * above * transmission / horizontal_illuminance(gradation))
    return (1 - cover) * clear + cover * clouds


def with_fog(sky: Float64, beam: Float64, beam_sine: Float64, fog_density: float) -> tuple[Float64, Float64]:
    """A map and beams (lights, 3) [lx, facing them] seen through ground fog: dimmed, and what droplets scatter down spread over the dome
    in proportion to how much of a ray's way the fog hides, so that a thin fog veils the horizon and leaves the zenith.

    beam_sine : (lights,), sines of the lights' elevations; fog_density : extinction [m^-1]
    """
    depth = fog_density * FOG_LAYER_M
    sine = np.maximum(beam_sine, 0.0)[:, None]
    before = horizontal_illuminance(sky) + (beam * sine).sum(axis=0)
    # At 0.02 the path is 50 layers: longer ones leave the fog's extent.
    kept = np.exp(-depth / np.maximum(map_directions()[..., 1:2], 0.02))
    seen = sky * kept
    through = beam * np.exp(-depth / np.maximum(sine, 0.02))
    arriving = before / (1 + 0.75 * (1 - DROPLET_ASYMMETRY) * depth)
    spread = np.maximum(arriving - horizontal_illuminance(seen) - (through * sine).sum(axis=0), 0.0)
    veil = np.broadcast_to(1 - kept, sky.shape)
    # No fog, no veil, and nothing to spread: 0 / 0.
    return seen + veil * (spread / np.maximum(horizontal_illuminance(veil), 1e-300)), through
