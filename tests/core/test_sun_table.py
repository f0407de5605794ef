"""Which sun directions are traced, and how a sun between them blends their planes."""

import json
import math
from datetime import UTC, date, datetime

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from gi_core.errors import CorruptFileError, InputError
from gi_core.sun import sun_position
from gi_core.sun_table import DECLINATION_LIMIT_DEGREES, SunTable, world_from_equatorial
from gi_core.world import Location, direction_from_azimuth

LATITUDES = [0.0, 40.7, 48.0, 70.0, 90.0, -35.0, -90.0]
LOWEST = math.sin(math.radians(0.5))


def table_at(latitude: float, north: float = 0.0, **steps: float) -> SunTable:
    return SunTable.build(Location(latitude, 0.0, 0.0, "UTC", north, date(2024, 6, 21)), **steps)


def sun(latitude: float, north: float, declination: float, hour_angle: float) -> np.ndarray:
    """Direction by the textbook's formulas of azimuth and elevation, independent of the table's rotation."""
    lat, dec, hour = np.radians([latitude, declination, hour_angle])
    elevation = np.arcsin(np.sin(lat) * np.sin(dec) + np.cos(lat) * np.cos(dec) * np.cos(hour))
    azimuth = np.arctan2(-np.cos(dec) * np.sin(hour), np.sin(dec) * np.cos(lat) - np.cos(dec) * np.sin(lat) * np.cos(hour))
    return direction_from_azimuth(float(np.degrees(azimuth)), float(np.degrees(elevation)), north)


@pytest.mark.parametrize("latitude", LATITUDES)
@pytest.mark.parametrize("north", [0.0, 29.0])
def test_directions_are_unit_above_the_horizon_and_few(latitude: float, north: float) -> None:
    table = table_at(latitude, north)
    np.testing.assert_allclose(np.linalg.norm(table.directions, axis=1), 1, rtol=1e-12)
    assert (table.directions[:, 1] >= LOWEST - 1e-12).all()
    # At the poles the sun of summer stands over all 36 hour angles.
    assert 100 <= table.plane_count <= (128 if abs(latitude) < 50 else 150)


@pytest.mark.parametrize("latitude", LATITUDES)
def test_every_plane_is_read_by_the_node_it_was_traced_for(latitude: float) -> None:
    table = table_at(latitude, 29.0)
    rows, columns = table.plane_of_node.shape
    assert sorted(set(table.plane_of_node.ravel().tolist())) == list(range(table.plane_count))
    for row in range(rows):
        for column in range(columns):
            declination = -DECLINATION_LIMIT_DEGREES + row * 2 * DECLINATION_LIMIT_DEGREES / (rows - 1)
            direction = sun(latitude, 29.0, declination, column * 360 / columns)
            planes, weights = table.lookup(direction)
            plane = int(planes[np.argmax(weights)])
            assert weights.max() == pytest.approx(1, abs=1e-6)
            if direction[1] >= LOWEST:
                np.testing.assert_allclose(table.directions[plane], direction, atol=1e-9)


@pytest.mark.parametrize("latitude", LATITUDES)
def test_blended_direction_follows_the_sun(latitude: float) -> None:
    # Inside the table the blend of four directions points to within the sagitta of a 10 degree cell (0.4 degrees at the worst).
    table = table_at(latitude, 29.0)
    for declination in (-23.44, -17.0, -3.0, 0.0, 11.0, 23.44):
        for hour_angle in np.arange(-180, 180, 3.7):
            direction = sun(latitude, 29.0, declination, float(hour_angle))
            if direction[1] < math.sin(math.radians(15)):  # lower, some of the four nodes were raised to the horizon
                continue
            planes, weights = table.lookup(direction)
            blend = weights @ table.directions[planes]
            assert np.degrees(np.arccos(np.clip(blend @ direction / np.linalg.norm(blend), -1, 1))) < 0.5


@pytest.mark.parametrize("latitude", LATITUDES)
def test_lookup_is_continuous_over_the_day_also_through_the_horizon(latitude: float) -> None:
    table = table_at(latitude)
    step = 0.1
    for declination in (-28.6, -23.44, -9.4, 1.0, 23.44, 28.6):
        before = None
        for hour_angle in np.arange(-180, 180 + step, step):
            planes, weights = table.lookup(sun(latitude, 0.0, declination, float(hour_angle)))
            now = np.bincount(planes, weights, table.plane_count)
            if before is not None:
                # A step of 0.1 degrees in a 10 degree cell moves 0.01 of the weight from one node to another.
                assert np.abs(now - before).sum() < 0.021
            before = now


