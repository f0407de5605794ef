"""Does light step where sectors meet? Neighbouring voxels of served volumes across borders of sectors, beside those inside sectors.

python -m bake_jobs.seam_study DATASET     a table on stdout
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, fields
from itertools import combinations

import numpy as np
from scipy.ndimage import binary_dilation

from bake_jobs.compare_states import parse_states
from gi_core.arrays import Bool, Float64, Int64
from gi_core.basis import convert
from gi_core.constants import SECTOR_SIZE_M, VOLUME_SHAPE, VOXEL_OUTDOORS, VOXEL_SIZE_M, VOXEL_SOLID
from gi_core.dataset import Dataset
from gi_core.engine import Engine
from gi_core.errors import InputError, SectorlightError
from gi_core.grid import SectorIndex, voxel_centre
from gi_core.lighting import Lighting
from gi_core.sector import Sector
from gi_core.spectrum import LUMINANCE_FROM_RGB
from gi_core.volume import Volume

STATES = ("noon", "low_sun", "overcast")
SHARES = (0.5, 0.95)
# Up to here above the lowest point of a world neighbours share probes (BakeSettings.band_m).
BAND_M = 28.0
# Neighbours store a shared probe's place from different corners, each rounded to 1/512 m.
PLACES_PER_M = 100


@dataclass(frozen=True, eq=False)
class Steps:
    """Pairs of voxels of the open air that are neighbours along x or z.

    size : (n,) float64, ``relative_step`` of the two cubes' luminance
    across : (n,) bool, the two are of different sectors; near : (n,) bool, a solid voxel is next to one of them
    layer : (n,) int64, lattice index along y; along_z : (n,) bool
    """

    size: Float64
    across: Bool
    near: Bool
    layer: Int64
    along_z: Bool

    def where(self, chosen: Bool) -> "Steps":
        """Some of the pairs: (n,) bool."""
        return Steps(*(getattr(self, field.name)[chosen] for field in fields(self)))


def main(arguments: Sequence[str]) -> None:
    """The command line that the module's docstring shows."""
    match arguments:
        case [path]:
            print_table(Engine(Dataset.open(path)))
        case _:
            raise SystemExit(__doc__)


def print_table(engine: Engine) -> None:
    """A row per part of the air: for each state the median / 95th percentile of steps [%], across borders : inside sectors."""
    world = engine.dataset.world
    states = parse_states(STATES, world.location)
    steps = [served_steps(engine, engine.lighting(state.time, state.weather)) for state in states]
    print(f"| air | pairs across | {' | '.join(state.name for state in states)} |")
    print("|---" * (2 + len(states)) + "|")
    low = (steps[0].layer + 0.5) * VOXEL_SIZE_M < world.bounds[0, 1] + BAND_M
    near = steps[0].near
    for name, part in (("beside solids", near), ("free, low", low & ~near), ("free, high", ~low & ~near)):
        pairs = [percentiles(some.where(part)) for some in steps]
        cells = [" : ".join(f"{100 * median:.1f} / {100 * high:.0f}" for median, high in pair) for pair in pairs]
        print(f"| {name} | {(part & steps[0].across).sum()} | {' | '.join(cells)} |")
    both = [shared_probes(engine, engine.lighting(state.time, state.weather)) for state in states]
    cells = ["{:.1f} / {:.0f}".format(*(100 * np.quantile(some, SHARES))) for some in both]
    print(f"| one probe, stored by both | {len(both[0])} | {' | '.join(cells)} |")


