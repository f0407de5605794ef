"""Packing a volume as it is served, in every format, beside copying the packed bytes in memory."""

import itertools
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from gi_core.bench import Measurement, side_by_side
from gi_core.dataset import Dataset
from gi_core.engine import Engine
from gi_core.volume import Volume
from server.bench import volume_place
from server.dependencies import VolumeFormatQuery
from server.routes.volume import light_body
from server.stream_header import StreamHeader
from server.volume_frames import VolumeEncoder

# Of the cube: the name of a row, and what a client asks for.
FORMATS = {
    "npy": VolumeFormatQuery(format="npy", encoding="f16", mask=False),
    "f16": VolumeFormatQuery(format="raw", encoding="f16", mask=False),
    "rgb9e5": VolumeFormatQuery(format="raw", encoding="rgb9e5", mask=False),
    "ktx2_f16": VolumeFormatQuery(format="ktx2", encoding="f16", mask=False),
    "ktx2_rgb9e5": VolumeFormatQuery(format="ktx2", encoding="rgb9e5", mask=False),
}


def bench_pack(dataset_path: Path, device: str | None = None, rounds: int = 100) -> list[Measurement]:
    """A row for each format of ``GET /v1/volume``, and one for a stream's first frame, of a clear noon. Median [us].

    Raises what Dataset.open and Engine raise, and BenchError.
    """
    dataset = Dataset.open(dataset_path)
    engine = Engine(dataset, device)
    volume = engine.volume(volume_place(dataset), engine.lighting("12:00", "clear"), basis="cube")
    packed: dict[str, Callable[[], bytes]] = {name: partial(_reply, volume, query) for name, query in FORMATS.items()}
    packed["stream"] = first_frames(volume)
    return [_row(name, pack, rounds) for name, pack in packed.items()]


def first_frames(volume: Volume) -> Callable[[], bytes]:
    """What gives a stream's full frame of a volume at each call: halves, compressed with zstd."""
    encoder, ticks = VolumeEncoder(StreamHeader()), itertools.count()

    def pack() -> bytes:
        encoder.forget()
        frame = encoder.encode(next(ticks), volume.values, volume.mask, volume.first_voxel, 0)
        assert frame is not None
        return frame

    return pack


def _reply(volume: Volume, query: VolumeFormatQuery) -> bytes:
    return light_body(volume, query).content


def _row(name: str, pack: Callable[[], bytes], rounds: int) -> Measurement:
    content = np.frombuffer(pack(), np.uint8)
    copy = np.empty_like(content)
    median, baseline = (1e6 * s for s in side_by_side(pack, lambda: np.copyto(copy, content), rounds))
    return Measurement(f"volume_pack_{name}", median, "us", baseline, baseline / median, {"bytes": content.size}, "CPU", "memcpy")
