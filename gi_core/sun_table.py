"""The sun directions that a bake traces, and how a direction of the sun blends the planes of visibility baked for them.

Nodes form a grid over declination (the season) and hour angle (the time of day), the two angles that the sun's path follows, so
that one table serves every moment of every year at one latitude:

    declination   +23.44  o--o--o--o--o--o--o      rows, both solstices included
                    0     .--o--o--o--o--o--.      . = dropped, below the horizon: an alias of the nearest kept node
                  -23.44  .--.--o--o--o--.--.
                          hour angle, the full circle, wraps

A plane is a kept node's number, counted row by row. Nodes down to one grid step below the horizon are kept, so that a rising sun
blends into the table instead of switching on.

The frame of the grid is (M, W, P): M where the meridian meets the celestial equator, W the west point, P the celestial north pole.
It is turned into the world's by a rotation, which has no special case at the poles of the Earth.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from gi_core.arrays import Float32, Float64, Int32
from gi_core.errors import CorruptFileError, InputError
from gi_core.world import Location, world_from_east_north

# Earth's obliquity in 2000; it falls by 0.013 degrees a century. The moon reaches 28.6 and is clamped, at most 5.2 degrees off:
# two more rows (a third more planes to trace and store) would be a high price for a light of 0.2 lx.
DECLINATION_LIMIT_DEGREES = 23.44
# 126 planes at 40 degrees of latitude.
DEFAULT_STEP_DEGREES = 10.0
# Below this a ray would graze the ground it starts from for hundreds of metres.
LOWEST_TRACED_ELEVATION_DEGREES = 0.5
# From 1 degree (17 000 nodes) to a quarter of a circle.
STEP_RANGE_DEGREES = (1.0, 90.0)


def world_from_equatorial(latitude_degrees: float, north_degrees: float) -> Float64:
    """(3, 3) float64 rotation whose columns are M, W and P in the world frame."""
    latitude = math.radians(latitude_degrees)
    sin, cos = math.sin(latitude), math.cos(latitude)
    # Rows: what each of M, W, P has of east, north, up.
    east = np.array([0.0, -1.0, 0.0])
    north = np.array([-sin, 0.0, cos])
    up = np.array([cos, 0.0, sin])
    x, z = world_from_east_north(east, north, north_degrees)
    return np.stack([x, up, z])


@dataclass(frozen=True, eq=False)
class SunTable:
    """Sun directions to trace and how to blend between them. D planes, R rows of declination, H columns of hour angle.

    latitude_degrees, north_degrees : of the world's Location
    declination_step_degrees, hour_angle_step_degrees : the largest distance between nodes; the real one divides the range evenly
    directions : (D, 3) float64, unit, world frame, towards the sun, at least 0.5 degrees above the horizon
    plane_of_node : (R, H) int32, the plane that a node reads; dropped nodes read the nearest kept one
    """

    latitude_degrees: float
    north_degrees: float
    declination_step_degrees: float
    hour_angle_step_degrees: float
    directions: Float64
    plane_of_node: Int32
    _equatorial_from_world: Float64

    @classmethod
    def build(
        cls,
        location: Location,
        declination_step_degrees: float = DEFAULT_STEP_DEGREES,
        hour_angle_step_degrees: float = DEFAULT_STEP_DEGREES,
    ) -> "SunTable":
        """The table for a place. Deterministic. Raises InputError for a step outside 1..90 degrees or an impossible latitude."""
        return cls._build(location.latitude_degrees, location.north_degrees, declination_step_degrees, hour_angle_step_degrees)

    @classmethod
    def _build(cls, latitude: float, north: float, declination_step: float, hour_angle_step: float) -> "SunTable":
        low, high = STEP_RANGE_DEGREES
        for name, step in (("declination", declination_step), ("hour angle", hour_angle_step)):
            if not low <= step <= high:
                raise InputError(f"sun table: expected a {name} step of {low:g}..{high:g} degrees, got {step!r}")
        if not -90 <= latitude <= 90 or not math.isfinite(north):
            raise InputError(f"sun table: expected a latitude of -90..90 and a finite north, got {latitude!r} and {north!r}")
        rows = math.ceil(2 * DECLINATION_LIMIT_DEGREES / declination_step) + 1
        columns = math.ceil(360 / hour_angle_step)
        declination = np.radians(np.linspace(-DECLINATION_LIMIT_DEGREES, DECLINATION_LIMIT_DEGREES, rows))[:, None]
        hour_angle = (np.arange(columns) * (2 * np.pi / columns))[None, :]
        equatorial = np.stack(
            [
                np.cos(declination) * np.cos(hour_angle),
                np.cos(declination) * np.sin(hour_angle),
                np.broadcast_to(np.sin(declination), (rows, columns)),
            ],
            axis=-1,
        ).reshape(-1, 3)
        world_from_grid = world_from_equatorial(latitude, north)
        nodes = equatorial @ world_from_grid.T
        lowest_kept = -math.sin(math.radians(max(declination_step, hour_angle_step)))
        kept = nodes[:, 1] > lowest_kept
        # Rounded, so that of two equally near nodes the first is taken on every machine.
        nearest = np.argmax(np.round(nodes @ nodes[kept].T, 9), axis=1)
        plane = np.where(kept, np.cumsum(kept) - 1, nearest).astype(np.int32).reshape(rows, columns)
        directions = _raised(nodes[kept], math.radians(LOWEST_TRACED_ELEVATION_DEGREES))
        return cls(latitude, north, declination_step, hour_angle_step, directions, plane, np.ascontiguousarray(world_from_grid.T))

    @property
    def plane_count(self) -> int:
        return len(self.directions)

    def lookup(self, direction: Float64) -> tuple[Int32, Float32]:
        """Planes and weights that stand for a sun in ``direction`` (3,), world frame, any length but 0.

        Returns planes (4,) int32 and weights (4,) float32 that sum to 1; a plane can occur twice. Bilinear and continuous in the
        direction, also through the horizon. Beyond the solstices' declinations (the moon) the nearest row is read. Only at the
        celestial poles, where neither sun nor moon ever stand, the hour angle and with it the answer are arbitrary.
        """
        vector = np.asarray(direction, np.float64)
        length = float(np.linalg.norm(vector))
        if vector.shape != (3,) or not math.isfinite(length) or length == 0:
            raise InputError(f"sun table: expected a finite direction of three numbers, got {direction!r}")
        meridian, west, pole = (self._equatorial_from_world @ (vector / length)).tolist()
        rows, columns = self.plane_of_node.shape
        limit = math.radians(DECLINATION_LIMIT_DEGREES)
        declination = min(max(math.asin(min(max(pole, -1.0), 1.0)), -limit), limit)
        row = (declination + limit) / (2 * limit) * (rows - 1)
        column = (math.atan2(west, meridian) / (2 * math.pi) * columns) % columns
        first_row = min(int(row), rows - 2)
        first_column = int(column) % columns  # a tiny negative angle wraps to exactly ``columns``
        down, right = row - first_row, column - int(column)
        next_column = (first_column + 1) % columns
        planes = self.plane_of_node[
            [first_row, first_row, first_row + 1, first_row + 1],
            [first_column, next_column, first_column, next_column],
        ]
        weights = np.array([(1 - down) * (1 - right), (1 - down) * right, down * (1 - right), down * right])
        return planes, weights.astype(np.float32)

    def to_json(self) -> dict[str, float]:
        """What ``from_json`` rebuilds the table from, and ``planes``, the number of them, as a check."""
        return {
            "latitude_degrees": self.latitude_degrees,
            "north_degrees": self.north_degrees,
            "declination_step_degrees": self.declination_step_degrees,
            "hour_angle_step_degrees": self.hour_angle_step_degrees,
            "planes": self.plane_count,
        }

    @classmethod
    def from_json(cls, record: Any) -> "SunTable":
        """The table that ``to_json`` described. Raises CorruptFileError when the record is not one."""
        names = ("latitude_degrees", "north_degrees", "declination_step_degrees", "hour_angle_step_degrees", "planes")
        if not isinstance(record, dict) or set(record) != set(names):
            raise CorruptFileError(f"sun table: expected an object with {', '.join(names)}, got {record!r:.120}")
        for name in names:
            if isinstance(record[name], bool) or not isinstance(record[name], int | float):
                raise CorruptFileError(f"sun table: expected {name} to be a number, got {record[name]!r:.60}")
        try:
            table = cls._build(*(float(record[name]) for name in names[:4]))
        except InputError as error:
            raise CorruptFileError(str(error)) from error
        except OverflowError as error:  # JSON's integers have no bound
            raise CorruptFileError(f"sun table: expected angles in degrees, got {record!r:.120}") from error
        if table.plane_count != record["planes"]:
            raise CorruptFileError(f"sun table: expected {record['planes']} planes, its grid has {table.plane_count}; bake again")
        return table


def _raised(directions: Float64, lowest_elevation: float) -> Float64:
    """Directions (n, 3) with those below an elevation [rad] lifted to it, at their own azimuth."""
    level = np.hypot(directions[:, 0], directions[:, 2])
    raised = directions.copy()
    low = directions[:, 1] < math.sin(lowest_elevation)
    # A low direction is far from the zenith: its level part is not 0.
    raised[low] *= (math.cos(lowest_elevation) / level[low])[:, None]
    raised[low, 1] = math.sin(lowest_elevation)
    return raised
