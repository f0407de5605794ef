"""What each directional basis costs: a tick of two sectors of the talk's size, and a volume, each beside the cube's in the same run."""

import itertools
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from gi_core import factor_weights
from gi_core.basis import conversion, projection_weights, served_from
from gi_core.bench import ROTATION, SKY_PATCHES, Measurement, daylight, side_by_side, talk_size_sector
from gi_core.constants import BASIS_SIZES, VOLUME_SHAPE
from gi_core.device import Device
from gi_core.relight import Relighter
from gi_core.resident_sector import ResidentSector
from gi_core.sector import Sector, counts
from gi_core.volume import box_record, plan_boxes

STANDARD_FEEDBACK = 6
# Surfels of a brick choose theirs among about as many: in made-up midtown a brick reads 11 probes, where each of its surfels reads 6.
PROBES_NEAR_BRICK = 11


def sector_in(basis: str, seed: int, feedback: int = 1) -> Sector:
    """The made-up sector of the talk's size in a basis, its surfels lit by the closest probe, or by more."""
    sector = talk_size_sector(seed)
    rng = np.random.default_rng(seed)
    first = np.repeat(rng.integers(0, sector.probe_count, sector.brick_count), counts(sector.brick_starts))
    chosen = np.argsort(rng.random((sector.surfel_count, PROBES_NEAR_BRICK)), axis=1)[:, :feedback]
    nearby = (first[:, None] + (chosen if feedback > 1 else 0)) % sector.probe_count
    weight = rng.uniform(0.2, 1, nearby.shape)
    shares = weight / weight.sum(axis=1, keepdims=True)
    sector = replace(sector, feedback_probe=nearby.astype(np.uint16), feedback_weight=shares.astype(np.float32))
    if basis == "cube":
        return sector
    towards = rng.normal(size=(sector.factor_count, 3))
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    weight = projection_weights(basis, towards) * sector.factor_weight.mean(axis=1, keepdims=True)
    codes = factor_weights.encode(weight, sector.factor_starts, sector.factor_source >= sector.brick_count)
    return replace(sector, **codes._asdict())


def bench_tick(device: Device, basis: str, feedback: int, rounds: int) -> Measurement:
    """One pass over two sectors. Baseline: the same of cubes, each surfel lit by its closest probe."""
    measured = _ticks(device, [sector_in(basis, seed, feedback) for seed in range(ROTATION)])
    baseline = _ticks(device, [sector_in("cube", seed) for seed in range(ROTATION)])
    found, cube = (1e3 * seconds for seconds in side_by_side(measured, baseline, rounds))
    sizes = {"coefficients": BASIS_SIZES[basis], "feedback_probes": feedback}
    name = f"relight_{basis}_feedback_{feedback}"
    return Measurement(name, found, "ms", cube, cube / found, sizes, device.name, "cube, one feedback probe")


def bench_fill(device: Device, source: str, target: str, rounds: int) -> Measurement:
    """Filling a volume in one basis from sectors in another, which converts probes first. Baseline: the same of cubes."""
    times = side_by_side(_fills(device, source, target), _fills(device, "cube", "cube"), rounds)
    found, cube = (1e3 * seconds for seconds in times)
    sizes = {"bytes": BASIS_SIZES[target] * int(np.prod(VOLUME_SHAPE)) * 12, "conversion": conversion(source, target).size}
    return Measurement(f"volume_fill_{target}_of_{source}", found, "ms", cube, cube / found, sizes, device.name, "cube of cubes")


def run(device: Device, quick: bool = False) -> list[Measurement]:
    """All rows: ticks in each basis, several feedback probes, and volumes in whatever each can be served in."""
    rounds = 3 if quick else 300
    ticks = [bench_tick(device, basis, feedback, rounds) for basis in ("cube", "sh1", "sh2") for feedback in (1, STANDARD_FEEDBACK)]
    pairs = [(source, target) for source in ("sh1", "sh2") for target in served_from(source)]
    return [*ticks[1:], *(bench_fill(device, source, target, rounds) for source, target in pairs)]


def _ticks(device: Device, sectors: list[Sector]) -> Callable[[], None]:
    residents = [ResidentSector(device, sector, SKY_PATCHES) for sector in sectors]
    relighter, given, turns = Relighter(device), daylight(), itertools.count()

    def tick() -> None:
        first = 2 * next(turns)
        relighter.relight([residents[first % ROTATION], residents[(first + 1) % ROTATION]], given)
        device.queue.finish()

    return tick


def _fills(device: Device, source: str, target: str) -> Callable[[], None]:
    resident = ResidentSector(device, sector_in(source, 0), SKY_PATCHES)
    size = BASIS_SIZES[source]
    resident.write_cubes(np.random.default_rng(0).uniform(0, 1e4, (resident.sector.probe_count, size, 3)).astype(np.float32))
    volume = device.allocate(4 * 3 * BASIS_SIZES[target] * int(np.prod(VOLUME_SHAPE)))
    records = []
    # The one made-up sector stands in for each of the four around the corner that they share.
    for box in plan_boxes(np.array([4, 0, 4])):
        record = box_record(box, resident.sector)
        record["sector_first"][0, [0, 2]] = 0
        records.append((record, (min(box.size[0], 20), box.size[1], min(box.size[2], 20))))

    def fill() -> None:
        for record, extent in records:
            resident.fill_volume(record, extent, volume, resident.converted(target), target)
        device.queue.finish()

    return fill
