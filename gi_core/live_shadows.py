"""The shadow map of the live world: drawn around players in turn, a little each tick, and sampled by the sectors it covers."""

import logging
import math
from collections import OrderedDict
from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import Future

import numpy as np

from gi_core.arrays import AnyArray, Float64
from gi_core.background import RightOfWay, background_thread, give_way
from gi_core.constants import SECTOR_SIZE_M
from gi_core.dataset import Dataset
from gi_core.device import Device
from gi_core.errors import SectorlightError
from gi_core.grid import SectorIndex
from gi_core.layout import SHADOW_TRIANGLE
from gi_core.live_sector import LiveLight, LiveSector
from gi_core.shadow_map import ShadowMap
from gi_core.shadow_plan import (
    HALF_MAP_M,
    NO_BOXES,
    MovingBox,
    ShadowPlan,
    box_corners,
    caster_records,
    is_near,
    plan_map,
    sun_or_box_moved,
)

log = logging.getLogger("sectorlight.shadows")

# Of one tick: half a millisecond each on two cores. For every so many players as much again, so that maps keep up with those who walk: a
# sector that is sampled in time need not fade, and whoever reads it need not be filled while it does.
TRIANGLES_PER_TICK = 1000
SECTORS_SAMPLED_PER_TICK = 2
PLAYERS_PER_SHARE, MOST_SHARES = 10, 6
# Where many walk, the next tick looks at others; few are looked at every so many ticks, in which nobody gets far.
PLAYERS_LOOKED_AT_PER_TICK, LOOK_TICKS = 4, 4
# Sectors with ground this near to a map's middle, along x and z, lie whole in it; the middle is rounded to texels.
NEAR_M = HALF_MAP_M - SECTOR_SIZE_M - 1.0
# Maps are drawn around where players will be in so long [s], but not farther ahead than this [m]: the map then still covers what their
# volumes read behind them.
LEAD_S, MOST_LEAD_M = 1.0, 24.0
# Triangles of sectors towards the sun that are kept in memory, 48 bytes each: for each player several maps' of Midtown, and all in all a
# city's.
KEPT_BYTES_PER_PLAYER, MOST_KEPT_BYTES = 1 << 23, 1 << 26

Casters = Mapping[SectorIndex, AnyArray]


