"""Ticks of several datasets side by side: one relight of two sectors each, in turns, so that they share a machine's moods."""

import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gi_core.dataset import Dataset
from gi_core.device import shared_device
from gi_core.lighting_model import make_lighting
from gi_core.relight import Relighter
from gi_core.relight_input import relight_input
from gi_core.resident_sector import ResidentSector

ROUNDS = 40
PASSES = 5  # of a round, one after another
TIMES = ("11:00", "11:20", "11:40", "12:00")  # the sun moves between passes, as it does between ticks


class _Ticks:
    """A dataset's two sectors with most probes, and what a tick does to them."""

    def __init__(self, folder: Path, device_name: str | None) -> None:
        dataset, device = Dataset.open(folder), shared_device(device_name)
        world = dataset.world
        largest = sorted(world.sectors, key=lambda i: -world.sectors[i].probes)[:2]
        self._residents = [ResidentSector(device, dataset.sector(index), world.sky_patches) for index in largest]
        lightings = [make_lighting(world.location, time, "clear") for time in TIMES]
        self._given = [relight_input(lighting, world.sun_table, world.sky, world.sky_patches) for lighting in lightings]
        self._relighter, self._queue, self._turn = Relighter(device), device.queue, 0

    def tick(self) -> None:
        self._turn += 1
        self._relighter.relight(self._residents, self._given[self._turn % len(self._given)])
        self._queue.finish()


def tick_microseconds(folders: Sequence[Path], device: str | None = None) -> list[float]:
    """Median time [us] of a tick of two sectors of each dataset."""
    ticks = [_Ticks(folder, device) for folder in folders]
    taken: list[list[float]] = [[] for _ in folders]
    for one in ticks:
        for _ in range(PASSES):
            one.tick()  # builds kernels, collects bounces
    for _ in range(ROUNDS):
        for one, times in zip(ticks, taken, strict=True):
            one.tick()  # the last one's data leave the cache
            for _ in range(PASSES):
                started = time.perf_counter()
                one.tick()
                times.append(1e6 * (time.perf_counter() - started))
    return [float(np.median(times)) for times in taken]
