"""The fixed start of every binary message of a player's stream. STREAM.md has the table of its bytes."""

import math
import struct
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from gi_core.arrays import Int64
from server.stream_header import StreamError

MAGIC = b"SLVF"
FRAME_VERSION = 1
MIN_SCALE, MAX_SCALE = 2.0**-40, 2.0**112
MAX_ELAPSED = 0xFFFFFFFF
_PREFIX = struct.Struct("<4sBBHQQQ3ifII")
PREFIX_BYTES = _PREFIX.size
_MAX_TICK = (1 << 63) - 1


class FrameKind(IntEnum):
    FULL = 0
    DELTA = 1


@dataclass(frozen=True)
class FramePrefix:
    """What is known of a frame before its payload is opened.

    base : tick of the frame that a delta changes; 0 in a full frame
    time_us : when the tick was published [microseconds since 1970, UTC, by the server's clock]
    first_voxel : world lattice index (x, y, z) of voxel (0, 0, 0)
    scale : a power of two; halves times it are lux
    count : voxels in the payload
    elapsed : ticks since the server last looked at this volume; 1 when it looks at every tick
    """

    kind: FrameKind
    tick: int
    base: int
    time_us: int
    first_voxel: tuple[int, int, int]
    scale: float
    count: int
    elapsed: int

    def pack(self) -> bytes:
        """The bytes; struct.error when a number does not fit its field."""
        numbers = (self.tick, self.base, self.time_us, *self.first_voxel, self.scale, self.count, self.elapsed)
        return _PREFIX.pack(MAGIC, FRAME_VERSION, self.kind, 0, *numbers)

    @property
    def first(self) -> Int64:
        """``first_voxel`` as an array."""
        return np.array(self.first_voxel, np.int64)


def parse_prefix(message: bytes, voxels: int) -> FramePrefix:
    """The prefix of a message about volumes of so many voxels. Raises StreamError unless every field is one that an encoder writes."""
    if len(message) < PREFIX_BYTES:
        raise StreamError(f"frame: expected at least {PREFIX_BYTES} bytes, found {len(message)}")
    magic, version, kind, zero, tick, base, time_us, x, y, z, scale, count, elapsed = _PREFIX.unpack_from(message)
    if magic != MAGIC or version != FRAME_VERSION or kind not in tuple(FrameKind) or zero != 0:
        raise StreamError(f"frame: expected {MAGIC!r} version {FRAME_VERSION}, found {message[:8]!r}")
    if not MIN_SCALE <= scale <= MAX_SCALE or math.frexp(scale)[0] != 0.5:
        raise StreamError(f"frame: expected a scale that is a power of two within {MIN_SCALE:g}..{MAX_SCALE:g}, found {scale:g}")
    if tick > _MAX_TICK or elapsed == 0:
        raise StreamError(f"frame: expected a tick below 2^63, later than the one before; found {tick}, {elapsed} later")
    if not (count == voxels if kind == FrameKind.FULL else 1 <= count <= voxels):
        raise StreamError(f"frame: expected at most {voxels} voxels, and all of them in a full frame; found {count}")
    return FramePrefix(FrameKind(kind), tick, base, time_us, (x, y, z), scale, count, elapsed)
