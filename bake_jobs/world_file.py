"""world.toml: several sources in one world, with place, rooms, lamps, decals and hints. Every key is checked; unknown ones are refused.

name = "my city"                       # all keys are optional but [[source]] and its path
north_degrees = 29.0                   # compass azimuth of the world's -Z axis; streets run along the axes when it is theirs

[location]                             # origin of the world; places .geojson and .city.json sources
latitude = 40.7484
longitude = -73.9857
elevation_m = 10.0
timezone = "America/New_York"          # found from the place when it is not given
date = 2024-06-21                      # the day that a bare HH:MM means

[[source]]
path = "city.glb"                      # relative to this file
offset = [0.0, 0.0, 0.0]               # metres, added in the world frame
albedo = [0.4, 0.4, 0.4]               # replaces the source's own, linear sRGB

[rooms]                                # beside those below, find rooms: air that is enclosed, with openings that are small against it
find = true
closed = false                         # true: also air without any opening, as behind doors that are modelled shut

[[room]]
name = "lobby"
minimum = [0.0, 0.0, 0.0]
maximum = [8.0, 4.0, 6.0]

[[room]]                               # or the inside of a closed mesh, kept in cells of 0.1 m
name = "hall"
mesh = "hall.obj"                      # .glb .gltf .obj or .ply, relative to this file
offset = [0.0, 0.0, 0.0]               # as of a source

[[lamp]]
name = "corner"
kind = "point"                         # point, spot or area (a rectangle that shines to one side)
position = [3.0, 6.0, 2.0]             # of an area its centre
lumens = 8000.0
color = [1.0, 0.8, 0.6]                # linear sRGB, only ratios count; or temperature_k = 3000.0
range_m = 30.0                         # light fades smoothly to none
direction = [0.0, -1.0, 0.0]           # of a spot's axis, of an area's normal
cone_degrees = 90.0                    # of a spot, full angle
size = [1.0, 1.0]                      # of an area, width and height; the width is level
schedule = "always"                    # or "night", or local times: "18:00-23:30"

[[decal]]                              # a box that darkens the ground: a parked vehicle that no source has
name = "taxi"
position = [3.0, 0.25, 8.0]            # the middle of its underside
size = [1.8, 1.25, 4.6]                # width, height and length, along its own x, y and z
yaw_degrees = 30.0                     # counter-clockwise seen from above

[[hint]]
kind = "add"                           # add; walls: off every wall in the box; forbid; densify: more where light changes (adaptive)
minimum = [0.0, 0.0, 0.0]
maximum = [8.0, 4.0, 6.0]
spacing_m = 2.0
"""

import dataclasses
import zoneinfo
from collections.abc import Callable
from datetime import date, datetime
from pathlib import Path

import numpy as np

from bake_jobs.geography import MapFrame, timezone_at
from bake_jobs.lamp_file import read_lamp
from bake_jobs.mesh_source import MESH_SUFFIXES
from bake_jobs.room_meshes import mesh_room
from bake_jobs.scene import Mesh, ProbeHint, Search, SourceContent, join_meshes
from bake_jobs.table import Table, read_toml
from gi_core.constants import MAX_PROBES_PER_SECTOR, SECTOR_SIZE_M
from gi_core.dataset import MAX_DECALS
from gi_core.decals import MAX_SIZE_M, MAX_YAW_DEGREES, MIN_SIZE_M
from gi_core.errors import SourceError
from gi_core.room_records import MAX_ROOMS
from gi_core.world import Decal, Location, Room

HINT_KINDS = ("add", "walls", "forbid", "densify")
# Places to try in one sector: most of a box may be solid.
MOST_ASKED = 100 * MAX_PROBES_PER_SECTOR
MAX_ROOM_M = 1000.0  # the largest halls; openings are looked for in every half metre or so of a room's faces
Loader = Callable[[Path, MapFrame | None], SourceContent]


def load_world_file(path: Path, load: Loader) -> SourceContent:
    """Read a world.toml and, with ``load``, the sources it names. Raises SourceError naming the key that is wrong."""
    top = read_toml(path)
    name = top.text("name", path.stem)
    north = top.number("north_degrees", 0.0, -360.0, 360.0)
    given = top.table("location")
    location = _location(given, north) if given else None
    frame = MapFrame(location.latitude_degrees, location.longitude_degrees, north) if location else None
    sources = [_source(table, path.parent, frame, north, load) for table in top.tables("source")]
    rooms = tuple(_room(table, path.parent, load) for table in top.tables("room"))
    search = _search(top.table("rooms"))
    lamps = tuple(read_lamp(table) for table in top.tables("lamp"))
    hints = tuple(_hint(table) for table in top.tables("hint"))
    decals = tuple(_decal(table) for table in top.tables("decal"))
    top.refuse_unknown()
    if not sources:
        raise SourceError(f"{path}: expected at least one [[source]] with a path, found none")
    if len(rooms) > MAX_ROOMS:
        raise SourceError(f"{path}: expected at most {MAX_ROOMS} rooms, found {len(rooms)}")
    if len(decals) > MAX_DECALS:
        raise SourceError(f"{path}: expected at most {MAX_DECALS} decals, found {len(decals)}")
    placed = [content for content in sources if content.location]
    if location is None:
        if len(placed) > 1:
            raise SourceError(f"{path}: expected a [location] to place {len(placed)} georeferenced sources in one world, found none")
        location = placed[0].location if placed else dataclasses.replace(Location(), north_degrees=north)
    notes = tuple(note for content in sources for note in content.notes)
    return SourceContent(join_meshes([content.mesh for content in sources]), location, rooms, lamps, hints, name, decals, search, notes)


