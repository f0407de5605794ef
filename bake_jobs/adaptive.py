"""Adaptive placement: probes where light changes, found by trying it out (bake_jobs/trial_light.py, bake_jobs/choose.py).

Along a sector's border lines lie blocks that two or four sectors share. Their probes are chosen first, block by block, from nothing but the
block's own voxels: every sector that has the block chooses the same. The rest of the sector then chooses around them.

    +--+-----------------+--+      c: corner blocks, of four sectors
    |c |        e        |c |      e: edge blocks, of two
    +--+-----------------+--+      m: the sector's own
    |e |        m        |e |      The outer half of c and e is the margin.
    +--+-----------------+--+
"""

from dataclasses import dataclass

import numpy as np

from bake_jobs.air import Air, beside_border, border_blocks
from bake_jobs.choose import GAIN_STEP, Chooser, Pairs, neighbour_pairs
from bake_jobs.config import BakeSettings
from bake_jobs.distinct import distinct
from bake_jobs.inside import Solids
from bake_jobs.placement import OFF_EDGES_M, Placement, asked_positions, in_boxes, positions_between_voxels, stored_order
from bake_jobs.rays import RayScene
from bake_jobs.scene import ProbeHint
from bake_jobs.trial_light import TrialLight, TrialScene
from bake_jobs.trial_states import TrialStates
from gi_core.arrays import Bool, Float32, Float64, Int64, UInt8, UInt16
from gi_core.constants import MAX_PROBES_PER_SECTOR, ROOM_OUTDOORS, SECTOR_SIZE_M
from gi_core.grid import SectorIndex
from gi_core.rooms import rooms_of
from gi_core.sector import PROBE_IN_MARGIN, PROBE_ON_GROUND, PROBE_ON_WALL
from gi_core.world import Room

# A probe this close to a surface would see little else.
CLEARANCE_M = 0.1
NEAR_SURFACE_M = 3.2
# People walk up to here; from here to the top of the band importance falls to HIGH_IMPORTANCE.
WALKING_M = 6.0
HIGH_IMPORTANCE = 0.6
OPEN_AIR_IMPORTANCE = 0.2  # of voxels that no surface is near to
DENSIFY = 8.0  # importance within a "densify" hint
# Light below this, relative to an open sky's, counts as this: dark corners of closed places must not draw probes.
DARK = 0.002
DARK_LAMPLIGHT_LX = 0.5
# Differences of light smaller than this are none: what rounding leaves must not decide between two places.
LIGHT_STEP = 1e-3
CHOSEN_DIMENSIONS = 8
# A border probe is stored by every sector that shares it. Its price grows as the root of their number: in proportion, seams began to show.
SHARED_PRICE = 0.5
# In the mean of two cities the bake's estimate is about this where a probe is worth that; it falls as the root.
WORTH_FOR_ERROR, WORTH_GIVES_ERROR = 0.01, 0.03


@dataclass(frozen=True, eq=False)
class Trial:
    """Trial light of a sector's air and of its probes.

    states : what it was lit by; air : the voxels; light : at them; probe_cube : (P, S, 6) float32, at the probes
    """

    states: TrialStates
    air: Air
    light: TrialLight
    probe_cube: Float32


@dataclass(frozen=True, eq=False)
class Ranking:
    """Where probes could stand, those that matter most first. R places.

    position : (R, 3) float64 [m], world frame; flags : (R,) uint8; room : (R,) uint16; cube : (R, S, 6) float32, trial light
    fixed : the first so many are asked for by hints or shared with neighbours, and stand whatever the budget says
    enough : the first so many are each worth it
    dead : places that hints asked for, inside solids
    """

    position: Float64
    flags: UInt8
    room: UInt16
    cube: Float32
    fixed: int
    enough: int
    dead: int = 0

    def first(self, count: int) -> tuple[Placement, Float32]:
        """The first ``count`` probes, and their trial light."""
        wanted = min(max(count, self.fixed), len(self.position))
        kept = np.arange(min(wanted, MAX_PROBES_PER_SECTOR))
        order = kept[stored_order(self.position[kept])]
        placed = Placement(self.position[order], self.flags[order], self.room[order], self.dead, wanted - len(kept))
        return placed, self.cube[order]


def rank_probes(
    ray_scene: RayScene,
    solids: Solids,
    index: SectorIndex,
    settings: BakeSettings,
    rooms: tuple[Room, ...],
    hints: tuple[ProbeHint, ...],
    air: Air,
    light: TrialLight,
    trial: TrialScene,
) -> Ranking:
    """Probes for a sector, in the order in which they are worth having. With a target error more are ranked than are worth it."""
    asked, dead = _asked(ray_scene, index, settings, hints, rooms, solids)
    chosen, shared, enough = _choose(ray_scene, index, settings, hints, air, light, trial.states)
    position = np.concatenate([asked, air.centre[chosen] + np.array(OFF_EDGES_M)])
    height = np.concatenate([np.full(len(asked), np.inf), air.height[chosen]])
    clearance = np.concatenate([np.full(len(asked), np.inf), light.clearance[chosen]])
    flags = np.where(height < NEAR_SURFACE_M, PROBE_ON_GROUND, np.where(clearance < NEAR_SURFACE_M, PROBE_ON_WALL, 0)).astype(np.uint8)
    local = position[:, [0, 2]] - index.origin[[0, 2]]
    flags[((local < 0) | (local >= SECTOR_SIZE_M)).any(axis=1)] |= PROBE_IN_MARGIN
    cube = np.concatenate([trial.light(asked).cube, light.cube[chosen]])
    return Ranking(position, flags, rooms_of(position, rooms), cube, len(asked) + shared, len(asked) + enough, dead)


