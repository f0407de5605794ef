"""Which probes light surfels that all probes are far from: not the closest, but the likest.

Sky and bounces reach a surfel by way of the probe that lights it, the closest of those that see it. That is right where it stands beside
the surfel. A wall down a canyon is seen by probes 80 m away, which stand in other light: it shone half as much again as it should, and two
sectors that see it from its two ends each gave it another light, so that a probe which both store had two. So what arrives at far surfels
is tried out (bake_jobs/trial_light.py), and of all probes, whether they see the surfel or not, that one lights it whose own trial light
is likest along the surfel's normal. What a surfel is lit by stays one probe, and costs no byte.
"""

import numpy as np

from bake_jobs.adaptive import DARK, Trial
from bake_jobs.distinct import least
from bake_jobs.gbuffer import GBuffer
from bake_jobs.placement import Placement
from bake_jobs.surfels import Surfels
from bake_jobs.trial_fit import FAINT
from bake_jobs.trial_light import START_M, TrialScene
from gi_core.arrays import Bool, Float32, Int64, UInt16
from gi_core.basis import feedback_weights

# Closer, the closest probe is as good: the light of a place is not another's yet, and trial light is no better than a guess.
FAR_M = 16.0
SURFELS_AT_ONCE = 128


def likest_where_far(
    surfels: Surfels,
    gbuffer: GBuffer,
    hit_room: UInt16,
    placement: Placement,
    trial: Trial,
    trial_scene: TrialScene,
    probe: UInt16,
    weight: Float32,
) -> tuple[UInt16, Float32]:
    """Feedback probes (S, k) and weights (S, k) of all surfels, those of far ones exchanged.

    hit_room : (P * r,) uint16, as ``surfels.rooms_of_hits`` gives it
    probe, weight : as ``surfels.feedback`` gives them

    Rooms are lit by their own probes. Where it is dark by day the closest probe stays: lamps are for those who see them.
    """
    distance = gbuffer.hits.distance[surfels.hit]
    closest = least(distance, surfels.of_hit, surfels.count)
    far = np.flatnonzero(distance[closest] >= FAR_M)
    # Where a ray met the surface: the mean of what a wide cell holds may lie inside a house.
    met = surfels.hit[closest[far]]
    states = trial.states
    by_day = np.arange(states.count)[states.fitted]
    by_day = by_day[~np.array(states.lamps)[by_day]]
    normal = gbuffer.hits.normal[met]
    arriving = trial_scene.around(gbuffer.position[met] + START_M * normal, normal)[:, by_day]
    same_room = hit_room[met, None] == placement.room
    good = (arriving.max(axis=1, initial=0) >= DARK) & same_room.any(axis=1)
    far = far[good]
    probe, weight = probe.copy(), weight.copy()
    probe[far], weight[far] = 0, 0
    probe[far, 0] = _likest(trial.probe_cube[:, by_day], normal[good], arriving[good], same_room[good])
    weight[far, 0] = 1
    return probe, weight


def _likest(cube: Float32, normal: Float32, arriving: Float32, may: Bool) -> Int64:
    """(n,): of probes with trial light ``cube`` (P, S, 6) the one that comes closest to what arrives (n, S) along normals (n, 3), relative;
    of those that ``may`` (n, P)."""
    probes, states, _ = cube.shape
    found = np.empty(len(normal), np.int64)
    by_face = np.ascontiguousarray(cube.reshape(probes * states, -1).T)
    for start in range(0, len(normal), SURFELS_AT_ONCE):
        some = slice(start, start + SURFELS_AT_ONCE)
        light, wanted = (feedback_weights("cube", normal[some]) @ by_face).reshape(-1, probes, states), arriving[some, None]
        error = (np.abs(light - wanted) / np.maximum(wanted, FAINT * wanted.mean(axis=2, keepdims=True))).sum(axis=2)
        found[some] = np.where(may[some], error, np.inf).argmin(axis=1)
    return found
