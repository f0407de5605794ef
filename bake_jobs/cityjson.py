"""CityJSON 1.x and 2.0 -> triangles: polygons with holes cut in their plane, Z up turned to Y up, albedo by what a surface is.

Of an object's levels of detail the highest is read. Where nothing lies under a place inside the model, a ground is added, so that
streets which the file leaves out are not holes. Textures and materials of the file are not read.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bake_jobs.geography import MapFrame, centre_of, lonlat_from, timezone_at
from bake_jobs.rays import RayScene
from bake_jobs.scene import Mesh, SourceContent, join_meshes
from bake_jobs.solids import expect_few_rings, triangulate
from bake_jobs.table import read_json
from bake_jobs.terrain import CELL_M, MAX_CELLS, Terrain, cells_needed, terrain_under
from gi_core.arrays import Bool, Float64, Int64
from gi_core.errors import SourceError
from gi_core.world import Location, world_from_east_north

# Boundaries nest this deep around a polygon's list of rings.
_POLYGON_DEPTH = {"MultiSurface": 1, "CompositeSurface": 1, "Solid": 2, "MultiSolid": 3, "CompositeSolid": 3}
MAX_VERTICES = 50_000_000
DEFAULT_ALBEDO = (0.35, 0.35, 0.35)
# Linear sRGB: of a semantic surface first, then of the object it belongs to.
SURFACE_ALBEDO = {
    "RoofSurface": (0.28, 0.20, 0.17),
    "WallSurface": (0.45, 0.38, 0.33),
    "GroundSurface": (0.25, 0.25, 0.25),
    "Window": (0.12, 0.13, 0.14),
    "Door": (0.25, 0.20, 0.15),
}
OBJECT_ALBEDO = {
    "Building": (0.42, 0.36, 0.32),
    "BuildingPart": (0.42, 0.36, 0.32),
    "Bridge": (0.35, 0.34, 0.33),
    "LandUse": (0.25, 0.24, 0.20),
    "PlantCover": (0.10, 0.16, 0.06),
    "Railway": (0.22, 0.20, 0.18),
    "Road": (0.20, 0.20, 0.20),
    "SolitaryVegetationObject": (0.10, 0.16, 0.06),
    "TINRelief": (0.20, 0.20, 0.16),
    "TransportSquare": (0.25, 0.25, 0.25),
    "WaterBody": (0.05, 0.07, 0.08),
}
BUILDINGS = ("Building", "BuildingPart")
GROUND_BELOW_M = 0.3  # added ground lies this far under the buildings' feet, so that it shows only where nothing else is
PROBE_STEP_M = 4.0  # between the rays that look for places with nothing under them


@dataclass(frozen=True, eq=False)
class _Polygon:
    """rings : (n,) vertex indices each, outer first; kind: the semantic surface's type, or the object's; object: its number."""

    rings: list[Int64]
    kind: str
    of_building: bool
    object: int


def load_cityjson(path: Path, frame: MapFrame | None = None) -> SourceContent:
    """Read a CityJSON file. Without a frame, the middle of its vertices is the world's x = z = 0. Raises SourceError."""
    document = _read(path)
    vertices, location = _world_vertices(document, path, frame)
    polygons = list(_polygons(document, len(vertices), path))
    if not polygons:
        raise SourceError(f"{path}: expected CityObjects with surfaces or solids, found none")
    corners, kinds = [], []
    for polygon in polygons:
        found = _triangulated(vertices, polygon.rings)
        corners.append(found)
        kinds += [polygon.kind] * len(found)
    colours = {kind: SURFACE_ALBEDO.get(kind) or OBJECT_ALBEDO.get(kind, DEFAULT_ALBEDO) for kind in set(kinds)}
    triangles = np.concatenate(corners).astype(np.int64)
    mesh = Mesh.of_colour(vertices, triangles, np.array([colours[kind] for kind in kinds]).reshape(-1, 3))
    ground = _ground_in_gaps(mesh, polygons, path) if len(triangles) else None
    return SourceContent(join_meshes([mesh, ground.mesh()] if ground else [mesh]), location)


