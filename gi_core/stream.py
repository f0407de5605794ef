"""Carries out streaming plans: sectors are read, checked and put on the device by threads of their own, and handed over when ready."""

import logging
import queue
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from gi_core.arrays import Float64, Int64
from gi_core.background import RightOfWay, background_thread
from gi_core.constants import BASIS_SIZES
from gi_core.dataset import SectorFacts, WorldInfo
from gi_core.grid import SectorIndex
from gi_core.live_sector import LiveSector
from gi_core.sector import Sector
from gi_core.stream_need import Needs, SectorTable
from gi_core.stream_plan import StreamOptions, StreamPlan, StreamState, plan_streaming, retry_delay_s

log = logging.getLogger("sectorlight.stream")

# Bytes on the device of one item, and a little for what is not counted: see ResidentSector, SunSamples and SurfelLights.
_BYTES_PER = {"probes": 256, "factors": 16, "bricks": 80, "surfels": 128, "voxels": 32}
# And in the host's memory: see ResidentSector.release_host_arrays.
_HOST_BYTES_PER = {"probes": 24, "bricks": 20, "surfels": 36, "voxels": 3}
_HOST_BYTES_PER_COEFFICIENT, _HOST_BYTES_PER_FEEDBACK = 16, 6
_BYTES_PER_SECTOR = 1 << 15

# A plan holds while no player is this far [m] from where it was going or has changed speed by this much [m/s], a small part of what its
# margins allow for, but not longer than this [s]: then sectors that failed may be tried again.
PLAN_HOLDS_M, PLAN_HOLDS_M_S, PLAN_HOLDS_S = 1.0, 0.5, 0.25


# What a probe and a brick have for each coefficient beyond the cube's six or, of a brick, for any of harmonics; and a probe's served cube.
_BYTES_PER_COEFFICIENT, _BRICK_BASIS_BYTES, _SERVED_BYTES = 48, 4, 96
# A bounce that each feedback probe but the first may add to a surfel's brick.
_BYTES_PER_BOUNCE = 16


def most_bytes(facts: SectorFacts, sun_planes: int, voxel_probes: int, coefficients: int = 6, feedback_probes: int = 1) -> int:
    """What a sector takes at most, on the device and in the host's memory, from what the index says of it: with sun, snow, lamps and
    samples. About twice what it takes."""
    counted = sum(size * int(getattr(facts, name)) for per in (_BYTES_PER, _HOST_BYTES_PER) for name, size in per.items())
    counted += facts.probes * _HOST_BYTES_PER_COEFFICIENT * coefficients + facts.surfels * _HOST_BYTES_PER_FEEDBACK * feedback_probes
    counted += _BYTES_PER_BOUNCE * facts.surfels * (feedback_probes - 1)
    if coefficients != BASIS_SIZES["cube"]:
        more = max(coefficients - BASIS_SIZES["cube"], 0)
        counted += facts.probes * (_BYTES_PER_COEFFICIENT * more + _SERVED_BYTES) + facts.bricks * _BRICK_BASIS_BYTES * coefficients
    return _BYTES_PER_SECTOR + counted + facts.surfels * sun_planes // 8 + 6 * facts.voxels * voxel_probes


def sector_table(world: WorldInfo) -> SectorTable:
    """The world's sectors for streaming plans."""
    planes, blended = world.sun_table.plane_count, int(world.settings.get("voxel_probes", 4))
    size, feedback = BASIS_SIZES[world.basis], int(world.settings.get("feedback_probes", 1))
    return SectorTable.of({index: most_bytes(facts, planes, blended, size, feedback) for index, facts in world.sectors.items()})


@dataclass(frozen=True)
class Failure:
    """A sector that could not be loaded: how often in a row, when it is tried again, and why."""

    attempts: int
    retry_at_s: float
    reason: str


