"""The shadow map of the live world: drawn around players in turn, a little each tick, and sampled by the sectors it covers."""

import logging
from collections import OrderedDict
from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np

from gi_core.arrays import AnyArray, Float64
from gi_core.constants import SECTOR_SIZE_M
from gi_core.dataset import Dataset
from gi_core.device import Device
from gi_core.errors import SectorlightError
from gi_core.grid import SectorIndex
from gi_core.layout import SHADOW_TRIANGLE
from gi_core.live_sector import LiveSector
from gi_core.relight_input import RelightInput
from gi_core.shadow_map import ShadowMap
from gi_core.shadow_plan import MAP_TEXELS, TEXELS_PER_METRE, MovingBox, ShadowPlan, caster_records, needs_drawing, plan_map

log = logging.getLogger("sectorlight.shadows")

# Of one tick: half a millisecond of a core each.
TRIANGLES_PER_TICK = 3000
SECTORS_SAMPLED_PER_TICK = 2
# Triangles of sectors towards the sun that are kept in memory, 48 bytes each.
KEPT_BYTES = 1 << 26


class LiveShadows:
    """Decides what the map shows and when; the ticker's alone. Geometry is read by a thread of its own."""

    def __init__(self, device: Device, dataset: Dataset) -> None:
        self._dataset = dataset
        low, high = dataset.world.bounds[:, 1]
        self._heights = float(low), float(high)
        self._map = ShadowMap(device, self._cast, self._heights[1])
        self._reader = ThreadPoolExecutor(1, thread_name_prefix="shadow-geometry")
        self._casters: OrderedDict[SectorIndex, Future[AnyArray]] = OrderedDict()
        self._planned: ShadowPlan | None = None
        self._last: dict[int, ShadowPlan] = {}
        self._turn = 0
        self._covers: tuple[SectorIndex, ...] = ()
        self._dark = True

    @property
    def nbytes(self) -> int:
        """Bytes on the device."""
        return self._map.nbytes

    def step(
        self,
        positions: Float64,
        given: RelightInput,
        sun_is_up: bool,
        boxes: Sequence[MovingBox],
        residents: Mapping[SectorIndex, LiveSector],
    ) -> None:
        """One tick's share of planning, drawing and sampling, for players at positions (p, 3) [m]."""
        if not sun_is_up:
            if not self._dark:
                self._planned, self._last, self._covers, self._dark = None, {}, (), True
                for sector in residents.values():
                    sector.drop_sun_samples()
            return
        self._dark = False
        # Sectors that have arrived since the map was drawn are sampled too.
        waiting = [i for i in self._covers if i in residents and residents[i].sampled_in != self._map.number]
        for index in waiting[:SECTORS_SAMPLED_PER_TICK]:
            residents[index].sample_sun(self._map)
        if self._map.is_drawing:
            if self._map.draw(TRIANGLES_PER_TICK):
                self._covers = covered(self._map.plan, self._dataset.world.sectors)
        elif self._planned is not None:
            if all(self._caster(index).done() for index in self._planned.sectors):
                self._map.begin(self._planned)
                self._planned = None
        elif not waiting and len(positions):
            self._plan(positions, np.asarray(given.lights["direction"][0, :3], np.float64), boxes)

    def warm_up(self, sector: LiveSector) -> None:
        """Compile and run the map's kernels, and forget what they drew."""
        index = sector.resident.sector.index
        plan = plan_map(index.origin + 32.0, np.array([0.0, 1.0, 0.0]), {index}, *self._heights)
        assert plan is not None
        self._map.begin(plan)
        self._map.draw(1)
        sector.sample_sun(self._map)

    def close(self) -> None:
        """Stop reading."""
        self._reader.shutdown(cancel_futures=True)

    def _plan(self, positions: Float64, to_sun: Float64, boxes: Sequence[MovingBox]) -> None:
        """Plan a map for the next player, in turn, who needs one."""
        count = len(positions)
        self._last = {player: plan for player, plan in self._last.items() if player < count}
        for offset in range(count):
            player = (self._turn + offset) % count
            if needs_drawing(self._last.get(player), positions[player], to_sun, boxes):
                plan = plan_map(positions[player], to_sun, self._dataset.world.sectors, *self._heights, boxes)
                self._turn = player + 1
                if plan is not None:
                    self._planned = self._last[player] = plan
                    for index in plan.sectors:
                        self._caster(index)
                return

    def _caster(self, index: SectorIndex) -> "Future[AnyArray]":
        found = self._casters.get(index)
        if found is None:
            found = self._casters[index] = self._reader.submit(self._read, index)
        self._casters.move_to_end(index)
        while len(self._casters) > 1 and sum(f.result().nbytes for f in self._casters.values() if f.done()) > KEPT_BYTES:
            self._casters.popitem(last=False)
        return found

    def _read(self, index: SectorIndex) -> AnyArray:
        try:
            return caster_records(self._dataset.geometry(index), index)
        except SectorlightError as error:
            log.error("no shadows from sector %s: %s", index, error)
            return np.zeros(0, SHADOW_TRIANGLE.dtype)

    def _cast(self, index: SectorIndex) -> AnyArray:
        return self._caster(index).result()


def covered(plan: ShadowPlan | None, sectors: Collection[SectorIndex]) -> tuple[SectorIndex, ...]:
    """Sectors on some of whose own ground a map may look, nearest first; a sector's far surfels are others' ground."""
    if plan is None:
        return ()
    half_map = MAP_TEXELS / TEXELS_PER_METRE / 2
    (x0, z0), (x1, z1) = (np.floor((plan.middle[[0, 2]] + side * half_map) / SECTOR_SIZE_M).astype(int).tolist() for side in (-1, 1))
    near = (SectorIndex(x, z) for x in range(x0, x1 + 1) for z in range(z0, z1 + 1))

    def away(index: SectorIndex) -> float:
        return float(np.abs((index.origin + SECTOR_SIZE_M / 2 - plan.middle)[[0, 2]]).max())

    return tuple(sorted((index for index in near if index in sectors), key=lambda index: (away(index), index)))
