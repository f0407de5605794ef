"""A sector's triangles <-> bytes of a ``.gigeo`` file: what shadow maps, previews and ``compare`` draw."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gi_core import container, quantise
from gi_core.arrays import AnyArray, Float32, Float64, Int32
from gi_core.errors import CorruptFileError
from gi_core.grid import SectorIndex, sector_index

KIND = "GEOM"
VERSION = 1
_ARRAYS = frozenset({"vertex", "triangle", "material", "material_albedo", "material_emission"})


@dataclass(frozen=True, eq=False)
class Geometry:
    """Triangles of one sector, cut at its borders.

    vertices : (v, 3) float64 [m], world frame
    triangles : (m, 3) int32
    albedo : (m, 3) float32, linear sRGB
    emission : (m, 3) float32 [cd m^-2]
    """

    vertices: Float64
    triangles: Int32
    albedo: Float32
    emission: Float32


def encode(index: SectorIndex, geometry: Geometry, bake_id: str) -> bytes:
    """Bytes of a geometry file: unique vertices in steps of 1/512 m, triangles, and a table of distinct materials.

    ``bake_id`` names the bake, as in the sector's other file. Triangles that the rounding makes degenerate are left out.
    """
    steps = quantise.encode_length(geometry.vertices - index.origin)
    vertices, inverse = np.unique(steps, axis=0, return_inverse=True)
    triangles = inverse.reshape(-1)[geometry.triangles].reshape(-1, 3)
    corners = [triangles[:, i] for i in range(3)]
    whole = (corners[0] != corners[1]) & (corners[1] != corners[2]) & (corners[2] != corners[0])
    albedo = quantise.encode_root(geometry.albedo[whole]).astype(np.float32)
    material, material_index = np.unique(np.hstack([albedo, geometry.emission[whole]]), axis=0, return_inverse=True)
    arrays: dict[str, AnyArray] = {
        "vertex": vertices.T.astype(np.int32),
        "triangle": triangles[whole].T.astype(np.int32),
        "material": material_index.reshape(-1).astype(np.uint32),
        "material_albedo": material[:, :3].astype(np.uint8),
        "material_emission": material[:, 3:].astype(np.float32),
    }
    return container.encode(KIND, VERSION, {"sector": list(index), "bake_id": bake_id}, arrays, frozenset({"vertex", "triangle"}))


def decode(data: bytes, where: str) -> tuple[Geometry, SectorIndex, str]:
    """Triangles of a geometry file, every index checked, the sector that they belong to, and their bake's id.

    Raises CorruptFileError or FormatVersionError.
    """
    found = container.decode(data, KIND, VERSION, where)
    try:
        found.refuse_unknown(frozenset({"sector", "bake_id"}), _ARRAYS)
        index, bake_id = sector_index(found.meta["sector"]), str(found.meta["bake_id"])
        vertex, triangle = found.take("vertex", "i4", 2), found.take("triangle", "i4", 2)
        material = found.take("material", "u4", 1)
        albedo, emission = found.take("material_albedo", "u1", 2), found.take("material_emission", "f4", 2)
        fits = (
            vertex.shape[0] == 3
            and triangle.shape == (3, len(material))
            and albedo.shape == emission.shape == (len(albedo), 3)
            and (not triangle.size or (0 <= triangle.min() and triangle.max() < vertex.shape[1]))
            and (not material.size or material.max() < len(albedo))
            and bool(np.isfinite(emission).all())
        )
    except CorruptFileError as error:
        raise CorruptFileError(f"{where}: {error}; bake it again") from error
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise CorruptFileError(f"{where}: inconsistent contents ({error}); bake it again") from error
    if not fits:
        raise CorruptFileError(f"{where}: a triangle or material index is out of range; bake it again")
    geometry = Geometry(
        vertices=quantise.decode_length(vertex.T) + index.origin,
        triangles=np.ascontiguousarray(triangle.T),
        albedo=quantise.decode_root(albedo)[material],
        emission=emission[material],
    )
    return geometry, index, bake_id


def read(path: Path) -> tuple[Geometry, SectorIndex, str]:
    """A geometry file from disk, as ``decode``."""
    return decode(container.read_bytes(path), str(path))
