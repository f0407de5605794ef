"""The stream's frames: a client holds what the server thinks it holds, bit for bit, and damaged bytes change nothing."""

import struct
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st

from gi_core.constants import VOXEL_NO_SECTOR, VOXEL_OUTDOORS
from server.frame_prefix import MAGIC, PREFIX_BYTES, FrameKind
from server.stream_header import FrameLostError, StreamError, StreamHeader
from server.volume_frames import VolumeDecoder, VolumeEncoder

SMALL = StreamHeader(shape=(6, 4, 5, 6))
NOW = 1_700_000_000_000_000


class World:
    """Light that is a function of the place in the world, so that a volume may move through it."""

    def __init__(self, header=SMALL, seed=0, peak=1e5):
        self.header, rng = header, np.random.default_rng(seed)
        size = (header.shape[0], *(3 * n for n in header.shape[1:]), 3)
        self.light = (peak * rng.uniform(0, 1, size) ** 6).astype(np.float32)
        self.classes = rng.integers(0, 4, size[1:4]).astype(np.uint8)
        self.rng = rng

    def volume(self, first):
        y, z, x = (slice(start, start + count) for start, count in zip(np.asarray(first)[[1, 2, 0]], self.header.shape[1:], strict=True))
        return self.light[:, y, z, x].copy(), self.classes[y, z, x].copy()

    def change(self, share, factor):
        self.light[:, self.rng.uniform(size=self.light.shape[1:4]) < share] *= np.float32(factor)


class Both:
    """An encoder and its client."""

    def __init__(self, header=SMALL):
        self.header, self.encoder, self.decoder, self.tick = header, VolumeEncoder(header), VolumeDecoder(header), 0

    def send(self, values, mask, first=(0, 0, 0)):
        self.tick += 1
        message = self.encoder.encode(self.tick, values, mask, np.asarray(first), NOW)
        return None if message is None else self.decoder.decode(message, compare=True)

    def expect_same(self):
        mirror = self.encoder._mirror
        assert np.array_equal(self.decoder.values.reshape(mirror.values.shape).view("u4"), mirror.values.view("u4"))
        assert np.array_equal(self.decoder.mask.reshape(-1), mirror.mask)
        assert np.array_equal(self.decoder.first_voxel, mirror.first_voxel)
        assert self.decoder.tick == mirror.tick

    def expect_close(self, values, mask):
        largest = np.abs(values).max(axis=(0, 4))
        # 2^-11: what a half float rounds; it comes on top where a voxel was sent just before.
        bound = (self.header.threshold + 2.0**-11) * largest + self.header.floor * largest.max() + 1e-9
        assert (np.abs(self.decoder.values - values).max(axis=(0, 4)) <= bound).all()
        assert np.array_equal(self.decoder.mask, mask)


STEPS = st.tuples(*[st.integers(-1, 1) | st.integers(0, 8)] * 3)


@settings(max_examples=60, deadline=None)
@given(st.data(), st.integers(0, 1000), st.sampled_from([1e-12, 1e-3, 1.0, 1e5, 1e9, 1e30]))
def test_a_client_holds_the_server_s_mirror_whatever_happens(data, seed, peak):
    world, both = World(seed=seed, peak=peak), Both()
    for _ in range(data.draw(st.integers(1, 8))):
        first = np.clip(data.draw(STEPS), 0, [12, 8, 10])
        world.change(data.draw(st.sampled_from([0.0, 0.05, 1.0])), data.draw(st.sampled_from([0.0, 0.5, 0.995, 1.004, 1.5])))
        if data.draw(st.integers(0, 9)) == 0:
            both.encoder.forget()
        values, mask = world.volume(first)
        both.send(values, mask, first)
        both.expect_same()
        both.expect_close(values, mask)
        assert both.send(values, mask, first) is None  # settled: nothing to say


