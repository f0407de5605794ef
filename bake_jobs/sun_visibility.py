"""Which surfels see the sun, for every direction of the dataset's sun table: one bit each. Also where snow can lie."""

import numpy as np

from bake_jobs.rays import RayScene
from bake_jobs.snow import snow_attribute
from bake_jobs.surfels import Surfels
from gi_core.arrays import Bool, Float32, Float64, UInt32

# A surfel's position is the mean of its hits, which at an edge may lie a little below the surface.
START_OFFSET_M = 0.05


def bake_visibility(ray_scene: RayScene, surfels: Surfels, origin: Float64, directions: Float64) -> UInt32:
    """Planes of bits (D, ceil(S / 32)) uint32: whether each surfel sees along each of the directions (D, 3), unit, world frame.

    A surfel that faces away from a direction does not see along it.
    """
    count = surfels.count
    words = (count + 31) // 32
    visible = np.zeros((len(directions), words * 32), bool)
    start = ray_scene.local(surfels.position + origin + surfels.normal * START_OFFSET_M)
    facing = np.ascontiguousarray((surfels.normal @ directions.T.astype(np.float32) > 0).T)  # (D, S)
    for plane, direction in enumerate(directions.astype(np.float32)):
        lit = np.flatnonzero(facing[plane])
        visible[plane, lit] = ~ray_scene.occluded_from(start.take(lit, axis=0), np.tile(direction, (len(lit), 1)))
    return pack_bits(visible)


def pack_bits(visible: Bool) -> UInt32:
    """(D, 32 w) bool -> (D, w) uint32, the first of 32 in the least significant bit."""
    octets = np.packbits(visible, axis=1, bitorder="little")
    return np.ascontiguousarray(octets).view("<u4").astype(np.uint32)


def bake_snow(ray_scene: RayScene, surfels: Surfels, origin: Float64) -> Float32:
    """(S,) float32, 0..1: see ``snow_attribute``."""
    return snow_attribute(ray_scene, surfels.position + origin + surfels.normal * START_OFFSET_M, surfels.normal)
