"""A baked city on disk: ``world.json``, ``sectors/*.gisec``, ``geometry/*.gigeo``, ``distant.gidist``, and ``fine/*.givox`` where
fine voxels were asked for. The only thing that bakes and servers share. FORMAT.md describes it."""

import hashlib
import json
import re
from dataclasses import asdict, dataclass
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np

from gi_core import container, distant_file, fine_file, geometry_file, sector_file
from gi_core.arrays import Float64
from gi_core.clock_time import time_zone
from gi_core.constants import BASIS_SIZES, CUBE_FACES, MAX_SKY_PATCHES
from gi_core.decals import check_decal
from gi_core.distant_file import DistantTexels
from gi_core.errors import CorruptFileError, FormatVersionError, InputError, SectorMissingError
from gi_core.geometry_file import Geometry
from gi_core.grid import MAX_SECTOR_NUMBER, SectorIndex
from gi_core.json_fields import Fields, all_finite
from gi_core.lights import MAX_LUMENS, check_lamp
from gi_core.room_records import DOORS_VERSION, ROOMS_VERSION, needs_doors_version, read_rooms, room_json
from gi_core.sector import Sector
from gi_core.sector_file import MAX_BLENDED_PROBES
from gi_core.sky_patches import MIN_PATCHES, SKY_SCHEMES
from gi_core.sun_table import SunTable
from gi_core.voxel_grid import VoxelGrid
from gi_core.world import LAMP_KINDS, Decal, Lamp, Location, Room

FORMAT = "sectorlight-dataset"
# Version 1 knew the ambient cube under six sky scalars alone; a bake of that kind still has it, so that older programs read it.
# Version 3 has fine voxels, version 4 decals, versions 5 and 6 rooms (gi_core.room_records).
VERSION, DECALS_VERSION, FINE_VERSION, PATCHES_VERSION, CUBE_VERSION = DOORS_VERSION, 4, 3, 2, 1
WORLD_FILE = "world.json"
DISTANT_FILE = "distant.gidist"
MAX_WORLD_BYTES = 1 << 28
# 62 500 km2 of city; a reader refuses more before it makes room for it.
MAX_SECTORS = 1 << 24
MAX_LAMPS = 1 << 20
# Six times the talk's 22 300 vehicles.
MAX_DECALS = 1 << 17


@dataclass(frozen=True)
class SectorFacts:
    """What world.json says of one sector: its files' bytes and digest, and what the bake counted.

    fine_bytes : of the file of fine voxels; None where the bake made none
    estimated_error : median relative error that the bake expects of voxels near surfaces, from interpolation alone or, with a target
        error, from all; None where it tried out no light, or the sector has no such voxel
    """

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
    fine_bytes: int | None = None
    estimated_error: float | None = None

    def to_json(self) -> dict[str, Any]:
        """The object in world.json; what there is none of has no member."""
        return {name: value for name, value in asdict(self).items() if value is not None}


_OPTIONAL_FACTS = frozenset({"fine_bytes", "estimated_error"})
COUNTS = tuple(name for name in SectorFacts.__dataclass_fields__ if name != "digest" and name not in _OPTIONAL_FACTS)


