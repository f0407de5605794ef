"""The weather: a handful of numbers, presets for them, and the text by which a request names one.

clear                            a preset
snow:0.7                         seven tenths of the way from ``clear`` to a preset
clear:cloud_cover=0.3,snow=0.5   a preset with some of its numbers replaced
overcast:0.5,snow=0.2            both
"""

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from types import MappingProxyType

from gi_core.errors import UnknownWeatherError

# Least and greatest value of each number; beyond them the sky model has not been looked at.
WEATHER_RANGES = MappingProxyType(
    {
        "cloud_cover": (0.0, 1.0),
        "cloud_transmission": (0.05, 1.0),
        "haze": (0.02, 2.0),
        "fog_density": (0.0, 0.2),
        "snow": (0.0, 1.0),
    }
)
_LONGEST_TEXT = 200
_LONGEST_ECHO = 60


@dataclass(frozen=True)
class Weather:
    """The weather of one moment. More of anything but cloud_transmission and snow is darker sunlight and whiter sky.

    text : the weather as asked for, normalised; equal texts are equal weathers
    cloud_cover : 0..1, share of the sky that clouds hide; they hide the same share of the sun's beam
    cloud_transmission : 0.05..1, share of light that clouds let through
    haze : 0.02..2, optical depth of aerosol at 550 nm (0.05 polar air, 0.1 clear, 0.3 city, 1 smog)
    fog_density : 0..0.2, extinction at the ground [m^-1]; visibility is about 3.9 / fog_density
    snow : 0..1, how much of the ground's snow attribute is covered
    """

    text: str
    cloud_cover: float
    cloud_transmission: float
    haze: float
    fog_density: float
    snow: float

    def __post_init__(self) -> None:
        for name, (low, high) in WEATHER_RANGES.items():
            value = getattr(self, name)
            if not low <= value <= high:
                raise UnknownWeatherError(f"weather {self.text[:_LONGEST_ECHO]!r}: expected {name} within {low:g}..{high:g}, got {value!r}")


def weather_presets() -> list[str]:
    """Names of the presets."""
    return list(_presets())


def parse_weather(text: str) -> Weather:
    """The weather that a text names; see the top of this file. Raises UnknownWeatherError, which lists what is allowed."""
    name, _, rest = text.strip().partition(":")
    presets = _presets()
    if len(text) > _LONGEST_TEXT or name not in presets:
        raise UnknownWeatherError(f"weather {text[:_LONGEST_ECHO]!r}: expected {_allowed()}")
    values = dict(presets[name])
    strength = 1.0
    overrides: dict[str, float] = {}
    for place, part in enumerate(rest.split(",") if ":" in text else ()):
        key, equals, number = (piece.strip() for piece in part.partition("="))
        if equals and key in values and key not in overrides:
            overrides[key] = _number(number, text)
        elif not equals and place == 0:
            strength = _number(key, text)
            if not 0 <= strength <= 1:
                raise UnknownWeatherError(f"weather {text[:_LONGEST_ECHO]!r}: expected a strength of 0..1, got {strength!r}")
        else:
            raise UnknownWeatherError(
                f"weather {text[:_LONGEST_ECHO]!r}: did not understand {part[:_LONGEST_ECHO]!r}; expected {_allowed()}"
            )
    if strength != 1.0:
        values = {key: (1 - strength) * presets["clear"][key] + strength * value for key, value in values.items()}
    changed = {key: value for key, value in sorted(overrides.items()) if value != values[key]}
    options = [repr(strength)] * (strength != 1.0) + [f"{key}={value!r}" for key, value in changed.items()]
    return Weather(name + ":" * bool(options) + ",".join(options), **{**values, **changed})


def weather_of(numbers: Mapping[str, float]) -> Weather:
    """The weather of numbers by their names; those of ``clear`` where one is left out. Its text reads back as the same weather.

    Raises UnknownWeatherError for other names, and for numbers out of range.
    """
    return parse_weather("clear:" + ",".join(f"{name}={float(value)!r}" for name, value in numbers.items()) if numbers else "clear")


def between(first: float, second: float, share: float) -> float:
    """The number a share 0..1 of the way from one to another; never beyond either, as rounding could put it."""
    blend = (1 - share) * first + share * second
    return min(max(blend, min(first, second)), max(first, second))


def as_weather(weather: Weather | str) -> Weather:
    """A weather given as itself or as text."""
    return weather if isinstance(weather, Weather) else parse_weather(weather)


def _number(text: str, whole: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise UnknownWeatherError(
            f"weather {whole[:_LONGEST_ECHO]!r}: expected a number, got {text[:_LONGEST_ECHO]!r}; expected {_allowed()}"
        )
    return value + 0.0  # -0.0 becomes 0.0, so that equal weathers have equal texts


def _allowed() -> str:
    ranges = ", ".join(f"{name}={low:g}..{high:g}" for name, (low, high) in WEATHER_RANGES.items())
    return f"one of {', '.join(_presets())}; a strength may follow, as in snow:0.7, or numbers, as in clear:snow=0.5 ({ranges})"


@cache
def _presets() -> dict[str, dict[str, float]]:
    """The presets in full, in the order of the file."""
    tables = tomllib.loads(resources.files("gi_core").joinpath("weather_presets.toml").read_text(encoding="utf-8"))
    return {name: {**tables["clear"], **table} for name, table in tables.items()}