def _read(path: Path) -> dict[str, Any]:
    document = read_json(path, "CityJSON")
    if document.get("type") != "CityJSON":
        raise SourceError(f'{path}: expected a JSON object whose type is "CityJSON"')
    version = str(document.get("version", ""))
    if not re.match(r"[12]\.", version):
        raise SourceError(f"{path}: expected CityJSON version 1.x or 2.0, found {version!r}; convert it with cjio")
    if not isinstance(document.get("CityObjects"), dict) or not isinstance(document.get("vertices"), list):
        raise SourceError(f"{path}: expected CityObjects and vertices")
    if len(document["vertices"]) > MAX_VERTICES:
        raise SourceError(f"{path}: expected at most {MAX_VERTICES:,} vertices, found {len(document['vertices']):,}; split the city")
    return document


def _world_vertices(document: dict[str, Any], path: Path, frame: MapFrame | None) -> tuple[Float64, Location | None]:
    """All vertices in the world frame (v, 3) [m], and where on Earth its origin lies if the file says so."""
    transform = document.get("transform") or {"scale": (1, 1, 1), "translate": (0, 0, 0)}
    try:
        stored = np.array(document["vertices"], np.float64).reshape(-1, 3)
        real = stored * np.array(transform["scale"], np.float64) + np.array(transform["translate"], np.float64)
    except (TypeError, ValueError, KeyError, OverflowError) as error:
        raise SourceError(f"{path}: expected vertices of three numbers and a transform with scale and translate ({error})") from error
    if not len(real):
        raise SourceError(f"{path}: expected vertices, found none")
    metadata = document.get("metadata")
    system = metadata.get("referenceSystem") if isinstance(metadata, dict) else None
    if not system:
        north = frame.north_degrees if frame else 0.0
        middle = np.round((np.nanmin(real, axis=0) + np.nanmax(real, axis=0)) / 2)
        x, z = world_from_east_north(real[:, 0] - middle[0], real[:, 1] - middle[1], north)
        return np.stack([x, real[:, 2], z], axis=1), None
    lonlat = lonlat_from(real[:, :2], str(system), f"{path}: referenceSystem")
    frame = frame or MapFrame(*centre_of(lonlat))
    xz = frame.world_from_lonlat(lonlat)
    latitude, longitude = frame.latitude_degrees, frame.longitude_degrees
    elevation = float(np.median(real[:, 2]))
    location = Location(latitude, longitude, elevation, timezone_at(latitude, longitude), frame.north_degrees, source="given")
    return np.stack([xz[:, 0], real[:, 2], xz[:, 1]], axis=1), location


def _polygons(document: dict[str, Any], vertex_count: int, path: Path) -> Iterator[_Polygon]:
    for number, (name, item) in enumerate(document["CityObjects"].items()):
        try:
            kind = str(item.get("type", "")).lstrip("+")
            readable = [geometry for geometry in item.get("geometry", []) if geometry.get("type") in _POLYGON_DEPTH]
            if not readable:
                continue
            geometry = max(readable, key=lambda one: float(one.get("lod", 0)))
            semantics = geometry.get("semantics") or {}
            surfaces = [str(surface.get("type", "")) for surface in semantics.get("surfaces", [])]
            depth = _POLYGON_DEPTH[geometry["type"]]
            leaves = _leaves(geometry["boundaries"], semantics.get("values"), depth)
            for rings, value in leaves:
                expect_few_rings(rings, f"{path}: object {name!r}")
                surface = surfaces[value] if isinstance(value, int) and 0 <= value < len(surfaces) else ""
                indices = [np.array(ring, np.int64) for ring in rings if len(ring) >= 3]
                if not indices or any(ring.min() < 0 or ring.max() >= vertex_count for ring in indices):
                    continue  # no polygon, or one over vertices that the file does not have
                yield _Polygon(indices, surface if surface in SURFACE_ALBEDO else kind, kind in BUILDINGS, number)
        except SourceError:
            raise
        except (TypeError, ValueError, KeyError, AttributeError, IndexError, OverflowError) as error:
            raise SourceError(f"{path}: object {name!r}: expected CityJSON geometry ({error})") from error


