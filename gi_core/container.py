"""The file that every baked array lives in: a fixed prefix, a JSON header, one zstd frame. FORMAT.md gives the bytes.

Files are untrusted: every size is checked against a limit and against the file's own length before anything is allocated, and the
digest is checked before anything is parsed.
"""

import hashlib
import json
import math
import os
import struct
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import zstandard

from gi_core.arrays import AnyArray
from gi_core.background import give_way
from gi_core.errors import CorruptFileError, FormatVersionError

MAGIC = b"SECTORLT"
_PREFIX = struct.Struct("<8s4sIIIQQ16s8x")  # magic, kind, version, header bytes, zero, payload bytes, raw bytes, digest, zero
PREFIX_BYTES = _PREFIX.size
_DIGEST_OFFSET = 40
_DTYPES = ("u1", "u2", "u4", "i1", "i2", "i4", "f2", "f4")
# Largest array data that a reader accepts: a sector of 1000 probes stays below 64 MiB.
MAX_RAW_BYTES = 1 << 28
MAX_HEADER_BYTES = 1 << 20
MAX_ARRAYS = 64
MAX_FILE_BYTES = PREFIX_BYTES + MAX_HEADER_BYTES + MAX_RAW_BYTES
# Steps between which a thread that loads may wait. Of the packed ones none can make more than half of MAX_RAW_BYTES: a block of zstd takes
# four bytes at least and gives 128 kB at most.
_STEP_BYTES, _PACKED_STEP_BYTES = 1 << 17, 1 << 12
# A higher level takes a tenth of a second more for a sector of the preset talk, a fifth of its bake, and saves 4 %.
ZSTD_LEVEL = 12


@dataclass(frozen=True)
class Container:
    """A file's contents: a small JSON object and named arrays, in one of the format's versions."""

    meta: dict[str, Any]
    arrays: dict[str, AnyArray]
    version: int

    def take(self, name: str, dtype: str, ndim: int) -> AnyArray:
        """The array of that name. Raises CorruptFileError when it is absent or of another dtype or rank."""
        give_way()
        found = self.arrays.get(name)
        if found is None:
            raise CorruptFileError(f"array {name!r} is missing; it has {sorted(self.arrays)}")
        if found.dtype != np.dtype(dtype) or found.ndim != ndim:
            raise CorruptFileError(f"array {name!r}: expected {dtype} with {ndim} axes, found {found.dtype.str} {found.shape}")
        return found

    def refuse_unknown(self, meta: frozenset[str], arrays: frozenset[str]) -> None:
        """Raise CorruptFileError when the file has members of meta or arrays besides these: they would change what it means."""
        unknown = sorted((set(self.meta) - meta) | (set(self.arrays) - arrays))
        if unknown:
            raise CorruptFileError(f"expected no such member or array as {', '.join(map(ascii, unknown))[:60]}")


def encode(
    kind: str,
    version: int,
    meta: dict[str, Any],
    arrays: dict[str, AnyArray],
    delta: frozenset[str] = frozenset(),
    level: int = ZSTD_LEVEL,
) -> bytes:
    """Bytes of a container. ``level`` : of zstd.

    ``delta`` names integer arrays that are stored as differences along their last axis (they wrap around). Multi-byte values are
    stored as byte planes, least significant first, which compress far better than interleaved bytes.
    """
    table: list[dict[str, Any]] = []
    planes: list[bytes] = []
    for name, values in arrays.items():
        code = values.dtype.newbyteorder("<").str[1:]
        if code not in _DTYPES:
            raise TypeError(f"array {name!r}: dtype {values.dtype} cannot be stored")
        table.append({"name": name, "dtype": code, "shape": list(values.shape), "delta": name in delta})
        planes += _pack(np.ascontiguousarray(values, np.dtype("<" + code)), name in delta)
    header = json.dumps({"meta": meta, "arrays": table}, separators=(",", ":"), sort_keys=True).encode()
    payload, raw_bytes = _compress(planes, level), sum(map(len, planes))
    prefix = _PREFIX.pack(MAGIC, kind.encode(), version, len(header), 0, len(payload), raw_bytes, bytes(16))
    digest = _digest(prefix, header, payload)
    return prefix[:_DIGEST_OFFSET] + digest + prefix[_DIGEST_OFFSET + 16 :] + header + payload


