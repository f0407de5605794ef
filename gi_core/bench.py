"""Timings, each beside its baseline in one run: here decode, in ``bench_relight`` the relighter, in ``bench_volume`` volumes. Any device.

Made-up sectors of the talk's size.

"Talk size" is the average sector of the talk's Manhattan: 294 probes, 14 355 surfels, 29 400 factors.
"""

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from gi_core import factor_weights, sector_file
from gi_core.constants import BRICK_CELL_M
from gi_core.device import Device, shared_device
from gi_core.grid import SectorIndex
from gi_core.layout import DIRECTIONAL_LIGHT
from gi_core.relight_input import RelightInput
from gi_core.resident_sector import ResidentSector
from gi_core.sector import Sector, starts

TALK_PROBES, TALK_SURFELS, TALK_FACTORS = 294, 14_355, 29_400
SURFELS_PER_BRICK = 7
SKY_PATCHES = 6
SUN_PLANES = 89  # of the talk preset at 40 degrees north
# Ticks rotate over this many sectors, so that no tick finds the last one's data in the nearest cache.
ROTATION = 8


@dataclass(frozen=True)
class Measurement:
    """One row of ``bench --json``. ``median`` and ``baseline`` are in ``unit``; ``ratio`` is how many times as good the median is:

    baseline / median where they are times, median / baseline where they are rates. Above 1, the median is the better of the two.
    """

    name: str
    median: float
    unit: str
    baseline: float
    ratio: float
    sizes: dict[str, int]
    device: str
    baseline_is: str

    def to_json(self) -> dict[str, Any]:
        """The row as a JSON object."""
        return asdict(self)


def side_by_side(measured: Callable[[], object], baseline: Callable[[], object], rounds: int, calls: int = 1) -> tuple[float, float]:
    """Median wall times [s] of two things that take turns, so that whatever else the machine does meets both.

    Every round is ``calls`` calls of ``measured`` and one of ``baseline``; one of each, before all, is not counted.
    """
    taken: tuple[list[float], list[float]] = ([], [])
    measured()
    baseline()
    for _ in range(rounds):
        for run, times, count in ((measured, taken[0], calls), (baseline, taken[1], 1)):
            for _ in range(count):
                started = time.perf_counter()
                run()
                times.append(time.perf_counter() - started)
    return float(np.median(taken[0])), float(np.median(taken[1]))


