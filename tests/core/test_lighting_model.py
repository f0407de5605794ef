"""The light of a moment, at every hour, place and weather: the contract's form, no jumps, no impossible numbers."""

import math
from datetime import UTC, date, datetime, timedelta

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gi_core.atmosphere import atmosphere
from gi_core.errors import UnknownTimeError, UnknownWeatherError
from gi_core.lighting import Lighting
from gi_core.lighting_model import MEAN_MOON_DISTANCE_AU, beam_irradiance, exposure_value, make_lighting, moon_spectrum
from gi_core.spectrum import LUMINANCE_FROM_RGB, RGB_FROM_SPECTRUM
from gi_core.sun import MoonPosition, sun_position
from gi_core.weather import WEATHER_RANGES, Weather, weather_presets
from gi_core.world import Location

NEW_YORK = Location()


def on_ground(light: Lighting) -> float:
    """Illuminance [lx] of level ground."""
    beams = sum(lamp.irradiance * max(0.0, float(lamp.direction[1])) for lamp in (light.sun, light.moon))
    return float(LUMINANCE_FROM_RGB @ (light.sky_cube[2] + beams))


def check_form(light: Lighting) -> None:
    assert light.sky_radiance.shape == (64, 128, 3)
    assert light.sky_radiance.dtype == np.float32
    assert np.isfinite(light.sky_radiance).all()
    assert (light.sky_radiance[:32] > 0).all()
    assert (light.sky_radiance[32:] == 0).all()
    assert light.sky_cube.shape == (6, 3)
    assert (light.sky_cube[3] == 0).all()
    assert (light.sky_cube[[0, 1, 2, 4, 5]] > 0).all()
    for lamp in (light.sun, light.moon):
        assert np.linalg.norm(lamp.direction) == pytest.approx(1, abs=1e-12)
        assert np.isfinite(lamp.irradiance).all()
        assert (lamp.irradiance >= 0).all()
        if lamp.direction[1] <= 0:
            assert (lamp.irradiance == 0).all()
    assert math.isfinite(light.exposure)


@pytest.mark.parametrize("weather", weather_presets())
@pytest.mark.parametrize("time", ["00:30", "05:30", "08:00", "13:00", "20:45"])
def test_form_at_all_hours_in_all_presets(weather: str, time: str) -> None:
    check_form(make_lighting(NEW_YORK, time, weather))


def test_clear_noon() -> None:
    light = make_lighting(NEW_YORK, "13:00", "clear")
    assert 60e3 < light.sun.irradiance.max() < 130e3
    assert 10e3 < LUMINANCE_FROM_RGB @ light.sky_cube[2] < 25e3
    assert light.sun.direction[1] == pytest.approx(math.sin(math.radians(72.66)), abs=1e-3)
    assert light.exposure == pytest.approx(15.7, abs=0.5)  # "sunny 16" is EV 15 for a scene lit by 80 klx


def test_overcast_noon_has_no_sun_and_the_cie_gradation() -> None:
    light = make_lighting(NEW_YORK, "13:00", "overcast")
    assert (light.sun.irradiance == 0).all()
    assert 10e3 < LUMINANCE_FROM_RGB @ light.sky_cube[2] < 40e3
    row = light.sky_radiance[:32, 0, 1]
    sine = np.cos(np.pi * (np.arange(32) + 0.5) / 64)
    np.testing.assert_allclose(row / row[0], (1 + 2 * sine) / (1 + 2 * sine[0]), rtol=1e-5)
    assert np.ptp(light.sky_radiance[:32], axis=1).max() < 1e-5 * row[0]
    # Overcast light is white.
    assert light.sky_cube[2].max() / light.sky_cube[2].min() < 1.1


def test_night_is_dark_but_not_black_and_the_moon_lights_it() -> None:
    # Full moon on 2024-06-22; new moon on 2024-06-06.
    moonlit = make_lighting(NEW_YORK, "2024-06-22T01:00", "clear")
    moonless = make_lighting(NEW_YORK, "2024-06-06T01:00", "clear")
    assert (moonlit.sun.irradiance == 0).all()
    assert (moonless.moon.irradiance == 0).all()
    assert 5e-4 < on_ground(moonless) < 2e-3  # starlight and airglow
    assert 0.02 < on_ground(moonlit) < 0.3  # a low full moon of summer


def test_sky_cube_is_the_integral_of_the_served_map() -> None:
    light = make_lighting(NEW_YORK, "18:00", "clear")
    # Midpoint rule on the contract's directions, as a client would do it: 0.04 % from the exact solid angles at 64 rows.
    theta = np.pi * (np.arange(64) + 0.5) / 64
    phi = 2 * np.pi * (np.arange(128) + 0.5) / 128
    t, p = np.meshgrid(theta, phi, indexing="ij")
    direction = np.stack([np.sin(t) * np.cos(p), np.cos(t), np.sin(t) * np.sin(p)], axis=-1)
    weight = np.sin(t) * (np.pi / 64) * (2 * np.pi / 128)
    for face, axis in enumerate(np.repeat(np.eye(3), 2, axis=0) * np.array([1, -1] * 3)[:, None]):
        cosine = np.maximum(direction @ axis, 0) * weight
        np.testing.assert_allclose((light.sky_radiance * cosine[..., None]).sum((0, 1)), light.sky_cube[face], rtol=1e-3)


