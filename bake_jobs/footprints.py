"""GeoJSON building footprints -> closed prisms on a gently sloping ground.

Read per feature, in metres: ``base`` (ground height, default 0) and ``height`` above it, or OpenStreetMap's ``height``,
``min_height`` (the part hangs in the air below it) and ``building:levels``. Features with the same ``building`` are parts of one
building and share their colour. Parts may overlap: each stays a closed solid of its own. Positions are longitude and latitude, or in the
system that the file's ``crs`` member names.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from bake_jobs.geography import MapFrame, centre_of, lonlat_of_geojson, timezone_at
from bake_jobs.scene import Mesh, SourceContent, join_meshes
from bake_jobs.solids import expect_few_rings, prism
from bake_jobs.table import read_json
from bake_jobs.terrain import MAX_CELLS, Terrain, cells_needed, terrain_under
from gi_core.arrays import Float32, Float64
from gi_core.errors import SourceError
from gi_core.json_fields import is_finite
from gi_core.world import Location

LEVEL_HEIGHT_M = 3.2
DEFAULT_HEIGHT_M = 3 * LEVEL_HEIGHT_M  # of a footprint that says nothing about its height
MAX_HEIGHT_M = 2000.0  # taller than any building; beyond it the unit is wrong
MIN_PART_AREA_M2 = 0.05  # slivers that repair leaves behind
SAME_POINT_M = 1e-3  # a ring's points this close after one another are one
FOUNDATION_M = 1.0  # how far walls go below the lowest ground near them, so that no gap opens
MAX_POINTS = 20_000_000  # of all rings; a borough of New York is 1.2 million
# Walls: brick, limestone, concrete, pale brick; each building takes one and scales it a little.
WALL_PALETTE = ((0.42, 0.33, 0.28), (0.50, 0.47, 0.41), (0.42, 0.42, 0.42), (0.50, 0.44, 0.36), (0.36, 0.38, 0.41))
WALL_VARIATION = 0.12
ROOF_ALBEDO = (0.3, 0.3, 0.3)


@dataclass(frozen=True, eq=False)
class _Part:
    """One polygon of a feature. rings: outer, then holes, (n, 2) positions, closed as in the file; is_guessed: whether its height is,
    since the feature has none that can be read."""

    rings: tuple[Float64, ...]
    building: str
    base: float
    bottom: float
    top: float
    is_guessed: bool


def load_footprints(path: Path, frame: MapFrame | None = None) -> SourceContent:
    """Read footprints; without a frame the world's origin is the middle of the data. Raises SourceError."""
    document = read_json(path, "a GeoJSON FeatureCollection")
    parts = _parts(document, path)
    lonlat = lonlat_of_geojson(np.concatenate([ring for part in parts for ring in part.rings]), document, str(path))
    _refuse_bad_places(lonlat, path)
    frame = frame or MapFrame(*centre_of(lonlat))
    xz = frame.world_from_lonlat(lonlat)
    if not np.isfinite(xz).all():
        raise SourceError(f"{path}: expected footprints near one place, found some that cannot be projected about its middle")
    polygons, part_of = _repaired_polygons(parts, xz)
    if not len(polygons):
        raise SourceError(f"{path}: expected footprints with an area, found none among {len(parts)} polygons")
    bounds = shapely.bounds(polygons)
    low, high = bounds[:, :2], bounds[:, 2:]
    if cells_needed(low, high) > MAX_CELLS:
        raise SourceError(
            f"{path}: expected footprints of one city, found {np.ptp(xz, axis=0).max():.3g} m between the farthest; split the file"
        )
    base = np.array([part.base for part in parts])[part_of]
    terrain = _terrain(polygons, np.array([part.building for part in parts])[part_of], base, low, high)
    meshes = _extrude(polygons, [parts[i] for i in part_of], terrain.lowest_below(low, high))
    location = Location(
        frame.latitude_degrees,
        frame.longitude_degrees,
        float(np.median(base)),
        timezone_at(frame.latitude_degrees, frame.longitude_degrees),
        frame.north_degrees,
        source="given",
    )
    guessed = sum(part.is_guessed for part in parts)
    note = (
        f"{path}: {guessed:,} of {len(parts):,} footprints have no height in metres and no building:levels; {DEFAULT_HEIGHT_M:g} m is taken"
    )
    return SourceContent(join_meshes([*meshes, terrain.mesh()]), location, notes=(note,) if guessed else ())