def talk_size_sector(seed: int, probes: int = TALK_PROBES, surfels: int = TALK_SURFELS, factors: int = TALK_FACTORS) -> Sector:
    """A made-up sector of the talk's average size, no kinder to a cache or a loop than a real one.

    Seven surfels a brick, where baked cities have 7.4 to 12: more bricks to visit. A brick's normals lean by some 12 degrees off its
    direction and its surfels read one of two probes, so a surfel has 0.86 bounces, where cities have 0.2 to 0.6. Bricks lie in order of
    place and a probe's bricks near one another, as in a bake. `python -m gi_core.bench_relight DATASET` counts the same of a dataset.
    """
    rng = np.random.default_rng(seed)
    bricks = max(surfels // SURFELS_PER_BRICK, 1)
    brick_sizes = np.full(bricks, surfels // bricks, np.int64)
    brick_sizes[: surfels - int(brick_sizes.sum())] += 1
    of_surfel = np.repeat(np.arange(bricks), brick_sizes)
    cell = rng.integers(0, 16, (bricks, 3))
    cell = cell[np.lexsort(cell.T)]
    direction = rng.integers(0, 6, bricks)
    normal = rng.normal(0, 0.15, (bricks, 3))[of_surfel] + rng.normal(0, 0.02, (surfels, 3))
    normal[np.arange(surfels), direction[of_surfel] // 2] = 1 - 2.0 * (direction[of_surfel] % 2)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    feedback = rng.integers(0, probes, (bricks, 2))[of_surfel, (rng.random(surfels) < 0.3).astype(int)]
    per_probe = factors // probes
    middle = rng.integers(0, bricks, probes)[:, None]
    near = (middle + rng.integers(-(bricks // 4) - 1, bricks // 4 + 1, (probes, per_probe - SKY_PATCHES))) % bricks
    sky = np.tile(bricks + np.arange(SKY_PATCHES), (probes, 1))
    weight = rng.uniform(0, 1, (factors, 6)) ** 4
    weight /= weight.reshape(probes, per_probe, 6).sum(axis=1).repeat(per_probe, axis=0)
    factor_starts = starts(np.full(probes, per_probe))
    source = np.concatenate([np.sort(near, axis=1), sky], axis=1).reshape(-1).astype(np.uint32)
    codes = factor_weights.encode(weight, factor_starts, source >= bricks)
    shape = (16, 20, 20)
    return Sector(
        index=SectorIndex(0, 0),
        probe_position=rng.uniform(0, 64, (probes, 3)).astype(np.float32),
        probe_flags=np.ones(probes, np.uint8),
        probe_room=np.zeros(probes, np.uint16),
        factor_starts=factor_starts,
        factor_source=source,
        **codes._asdict(),
        brick_starts=starts(brick_sizes),
        brick_level=np.zeros(bricks, np.uint8),
        brick_cell=cell.astype(np.int32),
        brick_direction=direction.astype(np.uint8),
        surfel_position=((cell[of_surfel] + rng.uniform(0, 1, (surfels, 3))) * BRICK_CELL_M).astype(np.float32),
        surfel_normal=normal.astype(np.float32),
        surfel_albedo=rng.uniform(0, 0.6, (surfels, 3)).astype(np.float32),
        surfel_snow=np.zeros(surfels, np.float32),
        surfel_emission=None,
        feedback_probe=feedback[:, None].astype(np.uint16),
        feedback_weight=np.ones((surfels, 1), np.float32),
        sun_visibility=rng.integers(0, 2**32, (SUN_PLANES, (surfels + 31) // 32), dtype=np.uint32),
        voxel_first=np.array([0, 0, 0], np.int32),
        voxel_class=np.ones(shape, np.uint8),
        voxel_room=np.zeros(shape, np.uint16),
        voxel_probe=rng.integers(0, probes, (*shape, 4)).astype(np.uint16),
        voxel_weight=np.full((*shape, 4), 0.25, np.float32),
    )


def daylight() -> RelightInput:
    """A high sun and a blue sky."""
    sun = np.zeros(1, DIRECTIONAL_LIGHT.dtype)
    sun["direction"][0, :3] = (0.4, 0.8, 0.447)
    sun["irradiance"][0, :3] = (1.1e5, 9.5e4, 7.5e4)
    sun["plane"], sun["plane_weight"] = (10, 11, 30, 31), (0.4, 0.3, 0.2, 0.1)
    return RelightInput(np.full((SKY_PATCHES, 3), (1.2e4, 1.4e4, 1.8e4), np.float32), sun)


def bench_decode(device: Device, sector: Sector, name: str, rounds: int) -> Measurement:
    """From a sector's file in memory to its buffers on the device. Baseline: decompressing the same bytes and no more."""
    import zstandard

    data = sector_file.encode(sector, {}, SKY_PATCHES)

    def decode() -> None:
        ResidentSector(device, sector_file.decode(data, "bench")[0], SKY_PATCHES)
        device.queue.finish()

    payload = data[data.index(b"\x28\xb5\x2f\xfd") :]
    alone = zstandard.ZstdDecompressor()
    milliseconds, baseline = (1e3 * s for s in side_by_side(decode, lambda: alone.decompress(payload), rounds))
    sizes = {"bytes": len(data), "factors": sector.factor_count}
    return Measurement(name, milliseconds, "ms", baseline, baseline / milliseconds, sizes, device.name, "zstd alone")


def run(device_name: str | None = None, quick: bool = False) -> list[Measurement]:
    """All measurements of this module on one device; ``quick`` ones are a look, not a result. Raises DeviceError."""
    from gi_core import bench_basis, bench_relight, bench_roofline, bench_volume  # these import this module
    from gi_core.bench_lamps import bench_lamps

    device = shared_device(device_name)
    relight = bench_relight.run(device, quick)
    volumes = [bench(device, 10 if quick else 100) for bench in (bench_volume.bench_fill, bench_volume.bench_step)]
    made_up = {"sector_decode": talk_size_sector(0), "sector_decode_sh2": bench_basis.sector_in("sh2", 0)}
    decodes = [bench_decode(device, sector, name, 3 if quick else 30) for name, sector in made_up.items()]
    rows = [*relight, *volumes, *decodes, *bench_lamps(device, quick)]
    return rows if quick else [*rows, *bench_basis.run(device), *bench_roofline.run(device.name)]