def decode(data: bytes, kind: str, version: int | tuple[int, ...], where: str) -> Container:
    """Contents of a container's bytes, of that version or one of those; ``where`` names the file in errors.

    Raises FormatVersionError for another kind or version, CorruptFileError for anything that does not fit together.
    """
    if len(data) < PREFIX_BYTES:
        raise CorruptFileError(f"{where}: expected at least {PREFIX_BYTES} bytes, found {len(data)}: the file is truncated; bake it again")
    magic, found_kind, found_version, header_bytes, _, payload_bytes, raw_bytes, digest = _PREFIX.unpack_from(data)
    if magic != MAGIC or found_kind != kind.encode():
        raise CorruptFileError(f"{where}: not a Sectorlight {kind} file (it starts with {data[:12]!r})")
    versions = (version,) if isinstance(version, int) else version
    if found_version not in versions:
        known = " or ".join(map(str, versions))
        raise FormatVersionError(
            f"{where}: format version {found_version}, this program reads version {known}; bake the dataset again with this program"
        )
    if header_bytes > MAX_HEADER_BYTES or raw_bytes > MAX_RAW_BYTES or len(data) != PREFIX_BYTES + header_bytes + payload_bytes:
        raise CorruptFileError(
            f"{where}: expected {PREFIX_BYTES + header_bytes + payload_bytes} bytes, found {len(data)}: truncated or altered; bake it again"
        )
    header, payload = data[PREFIX_BYTES : PREFIX_BYTES + header_bytes], data[PREFIX_BYTES + header_bytes :]
    if _digest(data[:PREFIX_BYTES], header, payload) != digest:
        raise CorruptFileError(f"{where}: checksum differs: the file was altered or damaged; bake it again")
    try:
        parsed = json.loads(header)
        # The frame's own size is what the decompressor allocates, whatever it is told.
        if zstandard.frame_content_size(payload) != raw_bytes:
            raise CorruptFileError(f"{where}: expected one zstd frame of {raw_bytes} bytes; bake it again")
        raw = _decompress(payload, raw_bytes)
        if not isinstance(parsed["meta"], dict):
            raise CorruptFileError(f"{where}: expected meta to be an object; bake it again")
        return Container(parsed["meta"], _read_arrays(parsed["arrays"], raw, where), found_version)
    except (zstandard.ZstdError, ValueError, KeyError, TypeError, RecursionError) as error:
        if isinstance(error, CorruptFileError):
            raise
        raise CorruptFileError(f"{where}: {error}; bake it again") from error


def read_bytes(path: Path, most: int = MAX_FILE_BYTES) -> bytes:
    """A file's bytes. Raises CorruptFileError for one of more than ``most`` bytes, before it is read, and OSError."""
    size = path.stat().st_size
    if size > most:
        raise CorruptFileError(f"{path}: expected at most {most} bytes, found {size}; bake it again")
    return path.read_bytes()


