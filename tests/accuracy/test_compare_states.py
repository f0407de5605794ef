"""Moments of comparison by name."""

from dataclasses import replace
from datetime import date

import pytest

from bake_jobs.compare_states import DEFAULT_STATES, State, low_sun_time, night_time, parse_states
from gi_core.clock_time import parse_time
from gi_core.errors import InputError, UnknownTimeError, UnknownWeatherError
from gi_core.sun import sun_position
from gi_core.world import Location


def test_default_states():
    noon, low_sun, overcast, night, snow = parse_states(DEFAULT_STATES, Location())
    assert (noon.time, noon.weather) == ("12:00", "clear")
    assert (overcast.time, overcast.weather) == ("12:00", "overcast")
    assert (snow.time, snow.weather) == ("12:00", "snow")
    assert night == State("night", night_time(Location()).strftime("%Y-%m-%dT%H:%M:%S"), "clear")
    assert low_sun.weather == "clear"
    sun = sun_position(Location(), parse_time(low_sun.time, Location()))
    assert sun.elevation_degrees == pytest.approx(5, abs=0.004)  # the sun sinks by at most 0.0042 degrees a second
    assert sun.azimuth_degrees > 180  # in the west


@pytest.mark.parametrize(
    "place",
    [
        Location(latitude_degrees=-33.9, longitude_degrees=151.2, timezone="Australia/Sydney", date=date(2024, 12, 21)),
        Location(latitude_degrees=48.1, longitude_degrees=11.6, timezone="Europe/Berlin", date=date(2024, 10, 27)),  # clocks change
        Location(latitude_degrees=0.0, longitude_degrees=36.8, timezone="Africa/Nairobi", date=date(2024, 3, 20)),
    ],
)
def test_low_sun_holds_anywhere(place):
    assert sun_position(place, low_sun_time(place)).elevation_degrees == pytest.approx(5, abs=0.005)


@pytest.mark.parametrize("latitude", [80.0, -80.0])
def test_polar_day_and_night_have_no_low_sun(latitude):
    with pytest.raises(InputError, match="does not sink through 5 degrees"):
        parse_states(["low_sun"], replace(Location(), latitude_degrees=latitude))


@pytest.mark.parametrize(
    "place",
    [
        Location(),
        Location(latitude_degrees=-33.9, longitude_degrees=151.2, timezone="Australia/Sydney", date=date(2024, 12, 21)),
        Location(latitude_degrees=48.1, longitude_degrees=11.6, timezone="Europe/Berlin", date=date(2024, 10, 27)),  # clocks change
        Location(latitude_degrees=70.0, longitude_degrees=20.0, timezone="Europe/Oslo", date=date(2024, 12, 21)),  # no day at all
    ],
)
def test_night_is_the_darkest_moment_of_the_date(place):
    moment = night_time(place)
    assert moment.date() == place.date
    darkest = sun_position(place, moment).elevation_degrees
    assert darkest < -12
    hours = [sun_position(place, parse_time(f"{hour:02}:{minute:02}", place)).elevation_degrees for hour in range(24) for minute in (0, 30)]
    assert darkest < min(hours) + 0.05  # within ten minutes of its lowest the sun moves by less


@pytest.mark.parametrize("latitude", [60.0, 90.0])
def test_after_white_nights_comes_a_dark_one(latitude):
    place = replace(Location(), latitude_degrees=latitude)
    moment = night_time(place)
    assert sun_position(place, moment).elevation_degrees < -12
    assert place.date < moment.date() < date(2024, 12, 21)


def test_own_states():
    assert parse_states(["dusk=20:45/partly_cloudy", " noon "], Location()) == [
        State("dusk", "20:45", "partly_cloudy"),
        State("noon", "12:00", "clear"),
    ]


@pytest.mark.parametrize(
    ("names", "error", "said"),
    [
        (["dawn"], InputError, "expected noon, low_sun, overcast, night, snow"),
        ([], InputError, "at least one"),
        (["noon", "noon"], InputError, "distinct"),
        (["a=25:00/clear"], UnknownTimeError, "25:00"),
        (["a=12:00/plague"], UnknownWeatherError, "plague"),
        (["a=12:00"], InputError, "NAME=TIME/WEATHER"),
    ],
)
def test_what_is_not_a_state_is_refused(names, error, said):
    with pytest.raises(error, match=said):
        parse_states(names, Location())