def test_clouds_and_fog_only_move_and_absorb_light() -> None:
    before = math.inf
    for weather in (
        "clear",
        "clear:cloud_cover=0.5",
        "clear:cloud_cover=1",
        "clear:cloud_cover=1,fog_density=0.01",
        "clear:cloud_cover=1,fog_density=0.1",
    ):
        now = on_ground(make_lighting(NEW_YORK, "13:00", weather))
        assert now < before
        before = now
    # A faint cloud or fog is a small change.
    clear = on_ground(make_lighting(NEW_YORK, "13:00", "clear"))
    for weather in ("clear:cloud_cover=1e-9", "clear:fog_density=1e-12"):
        assert on_ground(make_lighting(NEW_YORK, "13:00", weather)) == pytest.approx(clear, rel=1e-6)


@pytest.mark.parametrize("weather", ["clear", "overcast", "fog"])
@pytest.mark.parametrize(("latitude", "on"), [(40.7, date(2024, 6, 21)), (0.0, date(2024, 3, 20)), (70.0, date(2024, 6, 21))])
def test_no_minute_of_the_day_jumps(latitude: float, on: date, weather: str) -> None:
    place = Location(latitude, 0.0, 0.0, "UTC", 0.0, on)
    start = datetime(on.year, on.month, on.day, tzinfo=UTC)
    before: Lighting | None = None
    # The two hours around sunrise at the equator; elsewhere the hours when the sun or twilight comes up.
    first = {0.0: 4.8, 40.7: 3.0, 70.0: 0.0}[latitude]
    for minute in range(120):
        now = make_lighting(place, start + timedelta(hours=first, minutes=minute), weather)
        if before is not None:
            # Around 7 degrees below the horizon light grows 3.1 times a degree (Janiczek and DeYoung): 29 % a minute at the equator.
            assert abs(math.log(on_ground(now) / on_ground(before))) < 0.4
            ratio = (now.sky_radiance[:32] @ LUMINANCE_FROM_RGB) / (before.sky_radiance[:32] @ LUMINANCE_FROM_RGB)
            assert np.abs(np.log(ratio)).max() < 0.7  # single texels, at the edge of the Earth's shadow, change fastest
            assert np.abs(now.sun.irradiance - before.sun.irradiance).max() < 3000
            # 0.25 degrees a minute, and a fifth more where refraction fades out.
            assert now.sun.direction @ before.sun.direction > math.cos(math.radians(0.35))
            assert abs(now.exposure - before.exposure) < 0.5
        before = now


@pytest.mark.parametrize("elevation", [-20.0, -18.0, -5.0, -1.0, 0.0, 0.5332])
def test_no_second_jumps_where_the_model_changes_hands(elevation: float) -> None:
    # The equator under a full moon: fastest, and with every light in the sky. Bisect for the second when the sun stands there.
    place = Location(0.0, 0.0, 0.0, "UTC", 0.0, date(2024, 3, 25))
    low, high = datetime(2024, 3, 25, 3, tzinfo=UTC), datetime(2024, 3, 25, 12, tzinfo=UTC)
    while high - low > timedelta(seconds=1):
        middle = low + (high - low) / 2
        low, high = (middle, high) if sun_position(place, middle).elevation_degrees < elevation else (low, middle)
    before, after = make_lighting(place, low), make_lighting(place, high)
    # A second at the steepest part of twilight is 0.5 %.
    assert on_ground(after) == pytest.approx(on_ground(before), rel=0.01)
    np.testing.assert_allclose(after.sky_cube, before.sky_cube, rtol=0.015)


def test_the_poles_a_leap_day_and_a_night_when_clocks_change() -> None:
    for latitude in (90.0, -90.0):
        pole = Location(latitude, 0.0, 2800.0, "UTC", 0.0, date(2024, 6, 21))
        for hour in range(0, 24, 3):
            light = make_lighting(pole, f"{hour:02d}:00", "clear")
            check_form(light)
            assert (light.sun.irradiance.max() > 0) == (latitude > 0)
    check_form(make_lighting(NEW_YORK, "2024-02-29T12:00"))
    before, after = (make_lighting(NEW_YORK, f"2024-03-10T{clock}") for clock in ("01:59:59", "03:00"))
    # One second apart, though the clock says an hour.
    assert before.sun.direction @ after.sun.direction > math.cos(math.radians(0.005))