def write_atomic(path: Path, data: bytes) -> None:
    """Write a file that is either there whole or not at all: a unique ``.partial`` beside it, flushed to disk, then renamed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, partial = tempfile.mkstemp(dir=path.parent, prefix=path.name + ".", suffix=".partial")
    try:
        with os.fdopen(handle, "wb") as out:
            out.write(data)
            out.flush()
            os.fsync(out.fileno())
        os.chmod(partial, 0o644)  # mkstemp gives 0600; a dataset is there to be served
        os.replace(partial, path)
    except BaseException:
        Path(partial).unlink(missing_ok=True)
        raise


def _digest(prefix: bytes, header: bytes, payload: bytes) -> bytes:
    h = hashlib.blake2b(digest_size=16)
    h.update(prefix[:_DIGEST_OFFSET])
    h.update(header)
    view = memoryview(payload)
    for at in range(0, len(view), _STEP_BYTES):
        give_way()
        h.update(view[at : at + _STEP_BYTES])
    return h.digest()


def _decompress(payload: bytes, raw_bytes: int) -> bytearray:
    """One zstd frame whose size is known. Raises zstandard.ZstdError, and ValueError for what is not one whole frame of that size."""
    raw = bytearray(raw_bytes)
    at = 0
    frame = zstandard.ZstdDecompressor().decompressobj()
    for start in range(0, len(payload), _PACKED_STEP_BYTES):
        give_way()
        made = frame.decompress(payload[start : start + _PACKED_STEP_BYTES])
        if frame.unused_data or at + len(made) > raw_bytes:
            raise ValueError("more than one zstd frame")
        raw[at : at + len(made)] = made
        at += len(made)
    if at != raw_bytes or not frame.eof:
        raise ValueError("the zstd frame is cut off")
    return raw


def interleaved(rows: AnyArray) -> AnyArray:
    """(k, n) -> (n, k) in memory, of few and long rows: row by row, in half the time that NumPy's transposition takes."""
    out = np.empty(rows.shape[::-1], rows.dtype)
    for k, row in enumerate(rows):
        out[:, k] = row
    return out


def _compress(planes: Sequence[bytes], level: int) -> bytes:
    """One frame, in which each plane begins a block: a block has one code for all of its bytes, which suits one kind of them. 1 % less."""
    filled = [plane for plane in planes if plane]
    packer = zstandard.ZstdCompressor(level=level, write_checksum=True).compressobj(size=sum(map(len, filled)))
    packed = [part for plane in filled for part in (packer.compress(plane), packer.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK))]
    return b"".join([*packed, packer.flush()])


def _pack(values: AnyArray, delta: bool) -> list[bytes]:
    """The byte planes of an array."""
    if delta and values.size:
        values = np.concatenate([values[..., :1], np.diff(values, axis=-1)], axis=-1)
    octets = values.reshape(-1).view(np.uint8).reshape(-1, values.dtype.itemsize)
    return [plane.tobytes() for plane in octets.T]


def _unpack(raw: memoryview, dtype: "np.dtype[Any]", shape: tuple[int, ...], delta: bool) -> AnyArray:
    values: AnyArray = interleaved(np.frombuffer(raw, np.uint8).reshape(dtype.itemsize, -1)).reshape(-1).view(dtype).reshape(shape)
    if delta and values.size:
        values = np.cumsum(values, axis=-1, dtype=dtype)
    return values


def _read_arrays(table: list[dict[str, Any]], raw: bytearray, where: str) -> dict[str, AnyArray]:
    if len(table) > MAX_ARRAYS:
        raise CorruptFileError(f"{where}: expected at most {MAX_ARRAYS} arrays, found {len(table)}")
    arrays: dict[str, AnyArray] = {}
    offset = 0
    for entry in table:
        give_way()
        name, code, shape = str(entry["name"]), str(entry["dtype"]), entry["shape"]
        delta = entry["delta"] is True
        if code not in _DTYPES or (delta and code[0] == "f") or name in arrays:
            raise CorruptFileError(f"{where}: array {name!r} of dtype {code!r} is not one that this format knows")
        if not isinstance(shape, list) or not all(type(n) is int and 0 <= n <= MAX_RAW_BYTES for n in shape):
            raise CorruptFileError(f"{where}: array {name!r} has shape {shape!r}")
        dtype = np.dtype("<" + code)
        size = math.prod(shape) * dtype.itemsize
        # An axis of length 0 must not hide lengths that what is computed from the array would have.
        if math.prod(max(n, 1) for n in shape) > MAX_RAW_BYTES:
            raise CorruptFileError(f"{where}: array {name!r} has shape {shape!r}")
        if offset + size > len(raw):
            raise CorruptFileError(f"{where}: array {name!r} ends beyond the data")
        arrays[name] = _unpack(memoryview(raw)[offset : offset + size], dtype, tuple(shape), delta)
        offset += size
    if offset != len(raw):
        raise CorruptFileError(f"{where}: {len(raw) - offset} bytes belong to no array")
    return arrays
