"""A baked city on disk: ``world.json``, ``sectors/*.gisec``, ``geometry/*.gigeo``, ``distant.gidist``. The only thing that bakes and
servers share. FORMAT.md describes it."""

import hashlib
import json
import math
from dataclasses import asdict, dataclass
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np

from gi_core import container, distant_file, geometry_file, sector_file
from gi_core.arrays import Float64
from gi_core.distant_file import DistantTexels
from gi_core.errors import CorruptFileError, FormatVersionError, InputError, SectorMissingError
from gi_core.geometry_file import Geometry
from gi_core.grid import SectorIndex
from gi_core.sector import Sector
from gi_core.sun_table import SunTable
from gi_core.world import Lamp, Location, Room

FORMAT = "sectorlight-dataset"
VERSION = 1
WORLD_FILE = "world.json"
DISTANT_FILE = "distant.gidist"
MAX_WORLD_BYTES = 1 << 28
# 62 500 km2 of city; a reader refuses more before it makes room for it.
MAX_SECTORS = 1 << 24


@dataclass(frozen=True)
class SectorFacts:
    """What world.json says of one sector: its files' bytes and digest, and what the bake counted."""

    bytes: int
    digest: str
    geometry_bytes: int
    probes: int
    factors: int
    bricks: int
    surfels: int
    voxels: int
    triangles: int
    probes_dead: int
    probes_dropped: int
    voxels_blind: int


@dataclass(frozen=True, eq=False)
class WorldInfo:
    """The contents of world.json.

    bounds : (2, 3) float64 [m], world frame: minimum and maximum of the geometry
    sectors : facts of each baked sector
    settings : the bake's knobs; preset, basis and sky patches are among what readers need of them
    error_report : what ``compare`` measured, or None
    """

    name: str
    source: str
    bake_id: str
    location: Location
    bounds: Float64
    preset: str
    basis: str
    sky_patches: int
    settings: dict[str, Any]
    seed: int
    sun_table: SunTable
    sectors: dict[SectorIndex, SectorFacts]
    rooms: tuple[Room, ...]
    lamps: tuple[Lamp, ...]
    dropped_triangles: dict[str, int]
    error_report: dict[str, Any] | None = None

    @property
    def counts(self) -> dict[str, int]:
        """Sums over all sectors."""
        names = [name for name in SectorFacts.__dataclass_fields__ if name != "digest"]
        return {"sectors": len(self.sectors)} | {name: sum(getattr(f, name) for f in self.sectors.values()) for name in names}

    def to_json(self) -> dict[str, Any]:
        """The object that world.json holds."""
        return {
            "format": FORMAT,
            "version": VERSION,
            "name": self.name,
            "source": self.source,
            "bake_id": self.bake_id,
            "location": asdict(self.location) | {"date": self.location.date.isoformat()},
            "bounds": self.bounds.tolist(),
            "preset": self.preset,
            "basis": self.basis,
            "sky_patches": self.sky_patches,
            "settings": self.settings,
            "seed": self.seed,
            "sun_table": self.sun_table.to_json(),
            "sectors": {f"{i.x},{i.z}": asdict(self.sectors[i]) for i in sorted(self.sectors)},
            "rooms": [asdict(room) for room in self.rooms],
            "lamps": [asdict(lamp) for lamp in self.lamps],
            "dropped_triangles": self.dropped_triangles,
            "error_report": self.error_report,
        }

    @classmethod
    def from_json(cls, record: Any, where: str) -> "WorldInfo":
        """The inverse of to_json. Raises InputError for what is no world.json, FormatVersionError for another version's."""
        if not isinstance(record, dict) or record.get("format") != FORMAT:
            raise InputError(f"{where}: not a Sectorlight dataset; `sectorlight bake` makes one")
        if record.get("version") != VERSION:
            raise FormatVersionError(
                f"{where}: dataset version {record.get('version')!r}, this program reads version {VERSION}; bake it again with this program"
            )
        try:
            sectors = {}
            for key, facts in record["sectors"].items():
                x, z = key.split(",")
                sectors[SectorIndex(int(x), int(z))] = SectorFacts(**facts)
            bounds = np.array(record["bounds"], np.float64)
            if len(sectors) > MAX_SECTORS or bounds.shape != (2, 3) or not np.isfinite(bounds).all():
                raise ValueError("bounds or sectors out of range")
            location = dict(record["location"])
            location["date"] = date.fromisoformat(location["date"])
            return cls(
                name=str(record["name"]),
                source=str(record["source"]),
                bake_id=str(record["bake_id"]),
                location=Location(**location),
                bounds=bounds,
                preset=str(record["preset"]),
                basis=str(record["basis"]),
                sky_patches=int(record["sky_patches"]),
                settings=dict(record["settings"]),
                seed=int(record["seed"]),
                sun_table=SunTable.from_json(record["sun_table"]),
                sectors=sectors,
                rooms=tuple(Room(r["name"], _point(r["minimum"]), _point(r["maximum"])) for r in record["rooms"]),
                lamps=tuple(_lamp(lamp) for lamp in record["lamps"]),
                dropped_triangles={str(k): int(v) for k, v in record["dropped_triangles"].items()},
                error_report=record["error_report"],
            )
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise CorruptFileError(f"{where}: {type(error).__name__}: {error}; bake it again") from error


