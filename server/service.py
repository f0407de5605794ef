"""What routes work with: one dataset, one engine, and the limits that keep the work bounded."""

import asyncio
import logging
import secrets
import threading
from collections.abc import AsyncIterator, Iterable, Iterator
from contextlib import asynccontextmanager, contextmanager
from dataclasses import replace
from pathlib import Path

from gi_core.dataset import Dataset
from gi_core.engine import Engine
from gi_core.error_report import expected_error
from gi_core.grid import SectorIndex
from gi_core.lighting import Lighting
from server.finished_replies import FinishedReplies
from server.heap import keeping_memory
from server.live import Live
from server.player_streams import PlayerStreams
from server.player_volumes import PlayerVolumes
from server.preview_scene import PreviewScenes
from server.settings import Settings, read_token
from server.tick_signal import TickSignal

log = logging.getLogger("sectorlight.service")

PREVIEW_THREADS = 2  # one draws while another finds its light, or that its client has the picture


class Service:
    """Shared by all requests of a process.

    Routes run on a pool of threads. The engine lights for one of them at a time, and pictures, the only other heavy work, take turns at
    two of them.
    Waiting threads hold no arrays, so memory does not grow with the queue. The live world has a thread and a queue of its own.
    """

    def __init__(self, dataset: Dataset, engine: Engine, settings: Settings) -> None:
        self.dataset = dataset
        self.engine = engine
        self.settings = settings
        self.token = None if settings.token_file is None else read_token(settings.token_file)
        self.live = Live(dataset, replace(settings.live, device=settings.device, sky=engine.sky))
        self.run_id = secrets.token_hex(8)
        self.ticks = TickSignal()
        self.streams = PlayerStreams(self.ticks)
        self.player_volumes = PlayerVolumes()
        self.replies = FinishedReplies()
        self.preview_scenes = PreviewScenes(dataset)
        self._preview_threads = asyncio.Semaphore(PREVIEW_THREADS)
        self._preview_lock = threading.Lock()
        self._misfits = misfits(dataset, dataset.world.sectors)
        for reason in self._misfits.values():
            log.error("%s", reason)

    @classmethod
    def open(cls, dataset_path: Path, settings: Settings) -> "Service":
        """Open a dataset and a device; InputError, FormatError or KernelBuildError when either cannot be used."""
        dataset = Dataset.open(dataset_path)
        sky = None if settings.sky is None else settings.sky.read(dataset.world.location)
        return cls(dataset, Engine(dataset, settings.device, sky), settings)

    def close(self) -> None:
        """Stop the threads that encode."""
        self.streams.stop_encoding()

    @asynccontextmanager
    async def preview_thread(self) -> AsyncIterator[None]:
        """The right to take a thread for a picture: whoever waits for it holds none, so that pictures do not take those of all else."""
        async with self._preview_threads:
            yield

    @contextmanager
    def preview_turn(self) -> Iterator[None]:
        """The right to draw one picture."""
        with self._preview_lock, keeping_memory():
            yield

    def lighting(self, time: str, weather: str) -> Lighting:
        """The light of a moment; UnknownTimeError or UnknownWeatherError when there is no such moment."""
        return self.engine.lighting(time, weather)

    @property
    def light_identity(self) -> str:
        """What decides the bits of served light beside the query: the dataset, and the device, whose sums may round differently."""
        return f"{self.dataset.digest} {self.engine.device_name}"

    @property
    def expected_error(self) -> float | None:
        """Median relative error that the dataset's error report gives for players' volumes, cubes; None without a report."""
        world = self.dataset.world
        return expected_error(world.error_report, world.basis, "cube")

    @property
    def failed_sectors(self) -> dict[SectorIndex, str]:
        """Sectors that queries are refused for, and why: files of the wrong size, and files that did not survive being read."""
        self._misfits = misfits(self.dataset, self._misfits)
        return self._misfits | self.engine.failed_sectors

    def public(self, text: str) -> str:
        """A message about a file without the folder that the dataset lies in, which is the operator's own."""
        return text.replace(f"{self.dataset.path}/", "")


def misfits(dataset: Dataset, sectors: Iterable[SectorIndex]) -> dict[SectorIndex, str]:
    """Which of ``sectors`` have a file that is missing or not as long as the index says, and why. Looks at no contents, so it is quick."""
    found = {}
    for index in sectors:
        path, expected = dataset.sector_path(index), dataset.world.sectors[index].bytes
        try:
            size = path.stat().st_size
        except OSError as error:
            found[index] = f"{path}: expected {expected} bytes, found {error.strerror}; bake it again"
            continue
        if size != expected:
            found[index] = f"{path}: expected {expected} bytes, found {size}; bake it again"
    return found
