"""Whatever the place, the moment and the weather: no NaN, no infinity and nothing negative leaves any part that makes light."""

import calendar
import math
from dataclasses import replace
from datetime import UTC, date, datetime, timedelta

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from gi_core.clock_time import FIRST_YEAR, LAST_YEAR
from gi_core.constants import SKY_SHAPE
from gi_core.epw import EpwYear
from gi_core.epw_weather import EpwWeather
from gi_core.errors import InputError
from gi_core.light_blend import LightVector, between_lightings, relative_changes
from gi_core.lighting import DirectionalLight, Lighting
from gi_core.lighting_model import make_lighting
from gi_core.lighting_table import illuminance
from gi_core.relight_input import relight_input
from gi_core.settings import MAX_AMBIENT_LX, MAX_FACTOR, Settings
from gi_core.snow_pack import DEEPEST_MM, HOTTEST_C, WETTEST_MM_H, cover, snow_rates, step
from gi_core.sun import sun_position
from gi_core.sun_table import SunTable
from gi_core.user_sky import lighting_with_sky, sky_of_image
from gi_core.weather import WEATHER_RANGES, Weather, parse_weather
from gi_core.weather_script import WeatherScript
from gi_core.world import Lamp, Location

FIRST, LAST = datetime(FIRST_YEAR, 1, 1, tzinfo=UTC), datetime(LAST_YEAR, 12, 31, 23, 59, 59, 999999, tzinfo=UTC)

moments = st.one_of(
    st.datetimes(FIRST.replace(tzinfo=None), LAST.replace(tzinfo=None), timezones=st.just(UTC)),
    st.sampled_from([FIRST, LAST, datetime(2000, 2, 29, 23, 59, 59, tzinfo=UTC), datetime(1900, 2, 28, 12, tzinfo=UTC)]),
)


@st.composite
def places(draw: st.DrawFn) -> Location:
    latitude = draw(st.one_of(st.sampled_from([-90.0, -66.56, -23.44, 0.0, 23.44, 66.56, 90.0]), st.floats(-90, 90)))
    longitude = draw(st.one_of(st.sampled_from([-360.0, -180.0, 0.0, 180.0, 360.0]), st.floats(-360, 360)))
    # Every height is an air of its own, 60 ms: a few of them, the extremes included.
    height = draw(st.sampled_from([-1000.0, 0.0, 10_000.0]))
    return Location(latitude, longitude, height, "UTC", draw(st.floats(-720, 720)), date(2024, 6, 21), "given")


@st.composite
def weathers(draw: st.DrawFn) -> Weather:
    numbers = {}
    for name, (low, high) in WEATHER_RANGES.items():
        ends = st.sampled_from([low, high])
        numbers[name] = draw(st.sampled_from([low, 0.15, high]) if name == "haze" else st.one_of(ends, st.floats(low, high)))
    return Weather("any", **numbers)


def at_elevation(place: Location, day: datetime, degrees: float) -> datetime:
    """A moment of a day when the sun stands at an elevation as seen, to a millisecond; if it never does, some moment of the day."""
    low, high = day, day + timedelta(hours=12)
    if sun_position(place, low).elevation_degrees > sun_position(place, high).elevation_degrees:
        low, high = high, low
    for _ in range(26):
        middle = low + (high - low) / 2
        low, high = (middle, high) if sun_position(place, middle).elevation_degrees < degrees else (low, middle)
    return high


def check(light: Lighting) -> None:
    numbers = [light.sky_radiance, light.sky_cube, light.sun.irradiance, light.moon.irradiance]
    for array in numbers:
        assert np.isfinite(array).all()
        assert (array >= 0).all()
    assert (light.sky_radiance[32:] == 0).all()
    for lamp in (light.sun, light.moon):
        assert np.linalg.norm(lamp.direction) == pytest.approx(1, abs=1e-12)
        assert lamp.direction[1] > 0 or not lamp.irradiance.any()
    assert 0 <= light.snow <= 1
    assert 0 <= light.fog_density < math.inf
    assert math.isfinite(light.exposure)
    assert len(light.digest) == 32


def check_relight(light: Lighting, table: SunTable) -> None:
    given_ = relight_input(light, table)
    assert np.isfinite(given_.patch_exitance).all()
    assert (given_.patch_exitance >= 0).all()
    for record in given_.lights:
        for name in ("irradiance", "plane_weight"):
            assert np.isfinite(record[name]).all()
            assert (record[name] >= 0).all()
        assert record["plane_weight"].sum() <= 1 + 1e-6  # sums of four float32 weights
        assert (record["plane"] < table.plane_count).all()
        assert np.isfinite(record["direction"]).all()


@given(places(), moments, weathers(), st.sampled_from([None, -0.83, -1e-7, 0.0, 1e-7, 0.5332, 90.0]))
@settings(max_examples=100, deadline=None)
def test_no_place_moment_or_weather_gives_a_number_that_is_none(
    place: Location, moment: datetime, weather: Weather, elevation: float | None
) -> None:
    if elevation is not None:
        moment = at_elevation(place, min(moment, LAST - timedelta(days=1)), elevation)
    light = make_lighting(place, moment, weather)
    check(light)
    assert illuminance(light) > 0  # the night is never black
    check_relight(light, SunTable.build(place, 90, 90))


