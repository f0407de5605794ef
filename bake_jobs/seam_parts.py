"""By what do two sectors' lights of one probe differ, and how much would it help if they did not? A bound, before anything is built.

python -m bake_jobs.seam_parts DATASET     tables on stdout

Sectors that store one probe cast the same rays from it, but each has surfels and feedback probes of its own. So its light is taken apart:
first light, what bricks send out of sun, moon and their own emission, and bounces, what they send on of probes, each of near bricks and of
far ones. The sky's part is the same in all sectors; lamps are left out. Then the tables of seam_study and seam_walls, of light as it is
served, and as it were if all sectors had the mean of a part: no way to make that part alike can be expected to give more.
"""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np

from bake_jobs import seam_study, seam_walls
from bake_jobs.compare_states import parse_states
from gi_core.arrays import Float32, Float64
from gi_core.basis import convert
from gi_core.dataset import Dataset
from gi_core.engine import Engine
from gi_core.errors import SectorlightError
from gi_core.grid import SectorIndex
from gi_core.lighting import Lighting
from gi_core.relight_input import relight_input
from gi_core.relight_twin import bounce_bricks, brick_exitance, brick_means, light_bricks
from gi_core.sector import Sector, counts
from gi_core.spectrum import LUMINANCE_FROM_RGB

# Bricks whose surfels are closer to the probe in the mean are near ones.
FAR_M = 16.0
PARTS = ("first light, near", "first light, far", "bounces, near", "bounces, far")
ALIKE: dict[str, tuple[int, ...]] = {
    "as it is": (),
    "the mean of first light, far": (1,),
    "the mean of first light": (0, 1),
    "the mean of bounces": (2, 3),
    "the mean of all": (0, 1, 2, 3),
}

# A probe as its sectors store it: which sector, and which of its probes.
Copies = list[tuple[SectorIndex, int]]


class AlikeEngine(Engine):
    """Serves light to which something is added: (P, B, 3) [lx] by digest of lighting and sector."""

    def __init__(self, dataset: Dataset) -> None:
        super().__init__(dataset)
        self.added: Mapping[tuple[str, SectorIndex], Float32] = {}

    def _lit_sector(self, index: SectorIndex, light: Any) -> Any:
        # What all queries read. Bounces are those of the light as it is.
        lit, added = super()._lit_sector(index, light), self.added.get((light.lighting.digest, index))
        return lit if added is None else replace(lit, cubes=lit.cubes + added)


def main(arguments: Sequence[str]) -> None:
    """The command line that the module's docstring shows."""
    match arguments:
        case [path]:
            print_tables(AlikeEngine(Dataset.open(path)))
        case _:
            raise SystemExit(__doc__)


def print_tables(engine: AlikeEngine) -> None:
    """Shares and differences of PARTS, then steps and walls for each of ALIKE."""
    dataset, states = engine.dataset, parse_states(seam_study.STATES, engine.dataset.world.location)
    probes = shared_probes({index: dataset.sector(index) for index in sorted(dataset.world.sectors)})
    lightings = [engine.lighting(state.time, state.weather) for state in states]
    parts = [{index: parts_of(engine, index, lighting) for index in dataset.world.sectors} for lighting in lightings]
    print(f"| part of a shared probe's light, its share, difference | {' | '.join(state.name for state in states)} |")
    print("|---" * (1 + len(states)) + "|")
    rows = [differences(engine, lighting, found, probes) for lighting, found in zip(lightings, parts, strict=True)]
    for number, name in enumerate((*PARTS, "all")):
        cells = [f"{100 * share[number]:.0f}, " + "{:.1f} / {:.0f}".format(*(100 * size[number])) for share, size in rows]
        print(f"| {name} | {' | '.join(cells)} |")
    for name, which in ALIKE.items():
        added = [to_mean(found, probes, which) for found in parts]
        engine.added = {(light.digest, i): array for light, found in zip(lightings, added, strict=True) for i, array in found.items()}
        print(f"\n{name}")
        seam_study.print_table(engine)
        seam_walls.print_table(engine)


def shared_probes(sectors: Mapping[SectorIndex, Sector]) -> list[Copies]:
    """Probes that several of some sectors store."""
    found: dict[tuple[int, ...], Copies] = {}
    for index, sector in sectors.items():
        for number, key in enumerate(seam_study.probe_places(index, sector)):
            found.setdefault(key, []).append((index, number))
    return [copies for copies in found.values() if len(copies) > 1]


def parts_of(engine: Engine, index: SectorIndex, lighting: Lighting) -> Float32:
    """(4, P, B, 3) [lx]: PARTS of the light of a sector's probes."""
    world, sector = engine.dataset.world, engine.dataset.sector(index)
    given = relight_input(lighting, world.sun_table, world.sky, world.sky_patches)
    first = light_bricks(sector, given)
    bounced = brick_exitance(first, bounce_bricks(sector, given, engine.lit_sector(index, lighting))) - first
    factor = np.flatnonzero(sector.factor_source < sector.brick_count)
    brick, weight = sector.factor_source[factor], sector.factor_weight[factor]
    probe = np.repeat(np.arange(sector.probe_count), counts(sector.factor_starts))[factor]
    way = brick_means(sector, sector.surfel_position)[brick] - sector.probe_position[probe]
    is_far = np.linalg.norm(way, axis=1) >= FAR_M
    parts = np.zeros((2, 2, sector.probe_count, sector.basis_size, 3), np.float32)
    for sum_of, sent in zip(parts, (first, bounced), strict=True):
        for part, chosen in zip(sum_of, (~is_far, is_far), strict=True):
            np.add.at(part, probe[chosen], weight[chosen, :, None] * sent[brick[chosen], None, :])
    return parts.reshape(len(PARTS), *parts.shape[2:])


def differences(
    engine: Engine, lighting: Lighting, parts: Mapping[SectorIndex, Float32], probes: list[Copies]
) -> tuple[Float64, list[Float64]]:
    """Of PARTS and of all: their shares of shared probes' light (5,), and five times seam_study.SHARES of by how much two sectors' differ.

    Both of the mean of the two sectors' whole light.
    """
    basis = engine.dataset.world.basis
    rows: list[Float64] = []
    for copies in probes:
        lights = []
        for index, number in copies:
            whole = engine.lit_sector(index, lighting)[number]
            lights.append(convert(np.concatenate([parts[index][:, number], whole[None]]), basis, "cube") @ LUMINANCE_FROM_RGB)
        for a, b in combinations(lights, 2):
            rows.append(np.stack([(a + b).sum(axis=1) / 2, np.abs(a - b).sum(axis=1)]) / ((a + b)[-1].sum() / 2))
    share, size = np.array(rows).transpose(1, 2, 0)
    return share.mean(axis=1), [np.quantile(some, seam_study.SHARES) for some in size]


def to_mean(parts: Mapping[SectorIndex, Float32], probes: list[Copies], which: Sequence[int]) -> dict[SectorIndex, Float32]:
    """What to add to sectors' probes (P, B, 3), that shared ones have the mean of some of their parts in all sectors; 0 for the others."""
    added = {index: np.zeros(found.shape[1:], np.float32) for index, found in parts.items()}
    for copies in probes:
        light = np.array([parts[index][list(which), number].sum(axis=0) for index, number in copies])
        for (index, number), missing in zip(copies, light.mean(axis=0) - light, strict=True):
            added[index][number] = missing
    return added


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except SectorlightError as error:
        raise SystemExit(str(error)) from error
