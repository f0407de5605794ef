"""The live world's clock: exact over any number of ticks and changes, on calendars and through clock changes."""

import json
from dataclasses import replace
from datetime import UTC, date, datetime, timedelta
from fractions import Fraction
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gi_core.errors import InputError, UnknownTimeError
from gi_core.world import Location
from server.world_clock import MAX_RATE, WorldClock, changed_clock, clock_to_json, starting_clock

NEW_YORK = Location()
NOON = starting_clock(NEW_YORK, "12:00")
rates = st.integers(0, int(MAX_RATE) * 1_000_000).map(lambda millionths: millionths / 1_000_000)


def microseconds(clock: WorldClock, tick: int) -> int:
    """Since noon; by way of UTC, since datetimes of one zone are subtracted as their clocks read."""
    return (clock.moment_at(tick).astimezone(UTC) - NOON.start.astimezone(UTC)) // timedelta(microseconds=1)


def seconds(clock: WorldClock, tick: int) -> float:
    return microseconds(clock, tick) / 1e6


def test_a_clock_shows_its_start_and_then_real_time() -> None:
    assert NOON.moment_at(0).isoformat() == "2024-06-21T12:00:00-04:00"
    assert NOON.moment_at(30).isoformat() == "2024-06-21T12:00:01-04:00"
    assert NOON.moment_at(1).isoformat() == "2024-06-21T12:00:00.033333-04:00"


def test_a_day_at_sixty_times_takes_24_minutes() -> None:
    assert seconds(NOON.with_rate(0, 60), 24 * 60 * 30) == 86400


@given(rates, st.integers(1, 240), st.integers(0, 10**6))
def test_a_million_ticks_are_the_closed_form(rate: float, ticks_per_second: int, tick: int) -> None:
    clock = starting_clock(NEW_YORK, "12:00", ticks_per_second).with_rate(0, rate)
    exact = Fraction(round(rate * 1e6), 10**6) * tick / ticks_per_second * 10**6
    assert microseconds(clock, tick) == exact.numerator // exact.denominator


def test_ten_thousand_changes_drift_no_more_than_none() -> None:
    changed = NOON.with_rate(0, 0.7)
    for tick in range(10_000):
        changed = changed.with_rate(tick, 0.7)
    for tick in (9_999, 10_000, 10**6):
        assert changed.moment_at(tick) == NOON.with_rate(0, 0.7).moment_at(tick)


@given(st.lists(st.tuples(st.integers(0, 50), rates, st.booleans()), max_size=30))
@settings(deadline=None)
def test_any_script_of_changes_is_the_sum_of_its_stretches(script: list[tuple[int, float, bool]]) -> None:
    clock, tick, exact = NOON, 0, Fraction(0)
    for wait, rate, paused in script:
        exact += 0 if clock.paused else Fraction(clock.rate_millionths) * wait / clock.ticks_per_second
        tick += wait
        clock = clock.with_rate(tick, rate).with_paused(tick, paused)
        assert microseconds(clock, tick) == exact.numerator // exact.denominator


def test_a_paused_clock_stands_and_then_goes_on_as_before() -> None:
    paused = NOON.with_rate(0, 60).with_paused(30, True)
    assert seconds(paused, 30) == seconds(paused, 10**9) == 60
    assert paused.last_tick is None
    assert seconds(paused.with_paused(1000, False), 1030) == 120


def test_a_jump_goes_forwards_and_backwards_and_keeps_the_rate() -> None:
    clock = NOON.with_rate(0, 2)
    for text, expected in (("2030-01-01T00:00", "2030-01-01T00:00:02-05:00"), ("2000-02-29T23:59:59", "2000-03-01T00:00:01-05:00")):
        assert clock.jumped(300, text, NEW_YORK).moment_at(330).isoformat() == expected


def test_hours_alone_mean_the_day_that_the_clock_shows() -> None:
    later = NOON.jumped(0, "2025-12-24T20:00", NEW_YORK).jumped(9, "06:30", NEW_YORK)
    assert later.moment_at(9).isoformat() == "2025-12-24T06:30:00-05:00"


@pytest.mark.parametrize(
    ("start", "real_seconds", "expected"),
    [
        ("2024-06-21T23:59:59", 2, "2024-06-22T00:00:01-04:00"),
        ("2024-02-28T23:59:59", 1, "2024-02-29T00:00:00-05:00"),
        ("2024-02-29T23:59:59", 1, "2024-03-01T00:00:00-05:00"),
        ("2023-12-31T23:59:59", 1, "2024-01-01T00:00:00-05:00"),
        # Clocks go from 02:00 to 03:00, and from 02:00 back to 01:00.
        ("2024-03-10T01:59:59", 1, "2024-03-10T03:00:00-04:00"),
        ("2024-11-03T01:59:59-04:00", 1, "2024-11-03T01:00:00-05:00"),
        ("2024-11-03T00:30", 2 * 3600, "2024-11-03T01:30:00-05:00"),
    ],
)
def test_calendars_and_clock_changes_are_crossed(start: str, real_seconds: int, expected: str) -> None:
    clock = starting_clock(NEW_YORK, start)
    assert clock.moment_at(30 * real_seconds).isoformat() == expected
    assert clock.moment_at(30 * real_seconds) - clock.moment_at(0).astimezone(UTC) == timedelta(seconds=real_seconds)


