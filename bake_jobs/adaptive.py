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

from bake_jobs.air import Air, border_blocks
from bake_jobs.choose import Chooser, Pairs, neighbour_pairs
from bake_jobs.config import BakeSettings
from bake_jobs.placement import OFF_EDGES_M, Placement, asked_positions, in_boxes, room_of
from bake_jobs.rays import RayScene
from bake_jobs.scene import ProbeHint
from bake_jobs.trial_light import TrialLight, TrialScene
from bake_jobs.trial_states import TrialStates
from bake_jobs.inside import Solids
from gi_core.arrays import Bool, Float32, Float64, Int64
from gi_core.constants import MAX_PROBES_PER_SECTOR, ROOM_OUTDOORS, SECTOR_SIZE_M
from gi_core.grid import SectorIndex
from gi_core.sector import PROBE_IN_MARGIN, PROBE_ON_GROUND, PROBE_ON_WALL
from gi_core.world import Room

# A probe this close to a surface would see little else.
CLEARANCE_M = 0.4
NEAR_SURFACE_M = 3.2
# People walk up to here; from here to the top of the band importance falls to HIGH_IMPORTANCE.
WALKING_M = 6.0
HIGH_IMPORTANCE = 0.35
OPEN_AIR_IMPORTANCE = 0.5  # of voxels that no surface is near to
DENSIFY = 8.0  # importance within a "densify" hint
# Light below this, relative to an open sky's, counts as this: dark corners of closed places must not draw probes.
DARK = 0.002
DARK_LAMPLIGHT_LX = 0.5
# Differences of light smaller than this are none: what rounding leaves must not decide between two places.
LIGHT_STEP = 1e-3
CHOSEN_DIMENSIONS = 12


@dataclass(frozen=True, eq=False)
class Trial:
    """Trial light of a sector's air and of its probes.

    states : what it was lit by; air : the voxels; light : at them; probe_cube : (P, S, 6) float32, at the probes
    """

    states: TrialStates
    air: Air
    light: TrialLight
    probe_cube: Float32


