"""The chain that a weather script walks: kinds of spell, how long they last, what follows; read from weather_chain.toml."""

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any

from gi_core.errors import InputError
from gi_core.weather import weather_presets

LONGEST_SPELL_HOURS = 240.0
# Shorter ones could not blend into their neighbours without a visible jump.
SHORTEST_SPELL_HOURS = 0.5
_LONGEST_ECHO = 60


@dataclass(frozen=True)
class SpellKind:
    """One state of the chain.

    preset, cold_preset : names of presets; the second is how the spell looks below freezing
    shortest_hours, longest_hours : lengths in between are equally likely
    rain_mm_h : precipitation as water [mm/h]
    next_kinds, next_odds : what follows, and cumulative odds that end with 1
    """

    preset: str
    cold_preset: str
    shortest_hours: float
    longest_hours: float
    rain_mm_h: float
    next_kinds: tuple[str, ...]
    next_odds: tuple[float, ...]


@dataclass(frozen=True)
class Climate:
    """Air temperature [C]: a mean, half its swing over a year and over a day, the half width of a spell's own; the warmest day 1..366."""

    mean_c: float
    year_c: float
    day_c: float
    spell_c: float
    warmest_day: float


@dataclass(frozen=True)
class WeatherChain:
    """Kinds of spell by name, the hub that every stretch of weather begins with, and the least and greatest time of a blend [h]."""

    kinds: Mapping[str, SpellKind]
    hub: str
    blend_hours: tuple[float, float]
    climate: Climate


def parse_chain(text: str) -> WeatherChain:
    """A chain from TOML; weather_chain.toml shows its form. Raises InputError that says which field is wrong."""
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"weather chain: {error}") from error
    kinds = data.get("kind")
    if not isinstance(kinds, dict) or not kinds:
        raise InputError("weather chain: expected tables [kind.NAME], found none")
    hub = data.get("hub")
    if not isinstance(hub, str) or hub not in kinds:
        raise InputError(f"weather chain: hub: expected one of {', '.join(kinds)}, got {str(hub)[:_LONGEST_ECHO]!r}")
    parsed = {name: _kind(name, table, kinds) for name, table in kinds.items()}
    for name, kind in parsed.items():
        if name != hub and hub not in kind.next_kinds:
            raise InputError(f"weather chain: kind.{name}.next: expected a weight for the hub {hub!r}, found none")
    climate = data.get("temperature")
    bounds = {"mean_c": (-60, 60), "year_c": (0, 60), "day_c": (0, 30), "spell_c": (0, 30), "warmest_day": (1, 366)}
    numbers = {key: _number(climate, key, f"temperature.{key}", *bound) for key, bound in bounds.items()}
    return WeatherChain(parsed, hub, _pair(data, "blend_hours", "blend_hours", 1 / 60), Climate(**numbers))


@cache
def temperate_chain() -> WeatherChain:
    """The chain of weather_chain.toml."""
    return parse_chain(resources.files("gi_core").joinpath("weather_chain.toml").read_text(encoding="utf-8"))


def _kind(name: str, table: object, kinds: Mapping[str, Any]) -> SpellKind:
    where = f"kind.{name[:_LONGEST_ECHO]}"
    if not isinstance(table, dict):
        raise InputError(f"weather chain: {where}: expected a table, got {type(table).__name__}")
    preset = table.get("preset")
    cold = table.get("cold_preset", preset)
    for given in (preset, cold):
        if given not in weather_presets():
            raise InputError(f"weather chain: {where}: expected a preset of {weather_presets()}, got {str(given)[:_LONGEST_ECHO]!r}")
    following = table.get("next")
    if not isinstance(following, dict) or not following or not set(following) <= set(kinds) - {name}:
        raise InputError(f"weather chain: {where}.next: expected weights of other kinds ({', '.join(kinds)})")
    weights = [_number(following, key, f"{where}.next.{key}", 1e-6, 1e6) for key in following]
    total = math.fsum(weights)
    odds = tuple(math.fsum(weights[: n + 1]) / total for n in range(len(weights)))
    shortest, longest = _pair(table, "hours", f"{where}.hours", SHORTEST_SPELL_HOURS)
    rain = _number(table, "rain_mm_h", f"{where}.rain_mm_h", 0.0, 100.0) if "rain_mm_h" in table else 0.0
    return SpellKind(str(preset), str(cold), shortest, longest, rain, tuple(following), odds)


def _pair(table: Mapping[str, Any], key: str, where: str, least: float) -> tuple[float, float]:
    pair = table.get(key)
    if not isinstance(pair, list) or len(pair) != 2:
        raise InputError(f"weather chain: {where}: expected [shortest, longest] hours, got {str(pair)[:_LONGEST_ECHO]}")
    numbers = {"shortest": pair[0], "longest": pair[1]}
    low = _number(numbers, "shortest", where, least, LONGEST_SPELL_HOURS)
    return low, _number(numbers, "longest", where, low, LONGEST_SPELL_HOURS)


def _number(table: object, key: str, where: str, low: float, high: float) -> float:
    value = table.get(key) if isinstance(table, dict) else None
    # Written so that NaN is refused too.
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise InputError(f"weather chain: {where}: expected a number of {low:g}..{high:g}, got {str(value)[:_LONGEST_ECHO]}")
    return float(value)