class LiveShadows:
    """Decides what the map shows and when; the ticker's alone. A thread of its own plans maps and reads geometry.

    Only sectors whose own ground lies whole in a map are sampled. Their samples hold wherever players go, and are taken anew when the sun
    or a box has moved: so a map is drawn only when a sector near some player has none, or old ones. Near is farther than the player's
    volume reads: a sector that a walker comes to is sampled before anybody sees it, and need not fade.
    """

    def __init__(self, device: Device, dataset: Dataset, ticks: RightOfWay) -> None:
        """The planner's thread gives way to ``ticks``."""
        self._known = frozenset(dataset.world.sectors)
        self._dataset = dataset
        low, high = dataset.world.bounds[:, 1]
        self._heights = float(low), float(high)
        self._map = ShadowMap(device, self._cast, self._heights[1])
        self._planner = background_thread("shadow-planner", ticks)
        self._casters: OrderedDict[SectorIndex, AnyArray] = OrderedDict()
        """What the planner has read, its own."""
        self._planning: Future[tuple[ShadowPlan | None, Casters]] | None = None
        self._to_draw: Casters = {}
        self._turn = self._ticks = 0
        """Which player is looked at next, and how many ticks there have been."""
        self._to_sample: list[SectorIndex] = []
        self._dark = True
        self._boxes: tuple[Sequence[MovingBox], Float64] = (), NO_BOXES
        """The boxes of the last tick, and their corners."""

    def step(
        self,
        positions: Float64,
        velocities: Float64,
        light: LiveLight,
        boxes: Sequence[MovingBox],
        residents: Mapping[SectorIndex, LiveSector],
    ) -> tuple[SectorIndex, ...]:
        """One tick's share of planning, drawing and sampling, for players at positions (p, 3) [m] with velocities (p, 3) [m/s]; sectors
        whose sun that changes."""
        self._ticks += 1
        if not light.sun_is_up:
            if self._dark:
                return ()
            self._planning, self._to_sample, self._dark = None, [], True
            for sector in residents.values():
                sector.drop_sun_samples()
            return tuple(residents)
        self._dark = False
        shares = min(1 + len(positions) // PLAYERS_PER_SHARE, MOST_SHARES)
        plan = self._map.plan
        if self._to_sample and plan is not None and is_near(plan.to_sun, light.to_sun):
            some = self._to_sample[: shares * SECTORS_SAMPLED_PER_TICK]
            del self._to_sample[: shares * SECTORS_SAMPLED_PER_TICK]
            chosen = tuple(i for i in some if i in residents and is_outdated(residents[i].sampled_of, plan.to_sun, plan.boxes))
            for index in chosen:
                residents[index].sample_sun(self._map)
            return chosen
        # A map for a sun that has moved away, as it does when the clock jumps, is given up for another.
        drawing = self._map.drawing
        if drawing is not None and is_near(drawing.to_sun, light.to_sun):
            if self._map.draw(shares * TRIANGLES_PER_TICK):
                assert self._map.plan is not None
                self._to_sample = covered(self._map.plan, residents)
        elif self._planning is not None:
            if self._planning.done():
                planned, self._planning = self._planning, None
                plan, casters = planned.result()
                if plan is not None and is_near(plan.to_sun, light.to_sun):
                    self._to_draw = casters
                    self._map.begin(plan)
        elif len(positions) > PLAYERS_LOOKED_AT_PER_TICK or (len(positions) and self._ticks % LOOK_TICKS == 0):
            if boxes is not self._boxes[0]:
                self._boxes = boxes, box_corners(boxes)
            self._plan(positions + np.clip(LEAD_S * velocities, -MOST_LEAD_M, MOST_LEAD_M), light.to_sun, self._boxes[1], residents)
        return ()

    def _plan(self, positions: Float64, to_sun: Float64, boxes: Float64, residents: Mapping[SectorIndex, LiveSector]) -> None:
        """Plan a map around the next of some positions (p, 3) [m], in turn, that is near a sector which lacks samples."""
        count = len(positions)
        for offset in range(min(count, PLAYERS_LOOKED_AT_PER_TICK)):
            player = (self._turn + offset) % count
            # Neighbours have their samples of one map, mostly.
            sources = {residents[index].sampled_of for index in sectors_within(NEAR_M, positions[player], residents)}
            if any(is_outdated(source, to_sun, boxes) for source in sources):
                self._turn = player + 1
                kept_bytes = min(count * KEPT_BYTES_PER_PLAYER, MOST_KEPT_BYTES)
                self._planning = self._planner.submit(self._prepare, positions[player].copy(), to_sun, boxes, kept_bytes)
                return
        self._turn += PLAYERS_LOOKED_AT_PER_TICK

    def warm_up(self, sector: LiveSector) -> None:
        """Compile and run the map's kernels, and forget what they drew."""
        index = sector.resident.sector.index
        plan = plan_map(index.origin + 32.0, np.array([0.0, 1.0, 0.0]), {index}, *self._heights)
        assert plan is not None
        self._to_draw = {index: self._read(index)}
        self._map.begin(plan)
        self._map.draw(1)
        sector.sample_sun(self._map)

    def close(self) -> None:
        """Stop planning."""
        self._planner.shutdown(cancel_futures=True)

    def _prepare(self, position: Float64, to_sun: Float64, boxes: Float64, kept_bytes: int) -> tuple[ShadowPlan | None, Casters]:
        """In the planner's thread: a map, and the triangles that it draws. So many bytes of what was read last are kept."""
        plan = plan_map(position, to_sun, self._known, *self._heights, boxes)
        if plan is None:
            return None, {}
        casters = {}
        for index in plan.sectors:
            give_way()
            casters[index] = self._casters[index] = self._casters.pop(index) if index in self._casters else self._read(index)
        held = sum(records.nbytes for records in self._casters.values())
        while held > kept_bytes:
            held -= self._casters.popitem(last=False)[1].nbytes
        return plan, casters

    def _read(self, index: SectorIndex) -> AnyArray:
        try:
            return caster_records(self._dataset.geometry(index), index)
        except SectorlightError as error:
            log.error("no shadows from sector %s: %s", index, error)
            return np.zeros(0, SHADOW_TRIANGLE.dtype)

    def _cast(self, index: SectorIndex) -> AnyArray:
        return self._to_draw[index]


def is_outdated(source: ShadowPlan | None, to_sun: Float64, boxes: Float64) -> bool:
    """Whether a sector with samples of this map, or none, lacks samples: the sun or a box has moved since."""
    return source is None or sun_or_box_moved(source, to_sun, boxes)


def covered(plan: ShadowPlan, sectors: Collection[SectorIndex]) -> list[SectorIndex]:
    """Sectors whose own ground lies whole in a map, nearest first; a sector's far surfels are others' ground."""
    near = sectors_within(HALF_MAP_M, plan.middle, sectors)
    return sorted((index for index in near if plan.covers_whole(index)), key=lambda index: (plan.away_m(index), index))


def sectors_within(distance_m: float, position: Float64, sectors: Collection[SectorIndex]) -> list[SectorIndex]:
    """Those of ``sectors`` with ground less than a distance away from a position (3,) [m] along x and z both."""
    x, _, z = position.tolist()
    columns, lines = (
        range(math.floor((at - distance_m) / SECTOR_SIZE_M), math.floor((at + distance_m) / SECTOR_SIZE_M) + 1) for at in (x, z)
    )
    around = (SectorIndex(column, line) for column in columns for line in lines)
    return [index for index in around if index in sectors]
