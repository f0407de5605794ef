"""What a unit of radiance from a direction adds to each coefficient of an irradiance basis, for the judge."""

import numpy as np

from gi_core.ambient_cube import FACE_DIRECTIONS
from gi_core.arrays import Float32

# Normalisation of real spherical harmonics in the order 1, y, z, x, xy, yz, 3 z^2 - 1, xz, x^2 - y^2.
SH2_NORMALISATION = np.sqrt(np.array([1, 3, 3, 3, 15, 15, 5 / 4, 15, 15 / 4]) / (4 * np.pi)).astype(np.float32)
# Cosine convolution per band: pi, 2 pi / 3, pi / 4 (Ramamoorthi and Hanrahan 2001).
SH2_COSINE = np.repeat(np.array([np.pi, 2 * np.pi / 3, np.pi / 4]), [1, 3, 5]).astype(np.float32)


def cube_weights(directions: Float32) -> Float32:
    """Clamped cosine to each face of the ambient cube: unit directions (n, 3) -> (n, 6) float32, +X -X +Y -Y +Z -Z."""
    return np.maximum(directions @ FACE_DIRECTIONS.T, np.float32(0))


def sh2(directions: Float32) -> Float32:
    """Real spherical harmonics up to degree 2: unit directions (n, 3) -> (n, 9) float32."""
    x, y, z = directions[:, 0], directions[:, 1], directions[:, 2]
    polynomial = np.stack([np.ones_like(x), y, z, x, x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y], axis=1)
    return np.asarray(polynomial * SH2_NORMALISATION, np.float32)


def sh2_weights(directions: Float32) -> Float32:
    """What unit radiance from each direction (n, 3) adds to the SH of the irradiance: (n, 9) float32, cosine convolution included."""
    return sh2(directions) * SH2_COSINE
