"""How numbers are made small in dataset files, each pair of functions an encoder and its decoder.

Lengths are integers of 1/512 m (2 mm), so that a vertex on a border is the same number in both sectors.
"""

from functools import cache

import numpy as np

from gi_core.arrays import AnyArray, Float32, Float64, Int8, Int32, UInt8, UInt16
from gi_core.errors import InputError

STEPS_PER_METRE = 512


def encode_length(metres: AnyArray) -> Int32:
    """[m] -> int32 steps of 1/512 m, nearest. Raises InputError beyond +-4194 km, where steps no longer fit."""
    steps = np.rint(np.asarray(metres, np.float64) * STEPS_PER_METRE)
    if not (np.abs(steps) <= np.iinfo(np.int32).max).all():
        raise InputError(
            "a height or place lies 4000 km or more from the origin; expected metres, near the origin: move or scale the source"
        )
    return steps.astype(np.int32)


def decode_length(steps: AnyArray) -> Float64:
    """int32 steps of 1/512 m -> [m]."""
    return np.asarray(steps, np.float64) / STEPS_PER_METRE


def encode_unit(vectors: AnyArray) -> UInt8:
    """Unit vectors (n, 3) -> octahedral (2, n) uint8; worst error 0.9 degrees. Cigolle et al., JCGT 2014."""
    v = np.asarray(vectors, np.float64)
    v = v / np.maximum(np.abs(v).sum(axis=1, keepdims=True), 1e-30)
    u = v[:, [0, 2]]
    folded = (1 - np.abs(v[:, [2, 0]])) * np.where(u >= 0, 1.0, -1.0)
    u = np.where(v[:, 1:2] < 0, folded, u)
    # 127 steps to each side, so that the six axes are exact.
    return np.ascontiguousarray((np.rint(u * 127) + 127).astype(np.uint8).T)


def decode_unit(octahedral: AnyArray) -> Float32:
    """Octahedral (2, n) uint8 -> unit vectors (n, 3) float32."""
    return _units().reshape(-1, 3).take((octahedral[0].astype(np.uint16) << 8) | octahedral[1], axis=0)


@cache
def _units() -> Float32:
    """(256, 256, 3): what each pair of codes stands for."""
    steps = np.minimum((np.arange(256, dtype=np.float64) - 127) / 127, 1.0)
    u = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=2)
    y = 1 - np.abs(u).sum(axis=2)
    folded = (1 - np.abs(u[..., ::-1])) * np.where(u >= 0, 1.0, -1.0)
    u = np.where(y[..., None] < 0, folded, u)
    v = np.stack([u[..., 0], y, u[..., 1]], axis=2)
    return np.asarray(v / np.maximum(np.linalg.norm(v, axis=2, keepdims=True), 1e-30), np.float32)


def encode_root(values: AnyArray) -> UInt8:
    """0..1 -> uint8 of the square root: dark values keep their relative precision."""
    return np.rint(np.sqrt(np.clip(values, 0, 1)) * 255).astype(np.uint8)


def decode_root(codes: AnyArray) -> Float32:
    """uint8 -> 0..1 float32: (code / 255) squared."""
    root = codes.astype(np.float32) / np.float32(255)
    return root * root


def encode_signed_root(values: AnyArray) -> Int8:
    """-1..1 -> int8, sign and square root of the magnitude."""
    return (np.sign(values) * np.rint(np.sqrt(np.clip(np.abs(values), 0, 1)) * 127)).astype(np.int8)


def decode_signed_root(codes: AnyArray) -> Float32:
    """int8 -> -1..1 float32: (code / 127) squared, with the code's sign."""
    root = codes.astype(np.float32) / np.float32(127)
    return root * np.abs(root)


def half_below(values: AnyArray) -> AnyArray:
    """Nearest float16 that is not above each value, so that weights never sum to more than they did."""
    half = np.asarray(values, np.float32).astype(np.float16)
    return np.where(half.astype(np.float64) > np.asarray(values, np.float64), np.nextafter(half, np.float16(0)), half)


def encode_fraction(values: AnyArray) -> UInt8:
    """0..1 -> uint8, linear."""
    return np.rint(np.clip(values, 0, 1) * 255).astype(np.uint8)


def smallest_unsigned(values: AnyArray) -> UInt8 | UInt16 | AnyArray:
    """The values in the smallest of uint8, uint16 and uint32 that holds them."""
    top = int(values.max(initial=0))
    return values.astype(np.uint8 if top < 1 << 8 else np.uint16 if top < 1 << 16 else np.uint32)
