"""Snow on the ground: exact at any step, between 0 and 1, and as fast as people have measured."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gi_core.errors import InputError
from gi_core.snow_pack import DEEPEST_MM, HIDING_MM, SnowRates, cover, snow_rates, step

RATE = st.floats(0, 50)


@given(st.floats(0, DEEPEST_MM), RATE, RATE, st.floats(0, 48), st.integers(1, 40))
def test_many_small_steps_are_one_big_one(water: float, build: float, melt: float, hours: float, parts: int) -> None:
    rates = SnowRates(build, melt)
    small = water
    for _ in range(parts):
        small = step(small, rates, hours / parts)
    big = step(water, rates, hours)
    assert small == pytest.approx(big, abs=1e-9)  # rounding of 40 sums of at most 2400 mm
    assert 0 <= big <= DEEPEST_MM


def test_known_snow() -> None:
    # Ten hours of 2 mm/h well below freezing, then two days at 5 C: 20 mm, of which 40 mm could melt.
    falling = snow_rates(2.0, -10.0)
    assert (falling.build_mm_h, falling.melt_mm_h) == (2.0, 0.0)
    assert step(0.0, falling, 10.0) == 20.0
    thaw = snow_rates(0.0, 5.0)
    assert step(20.0, thaw, 24.0) == pytest.approx(0.0, abs=1e-9)
    assert step(30.0, thaw, 24.0) == pytest.approx(10.0)
    # Rain melts faster than dry air of the same warmth: 10 mm/h at 8 C melts 1 mm/h more.
    assert snow_rates(10.0, 8.0).melt_mm_h - snow_rates(0.0, 8.0).melt_mm_h == pytest.approx(1.0)


@given(st.floats(0, 20), st.floats(-40, 40))
def test_rates_are_continuous_and_split_precipitation(precipitation: float, temperature: float) -> None:
    here, beside = snow_rates(precipitation, temperature), snow_rates(precipitation, temperature + 1e-6)
    assert here.build_mm_h == pytest.approx(beside.build_mm_h, abs=2e-5)
    assert here.melt_mm_h == pytest.approx(beside.melt_mm_h, abs=2e-5)
    assert 0 <= here.build_mm_h <= precipitation
    assert here.melt_mm_h >= 0


@given(st.floats(0, DEEPEST_MM), st.floats(0, DEEPEST_MM))
def test_deeper_snow_covers_more(one: float, other: float) -> None:
    low, high = sorted((one, other))
    assert 0 <= cover(low) <= cover(high) <= 1


def test_cover_of_nothing_and_of_the_hiding_depth() -> None:
    assert cover(0.0) == 0
    assert cover(HIDING_MM) == pytest.approx(1 - 1 / math.e)
    assert cover(DEEPEST_MM) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("precipitation", "temperature"), [(-1.0, 0.0), (math.nan, 0.0), (math.inf, 0.0), (1.0, math.nan), (0.0, math.inf)]
)
def test_what_is_no_weather_is_refused(precipitation: float, temperature: float) -> None:
    with pytest.raises(InputError, match="snow"):
        snow_rates(precipitation, temperature)