@settings(deadline=None, max_examples=200)
@given(
    latitude=st.floats(-90, 90),
    north=st.floats(-720, 720),
    direction=st.tuples(*[st.floats(-1e6, 1e6)] * 3).filter(lambda d: np.linalg.norm(d) > 1e-6),
)
@example(latitude=90.0, north=0.0, direction=(0.0, 1.0, 0.0))
@example(latitude=0.0, north=0.0, direction=(0.0, -1.0, 0.0))
@example(latitude=0.0, north=0.0, direction=(1e-300, 1.0, 0.0))
def test_any_direction_gets_weights_that_sum_to_one(latitude: float, north: float, direction: tuple[float, ...]) -> None:
    table = table_at(latitude, north)
    planes, weights = table.lookup(np.array(direction))
    assert planes.dtype == np.int32
    assert weights.dtype == np.float32
    assert planes.shape == weights.shape == (4,)
    assert ((planes >= 0) & (planes < table.plane_count)).all()
    assert (weights >= 0).all()
    assert weights.sum() == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("latitude", [0.0, 40.7, 70.0, 90.0, -35.0])
def test_the_real_sun_of_a_solstice_noon_reads_the_node_of_a_solstice_noon(latitude: float) -> None:
    place = Location(latitude, 0.0, 0.0, "UTC", 29.0, date(2024, 6, 21))
    # The sun crosses Greenwich's meridian 2 minutes after 12:00 that day.
    position = sun_position(place, datetime(2024, 6, 20, 12, 2, tzinfo=UTC), 0.0)
    table = SunTable.build(place)
    planes, weights = table.lookup(position.direction(29.0))
    assert weights.max() > 0.97
    assert planes[np.argmax(weights)] == table.plane_of_node[-1, 0]


@pytest.mark.parametrize("latitude", [0.0, 40.7, 70.0, -35.0])
def test_a_sun_just_below_the_horizon_reads_planes_near_its_azimuth(latitude: float) -> None:
    table = table_at(latitude)
    for declination in (-23.44, -5.0, 0.0, 16.0, 23.44):
        for hour_angle in np.arange(-180, 180, 2.5):
            direction = sun(latitude, 0.0, declination, float(hour_angle))
            if not -0.2 < direction[1] < 0:
                continue
            planes, weights = table.lookup(direction)
            level = (weights @ table.directions[planes])[[0, 2]]
            toward = direction[[0, 2]]
            # Near the poles' circles the nearest kept node can lie two steps along the horizon.
            assert level @ toward / np.linalg.norm(level) / np.linalg.norm(toward) > math.cos(math.radians(25))


def test_the_frame_of_the_grid() -> None:
    meridian, west, pole = world_from_equatorial(48.0, 0.0).T
    np.testing.assert_allclose(meridian, direction_from_azimuth(180.0, 42.0, 0.0), atol=1e-12)
    np.testing.assert_allclose(west, [-1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(pole, direction_from_azimuth(0.0, 48.0, 0.0), atol=1e-12)


def test_turning_the_world_turns_the_table() -> None:
    straight, turned = table_at(48.0), table_at(48.0, 29.0)
    for azimuth, elevation in ((95.0, 12.0), (180.0, 40.0), (250.0, 3.0)):
        a = straight.lookup(direction_from_azimuth(azimuth, elevation, 0.0))
        b = turned.lookup(direction_from_azimuth(azimuth, elevation, 29.0))
        np.testing.assert_array_equal(a[0], b[0])
        np.testing.assert_allclose(a[1], b[1], atol=1e-6)


def test_json_rebuilds_the_same_bytes() -> None:
    table = table_at(40.7484, 29.0, declination_step_degrees=12.0, hour_angle_step_degrees=9.0)
    again = SunTable.from_json(json.loads(json.dumps(table.to_json())))
    assert again.directions.tobytes() == table.directions.tobytes()
    assert again.plane_of_node.tobytes() == table.plane_of_node.tobytes()
    assert again.to_json() == table.to_json()


@pytest.mark.parametrize(
    "change",
    [
        {"planes": 3},
        {"latitude_degrees": 91},
        {"latitude_degrees": "40"},
        {"north_degrees": math.nan},
        {"hour_angle_step_degrees": 1e-9},  # would ask for 3.6e11 nodes
        {"declination_step_degrees": True},
        {"extra": 1},
        {"latitude_degrees": 10**400},
    ],
)
def test_a_tampered_record_is_refused(change: dict[str, object]) -> None:
    with pytest.raises(CorruptFileError, match="sun table"):
        SunTable.from_json({**table_at(40.0).to_json(), **change})
    with pytest.raises(CorruptFileError, match="expected an object"):
        SunTable.from_json([])


@pytest.mark.parametrize("direction", [(0, 0, 0), (math.nan, 0, 1), (math.inf, 0, 0)])
def test_no_direction_is_an_error(direction: tuple[float, float, float]) -> None:
    with pytest.raises(InputError, match="finite direction"):
        table_at(40.0).lookup(np.array(direction, float))


@pytest.mark.parametrize("step", [0.0, 0.5, 91.0, math.nan, -10.0])
def test_an_absurd_step_is_an_error(step: float) -> None:
    with pytest.raises(InputError, match=r"step of 1\.\.90"):
        table_at(40.0, hour_angle_step_degrees=step)
