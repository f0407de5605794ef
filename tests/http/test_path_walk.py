"""Where a player is: a closed form of time, continuous, at its speed, the same whenever it is asked."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from server.path_walk import PathWalk, Point

SQUARE = [(0.0, 1.6, 0.0), (10.0, 1.6, 0.0), (10.0, 1.6, 10.0), (0.0, 1.6, 10.0)]
points_of = st.lists(st.tuples(*[st.floats(-1e4, 1e4)] * 3), min_size=1, max_size=12)
walks: Any = st.builds(
    PathWalk,
    points_of,
    st.floats(0.01, 200),
    st.booleans(),
    pause_s=st.tuples(st.floats(0, 3), st.floats(3, 10)),
    turn_s=st.floats(0, 5),
    seed=st.integers(0, 2**53),
)


def near(a: Sequence[float], b: Sequence[float], tolerance: float = 1e-6) -> bool:
    return math.dist(a, b) <= tolerance


def test_a_loop_goes_round() -> None:
    walk = PathWalk(SQUARE, 2.0, True)
    assert (walk.length_m, walk.lap_s) == (40.0, 20.0)
    for t, place, heading in (
        (0, (0, 1.6, 0), 90),
        (2.5, (5, 1.6, 0), 90),
        (6, (10, 1.6, 2), 180),
        (11, (8, 1.6, 10), 270),
        (16, (0, 1.6, 8), 0),
    ):
        for lap in (0, 1, 1000):
            pose = walk.at(t + 20.0 * lap)
            assert near(pose.position, place)
            assert pose.heading_degrees == pytest.approx(heading)
    assert walk.at(6).velocity == pytest.approx((0, 0, 2))


def test_an_open_path_is_walked_back_and_forth() -> None:
    walk = PathWalk(SQUARE[:3], 2.0, False)
    assert walk.lap_s == 20.0
    for t, place in ((0, (0, 1.6, 0)), (10, (10, 1.6, 10)), (11, (10, 1.6, 8)), (19, (2, 1.6, 0)), (21, (2, 1.6, 0))):
        assert near(walk.at(t).position, place)
    assert walk.at(11).velocity == pytest.approx((0, 0, -2))
    assert walk.at(11).heading_degrees == pytest.approx(0)


def test_pauses_and_turns_are_stood_through_at_the_corner() -> None:
    walk = PathWalk(SQUARE, 2.0, True, pause_s=(3.0, 3.0), turn_s=4.0)
    assert walk.lap_s == 20 + 4 * (3 + 2)
    pose = walk.at(5.0 + 1.5)
    assert near(pose.position, (10, 1.6, 0))
    assert pose.velocity == (0, 0, 0)
    assert pose.heading_degrees == pytest.approx(90)
    assert walk.at(5.0 + 3 + 1).heading_degrees == pytest.approx(135)
    assert near(walk.at(5.0 + 5 + 1).position, (10, 1.6, 2))


@given(walks, st.floats(0, 1e6))
@settings(deadline=None)
def test_motion_is_continuous_and_no_faster_than_its_speed(walk: PathWalk, t: float) -> None:
    dt = 1 / 240
    before, after = walk.at(t), walk.at(t + dt)
    speed = max(math.hypot(*before.velocity), math.hypot(*after.velocity))
    if math.isinf(walk.lap_s):
        assert before == after
        assert speed == 0
    # A million seconds leave a double 1e-10 s; it moves 200 m/s by 2e-8 m, and laps' lengths add up to as much again.
    fastest = 200.0 if speed == 0 else speed
    assert math.dist(before.position, after.position) <= fastest * dt + 1e-5
    assert 0 <= before.heading_degrees < 360


@given(points_of, st.floats(0.01, 200), st.booleans(), st.floats(0, 1e5))
@settings(deadline=None)
def test_without_pauses_the_speed_is_always_the_speed(points: list[Point], speed: float, loop: bool, t: float) -> None:
    walk = PathWalk(points, speed, loop)
    found = math.hypot(*walk.at(t).velocity)
    assert found == pytest.approx(0 if math.isinf(walk.lap_s) else speed, rel=1e-9)
    assert math.isinf(walk.lap_s) or walk.lap_s == pytest.approx(walk.length_m / speed)


@given(walks, st.floats(0, 1e4))
@settings(deadline=None)
def test_every_place_is_on_the_path(walk: PathWalk, t: float) -> None:
    place = np.array(walk.at(t).position)
    corners = np.array(walk._corner if math.isfinite(walk.lap_s) else [walk.at(0).position] * 2)
    a, d = corners[:-1], np.diff(corners, axis=0)
    share = np.clip(((place - a) * d).sum(axis=1) / np.maximum((d**2).sum(axis=1), 1e-12), 0, 1)
    assert np.linalg.norm(a + share[:, None] * d - place, axis=1).min() < 1e-4


@given(walks, st.floats(0, 1e4), st.integers(1, 100))
@settings(deadline=None)
def test_laps_are_alike_and_time_zero_is_the_start(walk: PathWalk, t: float, laps: int) -> None:
    if math.isfinite(walk.lap_s):
        assert near(walk.at(0).position, walk._corner[0])
        assert near(walk.at(t).position, walk.at(t + laps * walk.lap_s).position, 1e-3)


@given(st.floats(1, 10), st.floats(0.1, 5))
def test_turning_takes_time_and_the_heading_never_jumps(speed: float, turn_s: float) -> None:
    walk = PathWalk([(0, 0, 0), (30, 0, 0), (31, 4, 0), (31, 9, 0), (2, 9, 5)], speed, True, turn_s=turn_s)
    most = 180 / turn_s * 0.01 + 1e-6
    for k in range(300):
        turned = (walk.at(0.01 * k + 0.01).heading_degrees - walk.at(0.01 * k).heading_degrees + 180) % 360 - 180
        assert abs(turned) <= most


def test_a_million_ticks_do_not_drift() -> None:
    walk = PathWalk(SQUARE, 2.0, True, pause_s=(1.0, 2.0), seed=3)
    ticks = round(walk.lap_s * 30)
    for k in (0, 7, 1000):
        whole = walk.at((k + 10**6 * ticks) / 30)
        assert near(
            whole.position, walk.at((k + 10**6 * ticks) / 30 - math.floor(10**6 * ticks / 30 / walk.lap_s) * walk.lap_s).position, 1e-4
        )
    steps = [walk.at(k / 30).position for k in range(ticks)]
    assert steps == [walk.at(k / 30).position for k in reversed(range(ticks))][::-1]


def test_pauses_are_drawn_from_the_seed() -> None:
    laps = {PathWalk(SQUARE, 2.0, True, pause_s=(0.0, 5.0), seed=seed).lap_s for seed in (1, 1, 2, 3)}
    assert len(laps) == 3


def test_a_bend_is_no_corner_to_pause_at() -> None:
    arc = [(100 * math.sin(a), 0.0, -100 * math.cos(a)) for a in np.linspace(0, 1, 30)]
    walk = PathWalk(arc, 1.0, False, pause_s=(5.0, 5.0))
    assert walk.lap_s == pytest.approx(walk.length_m + 2 * 5)  # where one turns round


@pytest.mark.parametrize(
    ("points", "speed"),
    [
        ([(1, 2, 3)], 5.0),
        ([(1, 2, 3)] * 4, 5.0),
        ([(1, 2, 3), (1, 2, 3.0005)], 5.0),
        ([(1, 2, 3), (9, 2, 3)], 0.0),
        ([(1, 2, 3), (9, 2, 3)], 5e-324),
    ],
)
@pytest.mark.parametrize("loop", [True, False])
def test_who_has_nowhere_to_go_stands(points: list[Point], speed: float, loop: bool) -> None:
    walk = PathWalk(points, speed, loop, pause_s=(1, 1), turn_s=1)
    for t in (0.0, 1e9):
        assert walk.at(t).position == (1, 2, 3)
        assert walk.at(t).velocity == (0, 0, 0)


def test_straight_up_keeps_the_heading() -> None:
    walk = PathWalk([(0, 0, 0), (4, 0, 0), (4, 9, 0)], 1.0, False)
    assert walk.at(6).velocity == pytest.approx((0, 1, 0))
    assert walk.at(6).heading_degrees == pytest.approx(90)
    assert PathWalk([(0, 0, 0), (0, 9, 0)], 1.0, False).at(3).heading_degrees == 0
