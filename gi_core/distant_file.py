"""Every sector's distant texel <-> bytes of ``distant.gidist`` (slide "Distant shading")."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from gi_core import container
from gi_core.arrays import AnyArray, Float32, UInt8
from gi_core.constants import MAX_SKY_PATCHES
from gi_core.distant_transfer import CHANNELS, COVERS, SUN_PARTS, DistantTransfer
from gi_core.errors import CorruptFileError
from gi_core.grid import SectorIndex
from gi_core.lights import is_schedule

KIND = "DIST"
# Version 1 has sky factors alone, as files of a world without transfers still do.
VERSION, SKY_VERSION = 2, 1
MAX_SCHEDULES = 64
# No lamp gives so much; the sum of all schedules is a float32 still.
MAX_GLOW_LX = 1e30
# The sky's direct light alone, or all light over all bounces.
DistantLight = Literal["sky", "full"]


@dataclass(frozen=True, eq=False)
class DistantTexels:
    """One texel per sector of the dataset's rectangle.

    origin : the sector of texel (0, 0), north-west: rows go south (+Z), columns east (+X)
    sky : (rows, cols, 6) float32, share of each cube face that sees the sky, mean over the sector's outdoor probes
    valid : (rows, cols) uint8, 1 where the dataset has a sector
    transfer : of the valid ones, row by row; None where it was not baked
    """

    origin: SectorIndex
    sky: Float32
    valid: UInt8
    transfer: DistantTransfer | None = None

    @property
    def lights(self) -> tuple[DistantLight, ...]:
        """What texels can be lit by, the best of them last."""
        return ("sky",) if self.transfer is None else ("sky", "full")

    def sectors(self) -> list[SectorIndex]:
        """The valid texels' sectors, row by row."""
        rows, columns = np.nonzero(self.valid)
        return [SectorIndex(self.origin.x + x, self.origin.z + z) for z, x in zip(rows.tolist(), columns.tolist(), strict=True)]


def assemble(texels: Mapping[SectorIndex, list[float]], transfers: Mapping[SectorIndex, DistantTransfer] | None = None) -> DistantTexels:
    """Texels of the rectangle around all sectors, from each sector's six sky factors, and its one texel's transfer where there are any.

    Transfers that are more than a file may hold are left out.
    """
    if not texels:
        return DistantTexels(SectorIndex(0, 0), np.zeros((0, 0, 6), np.float32), np.zeros((0, 0), np.uint8))
    xs, zs = [i.x for i in texels], [i.z for i in texels]
    origin = SectorIndex(min(xs), min(zs))
    shape = (max(zs) - origin.z + 1, max(xs) - origin.x + 1)
    sky, valid = np.zeros((*shape, 6), np.float32), np.zeros(shape, np.uint8)
    for index, values in texels.items():
        sky[index.z - origin.z, index.x - origin.x] = values
        valid[index.z - origin.z, index.x - origin.x] = 1
    found = DistantTexels(origin, sky, valid)
    if not transfers or sum(transfer.nbytes for transfer in transfers.values()) + sky.nbytes + valid.nbytes > container.MAX_RAW_BYTES:
        return found
    parts = [transfers[index] for index in found.sectors()]
    return replace(
        found,
        transfer=DistantTransfer(
            sky=np.concatenate([part.sky for part in parts], axis=-2),
            sun=np.concatenate([part.sun for part in parts], axis=-2),
            glow=np.concatenate([part.glow for part in parts], axis=-2),
            schedules=parts[0].schedules,
        ),
    )


def taken_apart(texels: DistantTexels) -> dict[SectorIndex, DistantTransfer]:
    """Each sector's transfer, as ``assemble`` took it; none where there is none."""
    whole = texels.transfer
    if whole is None:
        return {}
    only = [slice(i, i + 1) for i in range(whole.texels)]
    return {
        index: DistantTransfer(whole.sky[..., one, :], whole.sun[..., one, :], whole.glow[..., one, :], whole.schedules)
        for index, one in zip(texels.sectors(), only, strict=True)
    }


