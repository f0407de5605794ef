"""Clocks that jump, run backwards and change, and whole days: the same moment is the same bytes, and neighbours are close."""

import math
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, date, datetime, timedelta

import numpy as np
import pytest

from gi_core import lighting_steps
from gi_core.clock_time import parse_time, time_zone
from gi_core.light_track import LightTrack
from gi_core.lighting import Lighting
from gi_core.lighting_model import _make_lighting, make_lighting
from gi_core.lighting_steps import FASTEST_DAY, FASTEST_PLACE, TOLERANCE, largest_steps, main
from gi_core.lighting_table import illuminance
from gi_core.sun import sun_position
from gi_core.weather import WEATHER_RANGES, Weather, between, parse_weather, weather_of
from gi_core.world import Location

# In a second, at the equator, where light changes fastest. Twilight grows 3.2-fold a degree at most, and the sun climbs 0.0042 degrees a
# second: ln 3.2 * 0.0042 = 0.5 %, a face that looks away from the sun a little more. The beam gains 4 / (pi * 0.533) of its strength a
# degree while the disc comes up: 1 % a second, and until it is out it gives less than the sky.
BOUNDS = {"illuminance": 0.006, "sky cube": 0.007, "sun": 0.01, "moon": 0.01, "sun's direction": 0.006}


@pytest.mark.parametrize(
    ("start", "hours", "moving"),
    [
        (4.8, 1.5, set(BOUNDS)),  # dawn, with a full moon going down
        (17.75, 1.5, set(BOUNDS)),  # dusk, with it coming up
        (3 * 24 + 20.4, 0.8, {"illuminance", "sky cube", "moon", "sun's direction"}),  # moonrise in a dark night
    ],
)
def test_nothing_jumps_while_sun_and_moon_rise_and_set(start: float, hours: float, moving: set[str]) -> None:
    steps = largest_steps(FASTEST_PLACE, FASTEST_DAY + timedelta(hours=start), hours)
    assert [step.quantity for step in steps] == list(BOUNDS)
    assert {step.quantity for step in steps if step.per_second > 0} == moving
    for step in steps:
        assert step.per_second < BOUNDS[step.quantity], step


@pytest.mark.slow
@pytest.mark.parametrize(
    ("latitude", "on"),
    [(0.0, date(2024, 3, 25)), (40.7, date(2024, 6, 22)), (40.7, date(2024, 12, 1)), (67.0, date(2024, 1, 25)), (-90.0, date(2024, 3, 21))],
)
@pytest.mark.parametrize("weather", ["clear", "fog"])
def test_no_second_of_whole_days_jumps(latitude: float, on: date, weather: str) -> None:
    start = datetime(on.year, on.month, on.day, tzinfo=UTC)
    for step in largest_steps(Location(latitude, 0.0, 0.0, "UTC", source="given"), start, 24.0, weather):
        assert step.per_second < BOUNDS[step.quantity], step


def test_a_jump_is_found_in_its_second(monkeypatch: pytest.MonkeyPatch) -> None:
    start, at = datetime(2024, 3, 25, 12, tzinfo=UTC), datetime(2024, 3, 25, 12, 17, 43, tzinfo=UTC)
    real = make_lighting

    def jumping(place: Location, moment: datetime, weather: str) -> Lighting:
        light = real(place, moment, weather)
        if moment >= at:
            object.__setattr__(light := _copy(light), "sky_cube", light.sky_cube * 1.02)
        return light

    monkeypatch.setattr(lighting_steps, "make_lighting", jumping)
    cube = next(step for step in largest_steps(FASTEST_PLACE, start, 0.5) if step.quantity == "sky cube")
    assert cube.per_second == pytest.approx(math.log(1.02), rel=0.02)
    assert cube.moment == at - timedelta(seconds=1)
    assert TOLERANCE < 0.01  # or 2 % could hide


def _copy(light: Lighting) -> Lighting:
    return Lighting(**{name: getattr(light, name) for name in Lighting.__dataclass_fields__})


def test_the_command_prints_every_quantity(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lighting_steps, "largest_steps", lambda place, start, hours: largest_steps(place, start, 0.05))
    main()
    printed = capsys.readouterr().out
    assert all(f"| {quantity} |" in printed for quantity in BOUNDS)


def test_a_clock_that_jumps_or_runs_backwards_meets_the_same_bytes() -> None:
    place = Location()
    moments = [datetime(2024, 2, 28, 21, tzinfo=UTC) + timedelta(hours=7.3 * k) for k in range(12)]
    forwards = [make_lighting(place, moment).digest for moment in moments]
    assert len(set(forwards)) == 12
    for order in (list(reversed(moments)), np.random.default_rng(1).permutation(np.array(moments)).tolist()):
        _make_lighting.cache_clear()
        again = {moment: make_lighting(place, moment).digest for moment in order}
        assert [again[moment] for moment in moments] == forwards


