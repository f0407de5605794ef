"""The model's illuminance of level ground beside the literature's, from noon to a moonless night."""

import math
from collections.abc import Callable
from importlib import resources

import pytest

from gi_core.lighting_model import make_lighting
from gi_core.lighting_table import LITERATURE, PLACE, Measured, Row, illuminance, lighting_table, main, time_of_elevation
from gi_core.sun import sun_position


@pytest.fixture(scope="module")
def rows() -> dict[str, Row]:
    return {row.state: row for row in lighting_table()}


@pytest.mark.parametrize("state", LITERATURE)
def test_every_state_lies_within_what_is_published(rows: dict[str, Row], state: str) -> None:
    assert rows[state].excess == 1.0


def supplement(degrees: float) -> float:
    """Explanatory Supplement to the Astronomical Almanac (Seidelmann 1992; Urban and Seidelmann 2013): a cubic for each range."""
    ranges = {
        20: (3.74, 3.97, -4.07, 1.47),
        5: (3.05, 13.28, -45.98, 64.33),
        -0.8: (2.88, 22.26, -207.64, 1034.30),
        -5: (2.88, 21.81, -258.11, -858.36),
        -12: (2.70, 12.17, -431.69, -1899.83),
        -18.1: (13.84, 262.72, 1447.42, 2797.93),
    }
    cubic = next(numbers for low, numbers in ranges.items() if degrees > low)
    return 10 ** sum(number * (degrees / 90) ** power for power, number in enumerate(cubic))


def circular(degrees: float) -> float:
    """USNO Circular 171 (Janiczek and DeYoung 1987), subroutines REFR and ATMOS: refraction ends at sunset there."""
    seen = degrees
    if degrees >= -5 / 6:
        seen += 1 / math.tan(math.radians(degrees + 8.6 / (degrees + 4.42))) / 60
    up, shell = math.sin(math.radians(seen)), 753.66156
    cosine = math.cos(math.asin(shell * math.cos(math.radians(seen)) / (shell + 1)))
    mass = shell * (cosine - up) + cosine
    return 133775 * (math.exp(-0.21 * mass) * up + 0.0289 * math.exp(-0.042 * mass) * (1 + math.radians(seen + 90) * up))


def ies(degrees: float) -> float:
    """IES, "Recommended Practice for the Calculation of Daylight Availability", J. IES 13, 1984: clear sky."""
    up = math.sin(math.radians(degrees))
    return 127.5e3 * math.exp(-0.21 / up) * up + 800 + 15.5e3 * math.sqrt(up)


@pytest.mark.parametrize(
    ("state", "degrees", "curves", "night"),
    [
        ("sun at 60 degrees", 60, (supplement, circular, ies), (0, 0)),
        ("sun at 5 degrees", 5, (supplement, circular, ies), (0, 0)),
        ("sun at 0 degrees", 0, (supplement, circular), (0, 0)),
        # Each source's own moonless night: 0.0005 lx in the Circular, 0.002 lx with the Supplement.
        ("sun at -12 degrees", -12, (supplement, circular), (2e-3, 5e-4)),
        ("sun at -18 degrees", -18, (supplement, circular), (2e-3, 5e-4)),
    ],
)
def test_ranges_are_those_of_the_published_curves(
    state: str, degrees: float, curves: tuple[Callable[[float], float], ...], night: tuple[float, float]
) -> None:
    values = [curve(degrees) + dark for curve, dark in zip(curves, (*night, 0), strict=False)]
    assert LITERATURE[state].low_lx == pytest.approx(min(values), rel=0.01)  # two or three digits are written down
    assert LITERATURE[state].high_lx == pytest.approx(max(values), rel=0.01)


@pytest.mark.parametrize(("state", "degrees"), [("sunset, -0.83 degrees", -0.83), ("sun at -6 degrees", -6)])
def test_what_is_measured_agrees_with_the_published_curves(state: str, degrees: float) -> None:
    for curve in (supplement, circular):
        assert LITERATURE[state].low_lx <= curve(degrees) <= LITERATURE[state].high_lx


# Day and twilight between the table's rows. The curves themselves are up to 19 % apart (2 degrees up and at -5).
@pytest.mark.parametrize("degrees", [70, 40, 20, 10, 2, -2, -3, -4, -5, -8, -10])
def test_the_whole_day_follows_the_published_curves(degrees: float) -> None:
    found = illuminance(make_lighting(PLACE, time_of_elevation(degrees)))
    curves = [curve(degrees) for curve in ((supplement, circular, ies) if degrees > 0 else (supplement, circular))]
    assert min(curves) / 1.25 < found < max(curves) * 1.25


def test_states_are_in_order_of_falling_light(rows: dict[str, Row]) -> None:
    falling = [row.model_lx for state, row in rows.items() if not state.startswith("full moon")]
    assert falling == sorted(falling, reverse=True)


def test_excess_tells_too_bright_from_too_dark() -> None:
    assert Row("x", 10.0, Measured(8.0, 12.0, "")).excess == 1
    assert Row("x", 25.2, Measured(8.0, 12.0, "")).excess == pytest.approx(2.0)
    assert Row("x", 4.0 / 1.05, Measured(8.0, 12.0, "")).excess == pytest.approx(0.5)


def test_elevations_are_found_to_the_second() -> None:
    # 15 arc seconds a second at most.
    assert sun_position(PLACE, time_of_elevation(-12.0)).true_elevation_degrees == pytest.approx(-12.0, abs=0.005)
    assert sun_position(PLACE, time_of_elevation(5.0)).true_elevation_degrees == pytest.approx(5.0, abs=0.005)


def test_the_command_prints_every_row_beside_the_range_that_it_is_held_to(capsys: pytest.CaptureFixture[str]) -> None:
    main()
    rows = [line.strip("| ").split(" | ") for line in capsys.readouterr().out.replace(",", "").splitlines()[2:]]
    assert [row[0] for row in rows] == [state.replace(",", "") for state in LITERATURE]
    for _, model, held, published, *_ in rows:
        (low, high), (least, most) = ([float(end) for end in ends.split(" - ")] for ends in (held, published))
        assert low <= float(model) <= high
        assert low < least < most < high


def test_the_table_of_math_md_is_what_the_command_prints(capsys: pytest.CaptureFixture[str]) -> None:
    main()
    text = resources.files("gi_core").joinpath("MATH.md").read_text(encoding="utf-8")
    assert capsys.readouterr().out in text
