"""Times as people write them, around everything that clocks and calendars do."""

from datetime import UTC, date, datetime, timedelta, timezone

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gi_core.clock_time import FIRST_YEAR, LAST_YEAR, local_time, parse_time
from gi_core.errors import InputError, UnknownTimeError
from gi_core.world import Location

NEW_YORK = Location()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("13:00", "2024-06-21T13:00:00-04:00"),
        ("00:00", "2024-06-21T00:00:00-04:00"),
        ("13:00:30", "2024-06-21T13:00:30-04:00"),
        ("2024-12-21T13:00", "2024-12-21T13:00:00-05:00"),
        ("2024-12-21 13:00", "2024-12-21T13:00:00-05:00"),
        ("2024-02-29T23:59:59", "2024-02-29T23:59:59-05:00"),
        ("2024-12-21T18:00Z", "2024-12-21T13:00:00-05:00"),
        ("2024-12-21T18:00+09:00", "2024-12-21T04:00:00-05:00"),
        ("2024-12-21 18:00 09:00", "2024-12-21T04:00:00-05:00"),  # of a URL that was not encoded
        # 02:30 does not exist on this day: clocks went from 02:00 to 03:00.
        ("2024-03-10T02:30", "2024-03-10T03:30:00-04:00"),
        # 01:30 came twice: the first one, unless an offset says otherwise.
        ("2024-11-03T01:30", "2024-11-03T01:30:00-04:00"),
        ("2024-11-03T01:30-05:00", "2024-11-03T01:30:00-05:00"),
    ],
)
def test_time_is_read_in_the_locations_zone(text: str, expected: str) -> None:
    assert parse_time(text, NEW_YORK).isoformat() == expected


@pytest.mark.parametrize(
    "text",
    [
        "25:99",
        "24:00",
        "13:60",
        "13:00:60",
        "1:00",
        "13",
        "",
        "noon",
        " 13:00",
        "13:00 09:00",
        "2024-06-21 13:00 9:00",
        "13:00Z",
        "2023-02-29T12:00",
        "2024-06-21",
        "-1:00",
        "٠٩:٠٠",
    ],
)
def test_anything_else_is_refused_in_one_line_that_says_what_is_allowed(text: str) -> None:
    with pytest.raises(UnknownTimeError, match="HH:MM") as refused:
        parse_time(text, NEW_YORK)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("year", ["0001", "1599", "2600", "9999"])
def test_a_silly_year_is_refused(year: str) -> None:
    with pytest.raises(UnknownTimeError, match=f"{FIRST_YEAR}\\.\\.{LAST_YEAR}"):
        parse_time(f"{year}-01-01T00:00", NEW_YORK)


def test_offsets_beyond_a_day_are_refused() -> None:
    with pytest.raises(UnknownTimeError):
        parse_time("2024-06-21T12:00+25:00", NEW_YORK)


@pytest.mark.parametrize("zone", ["Mars/Olympus", "", "../etc/passwd", "America"])
def test_a_zone_that_does_not_exist_is_an_input_error(zone: str) -> None:
    with pytest.raises(InputError, match="IANA"):
        parse_time("12:00", Location(0.0, 0.0, 0.0, zone, 0.0, date(2024, 1, 1)))


def test_a_datetime_of_any_zone_becomes_local() -> None:
    moment = datetime(2024, 6, 21, 17, tzinfo=UTC)
    assert local_time(moment, NEW_YORK).isoformat() == "2024-06-21T13:00:00-04:00"
    assert local_time(moment.astimezone(timezone(timedelta(hours=9))), NEW_YORK) == moment
    assert local_time(datetime(2024, 6, 21, 13), NEW_YORK) == moment


@given(st.text(max_size=60))
def test_no_text_does_anything_but_parse_or_be_refused(text: str) -> None:
    try:
        moment = parse_time(text, NEW_YORK)
    except UnknownTimeError:
        return
    assert parse_time(moment.isoformat(), NEW_YORK) == moment


@given(st.datetimes(datetime(FIRST_YEAR, 1, 2), datetime(LAST_YEAR, 12, 30)))
def test_every_moment_survives_being_written_and_read(moment: datetime) -> None:
    local = local_time(moment.replace(microsecond=0), NEW_YORK)
    # Before 1883 New York kept local mean time, whose offset has seconds that ISO 8601 offsets of HH:MM cannot say.
    if local.utcoffset() is not None and local.utcoffset().seconds % 60 == 0:  # type: ignore[union-attr]
        assert parse_time(local.isoformat(), NEW_YORK) == local
