"""The sources of the sun's visibility as the relighter has them, timed on the device; and suns to compare them under."""

import itertools
import time
from collections.abc import Callable
from datetime import datetime, timedelta

import numpy as np

from gi_core import relight_twin
from gi_core.arrays import Bool, Float64
from gi_core.clock_time import local_time
from gi_core.dataset import Dataset
from gi_core.device import Device
from gi_core.geometry_file import Geometry
from gi_core.grid import SectorIndex
from gi_core.layout import DIRECTIONAL_LIGHT, NO_SAMPLE, WHOLE_SAMPLE
from gi_core.relight import Relighter
from gi_core.relight_input import RelightInput
from gi_core.resident_sector import ResidentSector
from gi_core.shadow_map import ShadowMap, SunSamples
from gi_core.shadow_plan import FRESH_DEGREES, caster_records, plan_map
from gi_core.sun import sun_position
from gi_core.world import Location

ELEVATIONS_DEGREES = (5.0, 10.0, 20.0, 40.0, 60.0)
# Between the table's rows of declination, which the solstices and the equinoxes lie on.
MONTH, DAY = 5, 20
_STEP = timedelta(seconds=30)
_REPEATS = 12


def suns(location: Location) -> list[tuple[float, Float64, Float64]]:
    """(elevation [degrees], direction, direction one degree of sky earlier) of the morning and the evening of 20 May.

    Elevations that the sun does not reach on that day are left out.
    """
    noon = datetime(location.date.year, MONTH, DAY, 12)
    moments = [local_time((noon + step * _STEP).astimezone(), location) for step in range(-1440, 1440)]
    positions = [sun_position(location, moment) for moment in moments]
    height = np.array([position.elevation_degrees for position in positions])
    direction = np.array([position.direction(location.north_degrees) for position in positions])
    found = []
    for elevation in ELEVATIONS_DEGREES:
        for now in np.flatnonzero((height[:-1] < elevation) != (height[1:] < elevation)).tolist():
            near = np.flatnonzero(direction[:now] @ direction[now] < np.cos(np.radians(FRESH_DEGREES)))
            if len(near):
                found.append((elevation, direction[now], direction[near[-1] + 1]))
    return found


class SunSources:
    """Shares of the sun of a sector's surfels, by source. ``*_seconds`` gather what the device took."""

    def __init__(self, dataset: Dataset, device: Device, geometry: Callable[[SectorIndex], Geometry]) -> None:
        self.table_seconds: list[float] = []
        self.draw_seconds: list[float] = []
        self.sample_seconds: list[float] = []
        self._world, self._device = dataset.world, device
        self._low, self._top = (float(height) for height in dataset.world.bounds[:, 1])
        self._map = ShadowMap(device, lambda index: caster_records(geometry(index), index), self._top)
        self._relighter, self._brightness = Relighter(device), itertools.count(1)

    def table(self, resident: ResidentSector, to_sun: Float64) -> Float64:
        """(S,) 0..1, the bake's. Times what every source needs and the table alone: direct light from visibility to bricks."""
        planes, weights = self._world.sun_table.lookup(to_sun)
        light = np.zeros(1, DIRECTIONAL_LIGHT.dtype)
        light["direction"][0, :3], light["plane"], light["plane_weight"] = to_sun, planes, weights
        patches = np.zeros((self._world.sky_patches, 3), np.float32)

        def run() -> None:
            light["irradiance"] = next(self._brightness)  # not last time's light, or nothing would run
            self._relighter.relight([resident], RelightInput(patches, light.copy()), passes=0)

        self.table_seconds += self._timed(run)
        bits = [relight_twin.sun_bits(resident.sector, int(plane)) for plane in planes]
        return np.asarray(weights.astype(np.float64) @ np.array(bits, np.float64))

    def shadow_map(self, samples: SunSamples, eye: Float64, to_sun: Float64) -> tuple[Float64, Bool]:
        """(S,) 0..1 of a map drawn around a player at ``eye`` (3,) [m], and (S,) where it is valid."""
        plan = plan_map(eye, to_sun, self._world.sectors, self._low, self._top)
        if plan is None:
            return np.zeros(samples.resident.sector.surfel_count), np.zeros(samples.resident.sector.surfel_count, bool)

        def draw() -> None:
            self._map.begin(plan)
            while not self._map.draw(1 << 30):
                pass
            self._device.queue.finish()

        draw()  # takes triangles to the device, as a map before has
        started = time.perf_counter()
        draw()
        self.draw_seconds.append(time.perf_counter() - started)
        self.sample_seconds += self._timed(lambda: self._map.sample(samples))
        samples.resident.set_sun_sample(None)
        share, number = samples.read()
        return share / WHOLE_SAMPLE, (number == samples.number) & (share != NO_SAMPLE)

    def _timed(self, run: Callable[[], None]) -> list[float]:
        taken = []
        for _ in range(_REPEATS):
            started = time.perf_counter()
            run()
            self._device.queue.finish()
            taken.append(time.perf_counter() - started)
        return taken[2:]
