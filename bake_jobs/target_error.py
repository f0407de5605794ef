"""How many probes a sector needs for its target error: the ranking's first so many, more and more of them, until the estimate is below."""

from functools import cached_property

import numpy as np

from bake_jobs.adaptive import NEAR_SURFACE_M, Ranking, Trial
from bake_jobs.air import Air
from bake_jobs.config import BakeSettings
from bake_jobs.rays import RayScene
from bake_jobs.trial_fit import TrialFit
from bake_jobs.trial_light import TrialLight
from bake_jobs.trial_states import TrialStates
from bake_jobs.voxels import blend
from gi_core.arrays import Float32, Int64
from gi_core.constants import MAX_PROBES_PER_SECTOR, ROOM_OUTDOORS, VOXEL_INDOORS, VOXEL_OUTDOORS

FEWEST = 16
GROWTH = 1.15
# Where a target is out of reach, what lies between probes may err by this share of what they err by themselves: less of it would take less
# than an eighth off the whole.
ENOUGH = 0.5


class TargetSearch:
    """One sector's ranking, tried out."""

    def __init__(
        self, ray_scene: RayScene, ranking: Ranking, states: TrialStates, air: Air, light: TrialLight, settings: BakeSettings
    ) -> None:
        self.ranking = ranking
        self._ray_scene, self._states, self._air, self._light, self._settings = ray_scene, states, air, light, settings
        most = min(len(ranking.position), settings.probe_budget, MAX_PROBES_PER_SECTOR)
        self._counts = _counts(max(ranking.fixed, FEWEST), most)
        self._found: dict[int, float] = {}

    @cached_property
    def judged(self) -> Int64:
        """(n, 3) world lattice indices of the voxels whose errors count."""
        return self._air.lattice[self._judged]

    @cached_property
    def _judged(self) -> Int64:
        air = self._air
        return np.flatnonzero(air.own & air.in_band & (self._light.clearance <= NEAR_SURFACE_M))

    def probes(self, own_error: float = 0.0) -> int:
        """The first of a growing row of counts whose estimate is at most ``settings.target_error``, with what probes err by themselves.

        Where none is, the first that more probes would not better much; the last where there is no such either.
        """
        left = np.sqrt(max(self._settings.target_error**2 - own_error**2, 0.0))
        last = self._counts[-1]
        if own_error and self.interpolation(last) > left:
            left = max(left, ENOUGH * own_error)
        return self._first_below(left)

    def interpolation(self, count: int) -> float:
        """Median relative error of what so many probes' own light makes of judged voxels; 0 where there is none."""
        if count not in self._found:
            self._found[count] = self._interpolation(count)
        return self._found[count]

    def trial(self, cube: Float32) -> Trial:
        """What voxels are fitted to, for probes with trial light ``cube``."""
        return Trial(self._states, self._air, self._light, cube)

    def _first_below(self, error: float) -> int:
        """Bisected, as if interpolation never got worse with more probes; where it does, a count that meets the error is still found."""
        low, high = 0, len(self._counts) - 1
        while low < high:
            middle = (low + high) // 2
            if self.interpolation(self._counts[middle]) <= error:
                high = middle
            else:
                low = middle + 1
        return self._counts[high]

    def _interpolation(self, count: int) -> float:
        air, judged, settings = self._air, self._judged, self._settings
        if len(judged) == 0:
            return 0.0
        kind = np.where(air.room[judged] == ROOM_OUTDOORS, VOXEL_OUTDOORS, VOXEL_INDOORS).astype(np.uint8)
        placed, cube = self.ranking.first(count)
        fit = TrialFit(self.trial(cube), self.judged, settings)
        blend(self._ray_scene, air.centre[judged], kind, air.room[judged], placed, settings, fit)
        return fit.estimated_error or 0.0


def _counts(fewest: int, most: int) -> list[int]:
    """Whole numbers from the fewest to the most, each about GROWTH times the one before; at least one."""
    counts = [min(fewest, most)]
    while counts[-1] < most:
        counts.append(min(max(int(counts[-1] * GROWTH), counts[-1] + 1), most))
    return counts
