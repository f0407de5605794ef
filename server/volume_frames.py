"""Frames of a player's stream: whole volumes and differences, as bytes. STREAM.md describes them byte by byte.

    VolumeEncoder   the server's end, one for each client: volumes in, messages out, or nothing where there is nothing worth a message
    VolumeDecoder   a client's end: messages in, the same volume out, bit for bit

Messages are untrusted: a decoder checks every size, count and position before it allocates or changes anything.
"""

import math
import threading
from dataclasses import dataclass

import numpy as np
import zstandard

from gi_core.arrays import Bool, Float32, Int64, UInt8, UInt16
from gi_core.constants import VOXEL_NO_SECTOR
from server.encoding import half_scale
from server.frame_prefix import MAX_ELAPSED, MIN_SCALE, PREFIX_BYTES, FrameKind, FramePrefix, parse_prefix
from server.half_floats import all_finite, half_bits
from server.stream_header import FrameLostError, StreamError, StreamHeader
from server.stream_mirror import Mirror, Move, entering

# Level 3 takes twice as long for 3 % fewer bytes.
ZSTD_LEVEL = 1
_MAX_WINDOW_BYTES = 1 << 23
# Changes below this are never sent: less than a millionth of starlight, and near what the smallest scale resolves.
LEAST_CHANGE_LX = 2.0**-40


@dataclass(frozen=True, eq=False)
class Frame:
    """What one message said.

    chosen : (n,) int64, voxels among y, z, x that the message carries
    before : (B, n, 3) float32 [lx] what they held before, NaN where they were outside; None unless asked for, and for full frames
    """

    prefix: FramePrefix
    chosen: Int64
    before: Float32 | None


class _Scratch(threading.local):
    """Arrays that every comparison of a thread needs: fresh memory each time would cost more than the comparison."""

    def __init__(self) -> None:
        self._arrays: dict[tuple[int, ...], Float32] = {}

    def like(self, values: Float32) -> Float32:
        if values.shape not in self._arrays:
            self._arrays = {values.shape: np.empty_like(values)}
        return self._arrays[values.shape]


_scratch = _Scratch()


