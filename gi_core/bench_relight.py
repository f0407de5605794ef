"""Timings of the relighter's ticks, on made-up sectors of the talk's size.

python -m gi_core.bench_relight DATASET      how the made-up sector's statistics compare with a baked city's
"""

import itertools
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from gi_core import relight_twin, shadow_map_twin
from gi_core.arrays import AnyArray, UInt8
from gi_core.bench import (
    SKY_PATCHES,
    TALK_FACTORS,
    TALK_PROBES,
    TALK_SURFELS,
    Measurement,
    daylight,
    side_by_side,
    talk_size_sector,
)
from gi_core.constants import SURFEL_CELL_M
from gi_core.dataset import Dataset
from gi_core.device import Device, shared_device
from gi_core.geometry_file import Geometry
from gi_core.grid import SectorIndex
from gi_core.layout import BOUNCE
from gi_core.light_geometry import ShadowGeometry
from gi_core.light_surfels import SurfelLights
from gi_core.relight import Relighter
from gi_core.relight_input import RelightInput
from gi_core.resident_sector import ResidentSector
from gi_core.sector import Sector
from gi_core.shadow_map import ShadowMap, SunSamples
from gi_core.shadow_plan import MovingBox, box_corners, box_triangles, caster_records, plan_map
from gi_core.world import Lamp

# Ticks rotate over this many sectors, so that no tick finds the last one's data in the nearest cache.
ROTATION = 8
# The sun stands elsewhere at every tick; after so many it starts again.
SUNS = 64
LAMPS = 16
SNOW = 0.5
CITY_TOP_M = 40.0


def made_up_city() -> Geometry:
    """Sixteen boxes on one sector: something for shadow rays to meet."""
    boxes = [MovingBox((x, y, z), (4.0, y, 4.0), x) for x in (8, 24, 40, 56) for z, y in ((8, 5), (24, 10), (40, 15), (56, 20))]
    corners = box_triangles(box_corners(boxes))
    triangles = np.arange(3 * len(corners), dtype=np.int32).reshape(-1, 3)
    colours = np.zeros((len(corners), 3), np.float32)
    return Geometry(corners.reshape(-1, 3), triangles, colours, colours)


def snowy_sectors() -> list[Sector]:
    """Sectors of the talk's size for one rotation, snow all over them."""
    rng = np.random.default_rng(0)
    plain = [talk_size_sector(seed) for seed in range(ROTATION)]
    return [replace(sector, surfel_snow=rng.uniform(0, 1, sector.surfel_count).astype(np.float32)) for sector in plain]


def moving_suns() -> list[RelightInput]:
    """One moment's light after another, under a sun that never stands where it stood, and with snow."""
    day, given = daylight(), []
    for step in np.linspace(0, 1, SUNS):
        lights = day.lights.copy()
        direction = np.array([0.4 + 0.02 * step, 0.8, 0.447 - 0.02 * step])
        lights["direction"][0, :3] = direction / np.linalg.norm(direction)
        lights["plane_weight"][0] = (0.4 - 0.3 * step, 0.3 + 0.3 * step, 0.2, 0.1)
        given.append(RelightInput(day.patch_exitance, lights, SNOW))
    return given


