"""What each feature adds to a tick of two sectors and keeps on the device for them, and what is left of that when it is off again."""

import itertools
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from gi_core.arrays import Bool, Float64
from gi_core.basis import average
from gi_core.bench import SKY_PATCHES, TALK_PROBES, Measurement, talk_size_sector
from gi_core.bench_relight import ROTATION, Ticks, moving_suns
from gi_core.constants import VOLUME_SHAPE, VOXEL_INDOORS
from gi_core.device import Device
from gi_core.light_surfels import SurfelLights
from gi_core.relight import Relighter
from gi_core.relight_input import RelightInput
from gi_core.resident_sector import ResidentSector
from gi_core.rooms import nearest
from gi_core.sector import Sector
from gi_core.shadow_map import SunSamples
from gi_core.volume import box_record, box_slices, plan_boxes
from gi_core.voxel_grid import ResidentGrid, VoxelGrid

FEEDBACK_PROBES = 4
# Of the made-up room: probes 0 to this, and the voxels [y, z, x] that blend them and no others.
ROOM_PROBES = 10
ROOM_VOXELS = (slice(0, 3), slice(4, 10), slice(4, 10))

Pair = Sequence[ResidentSector]


@dataclass
class _Side:
    """One of the things compared: sectors, the light of one tick after another, and what else a tick does.

    before : called with the number of each sector about to be relit; after : with the two that were
    lamps, samples : what else is held on the device, for each sector, if anything
    """

    residents: list[ResidentSector]
    given: list[RelightInput]
    before: Callable[[int], None] = field(default=lambda _: None)
    after: Callable[[Pair], None] = field(default=lambda _: None)
    lamps: list[SurfelLights] = field(default_factory=list)
    samples: list[SunSamples] = field(default_factory=list)

    @property
    def nbytes(self) -> int:
        """On the device for two sectors."""
        return sum(held.nbytes for parts in (self.residents, self.lamps, self.samples) for held in parts[:2])

    def ticks(self, device: Device) -> Callable[[], None]:
        """A function that relights two of the sectors at each call, in rotation, and waits."""
        relighter, turns = Relighter(device), itertools.count()

        def tick() -> None:
            turn = next(turns)
            numbers = [2 * turn % ROTATION, (2 * turn + 1) % ROTATION]
            for i in numbers:
                self.before(i)
            pair = [self.residents[i] for i in numbers]
            relighter.relight(pair, self.given[turn % len(self.given)])
            self.after(pair)
            device.queue.finish()

        return tick

    def switched_off(self, device: Device, given: list[RelightInput], after: Callable[[Pair], None]) -> "_Side":
        """The same sectors once each was lit with the feature and then lost it, as the live world takes lamps and samples away."""
        tick = self.ticks(device)
        for _ in range(ROTATION // 2):
            tick()
        for resident in self.residents:
            resident.set_lamps(None)
            resident.set_sun_sample(None)
        for lamps in self.lamps:
            lamps.set_static(())
        return _Side(self.residents, given, after=after, lamps=self.lamps)


def bench_features(device: Device, rounds: int = 320) -> list[Measurement]:
    """Each feature beside the same tick without it. The light changes at every tick, so what is only done then counts in full.

    ``us_added`` and ``bytes_added`` are for two sectors, beside a tick that never knew of the feature; snow's attribute is the fourth
    component of an albedo, so it adds no bytes. ``us_left`` and ``bytes_left`` are those of sectors that had it before, beside the same
    tick: emission and feedback weights are baked and never go. The relighter has no code for interiors and fog, so their ticks also fill
    and read a volume: ``interior`` another one of a room, from buffers that live as long as the query, ``fog`` the mean over directions.
    """
    plain = [talk_size_sector(seed) for seed in range(ROTATION)]
    rng = np.random.default_rng(0)
    shining = [replace(s, surfel_emission=rng.uniform(0, 10, (s.surfel_count, 3)).astype(np.float32)) for s in plain]
    snowy = [replace(s, surfel_snow=rng.uniform(0, 1, s.surfel_count).astype(np.float32)) for s in plain]
    sun = [replace(given, snow=0.0) for given in moving_suns()]
    dark = [replace(given, lights=given.lights[:0]) for given in sun]
    sun_and_moon = [replace(given, lights=np.concatenate([given.lights, given.lights])) for given in sun]
    worst, volumes = Ticks(device, plain), _Volumes(device)

    def side(sectors: list[Sector], given: list[RelightInput], after: Callable[[Pair], None] = lambda _: None) -> _Side:
        return _Side([ResidentSector(device, sector, SKY_PATCHES) for sector in sectors], given, after=after)

    def lit() -> _Side:
        found = replace(side(plain, sun), lamps=[SurfelLights(device, sector, worst.shadows) for sector in plain])
        for resident, lamps in zip(found.residents, found.lamps, strict=True):
            lamps.set_static(worst.lamps)
            resident.set_lamps(lamps.buffer)
        return found

    def sampled() -> _Side:
        found = side(plain, sun)
        samples = [SunSamples(device, resident) for resident in found.residents]
        return replace(found, before=lambda i: worst.shadow_map.sample(samples[i]), samples=samples)

    def feature(name: str, on: Callable[[], _Side], off: _Side, is_baked: bool = False, **sizes: int) -> Measurement:
        sides = [on(), off] if is_baked else [on(), off, on().switched_off(device, off.given, off.after)]
        taken = _by_turns([side.ticks(device) for side in sides], rounds)
        with_it, without_it, *_ = np.median(taken, axis=0).tolist()
        # Of what each turn's differ by: other work on the machine slows neighbours alike.
        more = np.median(taken - taken[:, 1:2], axis=0)
        for side, word in zip(sides[::2], ("added", "left"), strict=False):
            sizes = {f"bytes_{word}": side.nbytes - off.nbytes} | sizes
        sizes |= {f"us_{word}": round(1e6 * float(s)) for s, word in zip(more[::2], ("added", "left"), strict=False)}
        what = "the same tick without it"
        return Measurement(f"feature_{name}", 1e3 * with_it, "ms", 1e3 * without_it, without_it / with_it, sizes, device.name, what)

    roomy, read = [_with_room(sector) for sector in plain], volumes.outdoor
    grids = sum(volumes.grid(sector).nbytes for sector in roomy[:2])
    return [
        feature("sun", lambda: side(plain, sun), side(plain, dark)),
        feature("moon", lambda: side(plain, sun_and_moon), side(plain, sun)),
        feature("snow", lambda: side(snowy, [replace(given, snow=0.5) for given in sun]), side(plain, sun)),
        feature("lamps", lit, side(plain, sun), bytes_shared=worst.shadows.on_device(device).nbytes),
        feature("emission", lambda: side(shining, sun), side(plain, sun), is_baked=True),
        feature("feedback_weights", lambda: side([_weighted(s, rng) for s in plain], sun), side(plain, sun), is_baked=True),
        feature("shadow_map", sampled, side(plain, sun), bytes_shared=worst.shadow_map.nbytes),
        feature("interior", lambda: side(roomy, sun, volumes.interior), side(plain, sun, read), bytes_added=grids),
        feature("fog", lambda: side(plain, sun, volumes.fog), side(plain, sun, read)),
    ]


class _Volumes:
    """What queries of each kind do once their sectors are lit. One sector of a rotation lies where the others do."""

    def __init__(self, device: Device) -> None:
        self._device = device
        self._box = plan_boxes(np.zeros(3, np.int64))[0]
        self._values = np.zeros((6, *VOLUME_SHAPE, 3), np.float32)
        self._target = device.allocate(self._values.nbytes)
        inside: Bool = np.zeros(VOLUME_SHAPE, np.bool_)
        inside[box_slices(self._box)][ROOM_VOXELS] = True
        self._inside = inside

    def outdoor(self, pair: Pair) -> None:
        """Fill the volume, and read it."""
        for resident in pair:
            resident.fill_volume(box_record(self._box, resident.sector), self._box.size, self._target)
        self._device.read(self._target, self._values)

    def fog(self, pair: Pair) -> None:
        """``outdoor``, and the mean over directions."""
        self.outdoor(pair)
        average(self._values)

    def interior(self, pair: Pair) -> None:
        """``outdoor``, and the volume of the room as well."""
        self.outdoor(pair)
        for resident in pair:
            self.grid(resident.sector).fill(self._box, self._target, resident.cubes, "cube")
        self._device.read(self._target, self._values)
        self._values[(slice(None), *nearest(self._inside))]

    def grid(self, sector: Sector) -> ResidentGrid:
        """A sector's voxels as its rooms blend them, on the device."""
        return ResidentGrid(self._device, VoxelGrid(sector.voxel_first, sector.voxel_class, sector.voxel_probe, sector.voxel_weight))


def _by_turns(runs: Sequence[Callable[[], None]], rounds: int) -> Float64:
    """Times (rounds, runs) [s] of things that take turns, in any order: what runs before leaves the caches as it pleases."""
    taken = np.zeros((rounds + ROTATION, len(runs)))
    rng = np.random.default_rng(0)
    for row in taken:
        for i in rng.permutation(len(runs)):
            started = time.perf_counter()
            runs[i]()
            row[i] = time.perf_counter() - started
    return taken[ROTATION:]


def _with_room(sector: Sector) -> Sector:
    """The sector with a room that has probes and voxels of its own."""
    kind, room, probe = sector.voxel_class.copy(), sector.voxel_room.copy(), sector.voxel_probe.copy()
    kind[ROOM_VOXELS], room[ROOM_VOXELS] = VOXEL_INDOORS, 1
    probe[probe < ROOM_PROBES] += ROOM_PROBES
    probe[ROOM_VOXELS] %= ROOM_PROBES
    in_room = np.arange(sector.probe_count) < ROOM_PROBES
    return replace(sector, voxel_class=kind, voxel_room=room, voxel_probe=probe, probe_room=in_room.astype(np.uint16))


def _weighted(sector: Sector, rng: np.random.Generator) -> Sector:
    """The sector with several weighted feedback probes for each surfel, those of a brick's neighbours the same."""
    shape = (sector.surfel_count, FEEDBACK_PROBES)
    probe = (sector.feedback_probe.astype(int) + np.arange(FEEDBACK_PROBES)) % TALK_PROBES
    weight = rng.uniform(0.1, 1, shape)
    return replace(
        sector, feedback_probe=probe.astype(np.uint16), feedback_weight=(weight / weight.sum(axis=1, keepdims=True)).astype(np.float32)
    )
