"""Timings of relight, volume and decode, each beside its baseline in the same run. Made-up sectors of the talk's size; any device.

"Talk size" is the average sector of the talk's Manhattan: 294 probes, 14 355 surfels, 29 400 factors.
"""

import itertools
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from gi_core import relight_twin, sector_file
from gi_core.constants import VOLUME_SHAPE
from gi_core.device import Device, shared_device
from gi_core.grid import SectorIndex
from gi_core.layout import DIRECTIONAL_LIGHT
from gi_core.relight import Relighter
from gi_core.relight_input import RelightInput
from gi_core.resident_sector import ResidentSector
from gi_core.sector import Sector, starts
from gi_core.volume import box_record, plan_boxes

TALK_PROBES, TALK_SURFELS, TALK_FACTORS = 294, 14_355, 29_400
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


def talk_size_sector(seed: int) -> Sector:
    """A made-up sector of the talk's average size, with a real one's locality: a probe's bricks lie near one another in memory."""
    rng = np.random.default_rng(seed)
    bricks = TALK_SURFELS // 6
    brick_sizes = np.full(bricks, 6, np.int64)
    brick_sizes[: TALK_SURFELS - 6 * bricks] += 1
    normal = rng.normal(size=(TALK_SURFELS, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    per_probe = TALK_FACTORS // TALK_PROBES
    middle = rng.integers(0, bricks, TALK_PROBES)[:, None]
    near = (middle + rng.integers(-bricks // 4, bricks // 4, (TALK_PROBES, per_probe - SKY_PATCHES))) % bricks
    sky = np.tile(bricks + np.arange(SKY_PATCHES), (TALK_PROBES, 1))
    weight = rng.uniform(0, 1, (TALK_FACTORS, 6)) ** 4
    weight /= weight.reshape(TALK_PROBES, per_probe, 6).sum(axis=1).repeat(per_probe, axis=0)
    shape = (16, 20, 20)
    return Sector(
        index=SectorIndex(0, 0),
        probe_position=rng.uniform(0, 64, (TALK_PROBES, 3)).astype(np.float32),
        probe_flags=np.ones(TALK_PROBES, np.uint8),
        probe_room=np.zeros(TALK_PROBES, np.uint16),
        factor_starts=starts(np.full(TALK_PROBES, per_probe)),
        factor_source=np.concatenate([np.sort(near, axis=1), sky], axis=1).reshape(-1).astype(np.uint32),
        factor_weight=weight.astype(np.float32),
        brick_starts=starts(brick_sizes),
        brick_level=np.zeros(bricks, np.uint8),
        brick_cell=np.sort(rng.integers(0, 16, (bricks, 3)), axis=0).astype(np.int32),
        brick_direction=rng.integers(0, 6, bricks).astype(np.uint8),
        surfel_position=rng.uniform(0, 64, (TALK_SURFELS, 3)).astype(np.float32),
        surfel_normal=normal.astype(np.float32),
        surfel_albedo=rng.uniform(0, 0.6, (TALK_SURFELS, 3)).astype(np.float32),
        surfel_snow=np.zeros(TALK_SURFELS, np.float32),
        surfel_emission=None,
        feedback_probe=rng.integers(0, TALK_PROBES, (TALK_SURFELS, 1)).astype(np.uint16),
        feedback_weight=np.ones((TALK_SURFELS, 1), np.float32),
        sun_visibility=rng.integers(0, 2**32, (SUN_PLANES, (TALK_SURFELS + 31) // 32), dtype=np.uint32),
        voxel_first=np.array([0, 0, 0], np.int32),
        voxel_class=np.ones(shape, np.uint8),
        voxel_room=np.zeros(shape, np.uint16),
        voxel_probe=rng.integers(0, TALK_PROBES, (*shape, 4)).astype(np.uint16),
        voxel_weight=np.full((*shape, 4), 0.25, np.float32),
    )


def daylight() -> RelightInput:
    """A high sun and a blue sky."""
    sun = np.zeros(1, DIRECTIONAL_LIGHT.dtype)
    sun["direction"][0, :3] = (0.4, 0.8, 0.447)
    sun["irradiance"][0, :3] = (1.1e5, 9.5e4, 7.5e4)
    sun["plane"], sun["plane_weight"] = (10, 11, 30, 31), (0.4, 0.3, 0.2, 0.1)
    return RelightInput(np.full((SKY_PATCHES, 3), (1.2e4, 1.4e4, 1.8e4), np.float32), sun)


def bench_relight(device: Device, rounds: int = 15) -> Measurement:
    """One tick's relight of two sectors, host overhead included: sun, sky and one bounce. Baseline: the NumPy twin in float32."""
    given = daylight()
    residents = [ResidentSector(device, talk_size_sector(seed), SKY_PATCHES) for seed in range(ROTATION)]
    tick = _ticks(device, residents, given)

    def twin() -> None:
        for resident in residents[:2]:
            relight_twin.relight(resident.sector, given, resident.read_cubes(), 1)

    milliseconds, baseline = (1e3 * s for s in side_by_side(tick, twin, rounds, calls=20))
    sizes = {"sectors": 2, "probes": TALK_PROBES, "surfels": TALK_SURFELS, "factors": TALK_FACTORS}
    return Measurement(
        "relight_two_sectors", milliseconds, "ms", baseline, baseline / milliseconds, sizes, device.name, "NumPy twin, float32"
    )


def bench_features(device: Device, rounds: int = 8) -> list[Measurement]:
    """What each feature of the relighter adds to a tick of two sectors: with it, beside the same tick without it.

    ``bytes_added`` is what the two sectors hold on the device for it. Without a feature its kernels have no code for it, and there is
    no buffer: the baseline is then a tick that never knew of it.
    """
    plain = [talk_size_sector(seed) for seed in range(ROTATION)]
    rng = np.random.default_rng(0)
    shining = [replace(s, surfel_emission=rng.uniform(0, 10, (s.surfel_count, 3)).astype(np.float32)) for s in plain]
    snowy = [replace(s, surfel_snow=rng.uniform(0, 1, s.surfel_count).astype(np.float32)) for s in plain]
    day, dark = daylight(), RelightInput(daylight().patch_exitance, daylight().lights[:0])
    both = RelightInput(day.patch_exitance, np.concatenate([day.lights, day.lights]))
    lit = [device.upload(np.ones((s.surfel_count, 4), np.float32)) for s in plain]

    def feature(name: str, given: RelightInput, without: RelightInput, sectors: list[Sector], lamps: bool = False) -> Measurement:
        on, off = ([ResidentSector(device, s, SKY_PATCHES) for s in group] for group in (sectors, plain))
        if lamps:
            for resident, buffer in zip(on, lit, strict=True):
                resident.set_lamps(buffer)
        times = side_by_side(_ticks(device, on, given), _ticks(device, off, without), 20 * rounds)
        added = sum(r.nbytes for r in on[:2]) - sum(r.nbytes for r in off[:2])
        with_it, without_it = (1e3 * s for s in times)
        return Measurement(
            f"feature_{name}",
            with_it,
            "ms",
            without_it,
            without_it / with_it,
            {"bytes_added": added},
            device.name,
            "the same tick without it",
        )

    return [
        feature("sun", day, dark, plain),
        feature("moon_beside_sun", both, day, plain),
        feature("snow", RelightInput(day.patch_exitance, day.lights, 0.5), day, snowy),
        feature("lamps", day, day, plain, lamps=True),
        feature("emission", day, day, shining),
    ]


def _ticks(device: Device, residents: list[ResidentSector], given: RelightInput) -> Callable[[], None]:
    """A function that relights two of the sectors at each call, in rotation, and waits."""
    relighter, turns = Relighter(device), itertools.count()

    def tick() -> None:
        turn = 2 * next(turns)
        relighter.relight([residents[turn % ROTATION], residents[(turn + 1) % ROTATION]], given)
        device.queue.finish()

    return tick


def bench_volume(device: Device, rounds: int = 100) -> Measurement:
    """Filling the volume from four lit sectors, on the device. Baseline: copying as many bytes in memory."""
    resident = ResidentSector(device, talk_size_sector(0), SKY_PATCHES)
    resident.write_cubes(np.random.default_rng(0).uniform(0, 1e4, (TALK_PROBES, 6, 3)).astype(np.float32))
    values = np.zeros((6, *VOLUME_SHAPE, 3), np.float32)
    target = device.allocate(values.nbytes)
    # The one made-up sector stands in for each of the four around the corner that they share.
    boxes = plan_boxes(np.array([4, 0, 4]))
    records = []
    for box in boxes:
        record = box_record(box, resident.sector)
        record["sector_first"][0, [0, 2]] = 0
        records.append((record, (min(int(box.size[0]), 20), int(box.size[1]), min(int(box.size[2]), 20))))

    def fill() -> None:
        for record, size in records:
            resident.fill_volume(record, size, target)
        device.queue.finish()

    copy = values.copy()
    milliseconds, baseline = (1e3 * s for s in side_by_side(fill, lambda: np.copyto(copy, values), rounds))
    return Measurement(
        "volume_fill", milliseconds, "ms", baseline, baseline / milliseconds, {"bytes": values.nbytes}, device.name, "memcpy"
    )


def bench_decode(device: Device, rounds: int = 30) -> Measurement:
    """From a sector's file in memory to its buffers on the device. Baseline: decompressing the same bytes and no more."""
    import zstandard

    data = sector_file.encode(talk_size_sector(0), {}, SKY_PATCHES)

    def decode() -> None:
        ResidentSector(device, sector_file.decode(data, "bench")[0], SKY_PATCHES)
        device.queue.finish()

    payload = data[data.index(b"\x28\xb5\x2f\xfd") :]
    alone = zstandard.ZstdDecompressor()
    milliseconds, baseline = (1e3 * s for s in side_by_side(decode, lambda: alone.decompress(payload), rounds))
    return Measurement(
        "sector_decode", milliseconds, "ms", baseline, baseline / milliseconds, {"bytes": len(data)}, device.name, "zstd alone"
    )


def run(device_name: str | None = None, quick: bool = False) -> list[Measurement]:
    """All measurements of this module on one device; ``quick`` ones are a look, not a result. Raises DeviceError."""
    from gi_core import bench_basis  # which imports this module

    device = shared_device(device_name)
    if quick:
        return [bench_relight(device, 2), bench_volume(device, 10), bench_decode(device, 3)]
    return [bench_relight(device), bench_volume(device), bench_decode(device), *bench_features(device), *bench_basis.run(device)]