class Ticks:
    """Sectors with all that a relight can have, and what a tick does to two of them: the next two at each tick."""

    def __init__(self, device: Device, sectors: list[Sector]) -> None:
        self.device, self.given = device, moving_suns()
        self.residents = [ResidentSector(device, sector, SKY_PATCHES) for sector in sectors]
        self.samples = [SunSamples(device, resident) for resident in self.residents]
        here, city = SectorIndex(0, 0), made_up_city()
        self.shadow_map = ShadowMap(device, lambda index: caster_records(city, index), CITY_TOP_M)
        plan = plan_map(np.array([32.0, 2.0, 32.0]), self.given[0].lights["direction"][0, :3].astype(float), {here}, 0.0, CITY_TOP_M)
        assert plan is not None
        self.shadow_map.begin(plan)
        while not self.shadow_map.draw(1 << 20):
            pass
        rng = np.random.default_rng(0)
        places = rng.uniform(0, 64, (LAMPS, 3)).tolist()
        self.lamps = [Lamp(str(i), "point", (x, y, z), 8000.0, range_m=40.0) for i, (x, y, z) in enumerate(places)]
        self.shadows = ShadowGeometry(lambda _: city, {here})
        self.surfel_lights = [SurfelLights(device, sector, self.shadows) for sector in sectors]
        for resident, lights in zip(self.residents, self.surfel_lights, strict=True):
            lights.set_dynamic(self.lamps)
            resident.set_lamps(lights.buffer)
        self._relighter, self._turn = Relighter(device), itertools.count()

    def sun_moved(self) -> None:
        """The sun has moved: both sectors are lit, through the samples of the shadow map that they have, and relit."""
        turn, pair = self._next()
        self._relight(pair, turn)

    def everything(self) -> None:
        """The sun has moved, the shadow map is another: both sectors are sampled, lit and relit."""
        turn, pair = self._next()
        for i in pair:
            self.shadow_map.sample(self.samples[i])
        self._relight(pair, turn)

    def flickering(self) -> None:
        """``sun_moved``, and all lamps have changed their brightness."""
        turn, pair = self._next()
        lamps = [replace(lamp, lumens=7000.0 + (turn * (i + 3)) % 2000) for i, lamp in enumerate(self.lamps)]
        for i in pair:
            self.surfel_lights[i].set_dynamic(lamps)
            self.residents[i].set_lamps(self.surfel_lights[i].buffer)
        self._relight(pair, turn)

    def settled(self) -> None:
        """The light is what it was: a bounce for both sectors."""
        _, pair = self._next()
        self._relight(pair, 0)

    def sun_moved_twin(self) -> None:
        """``sun_moved`` in NumPy; it finds samples and lamps' light ready as a tick does."""
        turn, pair = self._next()
        for i in pair:
            self._relight_twin(i, turn, self._sun_sample[i])

    def everything_twin(self) -> None:
        """``everything`` in NumPy; it finds lamps' light ready as a tick does."""
        turn, pair = self._next()
        plan = self.shadow_map.plan
        assert plan is not None
        for i in pair:
            sector = self.residents[i].sector
            cell = np.full(sector.surfel_count, SURFEL_CELL_M, np.float32)
            sample, _ = shadow_map_twin.sample(plan, self._depth, sector.surfel_position, sector.surfel_normal, cell, CITY_TOP_M)
            self._relight_twin(i, turn, sample)

    def _relight_twin(self, i: int, turn: int, sample: UInt8) -> None:
        sector, lamps = self.residents[i].sector, self._lamp_light[i]
        relight_twin.relight(sector, self.given[turn % SUNS], self._cubes[i], 1, lamps=lamps, sun_sample=sample)

    def read_for_twin(self) -> None:
        """What the twin starts from, so that reading it is not timed."""
        self._depth = self.shadow_map.read()
        self._cubes = [resident.read_cubes() for resident in self.residents]
        self._sun_sample = [samples.read()[0] for samples in self.samples]
        self._lamp_light: list[AnyArray] = []
        for lights, resident in zip(self.surfel_lights, self.residents, strict=True):
            light = np.zeros((resident.sector.surfel_count, 4), np.float32)
            if lights.buffer is not None:
                self.device.read(lights.buffer, light)
            self._lamp_light.append(np.ascontiguousarray(light[:, :3]))

    def _next(self) -> tuple[int, tuple[int, int]]:
        turn = next(self._turn)
        return turn, (2 * turn % len(self.residents), (2 * turn + 1) % len(self.residents))

    def _relight(self, pair: tuple[int, int], turn: int) -> None:
        self._relighter.relight([self.residents[i] for i in pair], self.given[turn % SUNS])
        self.device.queue.finish()


