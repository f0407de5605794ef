"""Lamps for a baked city's streets, as a file that ``sectorlight compare --lamps`` takes. The same arguments give the same file.

    python -m bake_jobs.street_lamps DATASET --sector X,Z --count 200 --seed 1 -o lamps.toml     at random, of all three kinds
    python -m bake_jobs.street_lamps DATASET --sector X,Z --spacing 20 -o lamps.toml             street lamps on a grid
    python -m bake_jobs.street_lamps DATASET --points lamps.geojson -o lamps.toml                where real ones stand

Only places in street air get one: nothing but ground below, open to the sky, clear of walls.
"""

import argparse
import re
import sys
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from bake_jobs.compare_points import EYE_HEIGHT_M, look_around, standing_eye
from bake_jobs.geography import MapFrame, centre_of, lonlat_of_geojson
from bake_jobs.lamp_file import lamps_toml
from bake_jobs.rays import RayScene
from bake_jobs.table import read_json
from gi_core.arrays import Bool, Float64
from gi_core.constants import SECTOR_SIZE_M
from gi_core.container import write_atomic
from gi_core.dataset import Dataset
from gi_core.errors import InputError, SectorlightError
from gi_core.geometry_file import Geometry
from gi_core.grid import SectorIndex
from gi_core.lights import color_from_temperature
from gi_core.world import Lamp

STREET_LAMP_HEIGHT_M, STREET_LAMP_LM = 8.0, 8000.0
# What a random street has: lanterns, spots that hang over the roadway, and lit shop fronts or signs.
KINDS = ("point", "point", "spot", "area")
HEIGHT_M = {"point": STREET_LAMP_HEIGHT_M, "spot": 9.0, "area": 4.0}
LUMENS = {"point": STREET_LAMP_LM, "spot": 6000.0, "area": 3000.0}
TEMPERATURE_K = {"point": 3000.0, "spot": 4000.0, "area": 5000.0}
SPOT_CONE_DEGREES = 100.0
AREA_SIZE_M = (2.0, 1.0)
# No wall closer than this: more than half an area's diagonal.
CLEARANCE_M = 1.2
# A surface this far above a sector's lowest tenth is a roof and not a hilly street.
HIGHEST_GROUND_M = 4.0
# Of 64 random places in a sector at least one is street, or there is none.
_TRIES = 64


class Streets:
    """Where in some sectors a lamp can hang."""

    def __init__(self, dataset: Dataset, sectors: Iterable[SectorIndex]) -> None:
        """Reads those sectors and their neighbours."""
        known = dataset.world.sectors
        self._sectors = {index for index in sectors if index in known}
        near = {SectorIndex(i.x + dx, i.z + dz) for i in self._sectors for dx in (-1, 0, 1) for dz in (-1, 0, 1)}
        parts = {index: dataset.geometry(index) for index in sorted(near) if index in known}
        self._rays = ray_scene_of(list(parts.values()))
        self._ground = {i: float(standing_eye(self._rays, i, parts[i])[1]) - EYE_HEIGHT_M for i in sorted(self._sectors)}
        self._top = float(dataset.world.bounds[1][1]) + 1

    def over(self, x: Float64, z: Float64, height_m: Float64) -> tuple[Float64, Bool]:
        """Places (n, 3) [m] at some heights (n,) above the surface at x and z (n,), and whether each is in street air (n,)."""
        sector = np.floor(np.stack([x, z], axis=1) / SECTOR_SIZE_M).astype(np.int64)
        ground = np.array([self._ground.get(SectorIndex(*index), -np.inf) for index in sector.tolist()])
        above = np.stack([x, np.full_like(x, self._top), z], axis=1)
        surface = self._top - self._rays.closest(above, np.broadcast_to(np.array([0.0, -1.0, 0.0]), above.shape)).distance
        on_ground = np.isfinite(surface) & (surface <= ground + HIGHEST_GROUND_M)
        place = np.stack([x, np.where(on_ground, surface, 0) + height_m, z], axis=1)
        seen = look_around(self._rays, place)
        return place, on_ground & seen.open_air & (seen.distance >= CLEARANCE_M)


