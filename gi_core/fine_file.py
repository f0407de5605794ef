"""A sector's fine voxels <-> bytes of a ``.givox`` file: half the talk's voxel, near surfaces, for volumes of cascade -1.

Where voxels have no weights the sector's own say enough. Only datasets that were baked for it have such files, and only whoever asks for
that cascade reads one.
"""

from pathlib import Path

import numpy as np

from gi_core import container, quantise
from gi_core.arrays import AnyArray
from gi_core.constants import FINE_VOXEL_SIZE_M, MAX_PROBES_PER_SECTOR, VOXEL_INDOORS
from gi_core.errors import CorruptFileError
from gi_core.grid import SectorIndex, sector_index, voxel_columns
from gi_core.sector_file import MAX_BLENDED_PROBES
from gi_core.voxel_grid import VoxelGrid

KIND = "FINE"
VERSION = 1
_ARRAYS = frozenset({"voxel_class", "voxel_probe", "voxel_weight"})


def encode(index: SectorIndex, voxels: VoxelGrid, bake_id: str) -> bytes:
    """Bytes of a fine voxel file. ``bake_id`` names the bake, as in the sector's other files."""
    arrays: dict[str, AnyArray] = {
        "voxel_class": voxels.kind,
        "voxel_probe": np.moveaxis(voxels.probe, 3, 0),
        "voxel_weight": np.moveaxis(quantise.encode_fraction(voxels.weight), 3, 0),
    }
    meta = {"sector": list(index), "voxel_first": [int(v) for v in voxels.first], "bake_id": bake_id}
    return container.encode(KIND, VERSION, meta, arrays, frozenset({"voxel_probe"}))


def decode(data: bytes, where: str) -> tuple[VoxelGrid, SectorIndex, str]:
    """Fine voxels, their sector and their bake's id; every count, range and index checked but against the sector's number of probes.

    Raises CorruptFileError or FormatVersionError.
    """
    found = container.decode(data, KIND, VERSION, where)
    try:
        found.refuse_unknown(frozenset({"sector", "voxel_first", "bake_id"}), _ARRAYS)
        index, bake_id = sector_index(found.meta["sector"]), str(found.meta["bake_id"])
        kind, probe, share = found.take("voxel_class", "u1", 3), found.take("voxel_probe", "u2", 4), found.take("voxel_weight", "u1", 4)
        first = np.array([int(v) for v in found.meta["voxel_first"]], np.int32)
    except CorruptFileError as error:
        raise CorruptFileError(f"{where}: {error}; bake it again") from error
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise CorruptFileError(f"{where}: inconsistent contents ({error}); bake it again") from error
    (x0, x1), (z0, z1) = (voxel_columns(i, FINE_VOXEL_SIZE_M) for i in index)
    fits = (
        first.shape == (3,)
        and (first[0], first[2]) == (x0, z0)
        and kind.shape[1:] == (z1 - z0, x1 - x0)
        and 1 <= len(share) <= MAX_BLENDED_PROBES
        and share.shape == probe.shape == (len(share), *kind.shape)
        and kind.max(initial=0) <= VOXEL_INDOORS
        and probe.max(initial=0) < MAX_PROBES_PER_SECTOR
    )
    if not fits:
        raise CorruptFileError(f"{where}: expected voxels of sector {index} with 1 to {MAX_BLENDED_PROBES} probes each; bake it again")
    shares = np.ascontiguousarray(np.moveaxis(share, 0, 3), np.float32)
    weight = shares / np.maximum(shares.sum(axis=3, keepdims=True), 1)
    return VoxelGrid(first, kind, np.ascontiguousarray(np.moveaxis(probe, 0, 3)), weight), index, bake_id


def read(path: Path) -> tuple[VoxelGrid, SectorIndex, str]:
    """A fine voxel file from disk, as ``decode``."""
    return decode(container.read_bytes(path), str(path))
