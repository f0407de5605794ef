"""The file that all arrays live in: what goes in comes out, and nothing that was damaged does."""

import struct

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from gi_core import container
from gi_core.errors import CorruptFileError, FormatVersionError

DTYPES = [np.dtype(d) for d in ("u1", "<u2", "<u4", "<i2", "<i4", "<f2", "<f4")]


@settings(max_examples=60, deadline=None)
@given(st.lists(st.sampled_from(DTYPES).flatmap(lambda d: hnp.arrays(d, hnp.array_shapes(min_dims=1, max_dims=3, min_side=0))), max_size=5))
def test_any_arrays_come_back_bit_for_bit(arrays):
    named = {f"a{i}": values for i, values in enumerate(arrays)}
    delta = frozenset(name for name, values in named.items() if values.dtype.kind in "ui")
    found = container.decode(container.encode("TEST", 3, {"k": [1, "x"]}, named, delta), "TEST", 3, "here")
    assert found.meta == {"k": [1, "x"]}
    assert list(found.arrays) == list(named)
    for name, values in named.items():
        assert found.arrays[name].dtype == values.dtype
        assert found.arrays[name].tobytes() == np.ascontiguousarray(values).tobytes()
        assert found.arrays[name].shape == values.shape


@pytest.fixture(scope="module")
def data() -> bytes:
    return container.encode("TEST", 3, {"a": 1}, {"x": np.arange(1000, dtype=np.uint16)}, frozenset({"x"}))


@pytest.mark.parametrize("share", [0.0, 0.01, 0.1, 0.5, 0.9, 0.999])
def test_truncated_anywhere_is_refused_by_name(data, share):
    with pytest.raises(CorruptFileError, match=r"city/0_0\.gisec"):
        container.decode(data[: int(len(data) * share)], "TEST", 3, "city/0_0.gisec")


def test_every_flipped_bit_is_noticed(data):
    for byte in range(len(data)):
        altered = bytearray(data)
        altered[byte] ^= 0x10
        if altered[byte] == data[byte]:
            continue
        # Bytes 56 to 63 of the prefix are reserved and mean nothing.
        if 56 <= byte < 64:
            continue
        with pytest.raises((CorruptFileError, FormatVersionError)):
            container.decode(bytes(altered), "TEST", 3, "here")


def test_another_version_says_which_and_what_to_do(data):
    with pytest.raises(FormatVersionError, match=r"version 3.*reads version 4.*bake"):
        container.decode(data, "TEST", 4, "here")
    with pytest.raises(CorruptFileError, match="not a Sectorlight"):
        container.decode(data, "SECT", 3, "here")


def forged(header: bytes, raw: bytes, raw_bytes: int | None = None, payload: bytes | None = None) -> bytes:
    """A file with a right checksum around a wrong header: an attacker can compute checksums too."""
    payload = zstandard.ZstdCompressor(write_checksum=True).compress(raw) if payload is None else payload
    prefix = struct.pack(
        "<8s4sIIIQQ16s8x",
        container.MAGIC,
        b"TEST",
        3,
        len(header),
        0,
        len(payload),
        len(raw) if raw_bytes is None else raw_bytes,
        bytes(16),
    )
    digest = container._digest(prefix, header, payload)
    return prefix[:40] + digest + prefix[56:] + header + payload


@pytest.mark.parametrize(
    "header",
    [
        b"{}",
        b"[]",
        b"not json",
        b'{"meta":{},"arrays":[{"name":"x","dtype":"u4","shape":[1000000000000],"delta":false}]}',
        b'{"meta":{},"arrays":[{"name":"x","dtype":"u4","shape":[-4],"delta":false}]}',
        b'{"meta":{},"arrays":[{"name":"x","dtype":"O","shape":[2],"delta":false}]}',
        b'{"meta":{},"arrays":[{"name":"x","dtype":"u1","shape":[true],"delta":false}]}',
        b'{"meta":{},"arrays":[{"name":"x","dtype":"u1","shape":[4],"delta":false}]}',
        b'{"meta":{},"arrays":[{"name":"x","dtype":"u1","shape":[8],"delta":false},{"name":"x","dtype":"u1","shape":[0],"delta":false}]}',
        b'{"meta":{},"arrays":[{"name":"x","dtype":"f4","shape":[2],"delta":true}]}',
    ],
)
def test_a_forged_header_is_refused(header):
    with pytest.raises(CorruptFileError):
        container.decode(forged(header, bytes(8)), "TEST", 3, "here")


def test_a_decompression_bomb_is_refused_before_it_unpacks():
    bomb = forged(b'{"meta":{},"arrays":[]}', bytes(10), raw_bytes=1 << 40)
    with pytest.raises(CorruptFileError):
        container.decode(bomb, "TEST", 3, "here")


RAW = np.random.default_rng(1).integers(0, 9, 50_000).astype(np.uint8).tobytes()
FRAME = zstandard.ZstdCompressor(write_checksum=True).compress(RAW)
OF_RAW = b'{"meta":{},"arrays":[{"name":"x","dtype":"u1","shape":[50000],"delta":false}]}'


def test_a_frame_of_many_steps_is_read():
    assert len(FRAME) > 2 * container._PACKED_STEP_BYTES
    assert container.decode(forged(OF_RAW, RAW), "TEST", 3, "here").arrays["x"].tobytes() == RAW


@pytest.mark.parametrize(
    "payload",
    [FRAME + b"\0", FRAME + FRAME, FRAME + bytes(2 * container._PACKED_STEP_BYTES), FRAME[:-1], FRAME[:-4], FRAME[: len(FRAME) // 2]],
    ids=["a byte more", "two frames", "many bytes more", "without its last byte", "without its checksum", "half of it"],
)
def test_what_is_not_one_whole_frame_is_refused(payload):
    with pytest.raises(CorruptFileError):
        container.decode(forged(OF_RAW, RAW, payload=payload), "TEST", 3, "here")


def test_a_file_is_whole_or_absent(tmp_path, monkeypatch):
    target = tmp_path / "deep" / "file.bin"
    container.write_atomic(target, b"one")
    assert target.read_bytes() == b"one"

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(container.os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        container.write_atomic(target, b"two")
    assert target.read_bytes() == b"one"
    assert [p.name for p in target.parent.iterdir()] == ["file.bin"]
