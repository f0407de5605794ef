"""Weather that changes by itself: spells drawn from a Markov chain, blended into each other, with the snow that they leave behind.

    time   | stretch -1        | stretch 0                               | stretch 1
    spells | ... wet | overcast | hub  | clear      | haze | clear        | hub | overcast ...

The weather is a pure function of seed, place and moment. Time is cut into stretches of a twelfth of a year; each is drawn from a
generator of its own and begins with the chain's hub, which any kind may turn into. So a moment centuries away costs what the next one
does, and a clock that runs backwards meets the same weather. Twelve stretches are a snow year, from one warmest day to the next; in the
last of them no snow gathers and what lies thaws, so that each snow year begins with bare ground and none depends on another.
"""

import math
from bisect import bisect_right
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import lru_cache

import numpy as np

from gi_core import snow_pack
from gi_core.errors import InputError
from gi_core.weather import WEATHER_RANGES, Weather, between, parse_weather, weather_of
from gi_core.weather_chain import SHORTEST_SPELL_HOURS, Climate, SpellKind, WeatherChain, temperate_chain
from gi_core.world import Location

_YEAR_HOURS = 365.2425 * 24
_STRETCHES = 12  # in a snow year
_STRETCH_HOURS = _YEAR_HOURS / _STRETCHES
_ORIGIN = datetime(2000, 1, 1, tzinfo=UTC)
_WARMEST_HOUR = 15.0
# Melt that clears the deepest pack within the snow year's last stretch.
_THAW_MM_H = snow_pack.DEEPEST_MM / _STRETCH_HOURS
_SNOW_STEP_HOURS = 1.0  # temperature is taken as constant over it
_BLENDED = tuple(name for name in WEATHER_RANGES if name != "snow")


@dataclass(frozen=True)
class Spell:
    """A run of one kind of weather.

    kind : of the chain; start_hours, end_hours : since the script's origin
    preset : how it looks; blend_hours : how long turning into the next spell takes, if that one is long enough
    precipitation_mm_h : as water; warmth_c : how much warmer than the season's mean
    """

    kind: str
    start_hours: float
    end_hours: float
    preset: str
    blend_hours: float
    precipitation_mm_h: float
    warmth_c: float