def _point(values: Any) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in values)
    if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(z)):
        raise ValueError("a position is not finite")
    return x, y, z


def _lamp(record: dict[str, Any]) -> Lamp:
    return Lamp(**record | {"position": _point(record["position"]), "color": _point(record["color"])})


def sector_path(root: Path, index: SectorIndex) -> Path:
    """Where a dataset keeps a sector."""
    return root / "sectors" / f"{index}.gisec"


def geometry_path(root: Path, index: SectorIndex) -> Path:
    """Where a dataset keeps a sector's triangles."""
    return root / "geometry" / f"{index}.gigeo"


class Dataset:
    """Read access to a dataset. Files are read when asked for; nothing is kept."""

    def __init__(self, path: Path, world: WorldInfo, digest: str) -> None:
        self.path = path
        self.world = world
        self.digest = digest  # 32 hexadecimal digits of everything that was baked

    @classmethod
    def open(cls, path: Path | str) -> "Dataset":
        """Open a dataset folder. Raises InputError, FormatVersionError or CorruptFileError."""
        root = Path(path)
        file = root / WORLD_FILE
        if not file.is_file():
            raise InputError(
                f"{root}: no {WORLD_FILE} here; expected a folder that `sectorlight bake` wrote (a bake that was cut off resumes)"
            )
        if file.stat().st_size > MAX_WORLD_BYTES:
            raise CorruptFileError(f"{file}: {file.stat().st_size} bytes, expected at most {MAX_WORLD_BYTES}")
        text = file.read_bytes()
        try:
            record = json.loads(text)
        except ValueError as error:
            raise CorruptFileError(f"{file}: {error}; bake it again") from error
        return cls(root, WorldInfo.from_json(record, str(file)), hashlib.blake2b(text, digest_size=16).hexdigest())

    def sector_path(self, index: SectorIndex) -> Path:
        """The sector's file. Raises SectorMissingError when the dataset has no such sector."""
        self._expect(index)
        return sector_path(self.path, index)

    def sector(self, index: SectorIndex) -> Sector:
        """A sector, validated. Raises SectorMissingError, CorruptFileError, FormatVersionError."""
        path = self.sector_path(index)
        try:
            sector, meta = sector_file.read(path)
        except OSError as error:
            raise CorruptFileError(f"{path}: {error.strerror}; bake it again") from error
        world = self.world
        if sector.index != index or meta.get("bake_id") != world.bake_id:
            raise CorruptFileError(f"{path}: holds sector {sector.index} of another bake; bake it again")
        if len(sector.sun_visibility) != world.sun_table.plane_count:
            raise CorruptFileError(
                f"{path}: {len(sector.sun_visibility)} sun planes, expected {world.sun_table.plane_count}; bake it again"
            )
        return sector

    def geometry(self, index: SectorIndex) -> Geometry:
        """A sector's triangles. Raises as ``sector``."""
        self._expect(index)
        path = geometry_path(self.path, index)
        try:
            return geometry_file.read(path)
        except OSError as error:
            raise CorruptFileError(f"{path}: {error.strerror}; bake it again") from error

    def distant(self) -> DistantTexels:
        """Sky factors of all sectors' distant texels. Raises CorruptFileError."""
        path = self.path / DISTANT_FILE
        try:
            return distant_file.read(path)
        except OSError as error:
            raise CorruptFileError(f"{path}: {error.strerror}; bake it again") from error

    def _expect(self, index: SectorIndex) -> None:
        if index not in self.world.sectors:
            raise SectorMissingError(f"{self.path}: sector {index.x},{index.z} is not in this dataset of {len(self.world.sectors)} sectors")


def write_world(root: Path, world: WorldInfo) -> None:
    """Write world.json; a dataset is complete once it is there."""
    text = json.dumps(world.to_json(), indent=1, sort_keys=True, allow_nan=False) + "\n"
    container.write_atomic(root / WORLD_FILE, text.encode())