class VolumeEncoder:
    """Turns a player's volumes into messages for one client. Not for two threads at once."""

    def __init__(self, header: StreamHeader) -> None:
        self._header = header
        self._mirror = Mirror(header)
        self._looked_at = -1
        self._unchanging: Float32 | None = None
        self._compressor = zstandard.ZstdCompressor(level=ZSTD_LEVEL, write_checksum=True)

    def forget(self) -> None:
        """Make the next message a full frame: the client asked for one, or lost one."""
        self._mirror.tick = -1
        self._unchanging = None

    def encode(self, tick: int, values: Float32, mask: UInt8, first_voxel: Int64, time_us: int) -> bytes | None:
        """The message that brings the client to a volume, or None when all that changed is below the thresholds.

        Call it at every tick, also when nothing changed: frames say how many ticks passed between two looks, and a client takes a gap for
        ticks that it was not shown.

        Parameters
        ----------
        tick : greater than at the last call
        values : (B, y, z, x, 3) float32 [lx], finite; an array that is read-only is taken never to change, and costs nothing when it
            comes again at the same place
        mask : (y, z, x) uint8 voxel classes
        first_voxel : (3,) world lattice index of voxel (0, 0, 0), within int32
        time_us : now [microseconds since 1970]

        A volume that moves by whole voxels is sent as its new voxels and whatever else changed. Raises ValueError.
        """
        if tick <= self._looked_at or tick < 0:
            raise ValueError(f"tick {tick}: expected one greater than {self._looked_at}")
        if np.abs(np.asarray(first_voxel, np.int64)).max() >= 1 << 31:
            raise ValueError(f"first voxel {first_voxel}: expected whole numbers of 32 bits")
        elapsed = min(tick - self._looked_at, MAX_ELAPSED)
        self._looked_at = tick
        mirror = self._mirror
        step = mirror.move_to(first_voxel) if mirror.tick >= 0 else None
        if values is self._unchanging and step == (0, 0, 0) and np.array_equal(mask.reshape(-1), mirror.mask):
            return None
        self._unchanging = values if not values.flags.writeable else None
        volume = np.ascontiguousarray(values, np.float32).reshape(mirror.values.shape)
        classes = np.asarray(mask, np.uint8).reshape(mirror.mask.shape)
        difference = _scratch.like(volume)
        largest = _largest(np.abs(volume, out=difference))
        if not math.isfinite(largest.max()):
            raise ValueError("volume: expected finite light, found infinite or NaN")
        if step is None:
            mirror.first_voxel = np.array(first_voxel, np.int64)
            prefix = self._prefix(FrameKind.FULL, tick, elapsed, time_us, half_scale(largest), mirror.voxels)
            return self._message(prefix, b"", slice(None), volume, classes)
        if step != (0, 0, 0):
            mirror.move(step, first_voxel)
        np.subtract(volume, mirror.values, out=difference)
        tolerance = self._header.threshold * largest + (self._header.floor * largest.max() + LEAST_CHANGE_LX)
        changed = _largest(np.abs(difference, out=difference)) > tolerance
        changed |= classes != mirror.mask
        if step != (0, 0, 0):
            changed |= entering(mirror.shape, step)
        chosen = np.flatnonzero(changed)
        if len(chosen) == 0:
            return None
        prefix = self._prefix(FrameKind.DELTA, tick, elapsed, time_us, half_scale(largest[chosen]), len(chosen))
        return self._message(prefix, np.packbits(changed).tobytes(), chosen, volume, classes)

    def _prefix(self, kind: FrameKind, tick: int, elapsed: int, time_us: int, scale: float, count: int) -> FramePrefix:
        x, y, z = (int(n) for n in self._mirror.first_voxel)
        base = self._mirror.tick if kind == FrameKind.DELTA else 0
        return FramePrefix(kind, tick, base, time_us, (x, y, z), max(scale, MIN_SCALE), count, elapsed)

    def _message(self, prefix: FramePrefix, bitmask: bytes, chosen: Int64 | slice, volume: Float32, classes: UInt8) -> bytes:
        """The bytes of a frame, which the mirror takes in as the client will."""
        start = prefix.pack()  # fails before the mirror changes
        if prefix.count == len(classes):
            chosen = slice(None)  # no copying to and fro
        rows = volume if isinstance(chosen, slice) else np.take(volume, chosen, axis=1)
        halves = half_bits(rows, prefix.scale)
        self._mirror.write(chosen, classes[chosen], halves, prefix.scale)
        self._mirror.tick = prefix.tick
        low, high = halves.astype(np.uint8), (halves >> np.uint16(8)).astype(np.uint8)
        payload = b"".join((bitmask, classes[chosen].tobytes(), low.tobytes(), high.tobytes()))
        return start + self._compressor.compress(payload)


