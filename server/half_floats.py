"""Float32 to half floats and back by bit arithmetic: several times as quick as NumPy's conversion, and the same bits on every machine.

Multiplied by 2^-112, a float32 has the exponent field that a half wants, above 13 bits of mantissa to round away. Halves below 2^-14
(subnormal) are taken for zero both ways, because whether float32 has such numbers depends on a processor flag that libraries change.
"""

import numpy as np

from gi_core.arrays import Float32, UInt16

HALF_MAX = 65504.0
_REBIAS = np.float32(2.0**-112)
_UNBIAS = np.float32(2.0**112)
_DROPPED_BITS = np.uint32(13)
_HALF_OF_LAST_KEPT = np.uint32(1 << 12)
_MAGNITUDE, _SIGN, _SMALLEST_NORMAL, _INFINITE = (np.uint16(bits) for bits in (0x7FFF, 0x8000, 0x0400, 0x7C00))


def half_bits(values: Float32, scale: float) -> UInt16:
    """Bits of the halves nearest to values / scale, ties away from zero. ``scale`` is a power of two; no quotient exceeds HALF_MAX."""
    scaled: Float32 = values * np.float32(1.0 / scale)
    scaled *= _REBIAS  # a product of both factors could be too small for a float32
    bits = scaled.view(np.uint32)
    sign = (bits >> np.uint32(16)).astype(np.uint16) & _SIGN if (values < 0).any() else None
    bits += _HALF_OF_LAST_KEPT
    bits >>= _DROPPED_BITS
    halves = bits.astype(np.uint16)
    if sign is not None:
        halves &= _MAGNITUDE
        halves |= sign
    halves[halves & _MAGNITUDE < _SMALLEST_NORMAL] = 0
    return halves


def floats_from_half(halves: UInt16, scale: float) -> Float32:
    """What ``half_bits`` stands for: float32, exact. Infinities and NaN must have been refused before (``all_finite``)."""
    bits = (halves & _MAGNITUDE).astype(np.uint32)
    bits <<= _DROPPED_BITS  # in place throughout: new memory for each step would cost more than the arithmetic
    signs = halves & _SIGN
    if signs.any():
        bits |= signs.astype(np.uint32) << np.uint32(16)
    values = bits.view(np.float32)
    values *= _UNBIAS
    values *= np.float32(scale)
    values[halves & _MAGNITUDE < _SMALLEST_NORMAL] = 0
    return values


def all_finite(halves: UInt16) -> bool:
    """Whether no half is infinite or NaN."""
    return not bool((halves & _MAGNITUDE >= _INFINITE).any())