def _location(table: Table, north: float) -> Location:
    default = Location()
    latitude = table.number("latitude", None, -90.0, 90.0)
    longitude = table.number("longitude", None, -180.0, 180.0)
    timezone = table.text("timezone", "") or timezone_at(latitude, longitude)
    if timezone not in zoneinfo.available_timezones():
        raise SourceError(f"{table.where}: timezone: expected an IANA name such as Europe/Berlin, found {timezone!r}")
    elevation = table.number("elevation_m", 0.0, -500.0, 9000.0)
    day = table.take("date", default.date)
    if not isinstance(day, date) or isinstance(day, datetime):
        raise SourceError(f"{table.where}: date: expected a TOML date such as 2024-06-21 (no quotes), found {day!r}")
    table.refuse_unknown()
    return Location(latitude, longitude, elevation, timezone, north, day, "given")


def _source(table: Table, folder: Path, frame: MapFrame | None, north: float, load: Loader) -> SourceContent:
    path = folder / table.text("path", None)
    offset = table.vector("offset", (0.0, 0.0, 0.0))
    albedo = table.vector("albedo", (-1.0, -1.0, -1.0), 0.0, 1.0)
    table.refuse_unknown()
    if path.suffix.lower() == ".toml":
        raise SourceError(f"{table.where}: path: expected a mesh or a map, found another world file ({path})")
    content = load(path, frame)
    if frame is None and north and content.location:
        # The file places itself; read it again about the same origin, turned.
        place = content.location
        content = load(path, MapFrame(place.latitude_degrees, place.longitude_degrees, north))
    mesh = content.mesh
    colour = mesh.albedo if albedo[0] < 0 else np.broadcast_to(np.array(albedo, np.float32), mesh.albedo.shape)
    return dataclasses.replace(content, mesh=Mesh(mesh.vertices + np.array(offset), mesh.triangles, colour, mesh.emission))


def _room(table: Table, folder: Path, load: Loader) -> Room:
    name = table.text("name", None)
    if "mesh" not in table:
        minimum, maximum = _box(table)
        table.refuse_unknown()
        longest = max(high - low for low, high in zip(minimum, maximum, strict=True))
        if longest > MAX_ROOM_M:
            raise SourceError(f"{table.where}: expected a room of at most {MAX_ROOM_M:g} m on every axis, found {longest:g} m")
        return Room(name, minimum, maximum)
    path = folder / table.text("mesh", None)
    offset = table.vector("offset", (0.0, 0.0, 0.0))
    if "minimum" in table or "maximum" in table:
        raise SourceError(f"{table.where}: expected a mesh, or minimum and maximum, found both")
    table.refuse_unknown()
    if not path.name.lower().endswith(MESH_SUFFIXES):
        raise SourceError(f"{table.where}: mesh: expected {' '.join(MESH_SUFFIXES)}, found {path}")
    if not path.is_file():
        raise SourceError(f"{table.where}: mesh: expected a file, found none at {path}")
    drawn = load(path, None).mesh
    return mesh_room(name, dataclasses.replace(drawn, vertices=drawn.vertices + np.array(offset)), f"{table.where}: {path}")


def _search(table: Table | None) -> Search:
    if table is None:
        return "none"
    find, closed = table.flag("find", default=False), table.flag("closed", default=False)
    table.refuse_unknown()
    if closed and not find:
        raise SourceError(f"{table.where}: closed: expected find = true with it, found closed alone")
    return ("all" if closed else "open") if find else "none"


def _decal(table: Table) -> Decal:
    decal = Decal(
        table.text("name", None),
        table.vector("position", None, -1e9, 1e9),
        table.vector("size", None, MIN_SIZE_M, MAX_SIZE_M),
        table.number("yaw_degrees", Decal.yaw_degrees, -MAX_YAW_DEGREES, MAX_YAW_DEGREES),
    )
    table.refuse_unknown()
    return decal


def _hint(table: Table) -> ProbeHint:
    kind = table.choice("kind", HINT_KINDS, None)
    minimum, maximum = _box(table)
    spacing = table.number("spacing_m", ProbeHint.spacing_m, 0.25, 1000.0)
    table.refuse_unknown()
    # Of one sector: along both axes of walls, in all of a box to add to.
    across = [min(maximum[axis] - minimum[axis], SECTOR_SIZE_M) / spacing for axis in (0, 2)]
    up = (maximum[1] - minimum[1]) / spacing
    asked = {"add": up * across[0] * across[1], "walls": up * sum(across)}.get(kind, 0.0)
    if asked > MOST_ASKED:
        raise SourceError(
            f"{table.where}: asks for {asked:,.0f} probes in one sector, which holds {MAX_PROBES_PER_SECTOR}; "
            "make spacing_m larger, or the box smaller"
        )
    return ProbeHint(kind, minimum, maximum, spacing)


def _box(table: Table) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    minimum, maximum = table.vector("minimum", None), table.vector("maximum", None)
    if not all(low < high for low, high in zip(minimum, maximum, strict=True)):
        raise SourceError(f"{table.where}: expected minimum below maximum on every axis, found {list(minimum)} and {list(maximum)}")
    return minimum, maximum
