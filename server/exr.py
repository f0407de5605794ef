"""A picture as an OpenEXR file: float32 scan lines, not compressed (OpenEXR, "The OpenEXR File Layout")."""

import struct

import numpy as np

from gi_core.arrays import Float32

_MAGIC, _VERSION, _FLOAT = 20000630, 2, 2


def exr(picture: Float32) -> bytes:
    """The file of a picture (height, width, 3), top row first."""
    height, width, _ = picture.shape
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    channels = b"".join(name + b"\0" + struct.pack("<iB3x2i", _FLOAT, 0, 1, 1) for name in (b"B", b"G", b"R")) + b"\0"
    attributes = (
        (b"channels", b"chlist", channels),
        (b"compression", b"compression", b"\0"),
        (b"dataWindow", b"box2i", window),
        (b"displayWindow", b"box2i", window),
        (b"lineOrder", b"lineOrder", b"\0"),
        (b"pixelAspectRatio", b"float", struct.pack("<f", 1.0)),
        (b"screenWindowCenter", b"v2f", struct.pack("<2f", 0.0, 0.0)),
        (b"screenWindowWidth", b"float", struct.pack("<f", 1.0)),
    )
    header = struct.pack("<2i", _MAGIC, _VERSION)
    header += b"".join(name + b"\0" + kind + b"\0" + struct.pack("<i", len(value)) + value for name, kind, value in attributes) + b"\0"
    line_bytes = 12 * width
    first = len(header) + 8 * height
    offsets = struct.pack(f"<{height}Q", *(first + row * (8 + line_bytes) for row in range(height)))
    # A line holds all of a channel, then all of the next, in the order of their names.
    lines = np.ascontiguousarray(picture[..., ::-1].transpose(0, 2, 1), "<f4")
    return header + offsets + b"".join(struct.pack("<2i", row, line_bytes) + lines[row].tobytes() for row in range(height))
