"""How many probes a sector needs for its target error: the ranking's first so many, more and more of them, until the estimate is below."""

import numpy as np

from bake_jobs.adaptive import NEAR_SURFACE_M, Ranking, Trial
from bake_jobs.air import Air
from bake_jobs.config import BakeSettings
from bake_jobs.rays import RayScene
from bake_jobs.trial_fit import TrialFit
from bake_jobs.trial_light import TrialLight
from bake_jobs.trial_states import TrialStates
from bake_jobs.voxels import blend
from gi_core.constants import MAX_PROBES_PER_SECTOR, ROOM_OUTDOORS, VOXEL_INDOORS, VOXEL_OUTDOORS

FEWEST = 16
GROWTH = 1.15


def probes_for_target(
    ray_scene: RayScene, ranking: Ranking, states: TrialStates, air: Air, light: TrialLight, settings: BakeSettings
) -> int:
    """The first of a growing row of counts whose estimate is at most ``settings.target_error``; the last where none is.

    Bisected, as if the estimate never rose with more probes; where it does, a count that meets the target is still found.
    """
    counts = _counts(max(ranking.fixed, FEWEST), min(len(ranking.position), settings.probe_budget, MAX_PROBES_PER_SECTOR))
    judged = np.flatnonzero(air.own & air.in_band & (light.clearance <= NEAR_SURFACE_M))
    if len(judged) == 0:
        return counts[0]
    kind = np.where(air.room[judged] == ROOM_OUTDOORS, VOXEL_OUTDOORS, VOXEL_INDOORS).astype(np.uint8)

    def estimate(count: int) -> float:
        placed, cube = ranking.first(count)
        fit = TrialFit(Trial(states, air, light, cube), air.lattice[judged], settings)
        blend(ray_scene, air.centre[judged], kind, air.room[judged], placed, settings, fit)
        return fit.estimated_error or 0.0

    low, high = 0, len(counts) - 1
    while low < high:
        middle = (low + high) // 2
        if estimate(counts[middle]) <= settings.target_error:
            high = middle
        else:
            low = middle + 1
    return counts[high]


def _counts(fewest: int, most: int) -> list[int]:
    """Whole numbers from the fewest to the most, each about GROWTH times the one before; at least one."""
    counts = [min(fewest, most)]
    while counts[-1] < most:
        counts.append(min(max(int(counts[-1] * GROWTH), counts[-1] + 1), most))
    return counts
