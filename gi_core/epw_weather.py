"""The weather of a measured year: what the sky looked like in that hour, so that its light is the light that was measured.

For each hour the clouds are solved for: they hide the share of the sun's beam that is missing from the measured one, and let through what
makes the light on level ground the measured one. Haze is the measured aerosol, fog what the visibility says beyond that haze.
"""

import math
from datetime import UTC, datetime, timedelta
from functools import cache
from pathlib import Path

import numpy as np

from gi_core import snow_pack
from gi_core.air_profile import HAZE_HEIGHT_KM
from gi_core.arrays import Float64
from gi_core.atmosphere import Atmosphere
from gi_core.epw import EpwYear, read_epw
from gi_core.errors import InputError
from gi_core.lighting_model import GROUND_ALBEDO, beam_irradiance
from gi_core.sky import DROPLET_ASYMMETRY, FOG_LAYER_M, clear_sky, horizontal_illuminance
from gi_core.spectrum import LUMINANCE_FROM_RGB, WAVELENGTH_NM
from gi_core.sun import STANDARD_PRESSURE_MBAR, STANDARD_TEMPERATURE_C, sun_position, without_refraction
from gi_core.weather import WEATHER_RANGES, Weather, between, weather_of
from gi_core.world import Location

_ELEVATIONS = np.array([0, 0.5, 1, 2, 3, 4, 6, 8, 10, 13, 16, 20, 25, 30, 40, 50, 60, 75, 90], np.float64)
_HAZES = 0.02 * 100 ** np.linspace(0, 1, 9)  # 0.02 .. 2, as weathers allow
_PARTS_OF_HOUR = 2
# Koschmieder: contrast falls to 2 % where extinction times distance is this.
_VISIBILITY_DEPTH = 3.912
# Below this the hour's beam is too weak a measure of the clouds, which hide it by their sides too.
_LEAST_SUN_DEGREES = 5.0
_USUAL_HAZE, _USUAL_TRANSMISSION = 0.15, 0.6  # the clear preset's, where the file has nothing
_LEAST_COVER = 0.02  # clouds so few say nothing of how thick they are


class EpwWeather:
    """Weather of a year of hours, linear between the hours' middles. Read-only once made (2 s); safe to share between threads."""

    def __init__(self, source: Path | str | EpwYear) -> None:
        """source : a file, or a year that was read. Raises InputError for a file that is no EPW."""
        self.year = source if isinstance(source, EpwYear) else read_epw(source)
        self._numbers = _hourly(self.year)

    @property
    def location(self) -> Location:
        """Where the year was measured; its standard time as a fixed zone where that is a whole hour, else UTC."""
        year, whole = self.year, self.year.zone_hours == int(self.year.zone_hours)
        # POSIX turns the sign: Etc/GMT+5 is five hours behind.
        zone = f"Etc/GMT{-int(year.zone_hours):+d}" if whole and year.zone_hours else "UTC"
        return Location(year.latitude_degrees, year.longitude_degrees, year.elevation_m, zone, source="given")

    def at(self, moment: datetime) -> Weather:
        """The weather at an aware moment of any year; 29 February is the 28th again where the file has none."""
        if moment.tzinfo is None:
            raise InputError(f"weather of {self.year.name}: expected a time with an offset, got {moment.isoformat()}")
        standard = moment.astimezone(UTC).replace(tzinfo=None) + timedelta(hours=self.year.zone_hours)
        middle = standard - timedelta(minutes=30)
        first = middle.replace(minute=0, second=0, microsecond=0)
        share = (middle - first) / timedelta(hours=1)
        hours = (self._numbers[:, self._row(hour)].tolist() for hour in (first, first + timedelta(hours=1)))
        blended = (between(one, after, share) for one, after in zip(*hours, strict=True))
        return weather_of(dict(zip(WEATHER_RANGES, blended, strict=True)))

    def _row(self, hour: datetime) -> int:
        """Of the hour that begins at a local standard time."""
        day = (hour.month, hour.day)
        return self.year.first_hour.get(day, self.year.first_hour[(2, 28)]) + hour.hour


def _hourly(year: EpwYear) -> Float64:
    """(5, hours): the numbers of a weather, in the order of WEATHER_RANGES."""
    haze = _within("haze", _filled(year.aerosol_depth, _USUAL_HAZE))
    extinction = _VISIBILITY_DEPTH / np.maximum(1000 * _filled(year.visibility_km, math.inf), 1.0)
    # What the haze itself takes from the view along the ground is no fog.
    fog = _within("fog_density", np.maximum(extinction - haze / (1000 * HAZE_HEIGHT_KM), 0.0))
    elevation = _elevations(year)
    clear_global, clear_beam = _clear_hours(elevation, haze, fog)

    tenths = np.where(np.isfinite(year.opaque_tenths), year.opaque_tenths, year.total_tenths)
    cover = _filled(tenths, 0.0) / 10
    measured = (elevation.mean(axis=1) > _LEAST_SUN_DEGREES) & np.isfinite(year.beam_lx)
    cover[measured] = np.clip(1 - year.beam_lx[measured] / clear_beam[measured], 0, 1)

    # (1 - c) clear + c t clear = measured
    known = np.flatnonzero((clear_global > 0) & np.isfinite(year.global_lx) & (cover >= _LEAST_COVER))
    solved = 1 - (1 - year.global_lx[known] / clear_global[known]) / cover[known]
    hours = np.arange(len(cover))
    transmission = np.interp(hours, known, solved) if len(known) else np.full(len(cover), _USUAL_TRANSMISSION)
    return np.stack([cover, _within("cloud_transmission", transmission), haze, fog, _snow(year)])