@given(places(), st.datetimes(datetime(FIRST_YEAR, 1, 2), datetime(LAST_YEAR, 12, 30), timezones=st.just(UTC)), weathers())
@settings(max_examples=60, deadline=None)
def test_no_second_of_any_year_at_any_place_jumps(place: Location, moment: datetime, weather: Weather) -> None:
    before, after = (make_lighting(place, moment + timedelta(seconds=second), weather) for second in (0, 1))
    # A light climbs 0.0042 degrees a second at most; twilight is 3.2 times as bright a degree later, clouds, fog and haze included.
    assert abs(math.log(illuminance(after) / illuminance(before))) < 0.008
    np.testing.assert_allclose(after.sky_cube, before.sky_cube, rtol=0.01)
    assert before.sun.direction @ after.sun.direction > math.cos(math.radians(0.006))


colours = st.tuples(*[st.one_of(st.sampled_from([0.0, MAX_AMBIENT_LX]), st.floats(0, MAX_AMBIENT_LX))] * 3)
gains = st.one_of(st.sampled_from([0.0, 1e-300, 1.0, MAX_FACTOR]), st.floats(0, MAX_FACTOR))
panels = st.builds(Settings, gains, gains, gains, gains, colours, gains, colours, colours, gains, gains)


@given(panels, st.sampled_from(["12:00", "00:30"]), st.integers(0, 1000))
@settings(max_examples=40, deadline=None)
def test_no_setting_makes_a_number_that_is_none(panel: Settings, clock: str, seed: int) -> None:
    light = panel.light(make_lighting(Location(), clock))
    for array in (light.sky_radiance, light.sky_cube, light.sun.irradiance, light.moon.irradiance):
        assert np.isfinite(array).all()
        assert (array >= 0).all()
    check_relight(light, SunTable.build(Location(), 90, 90))
    rng = np.random.default_rng(seed)
    first = (10 ** rng.uniform(-30, 12, (4, 6, 3))).astype(np.float32)
    converged = first * rng.uniform(1, 20, first.shape).astype(np.float32)
    cubes = panel.cubes(first, converged, np.array([0, 1, 0, 65535], np.uint16))
    assert np.isfinite(cubes).all()
    assert (cubes >= 0).all()
    lamps = panel.brightened((Lamp("a", "point", (0.0, 0.0, 0.0), 0.0), Lamp("b", "area", (0.0, 9.0, 0.0), 1e9)))
    assert all(0 <= lamp.lumens < math.inf for lamp in lamps)


@given(st.integers(0, 2**63 - 1), places(), moments)
@settings(max_examples=40, deadline=None)
def test_a_weather_script_speaks_of_possible_weather_only(seed: int, place: Location, moment: datetime) -> None:
    script = WeatherScript(seed, place)
    weather = script.at(moment)  # a Weather refuses numbers out of its ranges, NaN among them
    assert parse_weather(weather.text) == weather
    assert script.at(moment) == weather
    assert math.isfinite(script.temperature_c(moment))
    spell = script.spell_at(moment)
    assert spell.start_hours < spell.end_hours


@given(
    st.floats(0, DEEPEST_MM),
    st.one_of(st.floats(0, WETTEST_MM_H), st.floats(allow_nan=True)),
    st.one_of(st.floats(-HOTTEST_C, HOTTEST_C), st.floats(allow_nan=True)),
    st.floats(0, 1e6),
)
def test_snow_stays_snow_for_any_number(water: float, precipitation: float, temperature: float, hours: float) -> None:
    try:
        rates = snow_rates(precipitation, temperature)
    except InputError:
        return
    for value in (rates.build_mm_h, rates.melt_mm_h):
        assert 0 <= value < math.inf
    assert 0 <= step(water, rates, hours) <= DEEPEST_MM
    assert 0 <= cover(step(water, rates, hours)) <= 1


LIMITS = {
    "temperature_c": (-90, 70), "global_lx": (0, 200e3), "beam_lx": (0, 200e3), "opaque_tenths": (0, 10), "total_tenths": (0, 10),
    "visibility_km": (0, 9998), "aerosol_depth": (0, 5), "snow_cm": (0, 998), "rain_mm": (0, 998),
}  # fmt: skip


def wild_year() -> EpwYear:
    """A leap year at the polar circle whose hours take the least, the greatest, any and no value of each number that a file may have."""
    rng, hours = np.random.default_rng(0), 366 * 24
    columns = {}
    for name, (low, high) in LIMITS.items():
        values = np.stack([np.full(hours, low), np.full(hours, high), rng.uniform(low, high, hours), np.full(hours, np.nan)])
        columns[name] = values[rng.integers(0, 4, hours), np.arange(hours)].astype(np.float64)
    days = [(month, day) for month in range(1, 13) for day in range(1, calendar.monthrange(2024, month)[1] + 1)]
    first_hour = {day: 24 * number for number, day in enumerate(days)}
    return EpwYear("wild", 66.56, -180.0, -12.0, 9000.0, np.full(hours, 2024), first_hour, **columns)