def random_lamps(dataset: Dataset, index: SectorIndex, count: int, seed: int) -> list[Lamp]:
    """Lamps of all kinds at random places of a sector's streets. Raises InputError where there is no street."""
    streets, rng = Streets(dataset, [index]), np.random.default_rng(seed)
    lamps: list[Lamp] = []
    for _ in range(_TRIES):
        kinds = [KINDS[i] for i in rng.integers(0, len(KINDS), count)]
        x, z = rng.uniform(0, SECTOR_SIZE_M, (2, count)) + index.origin[[0, 2], None]
        turn = rng.uniform(0, 2 * np.pi, count)
        place, fits = streets.over(x, z, np.array([HEIGHT_M[kind] for kind in kinds]))
        lamps += [_lamp(f"lamp {i}", kinds[i], place[i], turn[i]) for i in np.flatnonzero(fits).tolist()]
        if len(lamps) >= count:
            return [replace(lamp, name=f"lamp {number}") for number, lamp in enumerate(lamps[:count])]
    raise InputError(f"--sector {index.x},{index.z}: found street air for {len(lamps)} of {count} lamps; choose a sector with a street")


def lamps_on_grid(dataset: Dataset, index: SectorIndex, spacing_m: float) -> list[Lamp]:
    """Street lamps every so many metres along x and z, where a sector has street. Raises InputError where it has none."""
    steps = np.arange(spacing_m / 2, SECTOR_SIZE_M, spacing_m)
    x, z = (grid.reshape(-1) for grid in np.meshgrid(*(steps + index.origin[axis] for axis in (0, 2))))
    return _street_lamps(Streets(dataset, [index]), x, z, f"--sector {index.x},{index.z}")


def lamps_from_points(dataset: Dataset, path: Path, centred: bool = False) -> list[Lamp]:
    """Street lamps at a GeoJSON's points, in the dataset's own frame; ``centred`` moves their middle to the world's origin.

    Raises InputError when the file is no GeoJSON with points, or none of them lies in a street of the dataset.
    """
    lonlat = _points(path)
    place = dataset.world.location
    centre = centre_of(lonlat) if centred else (place.latitude_degrees, place.longitude_degrees)
    xz = MapFrame(*centre, place.north_degrees).world_from_lonlat(lonlat)
    xz = xz[np.isfinite(xz).all(axis=1)]
    sector = [SectorIndex(*index) for index in np.floor(xz / SECTOR_SIZE_M).astype(np.int64).tolist()]
    inside = np.array([index in dataset.world.sectors for index in sector], bool)
    if not inside.any():
        raise InputError(f"{path}: none of its {len(lonlat)} points lies in {dataset.path}; --centred moves them there")
    streets = Streets(dataset, {i for i, ok in zip(sector, inside, strict=True) if ok})
    return _street_lamps(streets, xz[inside, 0], xz[inside, 1], str(path))


def _street_lamps(streets: Streets, x: Float64, z: Float64, where: str) -> list[Lamp]:
    place, fits = streets.over(x, z, np.full(len(x), STREET_LAMP_HEIGHT_M))
    if not fits.any():
        raise InputError(f"{where}: none of {len(x)} places is in street air")
    return [_lamp(f"lamp {number}", "point", one, 0.0) for number, one in enumerate(place[fits])]


def _lamp(name: str, kind: str, place: Float64, turn: float) -> Lamp:
    """A lamp of a kind; an area looks along ``turn``, an angle in the level plane, all others down."""
    x, y, z = (round(float(v), 2) for v in place)
    r, g, b = (round(v, 4) for v in color_from_temperature(TEMPERATURE_K[kind]))
    lamp = Lamp(name, kind, (x, y, z), LUMENS[kind], (r, g, b), schedule="night")
    if kind == "spot":
        return replace(lamp, cone_degrees=SPOT_CONE_DEGREES)
    if kind == "area":
        level = (round(float(np.cos(turn)), 3), 0.0, round(float(np.sin(turn)), 3))
        return replace(lamp, direction=level, size=AREA_SIZE_M)
    return lamp