def test_sun_at_the_zenith() -> None:
    place = Location(23.44, 0.0, 0.0, "UTC", 0.0, date(2024, 6, 20))
    light = max((make_lighting(place, f"12:{minute:02d}") for minute in range(0, 6)), key=lambda light: float(light.sun.direction[1]))
    assert light.sun.direction[1] > math.cos(math.radians(0.7))
    check_form(light)
    level = light.sky_cube[[0, 1, 4, 5]]
    np.testing.assert_allclose(level, np.broadcast_to(level.mean(axis=0), (4, 3)), rtol=0.01)


def test_same_question_same_object_and_same_bytes_when_asked_anew() -> None:
    a = make_lighting(NEW_YORK, "13:00", "clear")
    assert make_lighting(NEW_YORK, datetime(2024, 6, 21, 17, tzinfo=UTC), "clear:snow=0") is a
    with pytest.raises(ValueError, match="read-only"):
        a.sky_radiance[0, 0, 0] = 1
    from gi_core.lighting_model import _make_lighting

    _make_lighting.cache_clear()
    again = make_lighting(NEW_YORK, "13:00", "clear")
    assert again is not a
    assert again.digest == a.digest
    assert make_lighting(NEW_YORK, "13:01", "clear").digest != a.digest
    assert make_lighting(NEW_YORK, "13:00", "clear:snow=0.1").digest != a.digest


def test_names_in_the_snapshot() -> None:
    light = make_lighting(NEW_YORK, "13:00", "clear:snow=0.50")
    assert light.time == "2024-06-21T13:00:00-04:00"
    assert light.weather == "clear:snow=0.5"
    assert light.snow == 0.5


def test_bad_questions() -> None:
    with pytest.raises(UnknownTimeError):
        make_lighting(NEW_YORK, "25:99", "clear")
    with pytest.raises(UnknownWeatherError):
        make_lighting(NEW_YORK, "12:00", "plague")


@settings(deadline=None, max_examples=40)
@given(
    latitude=st.floats(-90, 90),
    longitude=st.floats(-180, 180),
    elevation=st.floats(-500, 9000),
    moment=st.datetimes(datetime(1601, 1, 1), datetime(2599, 1, 1)),
    # A new haze builds a new atmosphere (60 ms): a few of them, the extremes included.
    haze=st.sampled_from([WEATHER_RANGES["haze"][0], 0.15, WEATHER_RANGES["haze"][1]]),
    numbers=st.tuples(*[st.floats(*WEATHER_RANGES[name]) for name in ("cloud_cover", "cloud_transmission", "fog_density", "snow")]),
)
def test_no_place_time_or_weather_gives_an_impossible_light(
    latitude: float, longitude: float, elevation: float, moment: datetime, haze: float, numbers: tuple[float, float, float, float]
) -> None:
    cover, transmission, fog, snow = numbers
    weather = Weather("any", cover, transmission, haze, fog, snow)
    place = Location(latitude, longitude, round(elevation, -3), "UTC", 17.0, date(2024, 6, 21))
    light = make_lighting(place, moment.replace(tzinfo=UTC), weather)
    check_form(light)
    assert on_ground(light) < 150e3


def test_moonlight_by_phase_and_distance() -> None:
    def lux(phase: float, distance: float) -> float:
        moon = MoonPosition(0.0, 45.0, 45.0, distance, phase)
        return float(LUMINANCE_FROM_RGB @ RGB_FROM_SPECTRUM @ moon_spectrum(moon))

    mean = MEAN_MOON_DISTANCE_AU
    assert lux(0.0, mean) == pytest.approx(10.7639 * 10 ** (-0.4 * 3.84), rel=1e-6)
    # A half moon gives far less than half: its soil is rough. Between a ninth and a twelfth, by every photometry.
    assert 9 < lux(0.0, mean) / lux(90.0, mean) < 12
    assert lux(0.0, 0.9 * mean) / lux(0.0, mean) == pytest.approx(1 / 0.81, rel=1e-9)
    assert lux(180.0, mean) < 1e-3 * lux(0.0, mean)


@pytest.mark.parametrize(("day", "distance"), [("2024-01-03", 0.98331), ("2024-07-05", 1.01673)])
def test_the_sun_is_stronger_in_january(day: str, distance: float) -> None:
    light = make_lighting(NEW_YORK, f"{day}T12:00", "clear")
    elevation = math.degrees(math.asin(light.sun.direction[1]))
    at_one_au = beam_irradiance(atmosphere(0.15, NEW_YORK.elevation_m / 1000), elevation, np.ones(8))
    np.testing.assert_allclose(light.sun.irradiance, at_one_au / distance**2, rtol=1e-4)


def test_exposure_of_a_grey_scene() -> None:
    # A grey of 18 % under pi / 0.18 lx has a luminance of 1 cd/m2: EV100 is 3.
    assert exposure_value(np.full(3, math.pi / 0.18)) == pytest.approx(3.0)
