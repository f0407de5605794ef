"""The text by which a request names a weather."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gi_core.errors import UnknownWeatherError
from gi_core.weather import WEATHER_RANGES, Weather, parse_weather, weather_presets


def test_the_presets_of_the_contract_exist_and_are_what_they_say() -> None:
    assert weather_presets() == ["clear", "partly_cloudy", "overcast", "fog", "haze", "rain", "snow"]
    weather = {name: parse_weather(name) for name in weather_presets()}
    assert weather["clear"].cloud_cover == weather["clear"].snow == 0
    assert 0 < weather["partly_cloudy"].cloud_cover < weather["overcast"].cloud_cover == 1
    assert weather["haze"].haze > weather["clear"].haze
    assert weather["fog"].fog_density == max(w.fog_density for w in weather.values())
    assert weather["rain"].cloud_transmission < weather["overcast"].cloud_transmission
    assert weather["snow"].snow == 1


def test_strength_goes_from_clear_to_the_preset() -> None:
    clear, snow = parse_weather("clear"), parse_weather("snow")
    some = parse_weather("snow:0.7")
    assert some.snow == pytest.approx(0.7)
    for name in WEATHER_RANGES:
        assert getattr(some, name) == pytest.approx(0.3 * getattr(clear, name) + 0.7 * getattr(snow, name))
    assert parse_weather("snow:1") == snow
    nothing = parse_weather("snow:0")
    assert all(getattr(nothing, name) == getattr(clear, name) for name in WEATHER_RANGES)


def test_numbers_replace_those_of_the_preset() -> None:
    weather = parse_weather("clear:cloud_cover=0.3,snow=0.5")
    assert (weather.cloud_cover, weather.snow) == (0.3, 0.5)
    assert weather.haze == parse_weather("clear").haze
    both = parse_weather("overcast:0.5,snow=0.2")
    assert (both.cloud_cover, both.snow) == (0.5, 0.2)


def test_text_is_normalised_and_reads_back() -> None:
    assert parse_weather(" clear:snow=0.50, cloud_cover = .3 ").text == "clear:cloud_cover=0.3,snow=0.5"
    assert parse_weather("clear:snow=0,haze=0.15").text == "clear"
    assert parse_weather("clear:snow=-0.0").text == "clear"
    assert parse_weather("overcast:1.0").text == "overcast"


@pytest.mark.parametrize(
    "text",
    [
        "plague", "", ":", "clear:", "clear:,", "Clear", "clear:wind=3", "clear:snow", "clear:snow=", "clear:snow=nan", "clear:snow=inf",
        "clear:snow=2", "clear:snow=-1", "clear:haze=0", "clear:snow=0.1,snow=0.2", "snow:1.5", "snow:-0.1", "snow:nan", "snow:0.5,0.5",
        "clear:snow=0.1,0.5", "clear:text=1", "clear" * 100, "clear:" + "snow=0.1," * 100,
    ],
)  # fmt: skip
def test_anything_else_is_refused_in_one_short_line(text: str) -> None:
    with pytest.raises(UnknownWeatherError) as refused:
        parse_weather(text)
    assert "\n" not in str(refused.value)
    assert len(str(refused.value)) < 600


def test_the_refusal_lists_presets_and_overrides() -> None:
    with pytest.raises(UnknownWeatherError) as refused:
        parse_weather("plague")
    for word in (*weather_presets(), *WEATHER_RANGES):
        assert word in str(refused.value)


def test_a_weather_made_by_hand_is_checked_too() -> None:
    with pytest.raises(UnknownWeatherError, match=r"cloud_cover within 0\.\.1, got nan"):
        Weather("mine", float("nan"), 0.5, 0.1, 0.0, 0.0)


@given(st.text(max_size=40) | st.text("clearsnow:=,.0123456789_", max_size=40).map(lambda rest: "snow:" + rest))
def test_no_text_does_anything_but_parse_or_be_refused(text: str) -> None:
    try:
        weather = parse_weather(text)
    except UnknownWeatherError:
        return
    assert parse_weather(weather.text) == weather


@given(
    st.sampled_from(["clear", "overcast", "snow"]),
    st.fixed_dictionaries({}, optional={name: st.floats(*bounds) for name, bounds in WEATHER_RANGES.items()}),
)
def test_every_weather_reads_back_exactly(preset: str, numbers: dict[str, float]) -> None:
    text = preset + ":" * bool(numbers) + ",".join(f"{name}={value!r}" for name, value in numbers.items())
    weather = parse_weather(text)
    assert all(getattr(weather, name) == value for name, value in numbers.items())
    assert parse_weather(weather.text) == weather
