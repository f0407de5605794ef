"""The weather script: a pure function of seed, place and moment, without a jump, in the shares and seasons of its chain."""

import math
import re
from datetime import UTC, date, datetime, timedelta
from zoneinfo import ZoneInfo

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gi_core.errors import InputError
from gi_core.lighting_model import make_lighting
from gi_core.weather import WEATHER_RANGES, Weather, parse_weather
from gi_core.weather_chain import parse_chain, temperate_chain
from gi_core.weather_script import _STRETCH_HOURS, WeatherScript
from gi_core.world import Location

NEW_YORK = Location()
SCRIPT = WeatherScript(7, NEW_YORK)
START = datetime(2024, 1, 1, tzinfo=UTC)

# The shortest blend takes a sixth of an hour (a third of the shortest spell); smoothstep is 1.5 times as steep in its middle. So in a
# second a number moves at most 1.5 / 600 of its range.
PER_SECOND = 1.5 / 600


def biggest_step(before: Weather, after: Weather) -> float:
    return max(abs(getattr(before, name) - getattr(after, name)) / (high - low) for name, (low, high) in WEATHER_RANGES.items())


def test_another_script_of_the_same_seed_gives_the_same_weather_in_any_order() -> None:
    moments = [START + timedelta(hours=17 * k) for k in range(300)]
    forwards = [SCRIPT.at(moment) for moment in moments]
    other = WeatherScript(7, NEW_YORK)
    assert [other.at(moment) for moment in reversed(moments)] == forwards[::-1]
    assert WeatherScript(8, NEW_YORK).at(moments[50]) != forwards[50]
    assert len(set(forwards)) > 40  # whole spells of one preset are one weather


@given(
    st.datetimes(datetime(1600, 1, 2), datetime(2599, 12, 30), timezones=st.just(UTC)),
    st.integers(0, 2**63 - 1),
)
@settings(max_examples=60, deadline=None)
def test_no_second_jumps(moment: datetime, seed: int) -> None:
    script = WeatherScript(seed, NEW_YORK)
    before, after = script.at(moment), script.at(moment + timedelta(seconds=1))
    assert biggest_step(before, after) <= PER_SECOND
    assert parse_weather(after.text) == after  # what a script says can be asked for


def test_no_second_jumps_across_spells_stretches_and_snow_years() -> None:
    edges = {SCRIPT.spell_at(START + timedelta(hours=h)).end_hours for h in range(0, 9000, 3)}
    edges |= {n * _STRETCH_HOURS for n in range(280, 320)}
    origin = START - timedelta(hours=SCRIPT._hours(START))
    ends = []
    for hours in sorted(edges):
        seconds = [SCRIPT.at(origin + timedelta(hours=hours, seconds=s)) for s in (-1, 0, 1)]
        ends.append(max(biggest_step(*seconds[:2]), biggest_step(*seconds[1:])))
    assert len(ends) > 500
    assert max(ends) <= PER_SECOND
    assert max(ends) > 0  # or nothing blends


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("2024-02-28T23:59:59", "2024-02-29T00:00:00"),
        ("2024-02-29T23:59:59", "2024-03-01T00:00:00"),
        ("2024-12-31T23:59:59", "2025-01-01T00:00:00"),
        ("2024-03-10T01:59:59", "2024-03-10T03:00:00"),  # clocks go forward
    ],
)
def test_midnights_leap_days_and_clock_changes_are_ordinary_seconds(before: str, after: str) -> None:
    zone = ZoneInfo("America/New_York")
    first, second = (datetime.fromisoformat(text).replace(tzinfo=zone) for text in (before, after))
    assert biggest_step(SCRIPT.at(first), SCRIPT.at(second)) <= PER_SECOND
    lights = [make_lighting(NEW_YORK, moment, SCRIPT.at(moment)) for moment in (first, second)]
    assert lights[1].exposure == pytest.approx(lights[0].exposure, abs=0.02)
    assert SCRIPT.at(first.astimezone(UTC)) == SCRIPT.at(first)


def test_a_year_has_every_kind_and_each_lasts_as_long_as_the_chain_says() -> None:
    chain = temperate_chain()
    spells = {SCRIPT.spell_at(START + timedelta(hours=h / 2)) for h in range(2 * 8766)}
    assert {spell.kind for spell in spells} == set(chain.kinds)
    stretch_ends = [n * _STRETCH_HOURS for n in range(275, 325)]
    for spell in spells:
        kind = chain.kinds[spell.kind]
        length = spell.end_hours - spell.start_hours
        cut = min(abs(spell.end_hours - end) for end in stretch_ends) < 1e-6
        assert cut or kind.shortest_hours - 1e-9 <= length <= kind.longest_hours + 1e-9
    by_start = {round(spell.start_hours, 6): spell for spell in spells}
    followers = [(spell, by_start[end]) for spell in spells if (end := round(spell.end_hours, 6)) in by_start]
    assert len(followers) > 500
    for spell, following in followers:
        assert following.kind in chain.kinds[spell.kind].next_kinds or following.kind == chain.hub
    share = sum(s.end_hours - s.start_hours for s in spells if s.preset == "clear") / 8766
    assert 0.15 < share < 0.5  # the chain's own is near 0.36; a year of two hundred spells strays