def test_a_settled_world_sends_nothing_and_a_changed_voxel_sends_itself():
    world, both = World(), Both()
    values, mask = world.volume((0, 0, 0))
    assert both.send(values, mask).prefix.kind == FrameKind.FULL
    assert all(both.send(values, mask) is None for _ in range(10))
    values[:, 1, 2, 3] = 777
    frame = both.send(values, mask)
    assert frame.prefix.kind == FrameKind.DELTA
    assert frame.chosen.tolist() == [(1 * 5 + 2) * 6 + 3]
    assert frame.prefix.elapsed == 1
    mask[3, 4, 5] = VOXEL_NO_SECTOR if mask[3, 4, 5] != VOXEL_NO_SECTOR else VOXEL_OUTDOORS
    assert both.send(values, mask).chosen.tolist() == [4 * 5 * 6 - 1]


def test_what_a_voxel_held_before_is_told():
    world, both = World(), Both()
    values, mask = world.volume((2, 2, 2))
    both.send(values, mask, (2, 2, 2))
    held = both.decoder.values.copy()
    world.light *= np.float32(2)
    frame = both.send(*world.volume((3, 2, 2)), (3, 2, 2))
    before = frame.before.reshape(6, 4, 5, 6, 3)
    assert np.array_equal(before[:, :, :, :-1], held[:, :, :, 1:])
    assert np.isnan(before[:, :, :, -1]).all()


def test_a_walk_sends_only_the_slabs_that_enter():
    world, both = World(), Both()
    both.send(*world.volume((0, 1, 1)), (0, 1, 1))
    for x in range(1, 6):
        frame = both.send(*world.volume((x, 1, 1)), (x, 1, 1))
        assert frame.prefix.count == 4 * 5
        assert (frame.chosen % 6 == 5).all()


def test_small_steps_never_add_up():
    """Ten times 0.3 % is 3 %: the client follows though no single step is worth a message."""
    world, both = World(), Both()
    values, mask = world.volume((0, 0, 0))
    both.send(values, mask)
    sent = 0
    for _ in range(100):
        values *= np.float32(1.003)
        sent += both.send(values, mask) is not None
        both.expect_close(values, mask)
    assert 20 <= sent <= 40


def test_a_light_switched_on_and_off_leaves_no_trace():
    both = Both()
    dark, mask = np.zeros((*SMALL.shape, 3), np.float32), np.ones(SMALL.shape[1:], np.uint8)
    both.send(dark, mask)
    for brightness in (1e-3, 1.0, 5e8):
        lit = dark.copy()
        lit[:, :2] = brightness
        both.send(lit, mask)
        assert both.decoder.values.max() == pytest.approx(brightness, rel=2**-11)
        both.send(dark, mask)
        assert not both.decoder.values.any()


def test_light_too_faint_for_any_scale_is_not_sent_for_ever():
    both = Both()
    values, mask = np.full((*SMALL.shape, 3), 1e-20, np.float32), np.ones(SMALL.shape[1:], np.uint8)
    both.send(values, mask)
    assert both.send(values, mask) is None
    assert not both.decoder.values.any()


def test_a_read_only_volume_is_not_looked_at_again_but_a_writeable_one_is():
    world, both = World(), Both()
    values, mask = world.volume((0, 0, 0))
    both.send(values, mask)
    values *= 2
    assert both.send(values, mask).prefix.count > 0
    values *= 2
    values.setflags(write=False)
    assert both.send(values, mask).prefix.count > 0
    assert both.send(values, mask) is None
    assert both.send(values, np.zeros_like(mask)) is not None
    both.encoder.forget()
    assert both.send(values, mask).prefix.kind == FrameKind.FULL
    both.expect_same()


def test_a_lost_frame_is_noticed_and_a_full_one_mends_it():
    world, both = World(), Both()
    both.send(*world.volume((0, 0, 0)))
    world.light *= 2
    assert both.encoder.encode(5, *world.volume((0, 0, 0)), np.zeros(3), NOW) is not None  # lost
    world.light *= 2
    held = both.decoder.values.copy()
    late = both.encoder.encode(6, *world.volume((0, 0, 0)), np.zeros(3), NOW)
    with pytest.raises(FrameLostError, match="full"):
        both.decoder.decode(late)
    assert np.array_equal(both.decoder.values, held)
    both.encoder.forget()
    both.tick = 6
    both.send(*world.volume((0, 0, 0)))
    both.expect_same()
    with pytest.raises(FrameLostError):
        VolumeDecoder(SMALL).decode(late)


