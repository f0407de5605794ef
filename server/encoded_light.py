"""What each encoding of a volume's light takes and what a client gets back: for ``sectorlight tradeoff``, which measures both."""

from collections.abc import Callable

import numpy as np

from gi_core.arrays import AnyArray, Float32
from server.encoding import half_scale, half_texels, npy, shared_exponent_scale, shared_exponent_texels

# Light (B, ..., 3) [lx] -> the bytes of a reply, and the light that a client reads of them.
Encoding = Callable[[Float32], tuple[int, Float32]]


def through_npy(values: Float32) -> tuple[int, Float32]:
    """Exact: twelve bytes a colour."""
    return len(npy(values)), values


def through_half(values: Float32) -> tuple[int, Float32]:
    """Half floats: eight bytes a colour, alpha among them."""
    scale = half_scale(values)
    texels = half_texels(values, scale)
    decoded = np.frombuffer(texels, "<f2").reshape(*values.shape[:-1], 4)[..., :3]
    return len(texels), decoded.astype(np.float32) * np.float32(scale)


def through_shared_exponent(values: Float32) -> tuple[int, Float32]:
    """RGB9E5: four bytes a colour, none of it negative."""
    scale = shared_exponent_scale(values)
    texels = shared_exponent_texels(values, scale)
    return len(texels), (unpack_shared_exponent(texels).reshape(values.shape) * scale).astype(np.float32)


def unpack_shared_exponent(texels: bytes) -> AnyArray:
    """(n, 3) float64 of RGB9E5 words, as OpenGL's EXT_texture_shared_exponent has them."""
    words = np.frombuffer(texels, "<u4")
    mantissa = (words[:, None] >> np.array([0, 9, 18], np.uint32)) & np.uint32(511)
    return np.ldexp(mantissa.astype(np.float64), (words >> np.uint32(27)).astype(np.int32)[:, None] - 24)


ENCODINGS: dict[str, Encoding] = {"npy": through_npy, "f16": through_half, "rgb9e5": through_shared_exponent}