@dataclass(frozen=True, eq=False)
class WorldInfo:
    """The contents of world.json.

    bounds : (2, 3) float64 [m], world frame: minimum and maximum of the geometry
    sectors : facts of each baked sector
    sky : scheme of the sky patches, one of sky_patches.SKY_SCHEMES
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
    sky: str
    sky_patches: int
    settings: dict[str, Any]
    seed: int
    sun_table: SunTable
    sectors: dict[SectorIndex, SectorFacts]
    rooms: tuple[Room, ...]
    lamps: tuple[Lamp, ...]
    dropped_triangles: dict[str, int]
    error_report: dict[str, Any] | None = None
    decals: tuple[Decal, ...] = ()

    @property
    def counts(self) -> dict[str, int]:
        """Sums over all sectors."""
        return {"sectors": len(self.sectors)} | {name: sum(getattr(f, name) for f in self.sectors.values()) for name in COUNTS}

    @property
    def estimated_error(self) -> float | None:
        """Median of the sectors' estimates; None where the bake made none."""
        found = [facts.estimated_error for facts in self.sectors.values() if facts.estimated_error is not None]
        return float(np.median(found)) if found else None

    @property
    def has_fine_voxels(self) -> bool:
        """Whether volumes of cascade -1 can be had."""
        return any(facts.fine_bytes is not None for facts in self.sectors.values())

    @property
    def version(self) -> int:
        """The lowest format version of world.json that can say this."""
        if any(needs_doors_version(room) for room in self.rooms):
            return VERSION
        if any(room.openings or room.cells is not None for room in self.rooms):
            return ROOMS_VERSION
        if self.decals:
            return DECALS_VERSION
        if self.has_fine_voxels:
            return FINE_VERSION
        return CUBE_VERSION if (self.basis, self.sky) == ("cube", "faces") else PATCHES_VERSION

    def to_json(self) -> dict[str, Any]:
        """The object that world.json holds."""
        described: dict[str, Any] = {} if self.version == CUBE_VERSION else {"sky": self.sky}
        if self.version >= DECALS_VERSION:
            described["decals"] = [asdict(decal) for decal in self.decals]
        return described | {
            "format": FORMAT,
            "version": self.version,
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
            "sectors": {f"{i.x},{i.z}": self.sectors[i].to_json() for i in sorted(self.sectors)},
            "rooms": [room_json(room, self.version) for room in self.rooms],
            "lamps": [asdict(lamp) for lamp in self.lamps],
            "dropped_triangles": self.dropped_triangles,
            "error_report": self.error_report,
        }

    @classmethod
    def from_json(cls, record: Any, where: str) -> "WorldInfo":
        """The inverse of to_json; ``where`` names the file in errors.

        Raises InputError for what is no world.json, FormatVersionError for another version's, CorruptFileError for anything in it that
        is missing, unknown, of another type or out of its range.
        """
        if not isinstance(record, dict) or record.get("format") != FORMAT:
            raise InputError(f"{where}: not a Sectorlight dataset; `sectorlight bake` makes one")
        found = record.get("version")
        if isinstance(found, bool) or not isinstance(found, int) or not 0 <= found < 1 << 32:
            raise CorruptFileError(f"{where}: expected the version to be a whole number, found a {type(found).__name__}; bake it again")
        if not CUBE_VERSION <= found <= VERSION:
            raise FormatVersionError(
                f"{where}: dataset version {found}, this program reads versions {CUBE_VERSION} to {VERSION}; bake it again"
            )
        absent = ({"decals"} if found < DECALS_VERSION else set()) | ({"sky"} if found == CUBE_VERSION else set())
        top = Fields(record, where, _TOP_LEVEL - absent)
        basis, sky, patches = _directions(top, found)
        low, high = _corners(top)
        report = None if record["error_report"] is None else top.mapping("error_report")
        settings = top.fields("settings")
        for name in ("voxel_probes", "feedback_probes"):  # streaming plans go by them
            if settings.has(name):
                settings.integer(name, 1, MAX_BLENDED_PROBES)
        if not all_finite([report, top.mapping("settings")]):
            raise CorruptFileError(f"{where}: settings or error_report hold a number or a text that JSON has no place for; bake it again")
        if report is not None and "expected_error" in report:
            top.fields("error_report").number("expected_error")
        return cls(
            name=top.text("name"),
            source=top.text("source"),
            bake_id=top.text("bake_id"),
            location=_location(top.fields("location", Location.__dataclass_fields__)),
            bounds=np.array([low, high], np.float64),
            preset=top.text("preset"),
            basis=basis,
            sky=sky,
            sky_patches=patches,
            settings=top.mapping("settings"),
            seed=top.integer("seed"),
            sun_table=_sun_table(record["sun_table"], where),
            sectors=_sectors(top, found),
            rooms=read_rooms(top, found),
            lamps=tuple(_lamp(Fields(r, f"{where}: lamps", Lamp.__dataclass_fields__)) for r in top.sequence("lamps", MAX_LAMPS)),
            dropped_triangles={name: top.fields("dropped_triangles").integer(name) for name in top.mapping("dropped_triangles")},
            error_report=report,
            decals=_decals(top) if found >= DECALS_VERSION else (),
        )


