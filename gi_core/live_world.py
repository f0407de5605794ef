"""The live world's light: sectors streamed around players, two of them relit every tick, volumes filled where something has changed.

A tick, in order:

    relight      take over sectors that loaders have put on the device and lit, and relight those that tick_plan chooses; in an idle world
                 one that has not settled exactly
    stream       while the device is at it, have volumes follow players, and plan loads and evictions for where they are and go; a tick that
                 has much to do leaves that to the next, for a while
    volumes      of players who moved, or near whom something was relit, until the tick's time for it is spent; the rest wait, and where
                 the tick has relit something also those in which nothing has changed that anybody would see, for a while
    shadow map   draw some more of the next one; sectors take samples of one that was just drawn

Lighting belongs to the world: players share lit sectors, only volumes are theirs. One thread calls ``tick``; what it publishes is
anybody's. No kernel is compiled in it, once ``warm_up`` has run, and no file read.
"""

import logging
import time
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import Executor
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from functools import partial
from itertools import product

import numpy as np
import pyopencl as cl

from gi_core.arrays import Float32, Float64
from gi_core.background import RightOfWay, background_thread
from gi_core.basis import conversion
from gi_core.constants import BASIS_SIZES, VOLUME_SHAPE
from gi_core.dataset import Dataset
from gi_core.device import Device
from gi_core.errors import SectorlightError
from gi_core.geometry_file import Geometry
from gi_core.grid import SectorIndex, volume_first_voxel
from gi_core.layout import DIRECTIONAL_LIGHT, MAX_DIRECTIONAL_LIGHTS
from gi_core.light_geometry import ShadowGeometry, SharedGeometry
from gi_core.light_needs import WHOLLY, LightNeeds
from gi_core.light_surfels import SurfelLights
from gi_core.live_sector import AHEAD_TIMES, BURST_CHANGE, BURST_PASSES, HURRIED_TIMES, LiveLight, LiveSector
from gi_core.live_shadows import LiveShadows
from gi_core.live_volume import PublishedVolume
from gi_core.live_volumes import LiveVolumes
from gi_core.relight import Relighter
from gi_core.relight_input import RelightInput
from gi_core.sector import Sector
from gi_core.settings import NEUTRAL, Settings
from gi_core.shadow_plan import MovingBox
from gi_core.stream import Streamer, sector_table
from gi_core.stream_plan import StreamOptions, StreamPlan
from gi_core.tick_plan import PLACES, plan_tick
from gi_core.volume import box_record, plan_boxes
from gi_core.world import Lamp

log = logging.getLogger("sectorlight.live")

NO_TRIANGLES = Geometry(np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32))
DEFAULT_BUDGET_BYTES = 512 << 20
# A tick with sectors to relight or volumes to fill leaves planning to later ones, at most so often on end. Sectors are planned for seconds
# ahead.
MOST_PUT_OFF = 3
# While a volume gets within this [s] to a sector that is not there, those that are loaded leave most of their light to ticks.
HURRY_S = 1.0


@dataclass(frozen=True, eq=False)
class TickPlayers:
    """Where players are. ids (p,); positions, velocities : (p, 3) float64 [m], [m/s], world frame."""

    ids: tuple[str, ...]
    positions: Float64
    velocities: Float64


@dataclass(eq=False)
class TickReport:
    """What a tick did. Times in milliseconds.

    relit, settled : sectors that were lit; missing : those that published volumes read and that are not there
    filled : players whose volume was filled; waiting : how many volumes wait for another tick
    """

    tick: int
    relit: tuple[SectorIndex, ...] = ()
    settled: tuple[SectorIndex, ...] = ()
    loaded: tuple[SectorIndex, ...] = ()
    evicted: tuple[SectorIndex, ...] = ()
    missing: tuple[SectorIndex, ...] = ()
    filled: tuple[str, ...] = ()
    waiting: int = 0
    passes: int = 0
    ms: dict[str, float] = field(default_factory=dict)


# A sector that the device relights: its row, and what waits for its cubes and gives them.
_Relit = tuple[int, LiveSector, Callable[[], Float32]]


