"""Is a bake nonsense? Asked before world.json is written: better no dataset than one that lights a city wrongly without a word.

Bakes fail silently: a mesh that rays miss gives probes which see nothing but sky, a mesh that swallows its probes gives none that see any.
"""

from collections.abc import Callable, Mapping

import numpy as np

from gi_core import relight_twin
from gi_core.constants import ROOM_OUTDOORS
from gi_core.dataset import SectorFacts
from gi_core.errors import SectorlightError
from gi_core.grid import SectorIndex
from gi_core.layout import DIRECTIONAL_LIGHT
from gi_core.relight_input import RelightInput
from gi_core.sector import PROBE_IN_MARGIN, Sector

# The sectors with most probes are looked into.
SECTORS = 4
PASSES = 2
# Of sectors with probes and triangles: a few may have all of theirs out of sight.
MOST_BLIND = 0.5
# A few probes may stand in closed places that nobody said were rooms.
MOST_DARK = 0.5


class NonsenseError(SectorlightError, RuntimeError):
    """What was baked cannot be right."""

    code = "nonsense"


def expect_normals(sector: Sector) -> None:
    """Raise NonsenseError unless all surfels of a sector have a normal. Before it is encoded: a file holds unit normals whatever it was
    given."""
    lengths = np.linalg.norm(sector.surfel_normal, axis=1)
    if sector.surfel_count and not np.abs(lengths - 1).max() < 0.01:
        raise NonsenseError(f"this bake is nonsense: sector {sector.index.x},{sector.index.z} has surfels without a normal")


def expect_sense(facts: Mapping[SectorIndex, SectorFacts], read: Callable[[SectorIndex], Sector], sky_patches: int) -> None:
    """Raise NonsenseError, saying where and what, unless a bake's sectors see surfaces and are lit by an even sky.

    read : a baked sector, as servers read it
    """
    with_probes = [index for index, sector in facts.items() if sector.probes]
    blind = [index for index in with_probes if facts[index].triangles and not facts[index].surfels]
    if len(blind) > MOST_BLIND * len(with_probes):
        probes, where = sum(facts[index].probes for index in blind), f"{len(blind):,} of {len(with_probes):,} sectors"
        raise NonsenseError(f"this bake is nonsense: in {where} {probes:,} probes see nothing but sky, and there are triangles")
    lights = np.zeros(0, DIRECTIONAL_LIGHT.dtype)
    for index in sorted(with_probes, key=lambda i: (-facts[i].probes, i))[:SECTORS]:
        sector = read(index)
        even = RelightInput(np.ones((sky_patches, 3), np.float32), lights)
        cubes = relight_twin.relight(sector, even, np.zeros((sector.probe_count, sector.basis_size, 3), np.float32), PASSES)
        outdoors = (sector.probe_room == ROOM_OUTDOORS) & (sector.probe_flags & PROBE_IN_MARGIN == 0)
        dark = outdoors & ~(np.abs(cubes).max(axis=(1, 2)) > 0)
        if outdoors.any() and dark.sum() > MOST_DARK * outdoors.sum():
            raise NonsenseError(
                f"this bake is nonsense: under an even sky {dark.sum()} of {outdoors.sum()} outdoor probes of sector {index.x},{index.z} "
                "get no light at all; are the mesh's faces inside out, or all of it under a lid?"
            )