def test_snow_lies_in_winter_only_and_comes_and_goes() -> None:
    cover = [SCRIPT.at(START + timedelta(hours=6 * k)).snow for k in range(4 * 365)]
    winter, summer = cover[: 4 * 60], cover[4 * 160 : 4 * 240]
    assert max(winter) > 0.5
    assert max(summer) == 0
    assert min(winter) < 0.1  # it thaws in between
    south = WeatherScript(7, Location(latitude_degrees=-40.0))
    assert max(south.at(START + timedelta(hours=6 * k)).snow for k in range(4 * 30)) == 0
    assert max(south.at(START + timedelta(hours=6 * k)).snow for k in range(4 * 160, 4 * 240)) > 0.5


def test_it_snows_when_it_is_cold_and_rains_when_it_is_warm() -> None:
    wet = [spell for h in range(0, 4 * 8766, 2) if (spell := SCRIPT.spell_at(START + timedelta(hours=h))).kind == "wet"]
    origin = START - timedelta(hours=SCRIPT._hours(START))
    seen = set()
    for spell in set(wet):
        warm = SCRIPT.temperature_c(origin + timedelta(hours=(spell.start_hours + spell.end_hours) / 2)) + spell.warmth_c
        assert spell.preset == ("snow" if warm < 1.0 else "rain")
        seen.add(spell.preset)
    assert seen == {"snow", "rain"}


def test_a_script_needs_a_seed_and_a_moment_with_an_offset() -> None:
    for seed in (-1, 2**63):
        with pytest.raises(InputError, match="seed"):
            WeatherScript(seed, NEW_YORK)
    with pytest.raises(InputError, match="offset"):
        SCRIPT.at(datetime(2024, 1, 1))


CHAIN = """
hub = "fair"
blend_hours = [0.5, 1.0]
[temperature]
mean_c = 10
year_c = 10
day_c = 3
spell_c = 2
warmest_day = 200
[kind.fair]
preset = "clear"
hours = [2, 4]
next = { grey = 1 }
[kind.grey]
preset = "overcast"
hours = [1, 2]
next = { fair = 1 }
"""


def test_a_chain_of_ones_own() -> None:
    script = WeatherScript(1, NEW_YORK, parse_chain(CHAIN))
    kinds = {script.spell_at(START + timedelta(hours=h)).kind for h in range(100)}
    assert kinds == {"fair", "grey"}
    noon = {script.at(START + timedelta(minutes=10 * k)).cloud_cover for k in range(600)}
    assert {0.0, 1.0} < noon


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ('hub = "fair"', 'hub = "gone"', "hub"),
        ('preset = "clear"', 'preset = "plague"', "kind.fair"),
        ("hours = [2, 4]", "hours = [4, 2]", "kind.fair.hours"),
        ("hours = [2, 4]", "hours = [0, 4]", "kind.fair.hours"),
        ("hours = [2, 4]", "hours = [2, 1e9]", "kind.fair.hours"),
        ("hours = [2, 4]", "hours = 2", "kind.fair.hours"),
        ("next = { grey = 1 }", "next = { fair = 1 }", "kind.fair.next"),
        ("next = { grey = 1 }", "next = { nowhere = 1 }", "kind.fair.next"),
        ("next = { grey = 1 }", "next = { grey = nan }", "kind.fair.next.grey"),
        ("next = { grey = 1 }", "next = { grey = true }", "kind.fair.next.grey"),
        ("mean_c = 10", "mean_c = inf", "temperature.mean_c"),
        ("mean_c = 10", "", "temperature.mean_c"),
        ("blend_hours = [0.5, 1.0]", "", "blend_hours"),
        ("hub", "hub hub", "weather chain"),
    ],
)
def test_a_wrong_chain_is_refused_with_its_field(old: str, new: str, complaint: str) -> None:
    assert old in CHAIN
    with pytest.raises(InputError, match=re.escape(complaint)) as refused:
        parse_chain(CHAIN.replace(old, new, 1))
    assert "\n" not in str(refused.value)


def test_a_location_moves_the_solar_day_only() -> None:
    east = WeatherScript(7, Location(longitude_degrees=NEW_YORK.longitude_degrees + 15, date=date(2020, 2, 29)))
    a, b = SCRIPT.at(START + timedelta(days=3, hours=1)), east.at(START + timedelta(days=3))
    assert all(getattr(a, name) == pytest.approx(getattr(b, name), abs=1e-9) for name in WEATHER_RANGES)


@given(st.datetimes(datetime(1900, 1, 2), datetime(2100, 12, 30), timezones=st.just(UTC)), st.integers(0, 1000))
@settings(max_examples=30, deadline=None)
def test_the_light_of_a_script_does_not_jump_either(moment: datetime, seed: int) -> None:
    script = WeatherScript(seed, NEW_YORK)
    moments = (moment, moment + timedelta(seconds=1))
    before, after = (make_lighting(NEW_YORK, at, script.at(at)) for at in moments)
    # A second of blending moves light by 1 % at most, a second of twilight by 0.5 %: 0.02 stops.
    assert after.exposure == pytest.approx(before.exposure, abs=0.03)
    np.testing.assert_allclose(after.sky_cube, before.sky_cube, rtol=0.03)
    assert before.sun.direction @ after.sun.direction > math.cos(math.radians(0.01))
    assert abs(after.snow - before.snow) <= PER_SECOND
