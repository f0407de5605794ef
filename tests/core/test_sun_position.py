"""Sun and moon against NREL's algorithm, the seasons, and almanac dates."""

import json
import math
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, date, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from gi_core.errors import InputError
from gi_core.sun import moon_position, refraction_degrees, sun_position
from gi_core.world import Location

SHARED = Path(__file__).resolve().parents[2].parent / "shared" / "data"


def place(latitude: float, longitude: float = 0.0, north: float = 0.0) -> Location:
    return Location(latitude, longitude, 0.0, "UTC", north, date(2024, 6, 21))


def day(year: int, month: int, number: int, hour: float = 0.0) -> datetime:
    return datetime(year, month, number, tzinfo=UTC) + timedelta(hours=hour)


def test_nrels_worked_example() -> None:
    path = SHARED / "nrel_spa_example.json"
    if not path.exists():
        pytest.skip("NREL's worked example is not here")
    example = json.loads(path.read_text())[0]
    location = Location(example["lat"], example["lon"], example["elev_m"], "America/Denver")
    sun = sun_position(location, datetime.fromisoformat(example["local_time"]), example["pressure_mbar"], example["temp_C"])
    # SPA claims 0.0003 degrees; the rest is the difference of refraction's inputs (geometric or lifted elevation).
    assert 90 - sun.elevation_degrees == pytest.approx(example["topocentric_zenith_deg"], abs=0.002)
    assert sun.azimuth_degrees == pytest.approx(example["azimuth_deg_from_north"], abs=0.002)


@pytest.mark.parametrize("latitude", [0.0, 40.7, 48.0, 66.0, -35.0])
@pytest.mark.parametrize(
    ("on", "declination"),
    [((2024, 3, 20, 3.1), 0.0), ((2024, 6, 20, 20.85), 23.44), ((2024, 9, 22, 12.7), 0.0), ((2024, 12, 21, 9.35), -23.44)],
)
def test_noon_elevation_at_solstices_and_equinoxes(latitude: float, on: tuple[int, int, int, float], declination: float) -> None:
    moment = day(*on)

    # At that instant it is noon somewhere: search the longitude where the sun stands highest.
    def elevation(longitude: float) -> float:
        return sun_position(place(latitude, longitude), moment, 0.0).true_elevation_degrees

    near = max(np.arange(-180.0, 180.0, 1.0).tolist(), key=elevation)
    best = max(elevation(longitude) for longitude in np.arange(near - 1, near + 1, 0.01).tolist())
    assert best == pytest.approx(90 - abs(latitude - declination), abs=0.02)


def test_the_sun_rises_in_the_east_stands_south_at_noon_and_sets_in_the_west() -> None:
    morning, noon, evening = (sun_position(place(40.0), day(2024, 3, 20, hour)).direction(0.0) for hour in (6.5, 12.12, 17.5))
    assert morning[0] > 0.95
    assert noon[2] > 0.5
    assert abs(noon[0]) < 0.02
    assert evening[0] < -0.95
    turned = sun_position(place(40.0), day(2024, 3, 20, 12.12)).direction(29.0)
    # The world's -Z looks 29 degrees east of north, so everything stands 29 degrees further west of it.
    west_of_south = [math.degrees(math.atan2(-direction[0], direction[2])) for direction in (noon, turned)]
    assert west_of_south[0] - west_of_south[1] == pytest.approx(29.0, abs=1e-9)


def test_the_polar_sun_circles_at_one_height() -> None:
    elevations = [sun_position(place(90.0), day(2024, 6, 21, hour), 0.0).true_elevation_degrees for hour in range(24)]
    assert max(elevations) - min(elevations) < 0.01
    assert np.mean(elevations) == pytest.approx(23.44, abs=0.01)
    winter = [sun_position(place(90.0), day(2024, 12, 21, hour)).elevation_degrees for hour in range(24)]
    assert max(winter) < -23


def test_full_and_new_moon_and_an_eclipse() -> None:
    full = moon_position(place(0.0), day(2024, 6, 22, 1.13))
    new = moon_position(place(0.0), day(2024, 6, 6, 12.63))
    # 11 degrees from either a hundredth of the disc is dark, or lit: (1 + cos) / 2.
    assert full.phase_angle_degrees < 11
    assert new.phase_angle_degrees > 169
    # The total solar eclipse of 2024-04-08 in Torreon, 18:18 UT: both discs in one place.
    torreon = place(25.54, -103.41)
    at = day(2024, 4, 8, 18.3)
    sun, moon = sun_position(torreon, at).direction(0.0), moon_position(torreon, at)
    assert math.degrees(math.acos(sun @ moon.direction(0.0))) < 0.15
    assert moon.phase_angle_degrees > 179


def test_refraction_at_the_horizon_and_its_fade() -> None:
    # Almanacs use 34 minutes of arc at the horizon, 1 at 45 degrees.
    assert refraction_degrees(-0.5, 1010, 10) * 60 == pytest.approx(34, abs=1)
    assert refraction_degrees(45, 1010, 10) * 60 == pytest.approx(1, abs=0.05)
    assert refraction_degrees(0, 0.0, 10) == 0
    assert refraction_degrees(-5, 1010, 10) == refraction_degrees(-90, 1010, 10) == 0
    true = np.arange(-90, 90, 0.01)
    lifted = np.array([t + refraction_degrees(float(t), 1010, 10) for t in true])
    assert (np.diff(lifted) > 0).all()  # never folds two heights onto one
    assert np.diff(lifted).max() < 0.02  # nor jumps


def test_threads_do_not_disturb_each_other() -> None:
    moments = [day(2024, 1, 1, hour) for hour in range(0, 8760, 73)]
    alone = [sun_position(place(40.0), moment) for moment in moments]
    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(lambda moment: sun_position(place(40.0), moment), moments)) == alone


@pytest.mark.parametrize("where", [(91.0, 0.0, 0.0), (float("nan"), 0.0, 0.0), (0.0, float("inf"), 0.0), (0.0, 0.0, 1e9)])
def test_an_impossible_place_is_an_input_error(where: tuple[float, float, float]) -> None:
    latitude, longitude, height = where
    with pytest.raises(InputError, match="location: expected a latitude"):
        sun_position(Location(latitude, longitude, height, "UTC"), day(2024, 1, 1))
