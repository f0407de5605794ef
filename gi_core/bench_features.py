"""What each feature of the relighter adds to a tick of two sectors, and what it keeps on the device for them."""

import itertools
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import pyopencl as cl

from gi_core.bench import SKY_PATCHES, TALK_PROBES, Measurement, talk_size_sector
from gi_core.bench_relight import ROTATION, Ticks, moving_suns
from gi_core.device import Device
from gi_core.relight import Relighter
from gi_core.relight_input import RelightInput
from gi_core.resident_sector import ResidentSector
from gi_core.sector import Sector

FEEDBACK_PROBES = 4


@dataclass
class _Side:
    """One of the two things compared: sectors, the light of one tick after another, and what else a tick does.

    before : called with the number of each sector about to be relit
    held : bytes on the device for two sectors beyond what they hold themselves
    """

    residents: list[ResidentSector]
    given: list[RelightInput]
    before: Callable[[int], None] = field(default=lambda _: None)
    held: int = 0

    @property
    def nbytes(self) -> int:
        """On the device for two sectors."""
        return sum(resident.nbytes for resident in self.residents[:2]) + self.held

    def ticks(self, device: Device) -> Callable[[], None]:
        """A function that relights two of the sectors at each call, in rotation, and waits."""
        relighter, turns = Relighter(device), itertools.count()

        def tick() -> None:
            turn = next(turns)
            pair = [2 * turn % ROTATION, (2 * turn + 1) % ROTATION]
            for i in pair:
                self.before(i)
            relighter.relight([self.residents[i] for i in pair], self.given[turn % len(self.given)])
            device.queue.finish()

        return tick


def bench_features(device: Device, rounds: int = 160) -> list[Measurement]:
    """Each feature beside the same tick without it. The light changes at every tick, so what is only done then counts in full.

    ``us_added`` and ``bytes_added`` are for two sectors; snow's attribute is the fourth component of an albedo, so it adds no bytes.
    Without a feature its kernels have no code for it and there is no buffer, so the baseline is a tick that never knew of it. Interiors
    and fog have no rows: rooms are voxels' business and fog is the sky's, and the relighter has no code for either.
    """
    plain = [talk_size_sector(seed) for seed in range(ROTATION)]
    rng = np.random.default_rng(0)
    shining = [replace(s, surfel_emission=rng.uniform(0, 10, (s.surfel_count, 3)).astype(np.float32)) for s in plain]
    snowy = [replace(s, surfel_snow=rng.uniform(0, 1, s.surfel_count).astype(np.float32)) for s in plain]
    sun = [replace(given, snow=0.0) for given in moving_suns()]
    dark = [replace(given, lights=given.lights[:0]) for given in sun]
    sun_and_moon = [replace(given, lights=np.concatenate([given.lights, given.lights])) for given in sun]
    worst = Ticks(device, plain)
    lit = [device.upload(np.ones((s.surfel_count, 4), np.float32)) for s in plain]

    def side(sectors: list[Sector], given: list[RelightInput], lamps: list[cl.Buffer] | None = None) -> _Side:
        residents = [ResidentSector(device, sector, SKY_PATCHES) for sector in sectors]
        for resident, buffer in zip(residents, lamps or [None] * len(residents), strict=True):
            resident.set_lamps(buffer)
        return _Side(residents, given, held=0 if lamps is None else sum(buffer.size for buffer in lamps[:2]))

    def sampled() -> _Side:
        for resident in worst.residents:
            resident.set_lamps(None)
        return _Side(
            worst.residents, sun, lambda i: worst.shadow_map.sample(worst.samples[i]), sum(samples.nbytes for samples in worst.samples[:2])
        )

    def feature(name: str, on: _Side, off: _Side, **sizes: int) -> Measurement:
        with_it, without_it, added = _paired(on.ticks(device), off.ticks(device), rounds)
        sizes = {"us_added": round(1e6 * added), "bytes_added": on.nbytes - off.nbytes} | sizes
        what = "the same tick without it"
        return Measurement(f"feature_{name}", 1e3 * with_it, "ms", 1e3 * without_it, without_it / with_it, sizes, device.name, what)

    return [
        feature("sun", side(plain, sun), side(plain, dark)),
        feature("moon", side(plain, sun_and_moon), side(plain, sun)),
        feature("snow", side(snowy, [replace(given, snow=0.5) for given in sun]), side(plain, sun)),
        feature("lamps", side(plain, sun, lit), side(plain, sun)),
        feature("emission", side(shining, sun), side(plain, sun)),
        feature("feedback_weights", side([_weighted(s, rng) for s in plain], sun), side(plain, sun)),
        feature("shadow_map", sampled(), side(plain, sun), bytes_shared=worst.shadow_map.nbytes),
    ]


def _paired(on: Callable[[], None], off: Callable[[], None], rounds: int) -> tuple[float, float, float]:
    """Median times [s] of two things that take turns, and the median of what each turn's differ by: other work on the machine slows
    neighbours alike."""
    taken = []
    for _ in range(rounds + ROTATION):
        for run in (on, off):
            started = time.perf_counter()
            run()
            taken.append(time.perf_counter() - started)
    pairs = np.array(taken[2 * ROTATION :]).reshape(-1, 2)
    with_it, without_it = np.median(pairs, axis=0).tolist()
    return with_it, without_it, float(np.median(pairs[:, 0] - pairs[:, 1]))


def _weighted(sector: Sector, rng: np.random.Generator) -> Sector:
    """The sector with several weighted feedback probes for each surfel, those of a brick's neighbours the same."""
    shape = (sector.surfel_count, FEEDBACK_PROBES)
    probe = (sector.feedback_probe.astype(int) + np.arange(FEEDBACK_PROBES)) % TALK_PROBES
    weight = rng.uniform(0.1, 1, shape)
    return replace(
        sector, feedback_probe=probe.astype(np.uint16), feedback_weight=(weight / weight.sum(axis=1, keepdims=True)).astype(np.float32)
    )