def _asked(
    ray_scene: RayScene,
    index: SectorIndex,
    settings: BakeSettings,
    hints: tuple[ProbeHint, ...],
    rooms: tuple[Room, ...],
    solids: Solids,
) -> tuple[Float64, int]:
    """Positions (n, 3) [m] that hints ask for, and rooms between voxels, in air; how many more lie in solids."""
    low, high = index.origin[[0, 2]] - settings.margin_m, index.origin[[0, 2]] + SECTOR_SIZE_M + settings.margin_m
    hinted = asked_positions(ray_scene, hints, low, high, settings.wall_offset_m)
    position = np.concatenate([hinted, positions_between_voxels(rooms, low, high)]) + np.array(OFF_EDGES_M)
    dead = solids.contain(position) & (rooms_of(position, rooms) == ROOM_OUTDOORS)
    return position[~dead], int(dead.sum())


def _choose(
    ray_scene: RayScene,
    index: SectorIndex,
    settings: BakeSettings,
    hints: tuple[ProbeHint, ...],
    air: Air,
    light: TrialLight,
    states: TrialStates,
) -> tuple[Int64, int, int]:
    """Voxels that become probes, the border's first, then in the order in which they were chosen; how many are the border's; how many,
    the border's among them, are worth it."""
    floor = np.where(states.lamps[states.fitted], DARK_LAMPLIGHT_LX, DARK).astype(np.float32)
    features = _features(light.cube[:, states.fitted], floor)
    voxel, probe = neighbour_pairs(air.lattice, beside_border(air, settings.margin_m))
    seen = _mutually_visible(ray_scene, air, voxel, probe)
    pairs = Pairs.of(voxel[seen], probe[seen], len(air.lattice))
    importance = _importance(air, light, hints, settings.band_m)
    # No light comes into closed solids that were not told for such: whatever stands there would explain nothing.
    importance[(light.cube[:, states.fitted].max(axis=2) < floor).all(axis=1)] = 0
    may = (light.clearance >= CLEARANCE_M) & ~in_boxes(air.centre, hints, "forbid")
    worth = settings.probe_worth
    if settings.target_error:
        worth = WORTH_FOR_ERROR * (settings.target_error / WORTH_GIVES_ERROR) ** 2
    border: list[int] = []
    shared = np.zeros(len(air.lattice), bool)
    for block, sharers in border_blocks(air, index, settings.margin_m):
        shared[block] = True
        border += _choose_within(features, importance, pairs, may, block, worth * sharers**SHARED_PRICE)
    own = Chooser(_fewer_dimensions(features), importance * air.own, pairs, may & air.own & ~shared)
    own.take(*border)
    most = max(0, settings.probe_budget - len(border))
    own.take_best(worth, most)
    enough = len(own.chosen)
    if settings.target_error:
        own.take_best(GAIN_STEP, most - (enough - len(border)))
    return np.array(own.chosen, np.int64), len(border), enough


def _choose_within(features: Float32, importance: Float64, pairs: Pairs, may: Bool, block: Int64, worth: float) -> list[int]:
    """A block's probes, from its own voxels alone."""
    chooser = Chooser(features[block], importance[block], pairs.within(block), may[block])
    chooser.take_best(worth, MAX_PROBES_PER_SECTOR)
    return [int(block[n]) for n in chooser.chosen]


def _features(cube: Float32, floor: Float32) -> Float32:
    """(n, states * 6): logarithms of light over a floor (states,); squared distances are mean squared relative differences."""
    logarithm = np.log(np.maximum(cube, 0) + floor[:, None])
    rounded = np.round(logarithm / LIGHT_STEP) * LIGHT_STEP
    return np.asarray(rounded.reshape(len(cube), -1) / np.sqrt(cube.shape[1] * 6), np.float32)


def _fewer_dimensions(features: Float32) -> Float32:
    """The same points (n, d) in the few dimensions in which they differ most: a fourth of the work, the same distances."""
    if features.shape[1] <= CHOSEN_DIMENSIONS or len(features) < 2:
        return features
    centred = features - features.mean(axis=0)
    _, vectors = np.linalg.eigh((centred.T @ centred).astype(np.float64))
    return np.asarray(centred @ vectors[:, -CHOSEN_DIMENSIONS:].astype(np.float32))


def _importance(air: Air, light: TrialLight, hints: tuple[ProbeHint, ...], band_m: float) -> Float64:
    """(n,): how much a voxel's error counts."""
    high = np.clip((air.height - WALKING_M) / max(band_m - WALKING_M, 1.0), 0, 1)
    importance = 1 - (1 - HIGH_IMPORTANCE) * high
    importance[light.clearance > NEAR_SURFACE_M] *= OPEN_AIR_IMPORTANCE
    importance[air.room != ROOM_OUTDOORS] = 1.0
    importance[in_boxes(air.centre, hints, "densify")] *= DENSIFY
    return importance


def _mutually_visible(ray_scene: RayScene, air: Air, voxel: Int64, probe: Int64) -> Bool:
    """(m,): which pairs have nothing between them and lie in one room. A voxel sees itself."""
    seen = air.room[voxel] == air.room[probe]
    # Both ways are one ray.
    low, high = np.minimum(voxel, probe), np.maximum(voxel, probe)
    both, of_pair = distinct(low * len(air.lattice) + high)
    a, b = np.divmod(both, len(air.lattice))
    offset = air.centre[b] - air.centre[a]
    distance = np.linalg.norm(offset, axis=1)
    open_ = ~ray_scene.occluded(air.centre[a], offset / np.maximum(distance, 1e-6)[:, None], distance)
    return seen & (open_ | (a == b))[of_pair]