def _parts(document: dict[str, Any], path: Path) -> list[_Part]:
    kind = document.get("type")
    features = document.get("features") if kind == "FeatureCollection" else [document] if kind == "Feature" else None
    if not isinstance(features, list):
        raise SourceError(f"{path}: expected a GeoJSON FeatureCollection, found {kind}")
    parts = []
    points = 0
    for number, feature in enumerate(features):
        where = f"{path}: feature {number}"
        if not isinstance(feature, dict):
            raise SourceError(f"{where}: expected an object, found {type(feature).__name__}")
        properties = feature.get("properties") or {}
        if not isinstance(properties, dict):
            raise SourceError(f"{where}: expected properties to be an object, found {type(properties).__name__}")
        base = _metres(properties, "base", where) or 0.0
        known = _height(properties, where)
        height = DEFAULT_HEIGHT_M if known is None else known
        bottom = _metres(properties, "min_height", where) or 0.0
        if height <= bottom:
            continue
        building = str(properties.get("building", number))
        for rings in _polygons(feature.get("geometry"), where):
            expect_few_rings(rings, where)
            points += sum(len(ring) for ring in rings)
            if points > MAX_POINTS:
                raise SourceError(f"{path}: expected at most {MAX_POINTS:,} points, found more; split the file")
            parts.append(_Part(rings, building, base, base + bottom, base + height, known is None))
    if not parts:
        raise SourceError(f"{path}: expected footprints (Polygon or MultiPolygon with a height above 0), found none")
    return parts


def _polygons(geometry: Any, where: str) -> Iterator[tuple[Float64, ...]]:
    """The rings of each polygon of a geometry; points and lines are not footprints and give nothing."""
    if not isinstance(geometry, dict):
        return
    kind, coordinates = geometry.get("type"), geometry.get("coordinates")
    try:
        if kind == "GeometryCollection":
            for member in geometry.get("geometries", []):
                yield from _polygons(member, where)
        elif kind in ("Polygon", "MultiPolygon"):
            polygons: list[Any] = [coordinates] if kind == "Polygon" else list(coordinates or ())
            for polygon in polygons:
                rings = [np.array([point[:2] for point in ring], np.float64) for ring in polygon]
                if rings and len(rings[0]) >= 3:
                    yield tuple(ring.reshape(-1, 2) for ring in rings if len(ring) >= 3)
    except SourceError:
        raise
    except (TypeError, ValueError, IndexError, KeyError, OverflowError) as error:
        raise SourceError(f"{where}: expected rings of [longitude, latitude] numbers ({error})") from error


def _height(properties: dict[str, Any], where: str) -> float | None:
    """[m], or None where a feature has none that can be read."""
    height = _metres(properties, "height", where)
    if height is None:
        levels = _metres(properties, "building:levels", where)
        if levels is None:
            return None
        height = levels * LEVEL_HEIGHT_M
    if height > MAX_HEIGHT_M:
        raise SourceError(f"{where}: expected a height of at most {MAX_HEIGHT_M:g} m, found {height:g}; heights are metres")
    return height


def _metres(properties: dict[str, Any], key: str, where: str) -> float | None:
    """A number, or OpenStreetMap's text such as "12", "12.5 m"; None where it is absent, empty or not finite."""
    value = properties.get(key)
    if isinstance(value, str):
        match = re.fullmatch(r"\s*([-+]?\d+(?:\.\d*)?)\s*m?\s*", value)
        value = float(match[1]) if match else None
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise SourceError(f"{where}: expected {key} to be a number of metres, found {value!r}")
    return float(value) if is_finite(value) else None


def _refuse_bad_places(lonlat: Float64, path: Path) -> None:
    bad = ~np.isfinite(lonlat).all(axis=1) | (np.abs(lonlat) > (180, 90)).any(axis=1)
    if bad.any():
        lon, lat = lonlat[bad][0]
        raise SourceError(
            f"{path}: expected WGS84 longitude and latitude in degrees (RFC 7946), found ({lon:g}, {lat:g}); "
            "name its system in a crs member, or reproject it to EPSG:4326"
        )