def test_signed_coefficients_travel_too():
    header = replace(SMALL, shape=(9, 4, 5, 6), basis="sh2")
    world, both = World(header), Both(header)
    world.light -= np.float32(3e4)
    both.send(*world.volume((0, 0, 0)))
    world.light *= np.float32(-0.7)
    values, mask = world.volume((1, 0, 0))
    both.send(values, mask, (1, 0, 0))
    both.expect_same()
    both.expect_close(values, mask)


def read_by_the_book(message, header, values, mask):
    """A reader written from STREAM.md alone, for frames that don't move: fills values (B, N, 3) and mask (N,)."""
    magic, version, kind, zero, tick, base, _, x, y, z, scale, count, _ = struct.unpack_from("<4sBBHQQQiiifII", message)
    assert (magic, version, zero) == (MAGIC, 1, 0)
    raw = zstandard.ZstdDecompressor().decompress(message[56:])
    chosen = np.arange(count)
    if kind == 1:
        bits = (header.voxels + 7) // 8
        chosen = np.flatnonzero(np.unpackbits(np.frombuffer(raw[:bits], np.uint8)))
        raw = raw[bits:]
    mask[chosen] = np.frombuffer(raw[:count], np.uint8)
    low, high = np.frombuffer(raw[count:], np.uint8).reshape(2, -1)
    halves = np.stack([low, high], axis=1).reshape(-1).view("<f2")
    values[:, chosen] = halves.reshape(header.shape[0], count, 3).astype(np.float32) * np.float32(scale)
    return tick, base, (x, y, z)


def test_frames_are_as_documented():
    world, both = World(), Both()
    values, mask = np.zeros((6, SMALL.voxels, 3), np.float32), np.zeros(SMALL.voxels, np.uint8)
    for tick, base, factor in ((3, 0, 1.0), (9, 3, 1.5)):
        world.change(0.3, factor)
        message = both.encoder.encode(tick, *world.volume((1, 2, 3)), np.array([1, 2, 3]), NOW)
        assert read_by_the_book(message, SMALL, values, mask) == (tick, base, (1, 2, 3))
        both.decoder.decode(message)
        assert np.array_equal(values, both.decoder.values.reshape(values.shape))
        assert np.array_equal(mask, both.decoder.mask.reshape(-1))


def pair_of_messages():
    world, encoder = World(), VolumeEncoder(SMALL)
    full = encoder.encode(1, *world.volume((1, 1, 1)), np.ones(3), NOW)
    world.change(0.3, 2.0)
    return full, encoder.encode(2, *world.volume((2, 1, 1)), np.array([2, 1, 1]), NOW)


@settings(max_examples=300, deadline=None)
@given(st.data(), st.booleans())
def test_damaged_bytes_are_refused_and_change_nothing(data, of_full):
    full, delta = pair_of_messages()
    decoder = VolumeDecoder(SMALL)
    decoder.decode(full)
    held = decoder.values.copy()
    message = bytearray(full if of_full else delta)
    for _ in range(data.draw(st.integers(1, 3))):
        message[data.draw(st.integers(0, len(message) - 1))] ^= data.draw(st.integers(1, 255))
    message = message[: data.draw(st.integers(0, 4 * len(message)))]
    tracemalloc.start()
    try:
        decoder.decode(bytes(message))
    except StreamError:
        assert np.array_equal(decoder.values, held)
        assert decoder.tick == 1
    else:  # only numbers of the prefix that any value may have were touched
        assert np.isfinite(decoder.values).all()
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 1 << 20


def test_random_bytes_are_refused():
    rng, decoder = np.random.default_rng(0), VolumeDecoder(SMALL)
    for length in (0, 1, PREFIX_BYTES - 1, PREFIX_BYTES, 5000):
        with pytest.raises(StreamError):
            decoder.decode(rng.bytes(length))
        with pytest.raises(StreamError):
            decoder.decode(MAGIC + b"\x01\x00\x00\x00" + rng.bytes(length))