def _leaves(boundaries: Any, values: Any, depth: int) -> Iterator[tuple[Any, Any]]:
    """Polygons with their semantic value; a values array may be null at any level, which counts for all below."""
    for i, inner in enumerate(boundaries):
        value = values[i] if isinstance(values, list) and i < len(values) else None
        if depth == 1:
            yield inner, value
        else:
            yield from _leaves(inner, value, depth - 1)


def _triangulated(vertices: Float64, rings: list[Int64]) -> Int64:
    """Triangles (t, 3) of a polygon that is flat to within its survey's accuracy, wound as its outer ring is."""
    if len(rings) == 1 and len(rings[0]) == 3:
        return rings[0][None]
    outer = vertices[rings[0]] - vertices[rings[0][0]]
    # Newell's normal: exact for a flat polygon, the best plane's for a bent one (Tampieri, Graphics Gems III, 1992).
    normal = np.cross(outer, np.roll(outer, -1, axis=0)).sum(axis=0)
    axis = int(np.abs(normal).argmax())
    # Dropping the largest axis keeps the sense of rotation, seen from its positive side, when the other two stay in cyclic order.
    flat_axes = [(axis + 1) % 3, (axis + 2) % 3]
    index = np.concatenate(rings)
    ends = np.cumsum([len(ring) for ring in rings]).astype(np.uint32)
    found = triangulate(np.ascontiguousarray(vertices[index][:, flat_axes]), ends)
    if normal[axis] < 0:
        found = found[:, ::-1]
    return np.asarray(index[found], np.int64)


def _ground_in_gaps(mesh: Mesh, polygons: list[_Polygon], path: Path) -> Terrain | None:
    """Ground through the feet of the buildings, in the cells where a ray from above meets nothing. None without such a cell."""
    feet = _feet(mesh.vertices, polygons)
    used = mesh.vertices[np.unique(mesh.triangles)]
    if not np.isfinite(used).all():
        return None
    corners = mesh.vertices[mesh.triangles][:, :, [0, 2]]
    low, high = corners.min(axis=1), corners.max(axis=1)
    if cells_needed(low, high) > MAX_CELLS:
        raise SourceError(f"{path}: expected one city, found {np.ptp(used, axis=0).max():.3g} m between the farthest vertices; split it")
    if not len(feet):
        feet = used[used[:, 1].argmin()][None]
    terrain = terrain_under(feet[:, [0, 2]], feet[:, 1] - GROUND_BELOW_M, low, high)
    gaps = _cells_with_gaps(mesh, terrain, float(used[:, 1].max()))
    return Terrain(terrain.first, terrain.height, gaps) if gaps.any() else None


def _feet(vertices: Float64, polygons: list[_Polygon]) -> Float64:
    """(n, 3) lowest vertex of each building."""
    rings: dict[int, list[Int64]] = {}
    for polygon in polygons:
        if polygon.of_building:
            rings.setdefault(polygon.object, []).extend(polygon.rings)
    lowest = []
    for of_object in rings.values():
        index = np.concatenate(of_object)
        lowest.append(vertices[index[vertices[index, 1].argmin()]])
    return np.array(lowest).reshape(-1, 3)


def _cells_with_gaps(mesh: Mesh, terrain: Terrain, top: float) -> Bool:
    """The covered cells of a terrain in which some place has nothing above or below it."""
    steps = int(CELL_M / PROBE_STEP_M)
    i, j = np.nonzero(terrain.covered)
    offset = (np.arange(steps) + 0.5) * PROBE_STEP_M
    x = (terrain.first[0] + i)[:, None, None] * CELL_M + offset[None, :, None] + np.zeros((1, 1, steps))
    z = (terrain.first[1] + j)[:, None, None] * CELL_M + offset[None, None, :] + np.zeros((1, steps, 1))
    origins = np.stack([x.ravel(), np.full(x.size, top + 1.0), z.ravel()], axis=1)
    met = RayScene(mesh.vertices, mesh.triangles.astype(np.int32)).occluded(origins, np.tile([[0.0, -1.0, 0.0]], (x.size, 1)))
    gaps = np.zeros(terrain.covered.shape, bool)
    gaps[i, j] = ~met.reshape(len(i), -1).all(axis=1)
    return gaps