def encode(texels: DistantTexels, bake_id: str) -> bytes:
    """Bytes of a distant file. ``bake_id`` names the bake, as in the sectors' files."""
    meta: dict[str, Any] = {"origin": list(texels.origin), "bake_id": bake_id}
    arrays: dict[str, AnyArray] = {"sky": texels.sky.astype(np.float32), "valid": texels.valid}
    transfer = texels.transfer
    if transfer is None:
        return container.encode(KIND, SKY_VERSION, meta, arrays)
    meta["schedules"] = list(transfer.schedules)
    arrays |= {"sky_transfer": transfer.sky.astype(np.float16), "sun_transfer": transfer.sun, "glow": transfer.glow}
    return container.encode(KIND, VERSION, meta, arrays)


def decode(data: bytes, where: str) -> tuple[DistantTexels, str]:
    """Texels of a distant file, and their bake's id. Raises CorruptFileError or FormatVersionError."""
    found = container.decode(data, KIND, (SKY_VERSION, VERSION), where)
    has_transfer, meta, arrays = found.version > SKY_VERSION, {"origin", "bake_id"}, {"sky", "valid"}
    if has_transfer:
        meta, arrays = meta | {"schedules"}, arrays | {"sky_transfer", "sun_transfer", "glow"}
    try:
        found.refuse_unknown(frozenset(meta), frozenset(arrays))
        sky, valid = found.take("sky", "f4", 3), found.take("valid", "u1", 2)
        origin, bake_id = SectorIndex(*(int(v) for v in found.meta["origin"])), str(found.meta["bake_id"])
        # A NaN is in no range.
        if sky.shape != (*valid.shape, 6) or not ((sky >= 0) & (sky <= 1.001)).all() or valid.max(initial=0) > 1:
            raise CorruptFileError(f"expected six sky factors of 0..1 per texel, found {sky.shape}")
        transfer = _transfer(found, int(valid.sum(dtype=np.int64))) if has_transfer else None
    except CorruptFileError as error:
        raise CorruptFileError(f"{where}: {error}; bake it again") from error
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise CorruptFileError(f"{where}: no origin, bake id or schedules ({error}); bake it again") from error
    return DistantTexels(origin, sky, valid, transfer), bake_id


def read(path: Path) -> tuple[DistantTexels, str]:
    """A distant file from disk, as ``decode``."""
    return decode(container.read_bytes(path), str(path))


def _transfer(found: container.Container, texels: int) -> DistantTransfer:
    sky, sun, glow = found.take("sky_transfer", "f2", 5), found.take("sun_transfer", "f2", 6), found.take("glow", "f4", 5)
    given = found.meta["schedules"]
    if not isinstance(given, list) or not all(isinstance(text, str) and is_schedule(text) for text in given):
        raise CorruptFileError("expected schedules to be a list of what a lamp's may be")
    patches, planes = sky.shape[1], sun.shape[1]
    if not 1 <= patches <= MAX_SKY_PATCHES or planes < 1 or len(given) > MAX_SCHEDULES or len(set(given)) < len(given):
        raise CorruptFileError(
            f"expected 1..{MAX_SKY_PATCHES} sky patches, a sun and at most {MAX_SCHEDULES} different schedules, "
            f"found {patches}, {planes} and {len(given)}"
        )
    expected = {
        "sky_transfer": (sky, (COVERS, patches, CHANNELS, texels, 6)),
        "sun_transfer": (sun, (COVERS, planes, SUN_PARTS, CHANNELS, texels, 6)),
        "glow": (glow, (COVERS, len(given), CHANNELS, texels, 6)),
    }
    for name, (values, shape) in expected.items():
        if values.shape != shape or not np.isfinite(values).all():
            raise CorruptFileError(f"expected {name} to be finite and of shape {shape}, found {values.shape}")
    if np.abs(glow).max(initial=0) > MAX_GLOW_LX:
        raise CorruptFileError(f"expected glow of at most {MAX_GLOW_LX:g} lx, found {np.abs(glow).max():g}")
    # Of the sky all is read at each relight: halves would have to be turned into floats each time, which takes longer than the sums.
    return DistantTransfer(sky.astype(np.float32), sun, glow, tuple(given))