@given(st.integers(0, 4 * 10**7))
def test_time_never_goes_back_by_itself(tick: int) -> None:
    clock = starting_clock(NEW_YORK, "2024-01-01T00:00").with_rate(0, 61.7)  # two and a half years, with five clock changes
    assert timedelta(0) <= clock.moment_at(tick + 1).astimezone(UTC) - clock.moment_at(tick).astimezone(UTC) < timedelta(seconds=2.1)


@pytest.mark.parametrize("start", ["2599-12-31T23:30", "2599-06-01T00:00"])
@pytest.mark.parametrize("rate", [1e-6, 1, 59.94, 3600])
def test_the_last_year_ends_with_an_error_that_says_what_to_do(start: str, rate: float) -> None:
    clock = starting_clock(NEW_YORK, start).with_rate(0, rate).with_rate(7, rate)
    last = clock.last_tick
    assert last is not None
    assert clock.moment_at(last).year == 2599
    with pytest.raises(UnknownTimeError, match=r"end of year 2599.*jump"):
        clock.moment_at(last + 1)
    with pytest.raises(UnknownTimeError):
        clock.with_rate(last + 1, 1)
    assert clock.jumped(last + 1, "2024-06-21T12:00", NEW_YORK).moment_at(last + 1).year == 2024
    assert clock.with_paused(last, True).moment_at(10 * last + 10**9).year == 2599


def test_what_a_clock_shows_can_be_asked_for_again() -> None:
    clock = NOON.with_rate(0, 0.3).with_paused(7, True)
    shown = json.loads(json.dumps(clock_to_json(clock, 10)))
    assert shown.pop("tick") == 10
    again = changed_clock(NOON, 100, shown, NEW_YORK)
    assert clock_to_json(again, 100) == {**shown, "tick": 100}


zones = st.sampled_from(["America/New_York", "Europe/Berlin", "Asia/Kathmandu", "Australia/Lord_Howe", "UTC"])


@given(st.datetimes(datetime(1600, 1, 3), datetime(2599, 12, 29)), zones)
@settings(deadline=None)  # the first moment of a zone reads its file
def test_every_moment_survives_being_written_and_read(moment: datetime, zone: str) -> None:
    place = replace(NEW_YORK, timezone=zone)
    clock = replace(
        starting_clock(place, "12:00"), start=moment.replace(tzinfo=UTC).astimezone(starting_clock(place, "12:00").start.tzinfo)
    )
    text = clock_to_json(clock, 0)["time"]
    assert changed_clock(clock, 5, {"time": text}, place).moment_at(5) == clock.start


@pytest.mark.parametrize(
    ("record", "complaint"),
    [
        ([], "expected an object"),
        (None, "expected an object"),
        ({}, "any of time, rate, paused"),
        ({"speed": 2}, "speed"),
        ({"tick": 2}, "tick"),
        ({"time": "25:99"}, "HH:MM"),
        ({"time": 12}, "time: expected a text"),
        ({"time": "2600-01-01T00:00"}, "2599"),
        ({"time": "1600-01-01T00:00Z"}, "1600"),
        ({"time": "2024-13-01T00:00:00.000000+00:00"}, "month"),
        ({"time": "9999-12-31T23:59:59.000000-23:00"}, "2599"),
        ({"rate": -1}, "rate"),
        ({"rate": 3601}, "rate"),
        ({"rate": float("nan")}, "rate"),
        ({"rate": True}, "rate"),
        ({"rate": "60"}, "rate"),
        ({"rate": 10**400}, "rate"),
        ({"paused": 1}, "paused"),
    ],
)
def test_a_wrong_change_is_refused_with_its_field(record: Any, complaint: str) -> None:
    with pytest.raises(InputError, match=complaint) as refused:
        changed_clock(NOON, 3, record, NEW_YORK)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("rate", [-1e-9, 3600.1, float("inf"), float("nan")])
def test_no_rate_is_negative_or_boundless(rate: float) -> None:
    with pytest.raises(InputError, match="rate"):
        NOON.with_rate(0, rate)


def test_a_tick_before_the_law_is_a_mistake_of_the_caller() -> None:
    with pytest.raises(ValueError, match="tick 9"):
        NOON.with_rate(10, 2).moment_at(9)
    with pytest.raises(ValueError, match="tick a second"):
        starting_clock(NEW_YORK, "12:00", 0)


def test_a_bare_time_starts_on_the_places_own_day() -> None:
    assert starting_clock(replace(NEW_YORK, date=date(2024, 2, 29)), "00:00").moment_at(0).isoformat() == "2024-02-29T00:00:00-05:00"