@pytest.fixture(scope="module")
def wild() -> EpwWeather:
    return EpwWeather(wild_year())


@given(moments)
@settings(max_examples=60, deadline=None)
def test_a_wild_measured_year_gives_possible_weather(wild: EpwWeather, moment: datetime) -> None:
    if FIRST + timedelta(days=1) < moment < LAST - timedelta(days=1):
        weather = wild.at(moment)
        assert parse_weather(weather.text) == weather


def test_light_of_a_wild_measured_year(wild: EpwWeather) -> None:
    for hour in range(0, 8760, 876):
        moment = datetime(2024, 1, 1, 12, tzinfo=UTC) + timedelta(hours=hour)
        check(make_lighting(wild.location, moment, wild.at(moment)))


pixels = arrays(np.float32, (4, 8, 3), elements=st.floats(width=32, allow_nan=True, allow_infinity=True))
finite_pixels = arrays(np.float32, (4, 8, 3), elements=st.floats(-(2.0**126), 2.0**126, width=32))


@given(
    st.one_of(pixels, finite_pixels, finite_pixels.map(lambda image: np.abs(image) * np.float32(1e-33))),
    st.floats(allow_nan=True), st.floats(-1e300, 1e300), st.one_of(st.none(), st.floats(allow_nan=True)), st.booleans(),
)  # fmt: skip
@settings(max_examples=80, deadline=None)
def test_no_picture_of_a_sky_makes_a_number_that_is_none(
    image: np.ndarray, north: float, centre: float, lux: float | None, holds_sun: bool
) -> None:
    try:
        sky = sky_of_image(image, north, centre, lux)
    except InputError:
        return
    assert 0 < sky.illuminance_lx <= 1.001e7
    assert 0 <= sky.below_horizon <= 1
    light = lighting_with_sky(make_lighting(Location(), "12:00"), replace(sky, holds_sun=holds_sun))
    for array in (light.sky_radiance, light.sky_cube):
        assert np.isfinite(array).all()
        assert (array >= 0).all()
    assert math.isfinite(light.exposure)
    check_relight(light, SunTable.build(Location(), 90, 90))


TABLE = SunTable.build(Location(), 30, 30)
# 1e14 times the brightest that the model, a sky of one's own and the panel together give.
MOST = 1e30
LUX = st.one_of(st.sampled_from([0.0, 5e-324, 1e-45, MOST]), st.floats(0, MOST), st.floats(0, 1e5))


@st.composite
def snapshots(draw: st.DrawFn) -> Lighting:
    """Any light, physical or not: lights below the horizon shine, and sky and cube have nothing to do with each other."""

    def beam() -> DirectionalLight:
        ends = st.sampled_from([(0.0, 1.0, 0.0), (0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (-1.0, 0.0, 0.0)])
        anywhere = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 1e-3)
        direction = np.array(draw(st.one_of(ends, anywhere)))
        return DirectionalLight(direction / np.linalg.norm(direction), np.array(draw(st.tuples(LUX, LUX, LUX))))

    sky = np.zeros((*SKY_SHAPE, 3), np.float32)
    sky[:32:31], sky[1:31] = draw(LUX), draw(LUX)
    cube = np.array(draw(st.lists(LUX, min_size=6, max_size=6)))[:, None] * np.ones(3)
    share = st.floats(0, 1)
    return Lighting("now", "any", beam(), beam(), sky, cube, draw(share), draw(LUX), draw(st.floats(-100, 100)))


def finite(light: Lighting) -> None:
    for array in (light.sky_radiance, light.sky_cube, light.sun.irradiance, light.moon.irradiance):
        assert np.isfinite(array).all()
        assert (array >= 0).all()
    for beam in (light.sun, light.moon):
        assert np.linalg.norm(beam.direction) == pytest.approx(1, abs=1e-12)
        assert beam.direction[1] > 0 or not beam.irradiance.any()
    assert 0 <= light.snow <= 1
    assert np.isfinite([light.fog_density, light.exposure]).all()


@given(
    snapshots(), snapshots(), st.one_of(st.sampled_from([0.0, 0.5, 1.0]), st.floats(0, 1)), st.sampled_from([("faces", 6), ("patches", 24)])
)
@settings(max_examples=60, deadline=None)
def test_between_any_two_lights_is_a_light_and_any_two_differ_by_a_number(
    first: Lighting, second: Lighting, share: float, sky: tuple[str, int]
) -> None:
    between = between_lightings(first, second, share, "then")
    finite(between)
    vectors = [LightVector.of(relight_input(light, TABLE, *sky)) for light in (first, between, second)]
    for vector in vectors:
        assert np.isfinite(vector.numbers).all()
        assert 0 <= vector.scale < math.inf
    numbers = np.stack([vector.numbers for vector in vectors])
    changes = relative_changes(numbers, np.array([vector.scale for vector in vectors]), vectors[1])
    assert np.isfinite(changes).all()
    assert (changes >= 0).all()
    assert changes[1] == 0
