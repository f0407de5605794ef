"""From a place, a time and a weather to the light of that moment."""

import math
from datetime import UTC, datetime
from functools import lru_cache
from typing import TypeVar

import numpy as np

from gi_core.arrays import AnyArray, Float64
from gi_core.atmosphere import Atmosphere, atmosphere
from gi_core.clock_time import local_time, parse_time, time_zone
from gi_core.constants import SKY_SHAPE
from gi_core.lighting import DirectionalLight, Lighting
from gi_core.sky import ROWS, clear_sky, cube_of_sky, horizontal_illuminance, night_sky, with_clouds, with_fog
from gi_core.spectrum import LUMINANCE_FROM_RGB, RGB_FROM_SPECTRUM, WAVELENGTH_NM
from gi_core.sun import MoonPosition, moon_position, sun_position
from gi_core.weather import Weather, as_weather
from gi_core.world import Location

ArrayT = TypeVar("ArrayT", bound=AnyArray)

GROUND_ALBEDO, SNOW_ALBEDO = 0.15, 0.7  # what the landscape around the city sends back to the sky

MEAN_MOON_DISTANCE_AU = 384_400 / 149_597_870.7
LUX_PER_FOOTCANDLE = 10.7639
# A light this far down adds a hundredth of the night's own glow, and the moon's sky adds 1e-4 to the sun's at sunrise. Leaving them out
# makes a night four times as fast; they fade out before, so that nothing jumps.
FADE_IN_DEGREES = (-20.0, -18.0)
MOON_FADE_OUT_DEGREES = (-2.0, 0.0)

# ISO 2720: reflected-light meters with K = 12.5 expose a mean luminance L at EV100 = log2(L 100 / K).
METER_CONSTANT = 12.5
# What a meter sees of a street: grey of 18 %.
MEAN_REFLECTANCE = 0.18


def make_lighting(location: Location, time: datetime | str, weather: Weather | str = "clear", keep: bool = True) -> Lighting:
    """The light at a place and time in a weather; the same arguments give the same bytes.

    Arrays are read-only and shared between callers: the last few hundred results are kept, unless ``keep`` says that nobody is going to
    ask for this one again. A naive datetime is local time.
    Raises UnknownTimeError and UnknownWeatherError (see ``parse_time`` and ``parse_weather``).
    """
    moment = parse_time(time, location) if isinstance(time, str) else local_time(time, location)
    # Datetimes of one zone are equal when their clocks read the same, which they do for two hours in autumn: UTC tells these apart.
    make = _make_lighting if keep else _make_lighting.__wrapped__
    return make(location, moment.astimezone(UTC), as_weather(weather))


@lru_cache(maxsize=256)
def _make_lighting(location: Location, moment: datetime, weather: Weather) -> Lighting:
    air = atmosphere(weather.haze, location.elevation_m / 1000)
    sun, moon = sun_position(location, moment), moon_position(location, moment)
    spectra = (np.full(len(WAVELENGTH_NM), sun.distance**-2), moon_spectrum(moon))
    directions = [light.direction(location.north_degrees) for light in (sun, moon)]
    ground_albedo = GROUND_ALBEDO + weather.snow * (SNOW_ALBEDO - GROUND_ALBEDO)

    sky = night_sky().copy()
    beams = np.zeros((2, 3))
    for number, (position, direction, spectrum) in enumerate(zip((sun, moon), directions, spectra, strict=True)):
        beams[number] = beam_irradiance(air, position.elevation_degrees, spectrum)
        true = position.true_elevation_degrees
        share = _smooth_step(*FADE_IN_DEGREES, true)
        if position is moon:
            share *= 1 - _smooth_step(*MOON_FADE_OUT_DEGREES, sun.elevation_degrees)
        if share > 0:
            sky += share * clear_sky(air, direction, spectrum, ground_albedo, true)
    sines = np.array([max(float(direction[1]), 0.0) for direction in directions])
    if weather.cloud_cover > 0:
        sky = with_clouds(sky, sines @ beams, weather.cloud_cover, weather.cloud_transmission)
        beams *= 1 - weather.cloud_cover
    if weather.fog_density > 0:
        sky, beams = with_fog(sky, beams, sines, weather.fog_density)

    radiance = np.zeros((*SKY_SHAPE, 3), np.float32)
    radiance[:ROWS] = sky
    served = radiance[:ROWS].astype(np.float64)  # the cube belongs to the rounded map, which is the one that is handed out
    lights = [DirectionalLight(_frozen(d), _frozen(beam)) for d, beam in zip(directions, beams, strict=True)]
    return Lighting(
        time=moment.astimezone(time_zone(location.timezone)).isoformat(),
        weather=weather.text,
        sun=lights[0],
        moon=lights[1],
        sky_radiance=_frozen(radiance),
        sky_cube=_frozen(cube_of_sky(served)),
        snow=weather.snow,
        fog_density=weather.fog_density,
        exposure=exposure_value(horizontal_illuminance(served) + sines @ beams),
    )


def _smooth_step(low: float, high: float, value: float) -> float:
    """From 0 up to low to 1 from high on, without a corner."""
    share = min(max((value - low) / (high - low), 0.0), 1.0)
    return share * share * (3 - 2 * share)


def beam_irradiance(air: Atmosphere, elevation_degrees: float, spectrum: Float64) -> Float64:
    """(3,) [lx]: what a light gives to a surface that faces it, through clear air, by its elevation as seen; 0 from the horizon down."""
    return np.maximum(RGB_FROM_SPECTRUM @ (air.beam(elevation_degrees) * spectrum), 0.0)


def moon_spectrum(moon: MoonPosition) -> Float64:
    """(8,): moonlight above the air, as shares of the sun's spectrum at 1 au.

    Illuminance by phase: Krisciunas and Schaefer 1991, eq. 20. The moon's soil reflects red nearly twice as well as blue.
    """
    phase = moon.phase_angle_degrees
    lux = LUX_PER_FOOTCANDLE * 10 ** (-0.4 * (3.84 + 0.026 * phase + 4e-9 * phase**4))
    reddened = WAVELENGTH_NM / 550
    unit = float(LUMINANCE_FROM_RGB @ RGB_FROM_SPECTRUM @ reddened)
    return np.asarray(reddened * (lux * (MEAN_MOON_DISTANCE_AU / moon.distance) ** 2 / unit), np.float64)


def exposure_value(ground_illuminance: Float64) -> float:
    """EV100 for a scene of mean reflectance whose level ground gets (3,) [lx]."""
    luminance = MEAN_REFLECTANCE / math.pi * float(LUMINANCE_FROM_RGB @ ground_illuminance)
    return math.log2(luminance * 100 / METER_CONSTANT)


def _frozen(array: ArrayT) -> ArrayT:
    array.flags.writeable = False
    return array
