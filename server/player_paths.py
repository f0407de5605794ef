"""A player's path as users write it: a list of points, or a GeoJSON LineString. Metres of the world frame."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from gi_core.errors import InputError
from server.json_input import number, numbers, read_text, shown
from server.path_walk import Point

MAX_POINTS = 10_000
MAX_COORDINATE_M = 1e7  # as for queries
MAX_PATH_FILE_BYTES = 1 << 22
# Asks for the height [m] of somebody's eyes above a place (x, z) [m]; None where nobody can stand.
EyeHeight = Callable[[float, float], float | None]


def points_from_json(value: Any, where: str, eye_height: EyeHeight | None = None) -> tuple[Point, ...]:
    """A path's points from a list of [x, y, z], or from a GeoJSON LineString, or a Feature or collection that holds just one.

    All in metres of the world frame. GeoJSON has its own order: [x, z], and the height third where there is one; ``eye_height`` gives
    it where there is none. Raises InputError.
    """
    if isinstance(value, dict):
        return tuple(_from_position(position, f"{where}: position {i}", eye_height) for i, position in enumerate(_line(value, where)))
    return tuple(_xyz(point, f"{where}: point {i}") for i, point in enumerate(_many(value, where, "points")))


def read_path_file(path: Path, eye_height: EyeHeight | None = None) -> tuple[Point, ...]:
    """A path's points from a GeoJSON file. Raises InputError."""
    text = read_text(path, MAX_PATH_FILE_BYTES)
    try:
        value = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: expected GeoJSON ({error})") from error
    if not isinstance(value, dict):
        raise InputError(f"{path}: expected a GeoJSON LineString, found {shown(value)}")
    return points_from_json(value, str(path), eye_height)


def _line(value: dict[str, Any], where: str) -> list[Any]:
    """A LineString's positions."""
    kind = value.get("type")
    if kind == "FeatureCollection":
        features = value.get("features")
        if not isinstance(features, list) or len(features) != 1 or not isinstance(features[0], dict):
            raise InputError(f"{where}: features: expected one, a LineString, found {shown(features)}")
        value = features[0]
        kind = value.get("type")
    if kind == "Feature":
        geometry = value.get("geometry")
        value = geometry if isinstance(geometry, dict) else {}
        kind = value.get("type")
    if kind != "LineString":
        raise InputError(f"{where}: type: expected a GeoJSON LineString, found {shown(kind)}")
    return _many(value.get("coordinates"), f"{where}: coordinates", "positions")


def _many(value: Any, where: str, what: str) -> list[Any]:
    if not isinstance(value, list | tuple) or not 1 <= len(value) <= MAX_POINTS:
        found = f"{len(value)}" if isinstance(value, list | tuple) else shown(value)
        raise InputError(f"{where}: expected 1 to {MAX_POINTS} {what}, found {found}")
    return list(value)


def _xyz(value: Any, where: str) -> Point:
    x, y, z = numbers(value, where, 3, -MAX_COORDINATE_M, MAX_COORDINATE_M)
    return x, y, z


def _from_position(value: Any, where: str, eye_height: EyeHeight | None) -> Point:
    if not isinstance(value, list | tuple) or len(value) not in (2, 3):
        raise InputError(f"{where}: expected [x, z] or [x, z, height] in metres, found {shown(value)}")
    x, z = numbers(value[:2], where, 2, -MAX_COORDINATE_M, MAX_COORDINATE_M)
    if len(value) == 3:
        return x, number(value[2], where, -MAX_COORDINATE_M, MAX_COORDINATE_M), z
    height = None if eye_height is None else eye_height(x, z)
    if height is None:
        raise InputError(f"{where}: expected a height as third number where no street is known, found {shown(list(value))}")
    return x, height, z