def _repaired_polygons(parts: list[_Part], xz: Float64) -> tuple[Any, Any]:
    """Valid, simple polygons in world x and z, an array of shapely geometries, and the part that each came from."""
    ring_sizes = [len(ring) for part in parts for ring in part.rings]
    ring_of_point = np.repeat(np.arange(len(ring_sizes)), ring_sizes)
    part_of_ring = np.repeat(np.arange(len(parts)), [len(part.rings) for part in parts])
    rings = shapely.linearrings(xz, indices=ring_of_point)
    # GEOS raises for a ring that repeated points leave no other point of. Where it is a footprint's outer one, the footprint goes.
    ring_starts = np.cumsum([0, *ring_sizes[:-1]])
    reach = np.linalg.norm(xz - xz[ring_starts][ring_of_point], axis=1)
    is_ring = np.maximum.reduceat(reach, ring_starts) > SAME_POINT_M
    is_ring &= is_ring[np.searchsorted(part_of_ring, part_of_ring)]
    part_of_polygon, polygon_of_ring = np.unique(part_of_ring[is_ring], return_inverse=True)
    if not len(part_of_polygon):
        return np.empty(0, object), part_of_polygon
    polygons = shapely.polygons(rings[is_ring], indices=polygon_of_ring)
    polygons = shapely.remove_repeated_points(polygons, SAME_POINT_M)
    broken = ~shapely.is_valid(polygons)
    polygons[broken] = shapely.make_valid(polygons[broken])
    # Repair may give several polygons, and lines and points where a footprint collapses.
    simple, part_of = shapely.get_parts(polygons, return_index=True)
    simple, deeper = shapely.get_parts(simple, return_index=True)
    part_of = part_of_polygon[part_of[deeper]]
    kept = (shapely.get_type_id(simple) == shapely.GeometryType.POLYGON) & (shapely.area(simple) > MIN_PART_AREA_M2)
    return simple[kept], part_of[kept]


def _terrain(polygons: Any, buildings: Any, base: Float64, low: Float64, high: Float64) -> Terrain:
    """Ground through one point per building, so that a tower of forty parts does not outvote its neighbours."""
    _, first = np.unique(buildings, return_index=True)
    centroid = shapely.get_coordinates(shapely.centroid(polygons[first]))
    return terrain_under(centroid, base[first], low, high)


def _extrude(polygons: Any, parts: list[_Part], ground: Float64) -> list[Mesh]:
    meshes = []
    for polygon, part, lowest in zip(polygons, parts, ground.tolist(), strict=True):
        points, ring = shapely.get_coordinates(polygon), shapely.get_rings(polygon)
        ends = np.cumsum(shapely.get_num_coordinates(ring))
        rings = [points[a : b - 1] for a, b in zip(np.r_[0, ends[:-1]], ends, strict=True)]  # without the repeated last point
        hangs = part.bottom > part.base
        bottom = part.bottom if hangs else min(part.bottom, lowest) - FOUNDATION_M
        vertices, triangles, is_wall = prism(rings, bottom, part.top)
        colour = np.where(is_wall[:, None], wall_albedo(part.building), np.array(ROOF_ALBEDO, np.float32))
        meshes.append(Mesh.of_colour(vertices, triangles, colour))
    return meshes


def wall_albedo(building: str) -> Float32:
    """(3,) float32, linear sRGB: the same for a name on every machine; Python's own hash is not."""
    state = 0xCBF29CE484222325  # FNV-1a, 64 bit
    for byte in building.encode(errors="replace"):
        state = (state ^ byte) * 0x100000001B3 & 0xFFFFFFFFFFFFFFFF
    state = (state ^ state >> 29) * 0xBF58476D1CE4E5B9 & 0xFFFFFFFFFFFFFFFF
    colour = np.array(WALL_PALETTE[(state >> 40) % len(WALL_PALETTE)], np.float32)
    scale = 1 + WALL_VARIATION * ((state >> 16 & 0xFFFF) / 0x7FFF - 1)
    return np.asarray(colour * np.float32(scale), np.float32)