def _within(name: str, values: Float64) -> Float64:
    return np.clip(values, *WEATHER_RANGES[name])


def _filled(values: Float64, default: float) -> Float64:
    """Missing hours from those around them; the default where all are missing."""
    known = np.flatnonzero(np.isfinite(values))
    return np.interp(np.arange(len(values)), known, values[known]) if len(known) else np.full(len(values), default)


def _elevations(year: EpwYear) -> Float64:
    """(hours, parts) [degrees]: the sun's elevation in the middle of each part of each hour, in the year that the hour is from."""
    place = Location(year.latitude_degrees, year.longitude_degrees, year.elevation_m)
    elevation = np.zeros((len(year.years), _PARTS_OF_HOUR))
    for (month, day), first in year.first_hour.items():
        # A leap day of a year that has none stands for the day before.
        here = datetime(int(year.years[first]), month, min(day, 28) if month == 2 else day, tzinfo=UTC)
        for part in range(24 * _PARTS_OF_HOUR):
            moment = here + timedelta(hours=(part + 0.5) / _PARTS_OF_HOUR - year.zone_hours)
            elevation[first + part // _PARTS_OF_HOUR, part % _PARTS_OF_HOUR] = sun_position(place, moment).elevation_degrees
    return elevation


def _clear_hours(elevation: Float64, haze: Float64, fog: Float64) -> tuple[Float64, Float64]:
    """Hours' means of illuminance without clouds (hours,) [lx]: on level ground, and the beam's facing it."""
    table = _clear_table()
    row = np.interp(np.log(haze), np.log(_HAZES), np.arange(len(_HAZES)))[:, None]
    column = np.interp(elevation, _ELEVATIONS, np.arange(len(_ELEVATIONS)))
    first_row, first_column = (np.minimum(at.astype(np.intp), n - 2) for at, n in zip((row, column), table.shape[1:], strict=True))
    down, right = row - first_row, column - first_column
    sky, beam = (
        (1 - down) * ((1 - right) * part[first_row, first_column] + right * part[first_row, first_column + 1])
        + down * ((1 - right) * part[first_row + 1, first_column] + right * part[first_row + 1, first_column + 1])
        for part in table
    )
    up = elevation > 0
    sine = np.where(up, np.sin(np.radians(elevation)), 0.0)
    depth = (fog * FOG_LAYER_M)[:, None]
    whole = (sky + beam * sine) / (1 + 0.75 * (1 - DROPLET_ASYMMETRY) * depth)
    seen = beam * np.exp(-depth / np.maximum(sine, 0.02))
    return np.asarray((whole * up).mean(axis=1), np.float64), np.asarray((seen * up).mean(axis=1), np.float64)


@cache
def _clear_table() -> Float64:
    """(2, hazes, elevations) [lx]: the clear sky on level ground, and the beam facing it, at the sea."""
    sun = np.ones(len(WAVELENGTH_NM))
    table = np.zeros((2, len(_HAZES), len(_ELEVATIONS)))
    for row, haze in enumerate(_HAZES.tolist()):
        air = Atmosphere(haze, 0.0)
        for column, degrees in enumerate(_ELEVATIONS.tolist()):
            angle = math.radians(degrees)
            true = without_refraction(degrees, STANDARD_PRESSURE_MBAR, STANDARD_TEMPERATURE_C)
            sky = clear_sky(air, np.array([math.cos(angle), math.sin(angle), 0.0]), sun, GROUND_ALBEDO, true)
            table[0, row, column] = LUMINANCE_FROM_RGB @ horizontal_illuminance(sky)
            table[1, row, column] = LUMINANCE_FROM_RGB @ beam_irradiance(air, degrees, sun)
    return table


def _snow(year: EpwYear) -> Float64:
    """(hours,): snow cover by the file's depth; where it has none, by its precipitation; else none."""
    if np.isfinite(year.snow_cm).any():
        water = _filled(year.snow_cm, 0.0) * snow_pack.WATER_MM_PER_SNOW_CM
    else:
        water = np.zeros(len(year.snow_cm))
        rain, temperature = np.nan_to_num(year.rain_mm), _filled(year.temperature_c, 10.0)
        pack = 0.0
        for _ in range(2):  # the second year begins with what the first one left
            for hour in range(len(water)):
                water[hour] = pack
                pack = snow_pack.step(pack, snow_pack.snow_rates(float(rain[hour]), float(temperature[hour])), 1.0)
    return np.array([snow_pack.cover(mm) for mm in water.tolist()])