class Streamer:
    """The sectors that are resident. ``residents`` is the ticker's: loaders only hand over what is whole.

    A sector that loads counts as the most that it may take, one that is there as what it takes (LiveSector.budget_bytes).
    """

    def __init__(
        self,
        table: SectorTable,
        load: Callable[[SectorIndex], Sector],
        place: Callable[[Sector], LiveSector],
        options: StreamOptions,
        ticks: RightOfWay,
    ) -> None:
        """``load`` reads a sector (``Dataset.sector``), ``place`` puts it on the device: both are called by a loader's thread, which gives
        way to ``ticks``."""
        self.residents: dict[SectorIndex, LiveSector] = {}
        self.failures: dict[SectorIndex, Failure] = {}
        self.lamps_planned = False
        """Whether sectors that arrive are counted with room for lamps."""
        self.table, self._load, self._place, self._options = table, load, place, options
        self._row = {index: row for row, index in enumerate(table.sectors)}
        self._state = StreamState.empty(table)
        self._loading: set[SectorIndex] = set()
        self._plan: StreamPlan | None = None
        self._planned: tuple[Float64, Float64, float] = np.zeros((0, 3)), np.zeros((0, 3)), 0.0
        """The plan that may hold, and the positions, velocities and time [s] that it was made for."""
        self._rows: Int64 = np.zeros(0, np.int64)
        self._done: queue.SimpleQueue[tuple[SectorIndex, LiveSector | Exception]] = queue.SimpleQueue()
        # One thread: decoding holds Python's lock half of the time, and more would take it from the ticks.
        self._loader = background_thread("sector-loader", ticks)

    @property
    def loading(self) -> int:
        """How many sectors are on their way."""
        return len(self._loading)

    @property
    def resident_bytes(self) -> int:
        """Bytes on the device and in the host's memory, as the plan counts them."""
        return int(self._state.resident_bytes.sum())

    @property
    def is_overfull(self) -> bool:
        """Whether sectors take more than the budget, since one has turned out larger: the next step must make them fit."""
        return self._state.used_bytes(self.table) > self._options.budget_bytes

    def lacks_within(self, seconds: float, needs: Needs) -> bool:
        """Whether a volume gets to a sector that is not resident within so many seconds. From any thread."""
        return bool(((needs.ahead_s < seconds) & (self._state.resident_bytes == 0)).any())

    def take_over(self) -> list[SectorIndex]:
        """Make resident what loaders have finished; those sectors. Failures are noted, to be tried again later."""
        arrived: list[SectorIndex] = []
        while True:
            try:
                index, found = self._done.get_nowait()
            except queue.Empty:
                return arrived
            row, self._plan = self._row[index], None
            self._loading.discard(index)
            self._state.loading[row] = False
            if isinstance(found, LiveSector):
                self.residents[index] = found
                self._rows = np.append(self._rows, row)
                self._state.resident_bytes[row] = found.budget_bytes(self.lamps_planned)
                self._state.retry_at_s[row] = 0.0
                self.failures.pop(index, None)
                arrived.append(index)
            else:
                attempts = self.failures[index].attempts + 1 if index in self.failures else 1
                retry_at_s = time.monotonic() + retry_delay_s(attempts)
                self._state.retry_at_s[row] = retry_at_s
                self.failures[index] = Failure(attempts, retry_at_s, str(found))
                log.error("%s", found)

    def step(self, positions: Float64, velocities: Float64) -> StreamPlan:
        """Plan for players at positions (p, 3) [m] with velocities (p, 3) [m/s], evict and start to load.

        The last plan holds, with nothing left to do, while nobody has gone far or turned and nothing has arrived or may be tried again.
        """
        plan = self._plan
        if plan is not None and self._holds(positions, velocities):
            return plan
        plan = plan_streaming(self.table, self._state, positions, velocities, now_s=time.monotonic(), options=self._options)
        for index in plan.evictions:
            del self.residents[index]
            self._rows = self._rows[self._rows != self._row[index]]
            self._state.resident_bytes[self._row[index]] = 0
        for index in plan.loads:
            self._loading.add(index)
            self._state.loading[self._row[index]] = True
            self._loader.submit(self._bring, index)
        self._plan, self._planned = replace(plan, loads=(), evictions=()), (positions, velocities, time.monotonic())
        return plan

    def _holds(self, positions: Float64, velocities: Float64) -> bool:
        before, going, at_s = self._planned
        passed_s = time.monotonic() - at_s
        return (
            passed_s < PLAN_HOLDS_S
            and before.shape == positions.shape
            and bool((np.abs(velocities - going) <= PLAN_HOLDS_M_S).all())
            and bool((np.abs(positions - before - passed_s * going) <= PLAN_HOLDS_M).all())
        )

    def count_again(self, index: SectorIndex, lamps: bool) -> None:
        """Count what a resident sector takes now, with room for ``lamps`` or not, where that is more: the next step makes it fit."""
        row, self._plan = self._row[index], None
        self._state.resident_bytes[row] = max(int(self._state.resident_bytes[row]), self.residents[index].budget_bytes(lamps))

    def resident_rows(self) -> Int64:
        """Rows of the table that are resident, in the order of their arrival."""
        return self._rows

    def close(self) -> None:
        """Stop loading; waits for what is under way."""
        self._loader.shutdown(cancel_futures=True)

    def _bring(self, index: SectorIndex) -> None:
        try:
            found: LiveSector | Exception = self._place(self._load(index))
        except Exception as error:  # whatever it is, the world goes on without this sector
            found = error
        self._done.put((index, found))
