"""Where the sun and the moon stand, by PyEphem (VSOP87 and the IAU 1980 nutation; libastro's moon), and how the air lifts them."""

import math
from dataclasses import dataclass
from datetime import UTC, datetime

import ephem

from gi_core.arrays import Float64
from gi_core.errors import InputError
from gi_core.world import Location, direction_from_azimuth

STANDARD_PRESSURE_MBAR = 1010.0
STANDARD_TEMPERATURE_C = 10.0
PRESSURE_SCALE_HEIGHT_M = 8434.0
# Refraction of a light below the horizon is fiction, but cutting it off would make dusk jump by half a degree: it fades out here.
REFRACTION_FADE_DEGREES = (-1.0, -5.0)


@dataclass(frozen=True)
class SkyPosition:
    """Topocentric position of a light in the sky.

    azimuth_degrees : clockwise from true north
    true_elevation_degrees : of the centre, as if there were no air
    elevation_degrees : of the centre, with refraction
    distance : in astronomical units
    """

    azimuth_degrees: float
    true_elevation_degrees: float
    elevation_degrees: float
    distance: float

    def direction(self, north_degrees: float) -> Float64:
        """(3,) float64, unit, world frame, towards the light, with refraction."""
        return direction_from_azimuth(self.azimuth_degrees, self.elevation_degrees, north_degrees)


@dataclass(frozen=True)
class MoonPosition(SkyPosition):
    """The moon also has a phase angle [degrees], 0 full, 180 new."""

    phase_angle_degrees: float


def refraction_degrees(true_elevation_degrees: float, pressure_mbar: float, temperature_c: float) -> float:
    """How much the air lifts a light [degrees]. Saemundsson 1986 (the formula in NREL's SPA), faded out below the horizon."""
    fade_start, fade_end = REFRACTION_FADE_DEGREES
    elevation = max(true_elevation_degrees, fade_end)
    minutes = 1.02 / math.tan(math.radians(max(elevation, fade_start) + 10.3 / (max(elevation, fade_start) + 5.11)))
    # At the zenith the formula ends a few arc seconds below 0.
    lift = max(minutes, 0.0) / 60 * (pressure_mbar / 1010.0) * (283.0 / (273.0 + temperature_c))
    fade = min(1.0, (elevation - fade_end) / (fade_start - fade_end))
    return lift * fade * fade * (3 - 2 * fade)


def without_refraction(elevation_degrees: float, pressure_mbar: float, temperature_c: float) -> float:
    """The true elevation [degrees] of a light that is seen at an elevation: the inverse of adding ``refraction_degrees``."""
    true = elevation_degrees
    for _ in range(20):  # each step leaves a third of the error at most
        true = elevation_degrees - refraction_degrees(true, pressure_mbar, temperature_c)
    return true


def pressure_at(elevation_m: float) -> float:
    """Mean air pressure [mbar] at a height above the sea."""
    return STANDARD_PRESSURE_MBAR * math.exp(-elevation_m / PRESSURE_SCALE_HEIGHT_M)


def sun_position(
    location: Location, time: datetime, pressure_mbar: float | None = None, temperature_c: float = STANDARD_TEMPERATURE_C
) -> SkyPosition:
    """The sun over a location at an aware time. Pressure 0 turns refraction off; None means the mean one at its elevation."""
    sun = ephem.Sun(_observer(location, time))
    true = math.degrees(sun.alt)
    lift = refraction_degrees(true, pressure_at(location.elevation_m) if pressure_mbar is None else pressure_mbar, temperature_c)
    return SkyPosition(math.degrees(sun.az), true, true + lift, float(sun.earth_distance))


def moon_position(location: Location, time: datetime) -> MoonPosition:
    """The moon over a location at an aware time, in air of the mean pressure at its elevation. Its parallax (a degree) is included."""
    observer = _observer(location, time)
    sun, moon = ephem.Sun(observer), ephem.Moon(observer)
    true = math.degrees(moon.alt)
    lift = refraction_degrees(true, pressure_at(location.elevation_m), STANDARD_TEMPERATURE_C)
    # Meeus, "Astronomical Algorithms", 48.3; atan2 keeps it exact near full and new moon.
    elongation = float(ephem.separation(sun, moon))
    sun_distance, distance = float(sun.earth_distance), float(moon.earth_distance)
    phase_angle = math.atan2(sun_distance * math.sin(elongation), distance - sun_distance * math.cos(elongation))
    return MoonPosition(math.degrees(moon.az), true, true + lift, distance, math.degrees(phase_angle))


def _observer(location: Location, time: datetime) -> ephem.Observer:
    """An observer without air. Made anew for each call: ephem's objects must not be shared between threads."""
    latitude, longitude, height = location.latitude_degrees, location.longitude_degrees, location.elevation_m
    # Written so that NaN is refused too.
    if not (-90 <= latitude <= 90 and -360 <= longitude <= 360 and -1000 <= height <= 10_000):
        raise InputError(
            f"location: expected a latitude of -90..90 and a longitude of -360..360 degrees, and an elevation of -1000..10000 m, "
            f"got {latitude!r}, {longitude!r}, {height!r}"
        )
    observer = ephem.Observer()
    observer.lat, observer.lon = math.radians(latitude), math.radians(longitude)
    observer.elevation = height
    observer.pressure = 0.0
    observer.date = ephem.Date(time.astimezone(UTC).replace(tzinfo=None))
    return observer
