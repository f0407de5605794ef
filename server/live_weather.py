"""Where the live world's weather comes from: a text, a script, a measured year; and how one turns into another."""

from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from gi_core.epw_weather import EpwWeather
from gi_core.errors import InputError
from gi_core.weather import WEATHER_RANGES, Weather, between, parse_weather, weather_of
from gi_core.weather_script import WeatherScript
from gi_core.world import Location
from server.json_input import Members, shown

MAX_BLEND_S = 86_400.0
_MEMBERS = ("weather", "script_seed", "measured", "blend_s")


@dataclass(frozen=True, eq=False)
class WeatherSource:
    """A weather for every moment.

    at : from an aware moment to its weather; description : what PUT /v1/weather takes to get it again
    is_blend : whether it turned out of another one
    """

    at: Callable[[datetime], Weather]
    description: dict[str, Any]
    is_blend: bool = False


def fixed_weather(text: str) -> WeatherSource:
    """One weather for all time. Raises UnknownWeatherError."""
    weather = parse_weather(text)
    return WeatherSource(lambda _: weather, {"weather": weather.text})


def scripted_weather(seed: int, location: Location) -> WeatherSource:
    """A seeded script's. Raises InputError."""
    return WeatherSource(WeatherScript(seed, location).at, {"script_seed": seed})


def measured_weather(year: EpwWeather) -> WeatherSource:
    """A measured year's."""
    return WeatherSource(year.at, {"measured": True})


def weather_from_json(record: Any, location: Location, measured: EpwWeather | None) -> tuple[WeatherSource, float]:
    """The source that a request asks for, and over how many seconds of the world's time the present weather turns into it.

    One of ``weather`` (a text as queries take it), ``script_seed`` and ``measured``; ``blend_s`` may stand beside it. Raises InputError.
    """
    members = Members(record, "weather", _MEMBERS)
    named = [name for name in _MEMBERS[:3] if name in members]
    if len(named) != 1:
        raise InputError(f"weather: expected one of weather, script_seed and measured, found {', '.join(named) or 'none'}")
    blend_s = members.number("blend_s", 0.0, 0.0, MAX_BLEND_S)
    if named == ["weather"]:
        text = members.value("weather")
        if not isinstance(text, str):
            raise InputError(f"weather: weather: expected a text, found {shown(text)}")
        return fixed_weather(text), blend_s
    if named == ["script_seed"]:
        return scripted_weather(members.integer("script_seed", None, 0, 2**63 - 1), location), blend_s
    if not members.flag("measured", False):
        raise InputError("weather: measured: expected true, found false; name a weather or a script instead")
    if measured is None:
        raise InputError("weather: measured: expected a server that was started with --epw FILE, found none")
    return measured_weather(measured), blend_s


def blended(before: WeatherSource, after: WeatherSource, since: datetime, blend_s: float) -> WeatherSource:
    """``after``, but within ``blend_s`` of the world's time from ``since`` on, in between: continuous in every number."""
    if blend_s <= 0:
        return after
    if before.is_blend:
        # From where that one has got to: else each blend would hold all those before it, and ask them.
        reached = before.at(since)
        before = WeatherSource(lambda _: reached, {})

    begin = since.astimezone(UTC)  # datetimes of one zone are subtracted as their clocks read, which change twice a year

    def at(moment: datetime) -> Weather:
        share = (moment - begin).total_seconds() / blend_s
        if not 0 <= share < 1:
            # A clock that jumped back finds what is, not what was: the change was made.
            return after.at(moment)
        share *= share * (3 - 2 * share)
        first, second = before.at(moment), after.at(moment)
        return weather_of({name: between(getattr(first, name), getattr(second, name), share) for name in WEATHER_RANGES})

    return WeatherSource(at, after.description, is_blend=True)
