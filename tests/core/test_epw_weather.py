"""Weather from EPW files: what a file says arrives, its light is tracked, nothing jumps, and damaged files are refused."""

import math
from datetime import UTC, date, datetime, timedelta, timezone
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gi_core.epw import EpwYear, parse_epw, read_epw
from gi_core.epw_weather import EpwWeather
from gi_core.errors import InputError
from gi_core.lighting_model import make_lighting
from gi_core.snow_pack import cover
from gi_core.spectrum import LUMINANCE_FROM_RGB
from gi_core.weather import WEATHER_RANGES, Weather, parse_weather

STANDARD = timezone(timedelta(hours=-5))


def epw_lines(leap: bool = False, place: str = "40.78,-73.97,-5.0,40.0", **columns: str) -> list[str]:
    """A year of equal hours; columns named c6, c16 ... replace fields."""
    lines = [
        f"LOCATION,Somewhere,NY,USA,TMY3,725033,{place}", "DESIGN CONDITIONS,0", "TYPICAL/EXTREME PERIODS,0", "GROUND TEMPERATURES,0",
        "HOLIDAYS/DAYLIGHT SAVINGS,No,0,0,0", "COMMENTS 1,", "COMMENTS 2,", "DATA PERIODS,1,1,Data,Sunday, 1/ 1,12/31",
    ]  # fmt: skip
    fields = ["0"] * 35
    fields[16:18], fields[22:25] = ["999999", "999999"], ["99", "5", "9999"]
    fields[29], fields[30], fields[33] = "0.15", "999", "999"
    for name, value in columns.items():
        fields[int(name[1:])] = value
    first = date(2024 if leap else 2023, 1, 1)
    for day in range(366 if leap else 365):
        on = first + timedelta(days=day)
        lines += [",".join([str(on.year), str(on.month), str(on.day), str(hour + 1), *fields[4:]]) for hour in range(24)]
    return lines


def replaced(lines: list[str], row: int, field: int, value: str) -> list[str]:
    fields = lines[row].split(",")
    fields[field] = value
    return [*lines[:row], ",".join(fields), *lines[row + 1 :]]


@pytest.fixture(scope="module")
def new_york(shared_data: Path) -> EpwWeather:
    path = shared_data / "newyork_tmy3.epw"
    if not path.exists():
        pytest.skip("New York's typical year is not here")
    return EpwWeather(path)


@pytest.fixture(scope="module")
def plain() -> EpwYear:
    return parse_epw(epw_lines(), "plain.epw")


def test_the_header_becomes_the_place(plain: EpwYear) -> None:
    assert (plain.name, plain.latitude_degrees, plain.longitude_degrees) == ("Somewhere", 40.78, -73.97)
    place = EpwWeather(plain).location
    assert (place.elevation_m, place.timezone) == (40.0, "Etc/GMT+5")
    make_lighting(place, "12:00", "clear")  # the zone exists
    assert EpwWeather(parse_epw(epw_lines(place="28,77,5.5,200"), "delhi.epw")).location.timezone == "UTC"


def test_missing_numbers_take_the_clear_presets_or_the_neighbours() -> None:
    lines = epw_lines(c29="999", c23="99", c22="99")
    weather = EpwWeather(parse_epw(lines, "x.epw")).at(datetime(2024, 6, 21, 12, tzinfo=STANDARD))
    assert (weather.haze, weather.cloud_cover, weather.fog_density, weather.snow) == (0.15, 0.0, 0.0, 0.0)
    year = parse_epw(replaced(epw_lines(), 100, 24, "3.0"), "x.epw")
    assert np.isfinite(year.visibility_km).sum() == 1
    assert EpwWeather(year).at(datetime(2024, 6, 21, 12, tzinfo=STANDARD)).fog_density == pytest.approx(3.912 / 3000 - 0.15 / 1200)


def test_hours_are_stamped_at_their_end_in_standard_time() -> None:
    # The 13th hour of 1 July, 12:00 to 13:00 EST, is the one with snow: its middle is 13:30 on a clock in daylight saving time.
    row = 8 + 24 * 181 + 12
    lines = replaced(epw_lines(c30="0"), row, 30, "7")
    assert lines[row].startswith("2023,7,1,13,")
    weather = EpwWeather(parse_epw(lines, "x.epw"))
    noon = datetime(2023, 7, 1, 17, 30, tzinfo=UTC)
    assert weather.at(noon).snow == pytest.approx(cover(7.0))
    assert weather.at(noon + timedelta(minutes=30)).snow == pytest.approx(cover(7.0) / 2)
    assert weather.at(noon + timedelta(hours=1)).snow == 0
    assert weather.at(noon.replace(year=1999)).snow == pytest.approx(cover(7.0))  # any year


def test_depth_of_aerosol_in_either_unit() -> None:
    plain, thousandths = (parse_epw(epw_lines(c29=text), "x.epw").aerosol_depth for text in ("0.084", "84"))
    np.testing.assert_allclose(plain, 0.084)
    np.testing.assert_allclose(thousandths, 0.084)


def test_precipitation_builds_snow_where_depth_is_missing() -> None:
    cold = EpwWeather(parse_epw(epw_lines(c6="-5", c33="0.1"), "x.epw"))
    assert cold.at(datetime(2023, 12, 1, tzinfo=STANDARD)).snow > 0.99
    assert cold.at(datetime(2023, 1, 1, tzinfo=STANDARD)).snow > 0.99  # last winter's
    warm = EpwWeather(parse_epw(epw_lines(c6="15", c33="0.1"), "x.epw"))
    assert warm.at(datetime(2023, 12, 1, tzinfo=STANDARD)).snow == 0