def place_adaptive(
    ray_scene: RayScene,
    solids: Solids,
    index: SectorIndex,
    settings: BakeSettings,
    rooms: tuple[Room, ...],
    hints: tuple[ProbeHint, ...],
    air: Air,
    light: TrialLight,
    trial: TrialScene,
) -> tuple[Placement, Float32]:
    """Probes for a sector, and their trial light (P, S, 6)."""
    states = trial.states
    asked = _asked(index, settings, hints, rooms, solids)
    asked_cube = trial.light(asked).cube
    chosen = _choose(ray_scene, index, settings, hints, air, light, states.fitted, states.lamps)
    room_left = max(0, min(settings.probe_budget, MAX_PROBES_PER_SECTOR) - len(asked))
    position = np.concatenate([asked, air.centre[chosen] + np.array(OFF_EDGES_M)])
    height = np.concatenate([np.full(len(asked), np.inf), air.height[chosen]])
    clearance = np.concatenate([np.full(len(asked), np.inf), light.clearance[chosen]])
    cube = np.concatenate([asked_cube, light.cube[chosen]])
    flags = np.where(height < NEAR_SURFACE_M, PROBE_ON_GROUND, np.where(clearance < NEAR_SURFACE_M, PROBE_ON_WALL, 0)).astype(np.uint8)
    local = position[:, [0, 2]] - index.origin[[0, 2]]
    flags[((local < 0) | (local >= SECTOR_SIZE_M)).any(axis=1)] |= PROBE_IN_MARGIN
    kept = np.arange(min(len(position), len(asked) + room_left, MAX_PROBES_PER_SECTOR))
    dropped = len(position) - len(kept)
    # Stored along a curve of place, as the grid's are.
    order = kept[np.lexsort((position[kept, 1], position[kept, 0] // 8, position[kept, 2] // 8))]
    placed = Placement(position[order], flags[order], room_of(position[order], rooms), 0, dropped)
    return placed, cube[order]


def _asked(index: SectorIndex, settings: BakeSettings, hints: tuple[ProbeHint, ...], rooms: tuple[Room, ...], solids: Solids) -> Float64:
    """Positions (n, 3) [m] that hints ask for, in air."""
    low, high = index.origin[[0, 2]] - settings.margin_m, index.origin[[0, 2]] + SECTOR_SIZE_M + settings.margin_m
    position = asked_positions(hints, low, high) + np.array(OFF_EDGES_M)
    return position[~(solids.contain(position) & (room_of(position, rooms) == ROOM_OUTDOORS))]


def _choose(
    ray_scene: RayScene,
    index: SectorIndex,
    settings: BakeSettings,
    hints: tuple[ProbeHint, ...],
    air: Air,
    light: TrialLight,
    fitted: slice,
    lamps: tuple[bool, ...],
) -> Int64:
    """Voxels that become probes, the border's first, then in the order in which they were chosen."""
    features = _features(light.cube[:, fitted], np.array(lamps[fitted]))
    voxel, probe = neighbour_pairs(air.lattice)
    seen = _mutually_visible(ray_scene, air, voxel, probe)
    pairs = Pairs.of(voxel[seen], probe[seen], len(air.lattice))
    importance = _importance(air, light, hints)
    forbidden = in_boxes(air.centre, [h for h in hints if h.kind == "forbid"])
    may = (light.clearance >= CLEARANCE_M) & ~forbidden
    border: list[int] = []
    shared = np.zeros(len(air.lattice), bool)
    for block in border_blocks(air, index, settings.margin_m):
        shared[block] = True
        inside = np.zeros(len(air.lattice), bool)
        inside[block] = True
        border += _choose_within(features, importance, pairs.within(inside), may, block, settings.probe_worth)
    own = Chooser(_fewer_dimensions(features), importance * air.own, pairs, may & air.own & ~shared)
    for number in border:
        own.take(number)
    own.take_best(settings.probe_worth, max(0, settings.probe_budget - len(border)))
    return np.array(own.chosen, np.int64)


def _choose_within(features: Float32, importance: Float64, pairs: Pairs, may: Bool, block: Int64, worth: float) -> list[int]:
    """A block's probes, from its own voxels alone."""
    number = np.full(len(features), -1)
    number[block] = np.arange(len(block))
    own_pairs = Pairs.of(number[pairs.voxel], number[pairs.probe], len(block))
    chooser = Chooser(features[block], importance[block], own_pairs, may[block])
    chooser.take_best(worth, MAX_PROBES_PER_SECTOR)
    return [int(block[n]) for n in chooser.chosen]


def _features(cube: Float32, lamps: Bool) -> Float32:
    """(n, states * 6): logarithms of light, scaled so that the squared distance of two is the mean squared relative difference."""
    dark = np.where(lamps, DARK_LAMPLIGHT_LX, DARK).astype(np.float32)[:, None]
    logarithm = np.log(np.maximum(cube, 0) + dark)
    rounded = np.round(logarithm / LIGHT_STEP) * LIGHT_STEP
    return np.asarray(rounded.reshape(len(cube), -1) / np.sqrt(cube.shape[1] * 6), np.float32)


def _fewer_dimensions(features: Float32) -> Float32:
    """The same points (n, d) in the few dimensions in which they differ most: a fourth of the work, the same distances."""
    if features.shape[1] <= CHOSEN_DIMENSIONS or len(features) < 2:
        return features
    centred = features - features.mean(axis=0)
    _, vectors = np.linalg.eigh((centred.T @ centred).astype(np.float64))
    return np.asarray(centred @ vectors[:, -CHOSEN_DIMENSIONS:].astype(np.float32))


def _importance(air: Air, light: TrialLight, hints: tuple[ProbeHint, ...]) -> Float64:
    """(n,): how much a voxel's error counts."""
    high = np.clip((air.height - WALKING_M) / np.maximum(air.height[air.in_band].max(initial=WALKING_M) - WALKING_M, 1.0), 0, 1)
    importance = 1 - (1 - HIGH_IMPORTANCE) * high
    importance[light.clearance > NEAR_SURFACE_M] *= OPEN_AIR_IMPORTANCE
    importance[air.room != ROOM_OUTDOORS] = 1.0
    importance[in_boxes(air.centre, [h for h in hints if h.kind == "densify"])] *= DENSIFY
    return importance


def _mutually_visible(ray_scene: RayScene, air: Air, voxel: Int64, probe: Int64) -> Bool:
    """(m,): which pairs have nothing between them and lie in one room. A voxel sees itself."""
    seen = air.room[voxel] == air.room[probe]
    # Both ways are one ray.
    low, high = np.minimum(voxel, probe), np.maximum(voxel, probe)
    unique, of_pair = np.unique(low * len(air.lattice) + high, return_inverse=True)
    a, b = np.divmod(unique, len(air.lattice))
    offset = air.centre[b] - air.centre[a]
    distance = np.linalg.norm(offset, axis=1)
    open_ = ~ray_scene.occluded(air.centre[a], offset / np.maximum(distance, 1e-6)[:, None], distance)
    return seen & (open_ | (a == b))[of_pair.reshape(-1)]
