"""One weather turns into another."""

from datetime import UTC, datetime, timedelta
from zoneinfo import ZoneInfo

import pytest

from gi_core.weather import WEATHER_RANGES, Weather
from gi_core.world import Location
from server.live_weather import WeatherSource, blended, fixed_weather, scripted_weather

NOON = datetime(2024, 6, 21, 12, tzinfo=UTC)


def after(seconds: float) -> datetime:
    return NOON + timedelta(seconds=seconds)


def numbers(weather: Weather) -> list[float]:
    return [getattr(weather, name) for name in WEATHER_RANGES]


def test_a_blend_starts_and_ends_where_it_should() -> None:
    clear, fog = fixed_weather("clear"), fixed_weather("fog")
    blend = blended(clear, fog, NOON, 100)
    assert numbers(blend.at(NOON)) == numbers(clear.at(NOON))
    assert numbers(blend.at(after(100))) == numbers(fog.at(NOON))
    middle = [(a + b) / 2 for a, b in zip(numbers(clear.at(NOON)), numbers(fog.at(NOON)), strict=True)]
    assert numbers(blend.at(after(50))) == pytest.approx(middle)
    assert blend.description == {"weather": "fog"}
    assert blended(clear, fog, NOON, 0) is fog


def test_a_blend_takes_as_long_when_clocks_go_back_meanwhile() -> None:
    zone = ZoneInfo("America/New_York")
    since = datetime(2024, 11, 3, 1, 30, tzinfo=zone)  # half an hour before
    blend = blended(fixed_weather("clear"), fixed_weather("fog"), since, 3600)
    # 01:15 for the second time: three quarters of the hour have passed.
    assert blend.at(datetime(2024, 11, 3, 1, 15, fold=1, tzinfo=zone)) == blended(
        fixed_weather("clear"), fixed_weather("fog"), NOON, 3600
    ).at(after(2700))


def test_a_script_goes_on_while_another_weather_takes_over() -> None:
    script = scripted_weather(5, Location())
    blend = blended(script, fixed_weather("fog"), NOON, 86_400)
    assert numbers(blend.at(after(1))) == pytest.approx(numbers(script.at(after(1))), abs=1e-6)


def test_a_blend_of_a_blend_goes_on_from_where_that_got_to() -> None:
    first = blended(fixed_weather("clear"), fixed_weather("fog"), NOON, 100)
    second = blended(first, fixed_weather("snow"), after(50), 100)
    assert numbers(second.at(after(50))) == numbers(first.at(after(50)))
    assert numbers(second.at(after(150))) == numbers(fixed_weather("snow").at(NOON))


def test_a_slider_that_is_dragged_for_hours_costs_no_more_than_one() -> None:
    """Each blend asks the one before where it has got to, once; held on to, they would be as deep as Python can go."""
    source: WeatherSource = fixed_weather("clear")
    for number in range(3000):
        source = blended(source, fixed_weather(f"fog:{number / 3000}"), after(number), 600)
    assert source.at(after(3000)).fog_density > 0