def test_light_of_new_yorks_typical_year_is_tracked(new_york: EpwWeather) -> None:
    year = new_york.year
    days = {row: day for day, row in year.first_hour.items()}
    errors, beams = [], []
    for row in np.random.default_rng(5).choice(np.flatnonzero(year.global_lx > 1000), 60, replace=False).tolist():
        month, day = days[row // 24 * 24]
        hour = datetime(int(year.years[row]), month, day, tzinfo=STANDARD) + timedelta(hours=row % 24)
        total = beam = 0.0
        for minute in (10, 30, 50):
            moment = hour + timedelta(minutes=minute)
            light = make_lighting(new_york.location, moment, new_york.at(moment))
            beam += float(LUMINANCE_FROM_RGB @ light.sun.irradiance) / 3
            total += float(LUMINANCE_FROM_RGB @ (light.sky_cube[2] + light.sun.irradiance * max(light.sun.direction[1], 0))) / 3
        errors.append(total / year.global_lx[row] - 1)
        beams.append(beam - year.beam_lx[row])
    # Seen over 200 hours: median 2.3 %, bias 0.0 %, 90th percentile 8 %; the hours' means against weather that is linear between them.
    assert np.median(np.abs(errors)) < 0.05
    assert abs(np.median(errors)) < 0.03
    assert np.median(np.abs(beams)) < 3000


def biggest_step(before: Weather, after: Weather) -> float:
    return max(abs(getattr(before, name) - getattr(after, name)) / (high - low) for name, (low, high) in WEATHER_RANGES.items())


@given(st.datetimes(datetime(1600, 1, 2), datetime(2599, 12, 30), timezones=st.just(UTC)))
@settings(max_examples=100, deadline=None)
def test_no_second_of_any_year_jumps(new_york: EpwWeather, moment: datetime) -> None:
    before, after = new_york.at(moment), new_york.at(moment + timedelta(seconds=1))
    assert biggest_step(before, after) <= 1 / 3600 + 1e-9  # linear over an hour
    assert parse_weather(after.text) == after
    assert new_york.at(moment) == before


@pytest.mark.parametrize("leap", [False, True])
@pytest.mark.parametrize("year", [2023, 2024])
def test_leap_days_and_new_year_are_ordinary(leap: bool, year: int) -> None:
    rng = np.random.default_rng(3)
    lines = epw_lines(leap, c30="0")
    lines = lines[:8] + [",".join([*line.split(",")[:30], f"{rng.integers(0, 9)}", *line.split(",")[31:]]) for line in lines[8:]]
    weather = EpwWeather(parse_epw(lines, "x.epw"))
    for month, day in ((2, 28), (2, 29), (3, 1), (12, 31), (1, 1)):
        if (month, day) == (2, 29) and year == 2023:
            continue
        for minute in (0, 30):
            edge = datetime(year, month, day, minute=minute, tzinfo=STANDARD)
            steps = [weather.at(edge + timedelta(seconds=s)) for s in (-1, 0, 1)]
            assert max(biggest_step(*steps[:2]), biggest_step(*steps[1:])) <= 1 / 3600 + 1e-9
    assert len({weather.at(datetime(year, 6, 1, h, tzinfo=STANDARD)).snow for h in range(24)}) > 5


@pytest.mark.parametrize(
    ("row", "field", "value", "complaint"),
    [
        (0, 0, "PLACE", "line 1: expected an EPW header 'LOCATION'"),
        (0, 6, "91", "line 1: latitude"),
        (0, 8, "nan", "line 1: time zone"),
        (7, 2, "2", "line 8"),
        (8, 1, "2", "line 9: expected month, day, hour (1, 1, 1)"),
        (20, 3, "24", "line 21: expected month, day, hour"),
        (30, 0, "1e9", "line 31: year"),
        (40, 16, "-1", "line 41: global_lx: expected 0..200000 lx"),
        (40, 6, "inf", "line 41: temperature_c"),
        (40, 23, "11", "line 41: opaque_tenths"),
        (40, 24, "far", "line 41: visibility_km"),
        (40, 34, "0,0", ""),
    ],
)
def test_damaged_lines_are_named(row: int, field: int, value: str, complaint: str) -> None:
    lines = replaced(epw_lines(), row, field, value)
    if not complaint:  # more fields than needed are no damage
        parse_epw(lines, "bad.epw")
        return
    with pytest.raises(InputError) as refused:
        parse_epw(lines, "bad.epw")
    assert complaint in str(refused.value)
    assert str(refused.value).startswith("bad.epw: ")
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("lines", [[], ["LOCATION"], epw_lines()[:8], epw_lines()[:-1], [*epw_lines()[:-1], "2023,12,31,24"]])
def test_files_that_end_early_are_refused(lines: list[str]) -> None:
    with pytest.raises(InputError, match=r"short\.epw"):
        parse_epw(lines, "short.epw")


def test_files_that_are_no_files(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot read"):
        read_epw(tmp_path / "gone.epw")
    with pytest.raises(InputError, match="cannot read"):
        read_epw(tmp_path)
    (tmp_path / "noise.epw").write_bytes(bytes(range(256)) * 4)
    with pytest.raises(InputError, match="header"):
        read_epw(tmp_path / "noise.epw")
    (tmp_path / "huge.epw").write_bytes(b"x" * ((16 << 20) + 1))
    with pytest.raises(InputError, match="at most"):
        read_epw(tmp_path / "huge.epw")


def test_a_naive_moment_is_refused(plain: EpwYear) -> None:
    with pytest.raises(InputError, match="offset"):
        EpwWeather(plain).at(datetime(2024, 1, 1))
    assert math.isnan(plain.global_lx[0])