def forged(raw, kind=FrameKind.FULL, count=SMALL.voxels, tick=2, first=(1, 1, 1), scale=1.0, **options):
    prefix = struct.pack("<4sBBHQQQiiifII", MAGIC, 1, kind, 0, tick, 1 if kind else 0, NOW, *first, scale, count, 1)
    return prefix + zstandard.ZstdCompressor(write_checksum=options.pop("checksum", True), **options).compress(raw)


VOXEL = 1 + 6 * 3 * 2
LIGHT = bytes(SMALL.voxels * VOXEL)


@pytest.mark.parametrize(
    "message",
    [
        forged(bytes(1 << 28)),
        forged(LIGHT[:-1]),
        forged(LIGHT + b"\0"),
        forged(LIGHT, checksum=False),
        forged(LIGHT, write_content_size=False),
        forged(LIGHT) + b"more",
        forged(LIGHT, count=SMALL.voxels - 1),
        forged(b"\x04" + LIGHT[1:]),
        forged(LIGHT[:-1] + b"\x7c"),
        forged(LIGHT, scale=3.0),
        forged(LIGHT, scale=float("nan")),
        forged(LIGHT, scale=-1.0),
        forged(LIGHT, scale=0.0),
        forged(LIGHT, scale=float("inf")),
        forged(bytes(15 + VOXEL), FrameKind.DELTA, count=1),
        forged(b"\xff" + bytes(14 + VOXEL), FrameKind.DELTA, count=1),
        forged(b"\x80" + bytes(14 + VOXEL), FrameKind.DELTA, count=1, first=(2, 1, 1)),
        forged(b"\x80" + bytes(14 + VOXEL), FrameKind.DELTA, count=1, first=(7, 1, 1)),
        forged(b"\x80" + bytes(14 + VOXEL), FrameKind.DELTA, count=0),
        forged(b"\x80" + bytes(14 + VOXEL), FrameKind.DELTA, count=1 << 31),
        forged(b"\x80" + bytes(14 + VOXEL), FrameKind.DELTA, count=1, tick=1),
    ],
    ids=[
        "bomb",
        "short",
        "long",
        "unchecked",
        "unsized",
        "trailing",
        "count",
        "class",
        "infinite",
        "three",
        "nan",
        "negative",
        "zero",
        "inf",
        "none",
        "many",
        "hole",
        "away",
        "empty",
        "huge",
        "again",
    ],
)
def test_forged_frames_are_refused_without_much_memory(message):
    decoder = VolumeDecoder(SMALL)
    decoder.decode(pair_of_messages()[0])
    held = decoder.values.copy()
    tracemalloc.start()
    with pytest.raises(StreamError):
        decoder.decode(message)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 1 << 20
    assert np.array_equal(decoder.values, held)


def test_an_honest_forgery_is_taken():
    """So that the refusals above are for the reason they name."""
    decoder = VolumeDecoder(SMALL)
    decoder.decode(forged(LIGHT, tick=1))
    decoder.decode(forged(b"\x80" + bytes(14 + VOXEL), FrameKind.DELTA, count=1))
    assert decoder.tick == 2


def test_an_encoder_refuses_what_it_cannot_say():
    world, encoder = World(), VolumeEncoder(SMALL)
    values, mask = world.volume((0, 0, 0))
    encoder.encode(5, values, mask, np.zeros(3), NOW)
    with pytest.raises(ValueError, match="tick"):
        encoder.encode(5, values, mask, np.zeros(3), NOW)
    with pytest.raises(ValueError, match="32 bits"):
        encoder.encode(6, values, mask, np.array([1 << 31, 0, 0]), NOW)
    values[0, 0, 0, 0, 0] = np.nan
    with pytest.raises(ValueError, match="finite"):
        encoder.encode(7, values, mask, np.zeros(3), NOW)