class LiveWorld:
    """Sectors, volumes and the shadow map of a running world."""

    def __init__(
        self,
        dataset: Dataset,
        device: str | None = None,
        *,
        budget_bytes: int = DEFAULT_BUDGET_BYTES,
        places: int = PLACES,
        shadow_map: bool = True,
        basis: str = "cube",
        stream: StreamOptions | None = None,
    ) -> None:
        """A queue of its own on the device, so that queries and ticks do not wait for each other.

        budget_bytes : of resident sectors, on the device and in the host's memory
        places : sectors to relight in a tick; basis : of players' volumes
        Raises DeviceError, and InputError for a basis that the dataset cannot be served in.
        """
        self.dataset = dataset
        # What may be damaged first: a device costs seconds.
        self._distant = dataset.distant()
        self.plan: StreamPlan | None = None
        self._device = Device(device)
        self._relighter = Relighter(self._device)
        self._relighter_ahead = Relighter(self._device)
        """The loader's, for sectors that are not resident yet."""
        self._places = places
        conversion(dataset.world.basis, basis)
        self.basis = basis
        self._right_of_way = RightOfWay()
        # Its thread begins when a tick first needs something read.
        self._geometry_reader = self.background_thread("geometry-reader")
        self._shared = SharedGeometry(ShadowGeometry(self._read_geometry, dataset.world.sectors), self._geometry_reader)
        options = stream or StreamOptions(budget_bytes)
        self.streamer = Streamer(sector_table(dataset.world), dataset.sector, self._place, options, self._right_of_way)
        self.streamer.lamps_planned = bool(dataset.world.lamps)
        self.volumes = LiveVolumes(self._device, frozenset(dataset.world.sectors), self.streamer.residents, basis)
        self._evicted: tuple[SectorIndex, ...] = ()
        """Since volumes were last told of changes: a tick that fails leaves them to the next."""
        self._put_off = 0
        """How many ticks ago the streaming plan was wanted."""
        self._needs = LightNeeds(len(self.streamer.table.sectors))
        self._row = {index: row for row, index in enumerate(self.streamer.table.sectors)}
        self._light: LiveLight | None = None
        self._fading: set[SectorIndex] = set()
        """Sectors that are not yet shown as they are."""
        self._placeholders: dict[SectorIndex, Float32] = {}
        """Of this tick's light."""
        self._texel_of = {index: texel for texel, index in enumerate(self._distant.sectors())}
        self._shadows = LiveShadows(self._device, dataset, self._right_of_way) if shadow_map else None

    def published(self, player: str) -> PublishedVolume | None:
        """A player's latest volume, from any thread; None before its first."""
        volume = self.volumes.of_player.get(player)
        return None if volume is None else volume.published

    def tick(
        self, tick: int, players: TickPlayers, light: LiveLight, boxes: Sequence[MovingBox] = (), fill_ms: float = np.inf
    ) -> TickReport:
        """One tick: see the top of this file. ``fill_ms``: when so much time has passed since its start, no other volume is filled."""
        started = time.perf_counter()
        report = TickReport(tick)

        def lap(name: str) -> None:
            report.ms[name] = report.ms.get(name, 0.0) + (time.perf_counter() - started) * 1e3 - sum(report.ms.values())

        report.loaded = tuple(self.streamer.take_over())
        for index in report.loaded:
            self._welcome(index, tick, light)
        gains_changed = self._light is not None and self._light.settings != light.settings
        if light is not self._light:
            self._placeholders.clear()
        self._light = light
        relit = self._begin_relight(tick, light, report)
        report.missing = self.volumes.missing
        lap("relight")
        # While the device is at it.
        self.volumes.follow(tick, players.ids, players.positions)
        lap("volumes")
        report.evicted = self._stream(players, is_busy=bool(relit) or self.volumes.are_behind)
        lap("stream")
        self._end_relight(relit, tick, light, report)
        lap("relight")
        changed = self._advance(tick, gains_changed, report)
        self.volumes.note(tick, changed)
        shown = partial(self._shown, light=light)
        report.filled, report.waiting = self.volumes.fill(
            tick, bool(relit), lambda: time.perf_counter() - started >= fill_ms / 1e3, shown, self._placeholder
        )
        lap("volumes")
        self._step_shadows(players, light, boxes)
        lap("shadow_map")
        return report

    def undisturbed(self) -> AbstractContextManager[None]:
        """For a tick: meanwhile threads that load and plan stand still, unless somebody looks at sectors that are not there."""
        return nullcontext() if self.plan is not None and self.plan.missing else self._right_of_way.taken()

    def background_thread(self, name: str) -> Executor:
        """A thread for work that gives way to ticks."""
        return background_thread(name, self._right_of_way)

    def warm_up(self, is_stopped: Callable[[], bool] = lambda: False) -> None:
        """Compile and run every kernel that light may ask for, on the dataset's smallest lit sector: a first run takes a dozen seconds,
        later ones find PoCL's cache. Given up between two kernels when ``is_stopped``. Raises what reading that sector raises."""
        world = self.dataset.world
        lit = [index for index, facts in world.sectors.items() if facts.probes and facts.bricks]
        if not lit:
            return
        index = min(lit, key=lambda i: (world.sectors[i].surfels, i))
        read = self.dataset.sector(index)
        sector = self._new_sector(read)
        lamps = _lit_by_a_lamp(self._device, read, world.sectors)
        samples = self._device.allocate(sector.resident.sector.surfel_count + 8)
        for lights, snow, shining, sun_map in product(range(MAX_DIRECTIONAL_LIGHTS + 1), (0.0, 0.5), (None, lamps.buffer), (None, samples)):
            if is_stopped():
                return
            sector.resident.set_lamps(shining)
            sector.resident.set_sun_sample(sun_map)
            dark = np.zeros(lights, DIRECTIONAL_LIGHT.dtype)
            given = RelightInput(np.ones((world.sky_patches, 3), np.float32), dark, snow, world.sky)
            self._relighter.relight([sector.resident], given)
        for tick, settings in enumerate((NEUTRAL, Settings(bounce_factor=2.0))):
            sector.advance(tick, must_show=True, is_read=True)
            # The sector's own part of a volume around its middle: what lies beyond its voxels must not be read.
            box = next(box for box in plan_boxes(volume_first_voxel(index.origin + 32.0)) if box.index == index)
            target = self._device.allocate(4 * 3 * BASIS_SIZES[self.basis] * int(np.prod(VOLUME_SHAPE)))
            cubes = sector.shown(settings, lambda: np.zeros((6, 3), np.float32), self.basis)
            sector.resident.fill_volume(box_record(box, sector.resident.sector), (1, 1, 1), target, cubes, self.basis)
        if self._shadows is not None:
            self._shadows.warm_up(sector)
        self._device.queue.finish()

    def close(self) -> None:
        """Stop the threads that read."""
        self.streamer.close()
        self._geometry_reader.shutdown(cancel_futures=True)
        if self._shadows is not None:
            self._shadows.close()

    def lamps_moved(self, touched: Sequence[tuple[Float64, float]]) -> None:
        """Lamps at positions (3,) [m] with ranges [m] have changed: sectors with a surface in range need light at once, and room for it."""
        self.streamer.lamps_planned |= bool(touched)
        for index, sector in self.streamer.residents.items():
            if any(sector.reaches(position, range_m) for position, range_m in touched):
                self._needs.disturb(self._row[index], WHOLLY)
                self.streamer.count_again(index, lamps=True)

    def _place(self, sector: Sector) -> LiveSector:
        """In a loader's thread: on the device, and lit, so that no tick has to."""
        light = self._light
        assert light is not None  # ticks ask for sectors, and have light
        with self._device.beside():
            placed = self._new_sector(sector)
            is_hurried = self.plan is not None and self.streamer.lacks_within(HURRY_S, self.plan.needs)
            placed.light_ahead(self._relighter_ahead, light, HURRIED_TIMES if is_hurried else AHEAD_TIMES)
            if self._shadows is not None and light.sun_is_up:
                placed.make_room_for_samples()
        return placed

    def _read_geometry(self, index: SectorIndex) -> Geometry:
        """A sector's triangles; none, and a line in the log, where its file is damaged: lamps then shine through what stands there, and
        ticks go on."""
        try:
            return self.dataset.geometry(index)
        except SectorlightError as error:
            log.warning("lamps have no shadows of sector %s: %s", f"{index.x},{index.z}", error)
            return NO_TRIANGLES

    def _new_sector(self, sector: Sector) -> LiveSector:
        return LiveSector(self._device, sector, self.dataset.world.sky_patches, self._shared)

    def _welcome(self, index: SectorIndex, tick: int, light: LiveLight) -> None:
        """Note how far a sector that has just arrived is from the light it should have."""
        row, sector = self._row[index], self.streamer.residents[index]
        assert sector.lit_ahead is not None
        self._needs.arrived(row, tick, sector.lit_ahead.vector, sector.moved_ahead)
        if sector.lamps.given != (light.static_lamps, light.dynamic_lamps):
            self._needs.disturb(row, WHOLLY)

    def _begin_relight(self, tick: int, light: LiveLight, report: TickReport) -> list[_Relit]:
        """Choose sectors and have the device relight them."""
        residents, needs, plan = self.streamer.residents, self._needs, self.plan
        if not residents or plan is None:
            return []
        rows = self.streamer.resident_rows()
        changes = needs.changes(rows, light.vector)
        chosen = plan_tick(tick, needs.relit_at[rows], changes, plan.needs.away_m[rows], places=self._places)
        report.relit = tuple(self.streamer.table.sectors[rows[k]] for k in chosen)
        sectors = [residents[index] for index in report.relit]
        read = [index in self.volumes.looked_at for index in report.relit]
        for index, sector, is_read in zip(report.relit, sectors, read, strict=True):
            sector.light(light, is_read)
            self._count_lamps(index, sector)
        passes = [BURST_PASSES if is_read and needs.at_most(rows[k]) > BURST_CHANGE else 1 for k, is_read in zip(chosen, read, strict=True)]
        cubes = self._relighter.begin([sector.resident for sector in sectors], light.given, passes)
        report.passes = sum(passes)
        return [(int(rows[k]), sector, lit) for k, sector, lit in zip(chosen, sectors, cubes, strict=True)]

    def _end_relight(self, relit: list[_Relit], tick: int, light: LiveLight, report: TickReport) -> None:
        """Wait for them. An idle world settles one instead, nearest first: it has time to make what it shows the very bytes of a query."""
        residents, needs = self.streamer.residents, self._needs
        for row, sector, cubes in relit:
            needs.relit(row, tick, light.vector, sector.measure(cubes()))
        rows = self.streamer.resident_rows()
        inexact = rows[~needs.exact[rows]] if light.standing and not relit else rows[:0]
        if len(inexact) and self.plan is not None:
            row = int(inexact[np.argmin(self.plan.needs.away_m[inexact])])
            index = self.streamer.table.sectors[row]
            if residents[index].settle(self._relighter, light, index in self.volumes.looked_at):
                needs.relit(row, tick, light.vector, 0.0, exact=True)
                report.settled = (index,)
                self._count_lamps(index, residents[index])

    def _count_lamps(self, index: SectorIndex, sector: LiveSector) -> None:
        if sector.lamps.nbytes:  # dozens of lamps cast more shadows than there was room for
            self.streamer.count_again(index, lamps=False)

    def _stream(self, players: TickPlayers, is_busy: bool) -> tuple[SectorIndex, ...]:
        """Plan for where players are and go, and see to it; evicted sectors."""
        if is_busy and self._put_off < MOST_PUT_OFF and not self.streamer.is_overfull:
            self._put_off += 1
            return ()
        self._put_off = 0
        self.plan = self.streamer.step(players.positions, players.velocities)
        self._evicted += self.plan.evictions
        return self.plan.evictions

    def _step_shadows(self, players: TickPlayers, light: LiveLight, boxes: Sequence[MovingBox]) -> None:
        if self._shadows is None:
            return
        residents = self.streamer.residents
        for index in self._shadows.step(players.positions, players.velocities, light, boxes, residents):
            other = index in residents and residents[index].has_other_source
            self._needs.disturb(self._row[index], WHOLLY if other else BURST_CHANGE)

    def _advance(self, tick: int, gains_changed: bool, report: TickReport) -> dict[SectorIndex, float]:
        """Sectors that show something else from this tick on, or are gone, and how far what they show moves, 1.0 being wholly."""
        residents, changed = self.streamer.residents, dict.fromkeys(self._evicted, WHOLLY)
        self._evicted = ()
        # Others have shown what they show since they were looked at last.
        self._fading.update(report.loaded, report.relit, report.settled)
        for index in list(residents) if gains_changed else self._fading.intersection(residents):
            sector = residents[index]
            moved = sector.advance(tick, gains_changed or index in report.settled, index in self.volumes.looked_at)
            if moved is not None:
                changed[index] = moved
        self._fading = {index for index in self._fading.intersection(residents) if residents[index].is_fading}
        return changed

    def _shown(self, sector: LiveSector, light: LiveLight) -> cl.Buffer:
        return sector.shown(light.settings, lambda: self._placeholder(sector.resident.sector.index), self.basis)

    def _placeholder(self, index: SectorIndex) -> Float32:
        """(6, 3) [lx]: the distant probe that stands in for a sector (slide "Distant shading"), in the best light that was baked."""
        texels, light = self._distant, self._light
        assert light is not None
        if index not in self._placeholders:
            if texels.transfer is None:
                sky = texels.sky[index.z - texels.origin.z, index.x - texels.origin.x]
                found = np.asarray(sky[:, None] * light.distant, np.float32)
            else:
                texel = self._texel_of[index]
                found = texels.transfer.light(light.given, light.lighting, slice(texel, texel + 1))[0]
            self._placeholders[index] = found
        return self._placeholders[index]


def _lit_by_a_lamp(device: Device, sector: Sector, sectors: Collection[SectorIndex]) -> SurfelLights:
    """A sector of a world with ``sectors`` beside a lamp and a triangle, neither of which is the world's: no geometry is read."""
    beside = sector.index.origin + sector.surfel_position[0] + 0.5 * sector.surfel_normal[0]
    above = Geometry(beside + np.eye(3), np.array([[0, 1, 2]], np.int32), np.ones((1, 3), np.float32), np.zeros((1, 3), np.float32))
    lamps = SurfelLights(device, sector, ShadowGeometry(lambda _: above, sectors))
    x, y, z = beside.tolist()
    lamps.set_static((Lamp("warm-up", "point", (x, y, z), 1.0, range_m=1.0),))
    return lamps
