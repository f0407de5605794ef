"""Where somebody who walks along a path is at any time: a closed form in time, so nothing adds up from tick to tick.

A path becomes one lap: a list of moments and where the walker is at each, with straight lines between. A closed path's lap goes round;
an open one's goes there and back. At a corner a walker may pause and turn on the spot: two moments with one place. Finding the moment
is a binary search, so a time that is years away costs what the next one does.
"""

import math
from bisect import bisect_right
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gi_core.arrays import Float64

Point = tuple[float, float, float]
# Points closer than this to the one before say nothing about a direction.
_SAME_PLACE_M = 1e-3
# A bend of less is no corner to stop at: a curve is many points.
_CORNER_DEGREES = 10.0


class Pose(NamedTuple):
    """position (x, y, z) [m]; velocity [m/s]; heading_degrees 0..360, 0 looks along -Z, 90 along +X, and goes on when one stands."""

    position: Point
    velocity: Point
    heading_degrees: float


class PathWalk:
    """Somebody on a path. Immutable; safe to share between threads."""

    def __init__(
        self,
        points: Sequence[Point],
        speed: float,
        loop: bool,
        *,
        pause_s: tuple[float, float] = (0.0, 0.0),
        turn_s: float = 0.0,
        seed: int = 0,
    ) -> None:
        """points : world metres, at least one; speed : [m/s], 0 stands at the first
        loop : the last point leads to the first; else the path is walked back and forth
        pause_s : shortest and longest pause at each corner, a turn of 10 degrees or more [s], drawn from ``seed`` once: laps are alike
        turn_s : how long turning round by 180 degrees on the spot takes [s]; 0 turns at once
        """
        corners = _lap(np.asarray(points, np.float64).reshape(-1, 3), loop)
        legs = np.diff(corners, axis=0)
        length = np.linalg.norm(legs, axis=1)
        heading = _headings(legs)
        turn = _turns(heading)
        self.length_m = float(length.sum())
        self.lap_s = math.inf
        self._standing = Pose(_point(corners[0]), (0.0, 0.0, 0.0), float(heading[0]) if len(heading) else 0.0)
        if len(legs) == 0 or not speed > 0 or not math.isfinite(self.length_m / speed):
            return
        # Before each leg one pauses, still looking back along the last, and turns.
        pause = np.where(np.abs(turn) >= _CORNER_DEGREES, np.random.default_rng(seed).uniform(*pause_s, len(legs)), 0.0)
        spans = np.stack([pause, np.abs(turn) * (turn_s / 180), length / speed], axis=1)
        begin = np.concatenate([[0.0], np.cumsum(spans)])
        self.lap_s = float(begin[-1])
        self._begin: list[float] = begin[:-1].tolist()
        self._span: list[float] = spans.reshape(-1).tolist()
        self._corner: list[Point] = [_point(corner) for corner in corners]
        self._velocity: list[Point] = [_point(v) for v in legs * (speed / length)[:, None]]
        self._heading: list[float] = heading.tolist()
        self._turn: list[float] = turn.tolist()
        # A lap starts at the end of its first pause and turn: a walker walks at time 0.
        self._start_s: float = self._begin[2]

    def at(self, seconds: float) -> Pose:
        """Where the walker is after some time, 0 or more [s]."""
        if math.isinf(self.lap_s):
            return self._standing
        t = math.fmod(self._start_s + math.fmod(seconds, self.lap_s), self.lap_s)
        i = bisect_right(self._begin, t) - 1
        leg, part = divmod(i, 3)
        since = min(t - self._begin[i], self._span[i])
        (x, y, z), heading = self._corner[leg], self._heading[leg]
        if part == 2:
            u, v, w = self._velocity[leg]
            return Pose((x + u * since, y + v * since, z + w * since), (u, v, w), heading)
        left = self._turn[leg] * (1.0 if part == 0 else 1.0 - since / self._span[i])
        return Pose((x, y, z), (0.0, 0.0, 0.0), (heading - left) % 360.0 % 360.0)


def _lap(points: Float64, loop: bool) -> Float64:
    """Corners of a lap (n, 3), the first again at its end; one corner for somebody who has nowhere to go."""
    kept = [points[0]]
    for point in points[1:]:
        if np.linalg.norm(point - kept[-1]) >= _SAME_PLACE_M:
            kept.append(point)
    if loop:
        while len(kept) > 1 and np.linalg.norm(kept[-1] - kept[0]) < _SAME_PLACE_M:
            kept.pop()
        kept += kept[:1] if len(kept) > 1 else []
    else:
        kept += kept[-2::-1]
    return np.array(kept)


def _headings(legs: Float64) -> Float64:
    """(n,) [degrees] 0..360 of each leg; one that goes straight up or down keeps that of the leg before."""
    level = np.hypot(legs[:, 0], legs[:, 2]) > 1e-9
    # A little less than 0 is 360 when it is taken modulo 360.
    heading = np.degrees(np.arctan2(legs[:, 0], -legs[:, 2])) % 360 % 360
    if not level.any():
        return np.zeros(len(legs))
    # The lap is closed: before the first level leg comes the last one.
    latest = np.maximum.accumulate(np.where(level, np.arange(len(legs)), -1))
    latest[latest < 0] = np.flatnonzero(level)[-1]
    return np.asarray(heading[latest])


def _turns(heading: Float64) -> Float64:
    """(n,) [degrees] -180..180: how far one turns before each leg."""
    return np.asarray((heading - np.roll(heading, 1) + 180) % 360 - 180)


def _point(values: Float64) -> Point:
    x, y, z = values.tolist()
    return x, y, z
