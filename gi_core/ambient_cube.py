"""The ambient cube: irradiance along the six axes, faces in the order +X -X +Y -Y +Z -Z.

Mitchell, McTaggart and Green, "Shading in Valve's Source Engine", SIGGRAPH 2006. The squares of a unit normal's components sum
to one, so reconstruction never rings, is never negative, and is exact along the axes and for constant light.
"""

import numpy as np

from gi_core.arrays import Float32, Float64
from gi_core.constants import CUBE_FACES

FACE_DIRECTIONS = np.array(CUBE_FACES, np.float32)  # (6, 3)


def basis_weights(normals: Float32) -> Float32:
    """Weight of each face for unit normals: (n, 3) -> (n, 6) float32, rows sum to 1. Twin of ``kernels_cl/ambient_cube.h``."""
    squared = normals * normals
    weights = np.zeros((len(normals), 6), np.float32)
    for axis in range(3):
        positive = normals[:, axis] >= 0
        weights[:, 2 * axis] = np.where(positive, squared[:, axis], 0)
        weights[:, 2 * axis + 1] = np.where(positive, 0, squared[:, axis])
    return weights


def evaluate(cubes: Float32, normals: Float32) -> Float32:
    """Irradiance [lx] on surfaces: cubes (n, 6, 3) [lx] and unit normals (n, 3) -> (n, 3) float32."""
    return np.einsum("nf,nfc->nc", basis_weights(normals), cubes)


def project_radiance(directions: Float64, radiance: Float64, solid_angle: Float64) -> Float64:
    """Project incoming radiance onto the cube.

    Parameters
    ----------
    directions : (n, 3), unit, world frame, towards the light
    radiance : (n, 3) [cd m^-2], linear sRGB
    solid_angle : (n,) [sr], what each direction stands for

    Returns
    -------
    cube : (6, 3) float64 [lx]
    """
    cosine = np.maximum(np.asarray(directions, np.float64) @ FACE_DIRECTIONS.T.astype(np.float64), 0.0)
    return np.einsum("nf,nc,n->fc", cosine, radiance, solid_angle)
