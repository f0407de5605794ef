"""Measures the player stream on a dataset: python tests/load/measure_frames.py DATASET

A player walks through the middle of the city. One volume is asked for each step of a voxel; between two steps, at 30 ticks per second,
the same volume comes again. Prints bytes and CPU time of encoder and decoder, with the clock at its normal rate and 60 times as fast.
"""

import sys
import time
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np

from gi_core.constants import VOXEL_SIZE_M
from gi_core.dataset import Dataset
from gi_core.engine import Engine
from gi_core.volume import Volume
from server.stream_header import StreamHeader
from server.volume_frames import VolumeDecoder, VolumeEncoder

SPEED_M_S = 5.0
STEPS = 32
START = datetime(2024, 6, 21, 13, 0)


def walk(engine: Engine, clock_rate: int) -> list[Volume]:
    """The volumes of a walk to the east, one for each step of a voxel."""
    low, high = engine.dataset.world.bounds
    start = (low + high) / 2
    start[1] = low[1] + 6.0
    volumes = []
    for step in range(STEPS):
        moment = START + timedelta(seconds=int(step * VOXEL_SIZE_M / SPEED_M_S * clock_rate))
        lighting = engine.lighting(moment.isoformat(), "clear")
        volumes.append(engine.volume(start + np.array([step * VOXEL_SIZE_M, 0.0, 0.0]), lighting))
    return volumes


def measure(name: str, volumes: list[Volume]) -> None:
    """Print one line: what a stream of the volumes costs."""
    header = StreamHeader()
    encoder, decoder = VolumeEncoder(header), VolumeDecoder(header)
    ticks_per_step = int(VOXEL_SIZE_M / SPEED_M_S * header.tick_rate)
    sizes, counts, encoding, decoding, comparing = [], [], [], [], []
    for number, volume in enumerate(volumes):
        tick = number * ticks_per_step
        started = time.thread_time()
        message = encoder.encode(tick, volume.values, volume.mask, volume.first_voxel, 0)
        encoded = time.thread_time()
        assert message is not None
        frame = decoder.decode(message)
        decoded = time.thread_time()
        assert encoder.encode(tick + 1, volume.values, volume.mask, volume.first_voxel, 0) is None
        comparing.append(time.thread_time() - decoded)
        sizes.append(len(message))
        counts.append(frame.prefix.count)
        encoding.append(encoded - started)
        decoding.append(decoded - encoded)
    seconds = (len(volumes) - 1) * ticks_per_step / header.tick_rate
    encode_ms, decode_ms, compare_ms = (1e3 * float(np.median(times[1:])) for times in (encoding, decoding, comparing))
    print(
        f"{name}: full {sizes[0]} B, step {np.median(sizes[1:]):.0f} B of {np.median(counts[1:]):.0f} voxels, "
        f"{8e-6 * sum(sizes[1:]) / seconds:.3f} Mbit/s; encode {encode_ms:.2f} ms, decode {decode_ms:.2f} ms, "
        f"a tick without change {compare_ms:.2f} ms"
    )


def main() -> None:
    """Measure the dataset that the first argument names."""
    engine = Engine(Dataset.open(Path(sys.argv[1])))
    for rate in (1, 60):
        measure(f"clock at {rate} x", walk(engine, rate))


if __name__ == "__main__":
    main()