class VolumeDecoder:
    """Follows a stream. ``values`` (B, y, z, x, 3) float32 [lx], ``mask`` (y, z, x) and ``first_voxel`` are valid once ``tick`` >= 0."""

    def __init__(self, header: StreamHeader) -> None:
        self._header = header
        self._mirror = Mirror(header)
        self._decompressor = zstandard.ZstdDecompressor(max_window_size=_MAX_WINDOW_BYTES)

    @property
    def tick(self) -> int:
        """Of the last frame, or -1."""
        return self._mirror.tick

    @property
    def values(self) -> Float32:
        return self._mirror.values.reshape(*self._header.shape, 3)

    @property
    def mask(self) -> UInt8:
        return self._mirror.mask.reshape(self._header.shape[1:])

    @property
    def first_voxel(self) -> Int64:
        return self._mirror.first_voxel

    def decode(self, message: bytes, compare: bool = False) -> Frame:
        """Take a message in; ``compare`` asks for ``Frame.before``. Raises StreamError or FrameLostError, and then nothing has changed."""
        prefix = parse_prefix(message, self._header.voxels)
        mirror, count = self._mirror, prefix.count
        step = None if prefix.kind == FrameKind.FULL else self._step(prefix)
        raw = self._payload(message[PREFIX_BYTES:], count, 0 if step is None else (mirror.voxels + 7) // 8)
        chosen = np.arange(count) if step is None else np.flatnonzero(self._selected(raw, count))
        new = np.zeros(mirror.voxels, np.bool_) if step in (None, (0, 0, 0)) else entering(mirror.shape, step)
        if np.count_nonzero(new[chosen]) != np.count_nonzero(new):
            raise StreamError("frame: the volume moved, but not all of its new voxels are there")
        classes = np.frombuffer(raw, np.uint8, count, len(raw) - count * (1 + self._voxel_bytes))
        halves = self._halves(raw, count)
        if int(classes.max()) > VOXEL_NO_SECTOR or not all_finite(halves):
            raise StreamError(f"frame: expected classes of 0..{VOXEL_NO_SECTOR} and finite light")
        before = None
        if step is None:
            mirror.first_voxel = prefix.first
        else:
            if step != (0, 0, 0):
                mirror.move(step, prefix.first)
            if compare:
                before = np.take(mirror.values, chosen, axis=1)
                before[:, new[chosen]] = np.nan
        mirror.write(chosen if count < mirror.voxels else slice(None), classes, halves, prefix.scale)
        mirror.tick = prefix.tick
        return Frame(prefix, chosen, before)

    def _step(self, prefix: FramePrefix) -> Move:
        """How far a delta moves the volume."""
        here = self._mirror.tick
        if here < 0 or prefix.base != here or prefix.tick <= here:
            raise FrameLostError(f"frame: tick {prefix.tick} changes tick {prefix.base}, but here is tick {here}; ask for a full frame")
        step = self._mirror.move_to(prefix.first)
        if step is None:
            raise StreamError("frame: a difference to a volume with no voxel in common")
        return step

    @property
    def _voxel_bytes(self) -> int:
        return self._header.shape[0] * 3 * 2

    def _payload(self, compressed: bytes, count: int, bitmask_bytes: int) -> bytes:
        expected = bitmask_bytes + count * (1 + self._voxel_bytes)
        try:
            parameters = zstandard.get_frame_parameters(compressed)
            if parameters.content_size != expected or not parameters.has_checksum:
                raise StreamError(f"frame: expected a checksummed payload of {expected} bytes, found {parameters.content_size}")
            raw = self._decompressor.decompress(compressed, max_output_size=expected, allow_extra_data=False)
        except zstandard.ZstdError as error:
            raise StreamError(f"frame: damaged payload: {error}") from error
        if len(raw) != expected:
            raise StreamError(f"frame: expected a payload of {expected} bytes, found {len(raw)}")
        return raw

    def _selected(self, raw: bytes, count: int) -> Bool:
        voxels = self._header.voxels
        bits = np.unpackbits(np.frombuffer(raw, np.uint8, (voxels + 7) // 8))
        selected: Bool = bits[:voxels].view(np.bool_)
        if np.count_nonzero(bits) != count or np.count_nonzero(selected) != count:
            raise StreamError(f"frame: expected {count} voxels, found {np.count_nonzero(bits)} marked")
        return selected

    def _halves(self, raw: bytes, count: int) -> UInt16:
        """(B, n, 3) from two planes of bytes, low ones first, which end the payload."""
        planes = np.frombuffer(raw, np.uint8, count * self._voxel_bytes, len(raw) - count * self._voxel_bytes).reshape(2, -1)
        halves = planes[1].astype(np.uint16) << np.uint16(8)
        halves |= planes[0]
        return halves.reshape(self._header.shape[0], count, 3)


def _largest(magnitudes: Float32) -> Float32:
    """(B, N, 3), not negative -> (N,): the largest of each voxel."""
    channels = magnitudes.max(axis=0)
    return np.maximum(np.maximum(channels[:, 0], channels[:, 1]), channels[:, 2])
