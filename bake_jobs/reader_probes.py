"""A few more probes where surfaces are lit as no blend of the chosen ones is: in light wells, and between walls a voxel or less apart.

Adaptive placement (bake_jobs/adaptive.py) chooses among voxels of the air, which such places have none of. Here places off surfaces are
tried out, and those that are explained worst become probes, one after another, each for what is wrong within reach of it. They stand beyond
the margin of every border, so that a sector shares none of them and its neighbours' borders stay as they are.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from bake_jobs.adaptive import DARK, Trial
from bake_jobs.config import BakeSettings
from bake_jobs.placement import OFF_EDGES_M, Placement, in_boxes, stored_order
from bake_jobs.scene import ProbeHint
from bake_jobs.surface_fit import FINE_AREA_M2, SurfaceFit
from bake_jobs.trial_light import TrialScene
from gi_core.arrays import Bool, Float64, Int64
from gi_core.constants import FINE_VOXEL_SIZE_M, MAX_PROBES_PER_SECTOR, ROOM_OUTDOORS, SECTOR_SIZE_M
from gi_core.grid import SectorIndex
from gi_core.sector import PROBE_ON_WALL

# A probe is for what is wrong within so far of it; it takes most of that away within a little less. No other stands closer than the last.
REACH_M, MENDS_M, APART_M = 2.0, 1.8, 1.0
LEFT = 0.2
# Errors of all places within reach, summed, its own twice, that are worth a probe.
LEAST_ERROR = 0.5


def add_probes(
    surface_fit: SurfaceFit,
    index: SectorIndex,
    settings: BakeSettings,
    hints: tuple[ProbeHint, ...],
    placed: Placement,
    trial: Trial,
    probe_scene: TrialScene,
) -> tuple[Placement, Trial]:
    """Placement and trial light with at most ``settings.reader_probes`` more, none where hints forbid them, which ``probe_scene``
    lights."""
    point, normal = surface_fit.both_sides(FINE_AREA_M2)
    place, found = surface_fit.in_air(point, normal, 0.5 * FINE_VOXEL_SIZE_M)
    place, normal = place[found], normal[found]
    light = surface_fit.light(place)
    error = surface_fit.unexplained(place, normal, light)
    error[light.max(axis=(1, 2)) < DARK] = 0
    local = place[:, [0, 2]] - index.origin[[0, 2]]
    may = ((local > settings.margin_m) & (local < SECTOR_SIZE_M - settings.margin_m)).all(axis=1) & ~in_boxes(place, hints, "forbid")
    room = min(settings.probe_budget, MAX_PROBES_PER_SECTOR) - len(placed.position)
    chosen = worst_places(place, error, may, min(settings.reader_probes, room))
    if not len(chosen):
        return placed, trial
    new = place[chosen] + np.array(OFF_EDGES_M)
    position = np.concatenate([placed.position, new])
    flags = np.concatenate([placed.flags, np.full(len(new), PROBE_ON_WALL, np.uint8)])
    rooms = np.concatenate([placed.room, np.full(len(new), ROOM_OUTDOORS, np.uint16)])
    cube = np.concatenate([trial.probe_cube, probe_scene.light(new, trial.light.cells).cube])
    order = stored_order(position)
    return Placement(position[order], flags[order], rooms[order], placed.dead, placed.dropped), replace(trial, probe_cube=cube[order])


def worst_places(place: Float64, error: Float64, may: Bool, most: int) -> Int64:
    """At most so many of the places (n, 3) [m] with errors (n,), those of which ``may`` (n,) allows, worst first."""
    if not len(place) or most <= 0:
        return np.zeros(0, np.int64)
    tree = cKDTree(place)
    within = tree.query_ball_point(place, REACH_M, return_sorted=True)
    left, alive = error.copy(), np.array(may, bool)
    # Its own error twice: a probe had better stand where the light is wrong than beside it.
    total = left + np.array([left[some].sum() for some in within])
    chosen: list[int] = []
    while len(chosen) < most:
        best = int(np.argmax(np.where(alive, total, -1)))
        if not alive[best] or total[best] < LEAST_ERROR:
            break
        chosen.append(best)
        left[tree.query_ball_point(place[best], MENDS_M)] *= LEFT
        alive[tree.query_ball_point(place[best], APART_M)] = False
        for touched in tree.query_ball_point(place[best], REACH_M + MENDS_M):
            total[touched] = left[touched] + left[within[touched]].sum()
    return np.array(chosen, np.int64)
