"""Sky factors of every sector's distant texel <-> bytes of ``distant.gidist`` (slide "Distant shading")."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gi_core import container
from gi_core.arrays import Float32, UInt8
from gi_core.errors import CorruptFileError
from gi_core.grid import SectorIndex

KIND = "DIST"
VERSION = 1


@dataclass(frozen=True, eq=False)
class DistantTexels:
    """One texel per sector of the dataset's rectangle.

    origin : the sector of texel (0, 0), north-west: rows go south (+Z), columns east (+X)
    sky : (rows, cols, 6) float32, share of each cube face that sees the sky, mean over the sector's outdoor probes
    valid : (rows, cols) uint8, 1 where the dataset has a sector
    """

    origin: SectorIndex
    sky: Float32
    valid: UInt8


def assemble(texels: dict[SectorIndex, list[float]]) -> DistantTexels:
    """Texels of the rectangle around all sectors, from each sector's six sky factors."""
    if not texels:
        return DistantTexels(SectorIndex(0, 0), np.zeros((0, 0, 6), np.float32), np.zeros((0, 0), np.uint8))
    xs, zs = [i.x for i in texels], [i.z for i in texels]
    origin = SectorIndex(min(xs), min(zs))
    shape = (max(zs) - origin.z + 1, max(xs) - origin.x + 1)
    sky, valid = np.zeros((*shape, 6), np.float32), np.zeros(shape, np.uint8)
    for index, values in texels.items():
        sky[index.z - origin.z, index.x - origin.x] = values
        valid[index.z - origin.z, index.x - origin.x] = 1
    return DistantTexels(origin, sky, valid)


def encode(texels: DistantTexels, bake_id: str) -> bytes:
    """Bytes of a distant file. ``bake_id`` names the bake, as in the sectors' files."""
    meta = {"origin": list(texels.origin), "bake_id": bake_id}
    return container.encode(KIND, VERSION, meta, {"sky": texels.sky.astype(np.float32), "valid": texels.valid})


def decode(data: bytes, where: str) -> tuple[DistantTexels, str]:
    """Texels of a distant file, and their bake's id. Raises CorruptFileError or FormatVersionError."""
    found = container.decode(data, KIND, VERSION, where)
    try:
        found.refuse_unknown(frozenset({"origin", "bake_id"}), frozenset({"sky", "valid"}))
        sky, valid = found.take("sky", "f4", 3), found.take("valid", "u1", 2)
        origin, bake_id = SectorIndex(*(int(v) for v in found.meta["origin"])), str(found.meta["bake_id"])
    except CorruptFileError as error:
        raise CorruptFileError(f"{where}: {error}; bake it again") from error
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise CorruptFileError(f"{where}: no origin or bake id ({error}); bake it again") from error
    # A NaN is in no range.
    if sky.shape != (*valid.shape, 6) or not ((sky >= 0) & (sky <= 1.001)).all() or valid.max(initial=0) > 1:
        raise CorruptFileError(f"{where}: expected six sky factors of 0..1 per texel, found {sky.shape}; bake it again")
    return DistantTexels(origin, sky, valid), bake_id


def read(path: Path) -> tuple[DistantTexels, str]:
    """A distant file from disk, as ``decode``."""
    return decode(container.read_bytes(path), str(path))
