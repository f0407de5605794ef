"""3D textures as KTX 2.0 files: no mipmaps, no supercompression (Khronos, "KTX File Format Specification", version 2.0).

A volume of six faces is laid out as bevy reads an irradiance volume: Rx wide, 2 Ry high, 3 Rz deep. Along the height come the positive
faces, then the negative ones; along the depth those of X, Y and Z. So bevy's shader has it (irradiance_volume.wgsl, 0.13 to 0.20: half of
the height further where the normal's component is negative), and Blender's Eevee, from whose files bevy's own come. The text in
bevy's irradiance_volume.rs has the halves the other way round: read so, floors would be lit by what comes from below.
"""

import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from gi_core.arrays import AnyArray

IDENTIFIER = b"\xabKTX 20\xbb\r\n\x1a\n"
WRITER = "Sectorlight"
# Of the texture's axes: x to the right (east), y up, z out of the picture (south).
ORIENTATION = "ruo"
_HEADER = struct.Struct("<9I4I2Q3Q")
_RGBSDA, _BT709, _LINEAR = 1, 1, 1  # colour model, primaries and transfer function of the data format descriptor
_SIGNED_FLOAT, _EXPONENT = 0xC0, 0x20
_RED, _GREEN, _BLUE, _ALPHA = 0, 1, 2, 15
_ONE, _MINUS_ONE = 0x3F800000, 0xBF800000  # bits of floats
_MANTISSA_ONE = 8448  # what the specification has as upper bound of shared-exponent mantissas


@dataclass(frozen=True)
class TexelFormat:
    """A texel's format. ``vulkan`` : VkFormat; samples : (bit offset, bits, channel and qualifiers, lower, upper)"""

    vulkan: int
    type_bytes: int
    texel_bytes: int
    samples: tuple[tuple[int, int, int, int, int], ...]


HALF_RGBA = TexelFormat(
    97, 2, 8, tuple((16 * i, 16, channel | _SIGNED_FLOAT, _MINUS_ONE, _ONE) for i, channel in enumerate((_RED, _GREEN, _BLUE, _ALPHA)))
)
SHARED_EXPONENT = TexelFormat(
    123,
    4,
    4,
    tuple(
        sample
        for i, channel in enumerate((_RED, _GREEN, _BLUE))
        for sample in ((9 * i, 9, channel, 0, _MANTISSA_ONE), (27, 5, channel | _EXPONENT, 15, 31))
    ),
)
BYTE = TexelFormat(13, 1, 1, ((0, 8, _RED, 0, 1),))


def texture_file(data: bytes, size: tuple[int, int, int], kind: TexelFormat, facts: Mapping[str, str]) -> bytes:
    """A file of texels, ``size`` (depth, height, width) of them, x fastest. ``facts`` : its keys and values."""
    depth, height, width = size
    assert len(data) == depth * height * width * kind.texel_bytes
    descriptor = _descriptor(kind)
    pairs = b"".join(_pair(key, value) for key, value in sorted({**facts, "KTXorientation": ORIENTATION, "KTXwriter": WRITER}.items()))
    descriptor_at = len(IDENTIFIER) + _HEADER.size
    pairs_at = descriptor_at + len(descriptor)
    alignment = math.lcm(kind.texel_bytes, 4)
    data_at = -(-(pairs_at + len(pairs)) // alignment) * alignment
    header = _HEADER.pack(
        *(kind.vulkan, kind.type_bytes, width, height, depth, 0, 1, 1, 0),  # no layers, one face, one level, no supercompression
        *(descriptor_at, len(descriptor), pairs_at, len(pairs)),
        *(0, 0),  # no global data
        *(data_at, len(data), len(data)),
    )
    start = IDENTIFIER + header + descriptor + pairs
    return start.ljust(data_at, b"\0") + data


def stacked_faces(faces: AnyArray) -> AnyArray:
    """Faces +X -X +Y -Y +Z -Z (6, y, z, x, ...) as one texture (3 z, 2 y, x, ...)."""
    _, ny, nz, nx, *rest = faces.shape
    by_axis = faces.reshape(3, 2, ny, nz, nx, *rest)  # axis, sign from positive to negative, y, z, x
    return np.ascontiguousarray(np.moveaxis(by_axis, 3, 1)).reshape(3 * nz, 2 * ny, nx, *rest)


def _descriptor(kind: TexelFormat) -> bytes:
    """The basic data format descriptor, and its length before it (Khronos Data Format Specification 1.3)."""
    size = 24 + 16 * len(kind.samples)
    block = struct.pack("<IHH4B4B8B", 0, 2, size, _RGBSDA, _BT709, _LINEAR, 0, 0, 0, 0, 0, kind.texel_bytes, *([0] * 7))
    samples = (struct.pack("<HBB4BII", at, bits - 1, channel, 0, 0, 0, 0, low, high) for at, bits, channel, low, high in kind.samples)
    return struct.pack("<I", 4 + size) + block + b"".join(samples)


def _pair(key: str, value: str) -> bytes:
    both = f"{key}\0{value}\0".encode()
    return struct.pack("<I", len(both)) + both + b"\0" * (-len(both) % 4)
