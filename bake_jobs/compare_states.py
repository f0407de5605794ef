"""The moments at which a dataset is compared: a name, a local time, a weather."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta

from gi_core.clock_time import local_time, parse_time
from gi_core.errors import InputError
from gi_core.sun import sun_position
from gi_core.weather import parse_weather
from gi_core.world import Location

DEFAULT_STATES = ("noon", "low_sun", "overcast", "night", "snow")
LOW_SUN_DEGREES = 5.0
NIGHT_DEGREES = -12.0  # the end of nautical twilight: what the sky still sends is less than any lamp
_NIGHT_STEP = timedelta(minutes=10)
_ALLOWED = f"{', '.join(DEFAULT_STATES)}, or NAME=TIME/WEATHER such as dusk=20:45/partly_cloudy"


@dataclass(frozen=True)
class State:
    """A moment to compare at. time and weather are texts as requests give them."""

    name: str
    time: str
    weather: str


def parse_states(names: Sequence[str], location: Location) -> list[State]:
    """States by name, in order; a bare time means ``location.date``.

    noon : clear, 12:00; low_sun : clear, the evening's moment with the sun 5 degrees up; overcast : overcast, 12:00; night : clear, the
    darkest moment (``night_time``); snow : snow, 12:00.
    Raises InputError for an unknown or repeated name, UnknownTimeError and UnknownWeatherError for what they do not know.
    """
    states = [_parse(text.strip(), location) for text in names]
    if not states or len({state.name for state in states}) < len(states):
        raise InputError(f"states {','.join(names)[:200]!r}: expected distinct names, at least one: {_ALLOWED}")
    return states


def _parse(text: str, location: Location) -> State:
    if text == "noon":
        return State(text, "12:00", "clear")
    if text == "overcast":
        return State(text, "12:00", "overcast")
    if text == "snow":
        return State(text, "12:00", "snow")
    if text == "low_sun":
        return State(text, _text(low_sun_time(location)), "clear")
    if text == "night":
        return State(text, _text(night_time(location)), "clear")
    name, equals, moment = text.partition("=")
    time, slash, weather = moment.partition("/")
    if not (name and equals and slash):
        raise InputError(f"state {text[:60]!r}: expected {_ALLOWED}")
    parse_time(time, location)
    parse_weather(weather)
    return State(name, time, weather)


def _text(moment: datetime) -> str:
    return moment.replace(tzinfo=None).isoformat(timespec="seconds")


def low_sun_time(location: Location) -> datetime:
    """The second of ``location.date``, after 12:00 local time, at which the sun sinks through 5 degrees.

    Raises InputError where it does not that day.
    """
    noon = parse_time("12:00", location)

    def elevation_degrees(seconds: int) -> float:
        return sun_position(location, local_time(noon + timedelta(seconds=seconds), location)).elevation_degrees

    high, low = 0, 12 * 3600 - 1
    if not elevation_degrees(high) > LOW_SUN_DEGREES > elevation_degrees(low):
        raise InputError(
            f"state 'low_sun': on {location.date} at latitude {location.latitude_degrees:g} the sun does not sink through "
            f"{LOW_SUN_DEGREES:g} degrees between 12:00 and midnight; name a time, as in low_sun=20:00/clear"
        )
    while low - high > 1:
        middle = (low + high) // 2
        high, low = (middle, low) if elevation_degrees(middle) > LOW_SUN_DEGREES else (high, middle)
    return local_time(noon + timedelta(seconds=low), location)


def night_time(location: Location) -> datetime:
    """The darkest moment, to ten minutes, of the first day from ``location.date`` on that has the sun below -12 degrees.

    A high summer's nights are brighter than that: north of 54 degrees a June's ``night`` lies weeks later.
    """
    for day in range(366):
        start = parse_time("00:00", location) + timedelta(days=day)
        moments = [local_time(start + place * _NIGHT_STEP, location) for place in range(timedelta(days=1) // _NIGHT_STEP)]
        heights = [sun_position(location, moment).elevation_degrees for moment in moments]
        if min(heights) < NIGHT_DEGREES:
            return moments[heights.index(min(heights))]
    raise InputError(f"state 'night': the sun does not sink below {NIGHT_DEGREES:g} degrees within a year of {location.date}; name a time")