class WeatherScript:
    """The weather over a place for a seed. Safe to share between threads; keeps the last few years that were asked for."""

    def __init__(self, seed: int, location: Location, chain: WeatherChain | None = None) -> None:
        """seed : 0..2**63 - 1; chain : weather_chain.toml's when None. Raises InputError for another seed."""
        if not 0 <= seed < 2**63:
            raise InputError(f"weather script: expected a seed of 0..2**63 - 1, got {seed}")
        self._seed = seed
        self._chain = chain or temperate_chain()
        climate = self._chain.climate
        # South of the equator the warmest day lies half a year off. Hours are solar ones: no clock change moves the weather.
        warmest_day = climate.warmest_day + (0.0 if location.latitude_degrees >= 0 else 365.2425 / 2)
        self._solar_hours = location.longitude_degrees / 15
        self._origin_hours = (warmest_day - 1) * 24
        self._presets = {name: parse_weather(name) for kind in self._chain.kinds.values() for name in (kind.preset, kind.cold_preset)}
        self._stretch = lru_cache(maxsize=4 * _STRETCHES)(self._drawn)
        self._snow = lru_cache(maxsize=2 * _STRETCHES)(self._settled)

    def at(self, moment: datetime) -> Weather:
        """The weather at an aware moment. Raises InputError for a naive one."""
        hours = self._hours(moment)
        return weather_of({**self._sky(hours), "snow": snow_pack.cover(self._snow_water(hours))})

    def spell_at(self, moment: datetime) -> Spell:
        """The spell that an aware moment lies in."""
        spells, number = self._around(self._hours(moment))
        return spells[number]

    def temperature_c(self, moment: datetime) -> float:
        """Air temperature of the season and the hour, without the spells' own warmth."""
        return _temperature(self._chain.climate, self._hours(moment))

    def _hours(self, moment: datetime) -> float:
        """Solar hours since the origin: midnight of the warmest day of 2000."""
        if moment.tzinfo is None:
            raise InputError(f"weather script: expected a time with an offset, got {moment.isoformat()}")
        return (moment - _ORIGIN) / timedelta(hours=1) + self._solar_hours - self._origin_hours

    def _around(self, hours: float) -> tuple[tuple[Spell, ...], int]:
        """Spells of a stretch with the neighbours' nearest ones, and which of them an hour lies in."""
        number = math.floor(hours / _STRETCH_HOURS)
        spells = (self._stretch(number - 1)[-1], *self._stretch(number), self._stretch(number + 1)[0])
        found = bisect_right(spells, hours, key=lambda spell: spell.start_hours) - 1
        return spells, min(max(found, 1), len(spells) - 2)

    def _sky(self, hours: float) -> dict[str, float]:
        spells, number = self._around(hours)
        here = spells[number]
        after = hours > (here.start_hours + here.end_hours) / 2
        old, new = (here, spells[number + 1]) if after else (spells[number - 1], here)
        # Blends take a third of the shorter spell at most: two never meet.
        width = min(old.blend_hours, *((spell.end_hours - spell.start_hours) / 3 for spell in (old, new)))
        share = min(max((hours - old.end_hours) / width + 0.5, 0.0), 1.0)
        share *= share * (3 - 2 * share)
        first, second = self._presets[old.preset], self._presets[new.preset]
        return {name: between(getattr(first, name), getattr(second, name), share) for name in _BLENDED}

    def _drawn(self, number: int) -> tuple[Spell, ...]:
        """The spells of a stretch."""
        signed = 2 * number if number >= 0 else -2 * number - 1
        rng = np.random.default_rng([self._seed, signed])
        chain, end = self._chain, (number + 1) * _STRETCH_HOURS
        name, start = chain.hub, number * _STRETCH_HOURS
        spells: list[Spell] = []
        while start < end:
            kind = chain.kinds[name]
            length, blend, warmth, following = rng.random(4).tolist()
            until = start + kind.shortest_hours + length * (kind.longest_hours - kind.shortest_hours)
            if until > end - SHORTEST_SPELL_HOURS:
                until = end
            spells.append(self._spell(name, kind, start, until, blend, chain.climate.spell_c * (2 * warmth - 1)))
            start, name = until, kind.next_kinds[bisect_right(kind.next_odds[:-1], following)]
        return tuple(spells)

    def _spell(self, name: str, kind: SpellKind, start: float, end: float, blend: float, warmth_c: float) -> Spell:
        frozen = (
            _temperature(self._chain.climate, (start + end) / 2) + warmth_c < (snow_pack.ALL_SNOW_BELOW_C + snow_pack.ALL_RAIN_ABOVE_C) / 2
        )
        low, high = self._chain.blend_hours
        preset = kind.cold_preset if frozen else kind.preset
        return Spell(name, start, end, preset, low + blend * (high - low), kind.rain_mm_h, warmth_c)

    def _snow_water(self, hours: float) -> float:
        """The pack [mm of water]."""
        knots, water, rates = self._snow(math.floor(hours / _STRETCH_HOURS))
        last = max(bisect_right(knots, hours) - 1, 0)
        return snow_pack.step(water[last], rates[last], max(hours - knots[last], 0.0))

    def _settled(self, number: int) -> tuple[list[float], list[float], list[snow_pack.SnowRates]]:
        """Of a stretch: hours at which the rates change, the pack then, and the rates from then on."""
        pack = 0.0
        if number % _STRETCHES:
            knots, water, rates = self._snow(number - 1)
            pack = snow_pack.step(water[-1], rates[-1], number * _STRETCH_HOURS - knots[-1])
        thawing = number % _STRETCHES == _STRETCHES - 1
        knots, water, rates = [], [], []
        for spell in self._stretch(number):
            steps = math.ceil((spell.end_hours - spell.start_hours) / _SNOW_STEP_HOURS)
            length = (spell.end_hours - spell.start_hours) / steps
            for k in range(steps):
                start = spell.start_hours + k * length
                temperature = _temperature(self._chain.climate, start + length / 2) + spell.warmth_c
                rate = snow_pack.snow_rates(spell.precipitation_mm_h, temperature)
                if thawing:
                    rate = snow_pack.SnowRates(0.0, max(rate.melt_mm_h, _THAW_MM_H))
                knots.append(start)
                water.append(pack)
                rates.append(rate)
                pack = snow_pack.step(pack, rate, length)
        return knots, water, rates


def _temperature(climate: Climate, hours: float) -> float:
    year = math.cos(2 * math.pi * hours / _YEAR_HOURS)
    day = math.cos(2 * math.pi * (hours - _WARMEST_HOUR) / 24)
    return climate.mean_c + climate.year_c * year + climate.day_c * day
