"""Directional bases of irradiance: E(n) on a surface with unit normal n, from B coefficients per channel [lx].

    cube   B = 6   irradiance along +X -X +Y -Y +Z -Z (gi_core.ambient_cube)
    sh1    B = 4   real spherical harmonics 1, y, z, x; on reconstruction ZH3 guesses the band that is left out
    sh2    B = 9   and xy, yz, 3 z^2 - 1, xz, x^2 - y^2

Of the harmonics E(n) = sum c_k Y_k(n): the cosine convolution is included. Ramamoorthi and Hanrahan, "An Efficient Representation for
Irradiance Environment Maps", SIGGRAPH 2001; ZH3: Roughton, Sloan, Silvennoinen, Iwanicki and Shirley, "ZH3: Quadratic Zonal
Harmonics", I3D 2024. MATH.md says what each costs, and why the loop of bounces shrinks in all of them.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np

from gi_core import ambient_cube
from gi_core.ambient_cube import FACE_DIRECTIONS
from gi_core.arrays import AnyArray, Float32, Float64
from gi_core.constants import ALBEDO_MAX, BASIS_SIZES
from gi_core.errors import InputError
from gi_core.spectrum import LUMINANCE_FROM_RGB

# Normalisation of the polynomials above: Y_k = SH_NORM[k] times the k-th.
SH_NORM = np.sqrt(np.array([1, 3, 3, 3, 15, 15, 5 / 4, 15, 15 / 4]) / (4 * np.pi))
# Cosine convolution per band, of each coefficient: pi, 2 pi / 3, pi / 4.
SH_COSINE = np.repeat(np.array([np.pi, 2 * np.pi / 3, np.pi / 4]), [1, 3, 5])
# ZH3's "hallucination": zonal L2 over L0 as a polynomial of |L1| / L0 along the luminance's main direction.
_ZH3_LINEAR, _ZH3_SQUARE = 0.08, 0.6
# A cube's weights of a factor are shares of a face's view; these make shares of the harmonics' too: no sum exceeds one.
_SHARES = {"cube": np.ones(6), "sh1": SH_NORM[:4], "sh2": SH_NORM}


@dataclass(frozen=True)
class Feedback:
    """How bounces read a basis, so that they shrink at every pass: MATH.md, "What bounds the loop".

    directional : gain on the harmonics' first band
    albedo_max : the most that a surface sends on
    shrinks : the most of a change that one pass leaves
    """

    directional: float
    albedo_max: float
    shrinks: float


FEEDBACK = {
    "cube": Feedback(1.0, ALBEDO_MAX, ALBEDO_MAX),
    "sh1": Feedback(0.68, ALBEDO_MAX, 0.996),
    "sh2": Feedback(1.0, 0.94, 0.998),
}


def brightness(values: Float32, basis: str) -> Float32:
    """Luminance of what arrives from all directions together, (B, n, 3) [lx] -> (n,), up to a factor that each basis has."""
    light = values.mean(axis=0) if basis == "cube" else values[0]
    return np.asarray(light @ LUMINANCE_FROM_RGB.astype(np.float32), np.float32)


def basis_of_size(size: int) -> str:
    """The basis with this many coefficients. Raises InputError where there is none."""
    for name, coefficients in BASIS_SIZES.items():
        if coefficients == size:
            return name
    raise InputError(f"{size} coefficients: expected those of {BASIS_SIZES}")


def harmonics(directions: AnyArray, size: int = 9) -> AnyArray:
    """Real spherical harmonics at unit directions: (n, 3) -> (n, size), of the input's dtype."""
    x, y, z = np.ascontiguousarray(directions.T)
    polynomials = [np.ones_like(x), y, z, x]
    if size > 4:
        polynomials += [x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y]
    found = np.empty((len(directions), size), directions.dtype)
    for b, norm in enumerate(SH_NORM[:size].astype(directions.dtype)):
        np.multiply(polynomials[b], norm, out=found[:, b])
    return found


def projection_weights(basis: str, directions: AnyArray) -> AnyArray:
    """What radiance 1 from a direction adds to each coefficient, per solid angle [sr]: unit directions (n, 3) -> (n, B)."""
    if basis == "cube":
        return np.maximum(directions @ FACE_DIRECTIONS.T.astype(directions.dtype), 0)
    size = BASIS_SIZES[basis]
    return np.asarray(harmonics(directions, size) * SH_COSINE[:size].astype(directions.dtype))


def evaluation_weights(basis: str, normals: AnyArray) -> AnyArray:
    """What each coefficient adds to irradiance along a normal: unit normals (n, 3) -> (n, B). Of sh1 what is linear of it."""
    if basis == "cube":
        return ambient_cube.basis_weights(normals)
    return harmonics(normals, BASIS_SIZES[basis])