@pytest.mark.parametrize(
    ("zone", "second", "clock"),
    [
        ("America/New_York", "2024-03-10T07:00:00", "2024-03-10T03:00:00-04:00"),  # clocks go forward
        ("America/New_York", "2024-11-03T06:00:00", "2024-11-03T01:00:00-05:00"),  # and back
        ("Australia/Lord_Howe", "2024-04-06T15:00:00", "2024-04-07T01:30:00+10:30"),  # by half an hour
        ("Pacific/Apia", "2011-12-30T10:00:00", "2011-12-31T00:00:00+14:00"),  # a whole day is skipped
        ("America/New_York", "2024-02-29T05:00:00", "2024-02-29T00:00:00-05:00"),  # a leap day begins
        ("America/New_York", "2024-03-01T05:00:00", "2024-03-01T00:00:00-05:00"),  # and ends
        ("Europe/Berlin", "1999-12-31T23:00:00", "2000-01-01T00:00:00+01:00"),
        ("Europe/London", "2100-02-28T23:59:59", "2100-02-28T23:59:59+00:00"),  # no leap year
    ],
)
def test_midnights_leap_days_and_changes_of_clocks_are_ordinary_seconds(zone: str, second: str, clock: str) -> None:
    place = Location(40.7484, -73.9857, 10.0, zone, source="given")
    moment = datetime.fromisoformat(second).replace(tzinfo=UTC)
    before, now, after = (make_lighting(place, moment + timedelta(seconds=s)) for s in (-1, 0, 1))
    assert now.time == clock
    # However the moment is written, it is the same object.
    assert make_lighting(place, clock) is now
    assert make_lighting(place, moment.astimezone(time_zone(zone))) is now
    for one, other in ((before, now), (now, after)):
        assert abs(math.log(illuminance(other) / illuminance(one))) < 0.006
        np.testing.assert_allclose(other.sky_cube, one.sky_cube, rtol=0.01)
        turned = one.sun.direction @ other.sun.direction
        assert math.cos(math.radians(0.006)) < turned < 1


def test_the_same_hour_of_neighbouring_days_differs_as_the_season_does() -> None:
    place = Location(40.7, 0.0, 0.0, "UTC", source="given")
    noons = [datetime(2023, 12, 25, 12, tzinfo=UTC) + timedelta(days=day) for day in range(0, 368)]
    elevations = np.array([sun_position(place, noon).elevation_degrees for noon in noons])
    assert np.abs(np.diff(elevations)).max() < 0.41  # 23.44 degrees * 2 pi / 365.25, and the equation of time
    picked = [illuminance(make_lighting(place, noon)) for noon in noons[::15]]
    ratios = np.exp(np.abs(np.diff(np.log(picked))))
    assert ratios.max() < 1.35  # fifteen days: 6 degrees of a winter sun that stands 26 degrees high


def test_the_hour_that_clocks_repeat_is_two_hours() -> None:
    """Whichever of them is asked for first: datetimes that differ in nothing but their offset look equal to a cache."""
    first, second = (make_lighting(Location(), f"2024-11-03T01:30{offset}") for offset in ("-04:00", "-05:00"))
    assert [light.time[-6:] for light in (first, second)] == ["-04:00", "-05:00"]
    turned = math.degrees(math.acos(float(first.sun.direction @ second.sun.direction)))
    assert turned == pytest.approx(15 * math.cos(math.radians(15)), abs=0.2)  # an hour of the path of a sun 15 degrees south


def test_a_standing_clock_can_jump_from_one_of_the_repeated_hours_to_the_other() -> None:
    first = parse_time("2024-11-03T01:30-04:00", Location())
    with ThreadPoolExecutor(1) as worker:
        track = LightTrack(Location(), worker, lambda _: parse_weather("clear"))
        assert [track.at(moment, 0).time[-6:] for moment in (first, first.replace(fold=1))] == ["-04:00", "-05:00"]


def test_a_clock_that_runs_leaves_what_queries_asked_for_in_memory() -> None:
    """At 60 x, a day makes ten times as many as are kept."""
    start = datetime(2024, 6, 1, 8, tzinfo=UTC)
    asked = make_lighting(Location(), start + timedelta(hours=1))
    kept = _make_lighting.cache_info().currsize
    with ThreadPoolExecutor(1) as worker:
        track = LightTrack(Location(), worker, lambda _: parse_weather("clear"))
        for second in range(3):
            track.at(start + timedelta(minutes=second), 60.0)
    assert _make_lighting.cache_info().currsize == kept
    assert make_lighting(Location(), start + timedelta(hours=1)) is asked


@pytest.mark.parametrize("rate", [1.0, 60.0])
def test_weather_that_turns_into_another_moves_light_little_by_little(rate: float) -> None:
    """Wherever in a step it begins, and where the clock's rate changes meanwhile: light of before it began would be of what it becomes."""
    clear, overcast = parse_weather("clear"), parse_weather("overcast")
    begin, lasts_s = datetime(2024, 6, 1, 16, 0, 7, tzinfo=UTC), 120.0

    def weather_at(moment: datetime) -> Weather:
        share = (moment - begin).total_seconds() / lasts_s
        if not 0 <= share < 1:
            return overcast
        return weather_of({name: between(getattr(clear, name), getattr(overcast, name), share) for name in WEATHER_RANGES})

    with ThreadPoolExecutor(1) as worker:
        track = LightTrack(Location(), worker, weather_at)
        steps = [(second, rate if second < 60 else 4 * rate) for second in range(140)]
        suns = np.array([track.at(begin + timedelta(seconds=second), r).sun.irradiance.sum() for second, r in steps])
    share = suns / make_lighting(Location(), begin).sun.irradiance.sum()
    assert share[0] == pytest.approx(1, abs=1e-3)
    assert share[-1] < 0.01
    assert np.abs(np.diff(share)).max() < 0.02


def test_the_last_evening_of_the_last_year_has_light() -> None:
    """In UTC it is the next year already."""
    assert make_lighting(Location(), "2599-12-31T23:00").time.startswith("2599-12-31T23:00:00")
