"""``load_scene``: any SOURCE that the bake command takes -> a clean Scene."""

import dataclasses
from pathlib import Path

from bake_jobs.cityjson import load_cityjson
from bake_jobs.clean import clean_mesh
from bake_jobs.footprints import load_footprints
from bake_jobs.geography import MapFrame
from bake_jobs.mesh_source import MESH_SUFFIXES, load_mesh
from bake_jobs.procedural import load_procedural
from bake_jobs.room_search import world_rooms
from bake_jobs.scene import Scene, SourceContent
from bake_jobs.world_file import load_world_file
from gi_core.errors import SourceError
from gi_core.world import Location

PROCEDURAL_PREFIX = "procedural:"
FOOTPRINT_SUFFIXES = (".geojson",)
CITYJSON_SUFFIXES = (".city.json", ".cityjson")
KNOWN_SOURCES = (
    ".glb .gltf .obj .ply (metres), .geojson (footprints), .city.json or .cityjson, a world .toml, or procedural:midtown?blocks=8x8&seed=1"
)


def load_scene(source: str | Path) -> Scene:
    """Read a city.

    Georeferenced sources (.geojson, .city.json with a coordinate system) are placed so that the middle of the data, or the world
    file's location when there is one, is the world's origin; their heights are kept. Raises SourceError with one line that says
    where, what was expected and what was found.
    """
    text = str(source)
    if text.startswith(PROCEDURAL_PREFIX):
        content, name = load_procedural(text), text
    elif text.lower().endswith(".toml"):
        content, name = load_world_file(_existing(text), load_content), _stem(text)
    else:
        content, name = load_content(_existing(text), None), _stem(text)
    mesh, dropped = clean_mesh(content.mesh, text, content.rooms)
    scene = Scene(
        mesh.vertices,
        mesh.triangles.astype("int32"),
        mesh.albedo,
        mesh.emission,
        content.name or name,
        content.location or Location(),
        content.rooms,
        content.lamps,
        content.hints,
        dropped,
        content.decals,
        content.notes,
    )
    return dataclasses.replace(scene, rooms=world_rooms(scene, content.search))


def load_content(path: Path, frame: MapFrame | None) -> SourceContent:
    """One mesh, map or city file; ``frame`` places what is georeferenced. Raises SourceError."""
    _existing(path)
    name = path.name.lower()
    if name.endswith(CITYJSON_SUFFIXES):
        return load_cityjson(path, frame)
    if name.endswith(FOOTPRINT_SUFFIXES):
        return load_footprints(path, frame)
    if name.endswith(MESH_SUFFIXES):
        return load_mesh(path)
    raise SourceError(f"{path}: expected {KNOWN_SOURCES}; found {path.suffix or 'no extension'}")


def _existing(path: str | Path) -> Path:
    found = Path(path)
    if not found.exists():
        raise SourceError(f"{path}: no such file; expected {KNOWN_SOURCES}")
    if not found.is_file():
        raise SourceError(f"{path}: expected a file, found a folder")
    return found


def _stem(text: str) -> str:
    name = Path(text).name
    for suffix in CITYJSON_SUFFIXES:
        name = name.removesuffix(suffix)
    return name if name != Path(text).name else Path(text).stem
