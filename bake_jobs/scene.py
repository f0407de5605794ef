"""What a bake reads: triangles with albedo and emission, and what a world.toml says about them."""

import dataclasses
import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from gi_core.arrays import Float32, Float64, Int32, Int64
from gi_core.world import Decal, Lamp, Location, Room

Search = Literal["none", "open", "all"]


@dataclass(frozen=True)
class DroppedTriangles:
    """How many triangles of the source were not used, and why."""

    degenerate: int = 0
    duplicate: int = 0
    non_finite: int = 0


@dataclass(frozen=True)
class ProbeHint:
    """A box in which the author wants probes added ("add", spaced by spacing_m), probes off every wall ("walls", spaced by it along the
    wall and up), none ("forbid"), or more of those that adaptive placement finds ("densify")."""

    kind: str
    minimum: tuple[float, float, float]
    maximum: tuple[float, float, float]
    spacing_m: float = 4.0


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles as a source gives them, not yet cleaned. World frame, metres.

    vertices : (v, 3) float64 [m]
    triangles : (m, 3) int64, indices that may be out of range
    albedo : (m, 3) float32, linear sRGB, any value
    emission : (m, 3) float32 [cd m^-2]
    """

    vertices: Float64
    triangles: Int64
    albedo: Float32
    emission: Float32

    @classmethod
    def of_colour(cls, vertices: Float64, triangles: Int64, albedo: Float64 | Float32 | Sequence[float]) -> "Mesh":
        """A mesh that gives no light; albedo is (3,) for all triangles or (m, 3)."""
        colour = np.broadcast_to(np.asarray(albedo, np.float32), (len(triangles), 3)).copy()
        return cls(vertices, triangles, colour, np.zeros((len(triangles), 3), np.float32))


@dataclass(frozen=True, eq=False)
class SourceContent:
    """What one source file holds, before it is cleaned and joined with others. location is None when the source knows no place.

    search : which enclosed air is to be found as rooms beside the authored ones: "none", "open" (with openings), or "all"
    notes : what was guessed for want of better, a line each, for whoever bakes
    """

    mesh: Mesh
    location: Location | None = None
    rooms: tuple[Room, ...] = ()
    lamps: tuple[Lamp, ...] = ()
    hints: tuple[ProbeHint, ...] = ()
    name: str = ""
    decals: tuple[Decal, ...] = ()
    search: Search = "none"
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Scene:
    """A city, ready to bake. World frame, metres.

    vertices : (v, 3) float64 [m]
    triangles : (m, 3) int32, counter-clockwise seen from outside where the source knows an outside
    albedo : (m, 3) float32, linear sRGB, 0..ALBEDO_MAX
    emission : (m, 3) float32 [cd m^-2]
    notes : as SourceContent's
    """

    vertices: Float64
    triangles: Int32
    albedo: Float32
    emission: Float32
    name: str = "scene"
    location: Location = field(default_factory=Location)
    rooms: tuple[Room, ...] = ()
    lamps: tuple[Lamp, ...] = ()
    hints: tuple[ProbeHint, ...] = ()
    dropped: DroppedTriangles = field(default_factory=DroppedTriangles)
    decals: tuple[Decal, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def bounds(self) -> Float64:
        """(2, 3) float64 [m]: minimum and maximum of the vertices."""
        return np.array([self.vertices.min(axis=0), self.vertices.max(axis=0)])


def join_meshes(meshes: Sequence[Mesh]) -> Mesh:
    """One mesh of several. An index that was out of range in its own mesh stays out of range (-1)."""
    triangles = []
    first = 0
    for mesh in meshes:
        count = len(mesh.vertices)
        in_range = (mesh.triangles >= 0) & (mesh.triangles < count)
        triangles.append(np.where(in_range, mesh.triangles + first, -1))
        first += count
    if not meshes:
        nothing = np.zeros((0, 3))
        return Mesh(nothing, nothing.astype(np.int64), nothing.astype(np.float32), nothing.astype(np.float32))
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]).astype(np.float64),
        np.concatenate(triangles).astype(np.int64),
        np.concatenate([mesh.albedo for mesh in meshes]).astype(np.float32),
        np.concatenate([mesh.emission for mesh in meshes]).astype(np.float32),
    )


def scene_digest(scene: Scene) -> str:
    """32 hexadecimal digits of all that a scene's sectors depend on: not its name, decals, openings, notes and dropped counts."""
    h = hashlib.blake2b(digest_size=16)
    for values, dtype in (
        (scene.vertices, np.dtype("<f8")),
        (scene.triangles, np.dtype("<i4")),
        (scene.albedo, np.dtype("<f4")),
        (scene.emission, np.dtype("<f4")),
    ):
        h.update(repr(values.shape).encode())
        h.update(np.ascontiguousarray(values, dtype).tobytes())
    said = [
        dataclasses.asdict(scene.location),
        [room.box_json() | ({} if room.cells is None else {"cells": room.cells.bits.hex()}) for room in scene.rooms],
        [dataclasses.asdict(lamp) for lamp in scene.lamps],
        [dataclasses.asdict(hint) for hint in scene.hints],
    ]
    h.update(json.dumps(said, sort_keys=True, default=str).encode())
    return h.hexdigest()