_TOP_LEVEL = frozenset(WorldInfo.__dataclass_fields__) | {"format", "version"}
_SECTOR_KEY = re.compile(r"(-?\d{1,7}),(-?\d{1,7})", re.ASCII)


def _directions(top: Fields, version: int) -> tuple[str, str, int]:
    """Basis, scheme of the sky patches, and their number."""
    if version == CUBE_VERSION:
        return top.choice("basis", ("cube",)), "faces", top.integer("sky_patches", len(CUBE_FACES), len(CUBE_FACES))
    sky = top.choice("sky", SKY_SCHEMES)
    least, most = (len(CUBE_FACES),) * 2 if sky == "faces" else (MIN_PATCHES, MAX_SKY_PATCHES)
    return top.choice("basis", tuple(BASIS_SIZES)), sky, top.integer("sky_patches", least, most)


def _sectors(top: Fields, version: int) -> dict[SectorIndex, SectorFacts]:
    records = top.mapping("sectors")
    if len(records) > MAX_SECTORS:
        raise CorruptFileError(f"{top.where}: expected at most {MAX_SECTORS} sectors, found {len(records)}; bake it again")
    optional = _OPTIONAL_FACTS if version >= FINE_VERSION else _OPTIONAL_FACTS - {"fine_bytes"}
    sectors = {}
    for key, record in records.items():
        match = _SECTOR_KEY.fullmatch(key)
        # One spelling for each sector: neither 01,0 nor -0,0.
        if match is None or f"{int(match[1])},{int(match[2])}" != key or max(abs(int(n)) for n in match.groups()) > MAX_SECTOR_NUMBER:
            raise CorruptFileError(f"{top.where}: sectors: expected keys such as 3,-2, found {key[:40]!a}; bake it again")
        given = optional & set(record) if isinstance(record, dict) else frozenset()
        facts = Fields(record, f"{top.where}: sectors: {key}", {*COUNTS, "digest", *given})
        counted = {name: facts.integer(name) for name in COUNTS}
        estimate = facts.number("estimated_error", 0.0) if "estimated_error" in given else None
        fine = facts.integer("fine_bytes") if "fine_bytes" in given else None
        index = SectorIndex(int(match[1]), int(match[2]))
        sectors[index] = SectorFacts(digest=facts.text("digest"), fine_bytes=fine, estimated_error=estimate, **counted)
    return sectors


def _corners(top: Fields) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    corners = [Fields({"bounds": corner}, top.where).point("bounds") for corner in top.sequence("bounds", 2)]
    if len(corners) != 2 or any(low > high for low, high in zip(*corners, strict=True)):
        raise CorruptFileError(f"{top.where}: bounds: expected a minimum and a maximum, found {corners}; bake it again")
    return corners[0], corners[1]


def _sun_table(record: Any, where: str) -> SunTable:
    try:
        return SunTable.from_json(record)
    except CorruptFileError as error:
        raise CorruptFileError(f"{where}: {error}") from error


def _location(place: Fields) -> Location:
    try:
        day, zone = date.fromisoformat(place.text("date")), place.text("timezone")
        time_zone(zone)
    except ValueError as error:
        if isinstance(error, CorruptFileError):
            raise
        raise CorruptFileError(f"{place.where}: {error}; bake it again") from error
    return Location(
        latitude_degrees=place.number("latitude_degrees", -90, 90),
        longitude_degrees=place.number("longitude_degrees", -180, 180),
        elevation_m=place.number("elevation_m"),
        timezone=zone,
        north_degrees=place.number("north_degrees"),
        date=day,
        source=place.text("source"),
    )