def _points(path: Path) -> Float64:
    """Longitudes and latitudes (n, 2) of a GeoJSON's Point features."""
    record = read_json(path, "a GeoJSON FeatureCollection with Point features")
    try:
        shapes = [feature["geometry"] for feature in record["features"]]
        points = [shape["coordinates"][:2] for shape in shapes if shape and shape["type"] == "Point"]
        found = np.array(points, np.float64).reshape(-1, 2)
    except (ValueError, TypeError, KeyError) as error:
        raise InputError(f"{path}: expected a GeoJSON FeatureCollection with Point features ({error!r})") from error
    lonlat = lonlat_of_geojson(found, record, str(path))
    if not len(lonlat) or not (np.abs(lonlat) <= (180, 90)).all():
        raise InputError(f"{path}: expected Point features with longitude and latitude, found {len(lonlat)}")
    return lonlat


def ray_scene_of(parts: Sequence[Geometry]) -> RayScene:
    """Sectors' geometries as one mesh."""
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    triangles = [part.triangles + start for part, start in zip(parts, starts, strict=False)]
    if not parts:
        return RayScene(np.zeros((0, 3)), np.zeros((0, 3), np.int32))
    return RayScene(np.concatenate([part.vertices for part in parts]), np.concatenate(triangles).astype(np.int32))


def main(arguments: Sequence[str] | None = None) -> None:
    """The command. Exits with status 2 and one line on stderr when the input is wrong."""
    parser = argparse.ArgumentParser(prog="python -m bake_jobs.street_lamps", description="Lamps for a baked city's streets.")
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--sector", metavar="X,Z", help="where; as --sector=-1,2 when X is negative")
    parser.add_argument("--count", type=int, default=200, help="lamps at random places of the sector")
    parser.add_argument("--seed", type=int, default=0, help="of those places")
    parser.add_argument("--spacing", type=float, metavar="M", help="street lamps on a grid instead")
    parser.add_argument("--points", type=Path, metavar="FILE.geojson", help="street lamps at these points instead")
    parser.add_argument("--centred", action="store_true", help="move the middle of the points to the world's origin")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE.toml")
    given = parser.parse_args(arguments)
    try:
        lamps = _chosen(given)
        write_atomic(given.output, lamps_toml(lamps).encode())
    except (SectorlightError, OSError) as error:
        print(f"street_lamps: {' '.join(str(error).split())}", file=sys.stderr)
        sys.exit(2)
    print(f"{given.output}: {len(lamps)} lamps")


def _chosen(given: argparse.Namespace) -> list[Lamp]:
    dataset = Dataset.open(given.dataset)
    if given.points is not None:
        return lamps_from_points(dataset, given.points, given.centred)
    match = re.fullmatch(r"(-?\d{1,6}),(-?\d{1,6})", given.sector or "")
    index = SectorIndex(*map(int, match.groups())) if match else None
    if index is None or index not in dataset.world.sectors:
        raise InputError(f"--sector: expected X,Z of a sector that {given.dataset} has, found {given.sector}")
    if given.spacing is not None:
        if not 1 <= given.spacing <= SECTOR_SIZE_M:
            raise InputError(f"--spacing: expected 1..{SECTOR_SIZE_M:g} m, found {given.spacing:g}")
        return lamps_on_grid(dataset, index, given.spacing)
    if not 1 <= given.count <= 100_000:
        raise InputError(f"--count: expected 1..100000, found {given.count}")
    return random_lamps(dataset, index, given.count, given.seed)


if __name__ == "__main__":
    main()
