"""What routes work with: one dataset, one engine, and the limits that keep the work bounded."""

import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gi_core.dataset import Dataset
from gi_core.engine import Engine

from gi_core.grid import SectorIndex
from gi_core.lighting import Lighting
from server.preview_scene import PreviewScenes
from server.settings import Settings

log = logging.getLogger("sectorlight.service")


class Service:
    """Shared by all requests of a process.

    Routes run on a pool of threads. The engine has one command queue, so one query relights at a time (``engine_turn``); pictures are the
    only other heavy work and also take turns. Waiting threads hold no arrays, so memory does not grow with the queue.
    """

    def __init__(self, dataset: Dataset, engine: Engine, settings: Settings) -> None:
        self.dataset = dataset
        self.engine = engine
        self.settings = settings
        self.preview_scenes = PreviewScenes(dataset)
        self._engine_lock = threading.Lock()
        self._preview_lock = threading.Lock()

    @classmethod
    def open(cls, dataset_path: Path, settings: Settings) -> "Service":
        """Open a dataset and a device; InputError, FormatError or KernelBuildError when either cannot be used."""
        dataset = Dataset.open(dataset_path)
        return cls(dataset, Engine(dataset, settings.device), settings)

    @contextmanager
    def engine_turn(self) -> Iterator[Engine]:
        """The engine, for this thread alone."""
        with self._engine_lock:
            yield self.engine

    @contextmanager
    def preview_turn(self) -> Iterator[None]:
        """The right to draw one picture."""
        with self._preview_lock:
            yield

    def lighting(self, time: str, weather: str) -> Lighting:
        """The light of a moment; UnknownTimeError or UnknownWeatherError when there is no such moment."""
        return self.engine.lighting(time, weather)

    @property
    def failed_sectors(self) -> dict[SectorIndex, str]:
        """Sectors whose files were refused, and why."""
        return dict(self.engine.failed_sectors)