def average(coefficients: AnyArray) -> AnyArray:
    """Mean of irradiance over all directions [lx]: coefficients (B, ..., 3) -> (..., 3)."""
    if basis_of_size(len(coefficients)) == "cube":
        return np.asarray(coefficients.mean(axis=0))
    return np.asarray(coefficients[0] * SH_NORM[0].astype(coefficients.dtype))  # all other harmonics' means are 0


def feedback_weights(basis: str, normals: Float32) -> Float32:
    """``evaluation_weights`` as bounces use them: (n, 3) -> (n, B) float32."""
    weights = evaluation_weights(basis, normals)
    if FEEDBACK[basis].directional != 1:
        weights[:, 1:4] *= np.float32(FEEDBACK[basis].directional)
    return np.asarray(weights, np.float32)


def evaluate(basis: str, coefficients: AnyArray, normals: AnyArray) -> AnyArray:
    """Irradiance [lx], not below 0: coefficients (n, B, 3) [lx] and unit normals (n, 3) -> (n, 3)."""
    if basis == "cube":
        return np.asarray(ambient_cube.evaluate(coefficients, normals))
    linear = np.einsum("nb,nbc->nc", evaluation_weights(basis, normals), coefficients)
    if basis == "sh1":
        linear = linear + _zh3_band(coefficients, normals)
    return np.maximum(linear, 0)


def _zh3_band(coefficients: AnyArray, normals: AnyArray) -> AnyArray:
    """(n, 3) [lx]: the zonal second band that ZH3 expects of linear harmonics (n, 4, 3)."""
    mean = coefficients[:, 0] / SH_COSINE[0].astype(coefficients.dtype)
    gradient = coefficients[:, [3, 1, 2]] / SH_COSINE[1].astype(coefficients.dtype)  # x, y, z
    axis = gradient @ LUMINANCE_FROM_RGB.astype(coefficients.dtype)
    axis = axis / np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-30)
    ratio = np.abs(np.einsum("na,nac->nc", axis, gradient)) / np.maximum(mean, 1e-30)
    # More than sqrt(3), a single direction, is no light.
    ratio = np.minimum(ratio, np.sqrt(3.0).astype(coefficients.dtype))
    zonal = mean * (_ZH3_LINEAR * ratio + _ZH3_SQUARE * ratio * ratio)
    along = np.einsum("na,na->n", axis, normals)[:, None]
    return np.asarray(SH_COSINE[8].astype(coefficients.dtype) * zonal * SH_NORM[6].astype(coefficients.dtype) * (3 * along * along - 1))


def factor_shares(basis: str) -> Float64:
    """(B,): a factor's weights times these are shares, which a file stores and of which no probe's sum exceeds one."""
    return _SHARES[basis]


@cache
def from_axes(basis: str) -> Float32:
    """(B, 6): coefficients of the smoothest light that has given irradiance along the six axes: exact there.

    Of sh1, which has four numbers, what is closest to it.
    """
    axes = FACE_DIRECTIONS.astype(np.float64)
    matrix = np.linalg.pinv(evaluation_weights(basis, axes)) if basis != "cube" else np.eye(6)
    matrix[np.abs(matrix) < 1e-12] = 0
    found = matrix.astype(np.float32)
    found.setflags(write=False)
    return found


@cache
def conversion(source: str, target: str) -> Float32:
    """(B', B): what is linear of ``convert``, so of sh1 without ZH3, and of a cube's faces negative where the harmonics are.

    Raises InputError where the target is richer than the source.
    """
    if target not in served_from(source):
        raise InputError(f"basis {target}: this light is in {source}; expected {' or '.join(served_from(source))}")
    sizes = BASIS_SIZES[target], BASIS_SIZES[source]
    axes = FACE_DIRECTIONS.astype(np.float64)
    matrix = np.eye(*sizes) if source == target or target != "cube" else np.asarray(evaluation_weights(source, axes))
    found = np.asarray(matrix, np.float32)
    found.setflags(write=False)
    return found


def served_from(basis: str) -> tuple[str, ...]:
    """What a dataset of this basis can be served in: itself, what is poorer, and always the cube."""
    return {"cube": ("cube",), "sh1": ("cube", "sh1"), "sh2": ("cube", "sh1", "sh2")}[basis]


def convert(values: Float32, source: str, target: str) -> Float32:
    """Coefficients (n, B, 3) [lx] in another basis: (n, B', 3) float32. A cube is the irradiance along its axes, and never negative.

    Raises InputError where the target is richer than the source. Twin of ``kernels_cl/convert_probes.cl``.
    """
    matrix = conversion(source, target)
    if source == target:
        return values
    if (source, target) == ("sh1", "cube"):
        faces = [evaluate(source, values, np.broadcast_to(axis, (len(values), 3))) for axis in FACE_DIRECTIONS]
        return np.asarray(np.stack(faces, axis=1), np.float32)
    found = np.einsum("tb,nbc->ntc", matrix, values)
    return np.asarray(np.maximum(found, 0) if target == "cube" else found, np.float32)