def _lamp(lamp: Fields) -> Lamp:
    size = lamp.sequence("size", 2)
    if len(size) != 2:
        raise CorruptFileError(f"{lamp.where}: size: expected two numbers, found {len(size)}; bake it again")
    width, height = (Fields({"size": side}, lamp.where).number("size") for side in size)
    found = Lamp(
        name=lamp.text("name"),
        kind=lamp.choice("kind", LAMP_KINDS),
        position=lamp.point("position"),
        lumens=lamp.number("lumens", 0, MAX_LUMENS),
        color=lamp.point("color", 0),
        range_m=lamp.number("range_m", 0),
        direction=lamp.point("direction"),
        cone_degrees=lamp.number("cone_degrees"),
        size=(width, height),
        schedule=lamp.text("schedule"),
    )
    try:
        check_lamp(found)
    except InputError as error:
        raise CorruptFileError(f"{lamp.where}: {error}; bake it again") from error
    return found


def _decals(top: Fields) -> tuple[Decal, ...]:
    return tuple(_decal(Fields(r, f"{top.where}: decals", Decal.__dataclass_fields__)) for r in top.sequence("decals", MAX_DECALS))


def _decal(decal: Fields) -> Decal:
    found = Decal(decal.text("name"), decal.point("position"), decal.point("size"), decal.number("yaw_degrees"))
    try:
        check_decal(found)
    except InputError as error:
        raise CorruptFileError(f"{decal.where}: {error}; bake it again") from error
    return found


def sector_path(root: Path, index: SectorIndex) -> Path:
    """Where a dataset keeps a sector."""
    return root / "sectors" / f"{index}.gisec"


def geometry_path(root: Path, index: SectorIndex) -> Path:
    """Where a dataset keeps a sector's triangles."""
    return root / "geometry" / f"{index}.gigeo"


def fine_path(root: Path, index: SectorIndex) -> Path:
    """Where a dataset keeps a sector's fine voxels."""
    return root / "fine" / f"{index}.givox"


