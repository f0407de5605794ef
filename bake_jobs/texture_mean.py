"""The mean of a texture over each triangle: 64 stratified samples on the mip level whose texels they just cover."""

import numpy as np

from gi_core.arrays import Float32, Float64, Int64, UInt8

SAMPLES_PER_SIDE = 8
TRIANGLES_AT_ONCE = 1 << 14  # bounds memory: 64 samples of 3 floats each


def linear_from_srgb(value: UInt8) -> Float32:
    """Linear values 0..1 of 8-bit sRGB ones, any shape (IEC 61966-2-1)."""
    return _LINEAR_OF_BYTE[value]


def mean_over_triangles(image: UInt8, uv: Float64, triangles: Int64) -> Float32:
    """Mean colour over each triangle.

    Parameters
    ----------
    image : (h, w, 3) uint8, sRGB, row 0 at the top
    uv : (v, 2), texture coordinates of the vertices; u to the right, v down from row 0, repeating beyond 0..1
    triangles : (m, 3), indices into uv

    Returns
    -------
    colour : (m, 3) float32, linear sRGB
    """
    corner = np.nan_to_num(uv, posinf=0, neginf=0)[triangles]
    edge, other = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    texels = np.abs(edge[:, 0] * other[:, 1] - edge[:, 1] * other[:, 0]) / 2 * image.shape[0] * image.shape[1]
    halves = _mip_chain(image)
    level = np.floor(np.log2(np.maximum(texels / SAMPLES_PER_SIDE**2, 1)) / 2).astype(np.int64)
    level = np.minimum(level, len(halves))
    weights = _sample_weights()
    colour = np.empty((len(triangles), 3), np.float32)
    for number in range(len(halves) + 1):
        here = np.flatnonzero(level == number)
        mip: UInt8 | Float32 = halves[number - 1] if number else image
        for start in range(0, len(here), TRIANGLES_AT_ONCE):
            some = here[start : start + TRIANGLES_AT_ONCE]
            at = np.einsum("sk,tkc->tsc", weights, corner[some])
            at -= np.floor(at)
            row = np.minimum((at[..., 1] * mip.shape[0]).astype(np.int64), mip.shape[0] - 1)
            column = np.minimum((at[..., 0] * mip.shape[1]).astype(np.int64), mip.shape[1] - 1)
            texel = mip[row, column]
            colour[some] = (texel if number else linear_from_srgb(texel.astype(np.uint8))).mean(axis=1)
    return colour


def _sample_weights() -> Float64:
    """(s, 3) barycentric coordinates: the centres of a square's cells, folded onto its lower triangle."""
    centre = (np.arange(SAMPLES_PER_SIDE) + 0.5) / SAMPLES_PER_SIDE
    a, b = (side.ravel() for side in np.meshgrid(centre, centre))
    # A cell centre on the diagonal stays on it; moving those by a third of a cell to either side keeps the mean unbiased.
    nudge = np.where(np.isclose(a + b, 1), np.where(a < b, -1, 1) / (3 * SAMPLES_PER_SIDE), 0)
    a, b = a + nudge, b + nudge
    beyond = a + b > 1
    a, b = np.where(beyond, 1 - a, a), np.where(beyond, 1 - b, b)
    return np.stack([1 - a - b, a, b], axis=1)


def _mip_chain(image: UInt8) -> list[Float32]:
    """Linear halves of an image, down to one texel. Averages are of light, so they are taken after decoding."""
    chain: list[Float32] = []
    finer: UInt8 | Float32 = image
    while max(finer.shape[:2]) > 1:
        even = np.pad(finer, ((0, finer.shape[0] % 2), (0, finer.shape[1] % 2), (0, 0)), mode="edge")
        half = np.zeros((even.shape[0] // 2, even.shape[1] // 2, 3), np.float32)
        for quarter in (even[i::2, j::2] for i in (0, 1) for j in (0, 1)):
            half += quarter if chain else linear_from_srgb(quarter.astype(np.uint8))
        half /= 4
        chain.append(half)
        finer = half
    return chain


def _linear_of_byte() -> Float32:
    value = np.arange(256) / 255.0
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4).astype(np.float32)


_LINEAR_OF_BYTE = _linear_of_byte()
