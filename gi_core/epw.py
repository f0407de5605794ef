"""Reading EnergyPlus weather files (.epw): an hour by hour year at one place.

Format: "Auxiliary Programs", EnergyPlus documentation, chapter "EnergyPlus Weather File Data Dictionary". Eight header lines, then one line
an hour of a normal or a leap year. Hours are stamped 1..24 by their *end*, in standard time of the header's zone, whatever clocks do.
Months may come from different years, as in a typical year.
"""

import calendar
import math
from dataclasses import dataclass
from datetime import date, timedelta
from pathlib import Path

import numpy as np

from gi_core.arrays import Float64
from gi_core.errors import InputError

_LARGEST_BYTES = 16 << 20  # ten times a year of the longest lines seen
_HEADERS = ("LOCATION", "DESIGN CONDITIONS", "TYPICAL/EXTREME PERIODS", "GROUND TEMPERATURES", "HOLIDAYS/DAYLIGHT SAVINGS")
_HEADER_LINES = 8
_LEAST_FIELDS = 34
_LONGEST_ECHO = 40
# Aerosol optical depth should be given in thousandths; the files made from TMY3 give it plain. No air reaches a depth of 5.
_LARGEST_PLAIN_DEPTH = 5.0


@dataclass(frozen=True)
class _Column:
    """Where a field stands in a line, its unit, what is possible, and the number from which on it means "missing"."""

    name: str
    index: int
    unit: str
    low: float
    high: float
    missing_from: float


_COLUMNS = (
    _Column("temperature_c", 6, "C", -90, 70, 99.9),
    _Column("global_lx", 16, "lx", 0, 200e3, 999_900),
    _Column("beam_lx", 17, "lx", 0, 200e3, 999_900),
    _Column("opaque_tenths", 23, "tenths", 0, 10, 99),
    _Column("total_tenths", 22, "tenths", 0, 10, 99),
    _Column("visibility_km", 24, "km", 0, 9998, 9999),
    _Column("aerosol_depth", 29, "thousandths", 0, 998, 999),
    _Column("snow_cm", 30, "cm", 0, 998, 999),
    _Column("rain_mm", 33, "mm", 0, 998, 999),
)


@dataclass(frozen=True, eq=False)
class EpwYear:
    """A year of hours at a place; every array is (hours,) float64, NaN where the file says "missing".

    name, latitude_degrees, longitude_degrees, elevation_m : the place; zone_hours : its standard time minus UTC
    years : (hours,) int64, which year each hour was taken from
    first_hour : row of the first hour of each (month, day) of the file
    temperature_c; global_lx : mean of the hour on level ground; beam_lx : the sun's alone, facing it
    opaque_tenths, total_tenths : sky covered by clouds, 0..10; visibility_km
    aerosol_depth : optical depth, 0..5; snow_cm : depth on the ground; rain_mm : precipitation of the hour, as water
    """

    name: str
    latitude_degrees: float
    longitude_degrees: float
    zone_hours: float
    elevation_m: float
    years: np.ndarray[tuple[int], np.dtype[np.int64]]
    first_hour: dict[tuple[int, int], int]
    temperature_c: Float64
    global_lx: Float64
    beam_lx: Float64
    opaque_tenths: Float64
    total_tenths: Float64
    visibility_km: Float64
    aerosol_depth: Float64
    snow_cm: Float64
    rain_mm: Float64


def read_epw(path: Path | str) -> EpwYear:
    """The year in a file. Raises InputError that names the file, the line, the field and what was expected."""
    path = Path(path)
    try:
        size = path.stat().st_size
        if size > _LARGEST_BYTES:
            raise InputError(f"{path.name}: expected an EPW file of at most {_LARGEST_BYTES} bytes, found {size}")
        lines = path.read_text(encoding="latin-1").splitlines()
    except OSError as error:
        raise InputError(f"{path.name}: cannot read it: {error.strerror}") from error
    return parse_epw(lines, path.name)