class Dataset:
    """Read access to a dataset. Files are read when asked for; of what is read only the distant texels are kept."""

    def __init__(self, path: Path, world: WorldInfo, digest: str) -> None:
        self.path = path
        self.world = world
        self.digest = digest  # 32 hexadecimal digits of everything that was baked
        self._distant: DistantTexels | None = None

    @classmethod
    def open(cls, path: Path | str) -> "Dataset":
        """Open a dataset folder. Raises InputError, FormatVersionError or CorruptFileError."""
        root = Path(path)
        file = root / WORLD_FILE
        if not file.is_file():
            raise InputError(
                f"{root}: no {WORLD_FILE} here; expected a folder that `sectorlight bake` wrote (a bake that was cut off resumes)"
            )
        try:
            text = container.read_bytes(file, MAX_WORLD_BYTES)
            record = json.loads(text)
        except OSError as error:
            raise InputError(f"{file}: {error.strerror}") from error
        except CorruptFileError:
            raise
        except (ValueError, RecursionError) as error:
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
            raise CorruptFileError(f"{path}: holds sector {sector.index}{_other_bake(meta.get('bake_id'), world)}; bake it again")
        if len(sector.sun_visibility) != world.sun_table.plane_count:
            raise CorruptFileError(
                f"{path}: {len(sector.sun_visibility)} sun planes, expected {world.sun_table.plane_count}; bake it again"
            )
        if sector.basis_size != BASIS_SIZES[world.basis]:
            raise CorruptFileError(
                f"{path}: {sector.basis_size} coefficients, expected {BASIS_SIZES[world.basis]} of {world.basis}; bake it again"
            )
        if max(int(sector.voxel_room.max(initial=0)), int(sector.probe_room.max(initial=0))) > len(world.rooms):
            raise CorruptFileError(f"{path}: expected rooms of 1 to {len(world.rooms)}; bake it again")
        # The device holds as many patches as world.json says; the file was checked against its own number.
        if int(sector.factor_source.max(initial=0)) >= sector.brick_count + world.sky_patches:
            raise CorruptFileError(f"{path}: expected factors of {world.sky_patches} sky patches at most; bake it again")
        return sector

    def geometry(self, index: SectorIndex) -> Geometry:
        """A sector's triangles. Raises as ``sector``."""
        self._expect(index)
        path = geometry_path(self.path, index)
        try:
            geometry, found, bake_id = geometry_file.read(path)
        except OSError as error:
            raise CorruptFileError(f"{path}: {error.strerror}; bake it again") from error
        if found != index or bake_id != self.world.bake_id:
            raise CorruptFileError(f"{path}: holds sector {found}{_other_bake(bake_id, self.world)}; bake it again")
        return geometry

    def fine_voxels(self, sector: Sector) -> VoxelGrid:
        """A sector's fine voxels, checked against its probes. Raises as ``sector``."""
        path = fine_path(self.path, sector.index)
        try:
            voxels, found, bake_id = fine_file.read(path)
        except OSError as error:
            raise CorruptFileError(f"{path}: {error.strerror}; bake it again") from error
        if found != sector.index or bake_id != self.world.bake_id:
            raise CorruptFileError(f"{path}: holds sector {found}{_other_bake(bake_id, self.world)}; bake it again")
        # What weighs nothing is read as well.
        if int(voxels.probe.max(initial=0)) >= max(sector.probe_count, 1):
            raise CorruptFileError(f"{path}: expected voxels of {sector.probe_count} probes; bake it again")
        return voxels

    def distant(self) -> DistantTexels:
        """All sectors' distant texels, for as long as this dataset is open. Raises CorruptFileError, FormatVersionError."""
        if self._distant is None:
            self._distant = self._read_distant()
        return self._distant

    @property
    def distant_bytes(self) -> int:
        """Bytes of the distant texels' file; 0 where there is none."""
        path = self.path / DISTANT_FILE
        return path.stat().st_size if path.is_file() else 0

    def _read_distant(self) -> DistantTexels:
        path = self.path / DISTANT_FILE
        try:
            texels, bake_id = distant_file.read(path)
        except OSError as error:
            raise CorruptFileError(f"{path}: {error.strerror}; bake it again") from error
        if bake_id != self.world.bake_id or set(texels.sectors()) != set(self.world.sectors):
            raise CorruptFileError(f"{path}: holds {int(texels.valid.sum())} sectors{_other_bake(bake_id, self.world)}; bake it again")
        transfer, planes = texels.transfer, self.world.sun_table.plane_count
        if transfer is not None and (transfer.sky.shape[1], transfer.sun.shape[1]) != (self.world.sky_patches, planes):
            found = f"{transfer.sky.shape[1]} sky patches and {transfer.sun.shape[1]} sun planes"
            raise CorruptFileError(f"{path}: {found}, expected {self.world.sky_patches} and {planes}; bake it again")
        return texels

    def _expect(self, index: SectorIndex) -> None:
        if index not in self.world.sectors:
            raise SectorMissingError(f"{self.path}: sector {index.x},{index.z} is not in this dataset of {len(self.world.sectors)} sectors")


def _other_bake(bake_id: Any, world: WorldInfo) -> str:
    return "" if bake_id == world.bake_id else " of another bake"


def write_world(root: Path, world: WorldInfo) -> None:
    """Write world.json; a dataset is complete once it is there."""
    text = json.dumps(world.to_json(), indent=1, sort_keys=True, allow_nan=False) + "\n"
    container.write_atomic(root / WORLD_FILE, text.encode())