def served_steps(engine: Engine, lighting: Lighting) -> Steps:
    """All pairs of a dataset's lowest 16 layers, each once: of a volume around every sector those that begin in it.

    Raises InputError for a dataset without two sectors side by side, and what ``Engine.volume`` raises.
    """
    world = engine.dataset.world
    middle = np.array([SECTOR_SIZE_M / 2, world.bounds[0, 1] + (VOLUME_SHAPE[0] // 2 - 1) * VOXEL_SIZE_M, SECTOR_SIZE_M / 2])
    lit = [index for index in sorted(world.sectors) if world.sectors[index].probes]
    found = [volume_steps(engine.volume(index.origin + middle, lighting, basis="cube"), index) for index in lit]
    if not any(steps.across.any() for steps in found):
        raise InputError(f"{engine.dataset.path}: expected sectors side by side with open air between them, found none")
    return Steps(*(np.concatenate([getattr(steps, field.name) for steps in found]) for field in fields(Steps)))


def volume_steps(volume: Volume, index: SectorIndex) -> Steps:
    """The pairs of a volume whose first voxel, the western or northern one, lies in a sector."""
    faces = np.moveaxis(volume.values @ LUMINANCE_FROM_RGB.astype(np.float64), 0, -1)
    air, near = volume.mask == VOXEL_OUTDOORS, binary_dilation(volume.mask == VOXEL_SOLID)
    y, z, x = (np.arange(count) for count in VOLUME_SHAPE)
    layer, sector_z, sector_x = np.meshgrid(
        volume.first_voxel[1] + y,
        np.floor(voxel_centre(volume.first_voxel[2] + z) / SECTOR_SIZE_M),
        np.floor(voxel_centre(volume.first_voxel[0] + x) / SECTOR_SIZE_M),
        indexing="ij",
    )
    parts = []
    for axis, sector in ((2, sector_x), (1, sector_z)):
        first, second = ((slice(None),) * axis + (part,) for part in (slice(None, -1), slice(1, None)))
        pair = air[first] & air[second] & (sector_x[first] == index.x) & (sector_z[first] == index.z)
        a, b = faces[first][pair], faces[second][pair]
        size = relative_step(a, b)
        across = (sector[first] != sector[second])[pair]
        parts.append(Steps(size, across, (near[first] | near[second])[pair], layer[first][pair], np.full(len(size), axis == 1)))
    return Steps(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(Steps)))


def shared_probes(engine: Engine, lighting: Lighting) -> Float64:
    """(n,): by how much the light of a probe that two sectors store differs between them, as ``Steps.size`` has it."""
    dataset = engine.dataset
    seen: dict[tuple[int, ...], list[Float64]] = {}
    for index in sorted(dataset.world.sectors):
        faces = convert(engine.lit_sector(index, lighting), dataset.world.basis, "cube") @ LUMINANCE_FROM_RGB
        for key, light in zip(probe_places(index, dataset.sector(index)), faces, strict=True):
            seen.setdefault(key, []).append(light)
    pairs = np.array([pair for lights in seen.values() for pair in combinations(lights, 2)]).reshape(-1, 2, 6)
    return relative_step(pairs[:, 0], pairs[:, 1])


def probe_places(index: SectorIndex, sector: Sector) -> list[tuple[int, ...]]:
    """Where a sector's probes stand: the same for one probe in all sectors that store it."""
    place = np.round((sector.probe_position + index.origin) * PLACES_PER_M).astype(np.int64)
    return list(map(tuple, place.tolist()))


def relative_step(a: Float64, b: Float64) -> Float64:
    """(n,): |a - b| of cubes (n, 6) summed over the faces, as a share of the mean of the two sums: 0 to 2."""
    return np.asarray(np.abs(a - b).sum(axis=1) / np.maximum((a + b).sum(axis=1) / 2, np.finfo(np.float64).tiny))


def percentiles(steps: Steps) -> tuple[Float64, Float64]:
    """SHARES of steps across borders, and of those inside sectors, which count by axis, layer and ``near`` as often as those across do."""
    stratum = 4 * steps.layer + 2 * steps.along_z + steps.near
    _, number = np.unique(stratum, return_inverse=True)
    across, inside = (np.bincount(number[chosen], minlength=number.max() + 1) for chosen in (steps.across, ~steps.across))
    # What lies at borders alone has nothing to be compared with.
    both = (inside > 0)[number]
    weight = (across / np.maximum(inside, 1))[number]
    return weighted(steps.size, (steps.across & both).astype(np.float64)), weighted(steps.size, ~steps.across * weight)


def weighted(values: Float64, weight: Float64) -> Float64:
    """SHARES of values (n,) of which each stands for so many."""
    order = np.argsort(values)
    total = np.cumsum(weight[order])
    return np.asarray(values[order][np.searchsorted(total, np.array(SHARES) * total[-1])])


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except SectorlightError as error:
        raise SystemExit(str(error)) from error
