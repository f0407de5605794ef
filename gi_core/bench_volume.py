"""Timings of volumes: filled whole on the device, and a player's that moves by one voxel."""

import itertools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from gi_core.arrays import Float32
from gi_core.bench import SKY_PATCHES, TALK_PROBES, Measurement, side_by_side, talk_size_sector
from gi_core.constants import VOLUME_SHAPE
from gi_core.device import Device
from gi_core.geometry_file import Geometry
from gi_core.grid import SectorIndex, voxel_columns
from gi_core.light_geometry import ShadowGeometry, SharedGeometry
from gi_core.live_sector import LiveSector
from gi_core.live_volume import LiveVolume, PublishedVolume
from gi_core.resident_sector import ResidentSector
from gi_core.sector import Sector
from gi_core.volume import box_record, plan_boxes


def bench_fill(device: Device, rounds: int = 100) -> Measurement:
    """Filling the volume from four lit sectors, on the device. Baseline: copying as many bytes in memory."""
    resident = ResidentSector(device, talk_size_sector(0), SKY_PATCHES)
    resident.write_cubes(_light())
    values = np.zeros((6, *VOLUME_SHAPE, 3), np.float32)
    target = device.allocate(values.nbytes)
    # The one made-up sector stands in for each of the four around the corner that they share.
    boxes = plan_boxes(np.array([4, 0, 4]))
    records = []
    for box in boxes:
        record = box_record(box, resident.sector)
        record["sector_first"][0, [0, 2]] = 0
        records.append((record, (min(box.size[0], 20), box.size[1], min(box.size[2], 20))))

    def fill() -> None:
        for record, size in records:
            resident.fill_volume(record, size, target)
        device.queue.finish()

    copy = values.copy()
    milliseconds, baseline = (1e3 * s for s in side_by_side(fill, lambda: np.copyto(copy, values), rounds))
    return Measurement(
        "volume_fill", milliseconds, "ms", baseline, baseline / milliseconds, {"bytes": values.nbytes}, device.name, "memcpy"
    )


def bench_step(device: Device, rounds: int = 100) -> Measurement:
    """A player's volume among four sectors that moves by one voxel to and fro along x, from its plan to its bytes in the host's memory.

    Baseline: the same volume moving by one voxel along y, where nothing stays in its place: filled whole, read likewise.
    """
    without_lamps: dict[SectorIndex, Geometry] = {}
    shadows = SharedGeometry(ShadowGeometry(without_lamps.__getitem__, ()), ThreadPoolExecutor(1))
    indices = [SectorIndex(x, z) for x in (0, 1) for z in (0, 1)]
    residents = {index: LiveSector(device, _sector_at(index), SKY_PATCHES, shadows) for index in indices}
    for sector in residents.values():
        sector.resident.write_cubes(_light())
    place = np.array([4, 0, 4])

    def walk(step: tuple[int, int, int]) -> Callable[[], PublishedVolume]:
        volume, ticks = LiveVolume(device), itertools.count()

        def move() -> PublishedVolume:
            tick = next(ticks)
            volume.move(place + tick % 2 * np.array(step), frozenset(indices))
            volume.enqueue(residents, lambda sector: sector.resident.cubes)
            return volume.publish(tick, lambda index: np.zeros((6, 3), np.float32))

        return move

    milliseconds, baseline = (1e3 * s for s in side_by_side(walk((1, 0, 0)), walk((0, 1, 0)), rounds))
    whole = 4 * 3 * 6 * int(np.prod(VOLUME_SHAPE))
    sizes = {"bytes": whole, "bytes_filled": whole // VOLUME_SHAPE[2]}
    return Measurement("volume_step", milliseconds, "ms", baseline, baseline / milliseconds, sizes, device.name, "filled whole")


def _sector_at(index: SectorIndex) -> Sector:
    """The talk's size, with as many columns of voxels as a sector has there."""
    (x0, x1), (z0, z1) = voxel_columns(index.x), voxel_columns(index.z)
    sector = talk_size_sector(0)
    shape = (len(sector.voxel_class), z1 - z0, x1 - x0)
    return replace(
        sector,
        index=index,
        voxel_first=np.array([x0, 0, z0], np.int32),
        voxel_class=np.ones(shape, np.uint8),
        voxel_room=np.zeros(shape, np.uint16),
        voxel_probe=np.random.default_rng(0).integers(0, TALK_PROBES, (*shape, 4)).astype(np.uint16),
        voxel_weight=np.full((*shape, 4), 0.25, np.float32),
    )


def _light() -> Float32:
    return np.random.default_rng(0).uniform(0, 1e4, (TALK_PROBES, 6, 3)).astype(np.float32)