def bench_ticks(device: Device, rounds: int = 15) -> list[Measurement]:
    """Ticks of two sectors, host and device, each with one bounce.

    ``relight_two_sectors`` has all there is: sun, sky, samples of the shadow map, snow, 16 lamps and feedback, the sun at every tick
    elsewhere. Samples, snow and lamps stay as they are. ``_resampled`` takes both sectors' samples anew too, as the live world does when a
    map was drawn, every quarter of a degree of the sun; ``_flicker`` changes 16 lamps at every tick, ``_settled`` nothing.
    ``relight_host`` makes the calls of ``_resampled`` for sectors of one probe and one brick: Python and driver.
    """
    ticks, tiny = Ticks(device, snowy_sectors()), Ticks(device, [talk_size_sector(seed, 1, 1, 1 + SKY_PATCHES) for seed in range(ROTATION)])
    for _ in range(ROTATION):
        ticks.flickering()
        ticks.everything()
        tiny.everything()
    ticks.read_for_twin()
    sizes = {"sectors": 2, "probes": TALK_PROBES, "surfels": TALK_SURFELS, "factors": TALK_FACTORS}

    def row(name: str, run: Callable[[], None], beside: Callable[[], None], rounds: int, what: str, sizes: dict[str, int]) -> Measurement:
        median, baseline = (1e3 * s for s in side_by_side(run, beside, rounds, calls=20))
        return Measurement(name, median, "ms", baseline, baseline / median, sizes, device.name, what)

    lit, all_of = sizes | {"lamps": LAMPS}, "relight_two_sectors"
    return [
        row("relight_two_sectors", ticks.sun_moved, ticks.sun_moved_twin, rounds, "NumPy twin, float32; each tick: the sun moves", lit),
        row("relight_two_sectors_resampled", ticks.everything, ticks.everything_twin, rounds, "NumPy twin, float32; both sample anew", lit),
        row("relight_two_sectors_settled", ticks.settled, ticks.sun_moved, 5 * rounds, f"{all_of}; here nothing moves", sizes),
        row("relight_two_sectors_flicker", ticks.flickering, ticks.sun_moved, 5 * rounds, f"{all_of}: lamps steady", lit),
        row("relight_host", tiny.everything, ticks.everything, 5 * rounds, f"{all_of}_resampled; here one probe and brick", {"sectors": 2}),
    ]


def statistics(sectors: list[Sector], device: Device) -> dict[str, float]:
    """Means over sectors: what a tick's time depends on besides the counts of the talk."""
    bounces = []
    for sector in sectors:
        resident = ResidentSector(device, sector, SKY_PATCHES)
        Relighter(device).relight([resident], daylight())
        device.queue.finish()
        bounces.append(0 if resident.bounces is None else resident.bounces.size / BOUNCE.dtype.itemsize)
    surfels = sum(s.surfel_count for s in sectors)
    return {
        "surfels a brick": surfels / sum(s.brick_count for s in sectors),
        "bounces a surfel": sum(bounces) / surfels,
        "factors a probe": sum(s.factor_count for s in sectors) / sum(s.probe_count for s in sectors),
    }


def run(device: Device, quick: bool = False) -> list[Measurement]:
    """All rows of the relighter; ``quick`` ones are a look, not a result."""
    from gi_core.bench_features import bench_features  # which imports this module

    return bench_ticks(device, 1) if quick else [*bench_ticks(device), *bench_features(device)]


if __name__ == "__main__":
    dataset = Dataset.open(Path(sys.argv[1]))
    known = [index for index, facts in sorted(dataset.world.sectors.items()) if facts.probes and facts.surfels]
    picks = np.random.default_rng(0).choice(len(known), min(20, len(known)), replace=False)
    for title, found in (("made up", [talk_size_sector(0)]), (sys.argv[1], [dataset.sector(known[i]) for i in picks])):
        print(title, {name: round(value, 2) for name, value in statistics(found, shared_device()).items()})
