"""The model's illuminance of level ground beside the literature's, from noon to a moonless night."""

from importlib import resources

import pytest

from gi_core.lighting_table import LITERATURE, PLACE, Measured, Row, lighting_table, main, time_of_elevation
from gi_core.sun import sun_position

# Our clear air is a little brighter in early twilight than what is published; MATH.md says why. Anything beyond this would be news.
KNOWN_EXCESS = {"sunset, -0.83 degrees": 1.09, "sun at -6 degrees": 1.02}


@pytest.fixture(scope="module")
def rows() -> dict[str, Row]:
    return {row.state: row for row in lighting_table()}


@pytest.mark.parametrize("state", LITERATURE)
def test_every_state_lies_within_what_is_published(rows: dict[str, Row], state: str) -> None:
    assert 1.0 <= rows[state].excess <= KNOWN_EXCESS.get(state, 1.0)


def test_states_are_in_order_of_falling_light(rows: dict[str, Row]) -> None:
    falling = [row.model_lx for state, row in rows.items() if state != "full moon, high"]
    assert falling == sorted(falling, reverse=True)


def test_excess_tells_too_bright_from_too_dark() -> None:
    assert Row("x", 10.0, Measured(8.0, 12.0, "")).excess == 1
    assert Row("x", 26.4, Measured(8.0, 12.0, "")).excess == pytest.approx(2.0)
    assert Row("x", 4.0 / 1.1, Measured(8.0, 12.0, "")).excess == pytest.approx(0.5)


def test_elevations_are_found_to_the_second() -> None:
    # 15 arc seconds a second at most.
    assert sun_position(PLACE, time_of_elevation(-12.0)).true_elevation_degrees == pytest.approx(-12.0, abs=0.005)
    assert sun_position(PLACE, time_of_elevation(5.0)).elevation_degrees == pytest.approx(5.0, abs=0.005)


def test_the_command_prints_every_row(capsys: pytest.CaptureFixture[str]) -> None:
    main()
    printed = capsys.readouterr().out
    assert all(f"| {state} |" in printed for state in LITERATURE)


def test_the_table_of_math_md_is_what_the_command_prints(capsys: pytest.CaptureFixture[str]) -> None:
    main()
    text = resources.files("gi_core").joinpath("MATH.md").read_text(encoding="utf-8")
    assert capsys.readouterr().out in text