def parse_epw(lines: list[str], where: str) -> EpwYear:
    """The year in the lines of a file; ``where`` names it in errors. Raises InputError."""
    place = _headers(lines, where)
    rows = [line for line in lines[_HEADER_LINES:] if line.strip()]
    days = {24 * (365 + leap): _days(2023 + leap) for leap in (0, 1)}  # a normal year and a leap year
    if len(rows) not in days:
        raise InputError(f"{where}: expected 8760 hours, or 8784 of a leap year, found {len(rows)}")
    year_days = days[len(rows)]
    years = np.zeros(len(rows), np.int64)
    values = np.full((len(_COLUMNS), len(rows)), np.nan)
    for hour, row in enumerate(rows):
        line = f"{where}: line {_HEADER_LINES + 1 + hour}"
        fields = row.split(",")
        if len(fields) < _LEAST_FIELDS:
            raise InputError(f"{line}: expected at least {_LEAST_FIELDS} fields, found {len(fields)}")
        stamp = tuple(_number(fields[k], line, name) for k, name in enumerate(("year", "month", "day", "hour")))
        expected = (*year_days[hour // 24], hour % 24 + 1)
        if stamp[1:] != expected:
            raise InputError(f"{line}: expected month, day, hour {expected}, found {', '.join(fields[1:4])[:_LONGEST_ECHO]}")
        if not (1800 <= stamp[0] <= 2200 and stamp[0] == int(stamp[0])):
            raise InputError(f"{line}: year: expected 1800..2200, found {fields[0][:_LONGEST_ECHO]!r}")
        years[hour] = int(stamp[0])
        for k, column in enumerate(_COLUMNS):
            values[k, hour] = _value(column, fields[column.index], line)
    columns = {column.name: values[k] for k, column in enumerate(_COLUMNS)}
    columns["aerosol_depth"] = _plain_depth(columns["aerosol_depth"])
    first_hour = {day: 24 * number for number, day in enumerate(year_days)}
    return EpwYear(*place, years=years, first_hour=first_hour, **columns)


def _headers(lines: list[str], where: str) -> tuple[str, float, float, float, float]:
    """Name, latitude, longitude, zone and elevation."""
    for k, name in enumerate(_HEADERS):
        if len(lines) <= k or lines[k].split(",")[0].strip().upper() != name:
            found = lines[k][:_LONGEST_ECHO] if len(lines) > k else ""
            raise InputError(f"{where}: line {k + 1}: expected an EPW header {name!r}, found {found!r}")
    place = lines[0].split(",")
    if len(place) < 10:
        raise InputError(f"{where}: line 1: expected 10 fields of LOCATION, found {len(place)}")
    numbers = []
    bounds = {"latitude": (-90, 90), "longitude": (-180, 180), "time zone": (-12, 14), "elevation": (-1000, 9999.9)}
    for text, (name, bound) in zip(place[6:10], bounds.items(), strict=True):
        number = _number(text, f"{where}: line 1", name)
        if not bound[0] <= number <= bound[1]:
            raise InputError(f"{where}: line 1: {name}: expected {bound[0]:g}..{bound[1]:g}, found {text[:_LONGEST_ECHO]!r}")
        numbers.append(number)
    periods = lines[7].split(",") if len(lines) > 7 else []
    if [field.strip() for field in periods[:3]] != ["DATA PERIODS", "1", "1"]:
        raise InputError(
            f"{where}: line 8: expected 'DATA PERIODS,1,1': one period, one line an hour; found {','.join(periods[:3])[:60]!r}"
        )
    return place[1].strip(), numbers[0], numbers[1], numbers[2], numbers[3]


def _value(column: _Column, text: str, line: str) -> float:
    """A field, NaN where it is missing."""
    if not text.strip():
        return math.nan
    value = _number(text, line, column.name)
    if value >= column.missing_from:
        return math.nan
    if not column.low <= value <= column.high:
        raise InputError(
            f"{line}: {column.name}: expected {column.low:g}..{column.high:g} {column.unit}, or {column.missing_from:g} for missing, "
            f"found {text[:_LONGEST_ECHO]!r}"
        )
    return value


def _number(text: str, line: str, name: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(f"{line}: {name}: expected a number, found {text[:_LONGEST_ECHO]!r}")
    return value


def _plain_depth(depth: Float64) -> Float64:
    """Aerosol optical depth, from whichever of the two units the file uses; .999 is missing in one of them."""
    known = depth[np.isfinite(depth)]
    if not len(known) or known.max() <= _LARGEST_PLAIN_DEPTH:
        return np.where(depth == 0.999, np.nan, depth)
    return depth / 1000


def _days(year: int) -> list[tuple[int, int]]:
    first = date(year, 1, 1)
    days = 365 + calendar.isleap(year)
    return [((day := first + timedelta(days=k)).month, day.day) for k in range(days)]
