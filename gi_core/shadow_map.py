"""The sun's shadow map on the device, and the surfels' samples of it (slide "Sun shadow").

Drawn a few sectors at a time into a buffer of its own, and looked at only when whole: no tick waits for a map, and no surfel sees half
of one. Queries never use it: their answer must not depend on where a player stands.
"""

from collections import OrderedDict
from collections.abc import Callable

import numpy as np
import pyopencl as cl

from gi_core.arrays import AnyArray, Float32, Float64, UInt8, UInt16
from gi_core.constants import SURFEL_CELL_M
from gi_core.device import Device
from gi_core.grid import SectorIndex
from gi_core.layout import NO_SAMPLE, SHADOW_ROW_TEXELS
from gi_core.relight_launch import SURFELS_PER_GROUP
from gi_core.resident_sector import ResidentSector
from gi_core.sector import counts
from gi_core.shadow_plan import FRESH_DEGREES, MAP_TEXELS, ShadowPlan, box_triangles, is_near, oldest_fresh, triangle_records

NOTHING_DRAWN = np.float32(-1e30)  # as in shadow_map.h
# Each work-item looks at every triangle. A CPU wants few of them, though more than cores; a GPU wants many.
CPU_ITEMS_PER_CORE, GPU_ITEMS = 2, 256
# Triangles of sectors that stay on the device for the next map, 48 bytes each.
KEPT_BYTES = 1 << 25
# A sector's looks at maps are numbered with 16 bits; its samples start anew when they run out.
LAST_NUMBER = 0xFFFF
# Looks at maps for suns this close are as old as the first of them: a box that moves has a map drawn at every tick, under one sun.
_ONE_LOOK_DEGREES = FRESH_DEGREES / 16


class SunSamples:
    """One resident sector's samples: share of the sun, and at which of its looks at a map each was taken. 19 bytes a surfel.

    sun_sample : (S padded to whole groups of eight,) uint8 on the device: share of layout.WHOLE_SAMPLE, or NO_SAMPLE
    sampled_in : (S padded,) uint16 on the device: the number of the look that a sample is from, 0 before any
    number : of the last look, 0 before any
    """

    def __init__(self, device: Device, resident: ResidentSector) -> None:
        sector = resident.sector
        self.groups = -(-sector.surfel_count // SURFELS_PER_GROUP)
        padded = self.groups * SURFELS_PER_GROUP
        place = np.zeros((4, padded), np.float32)
        place[:3, : sector.surfel_count] = sector.surfel_position.T
        cell = SURFEL_CELL_M * 2.0 ** sector.brick_level.astype(np.float32)
        place[3, : sector.surfel_count] = np.repeat(cell, counts(sector.brick_starts))
        self.resident = resident
        self.place = device.upload(place)
        self.sun_sample = device.upload(np.full(padded, NO_SAMPLE, np.uint8))
        self.sampled_in = device.allocate(2 * padded)
        self.number = 0
        self._forget = device.shared_kernel("forget_sun_samples")
        self._looks: list[tuple[int, Float64]] = []
        """Numbers and suns of the looks that samples may be from, oldest first; of a run of looks at nearly one sun the first."""
        self._framed: ShadowPlan | None = None
        self._frame: AnyArray

    @staticmethod
    def nbytes_of(surfels: int) -> int:
        """Bytes on the device that samples of so many surfels take."""
        return (16 + 1 + 2) * -(-surfels // SURFELS_PER_GROUP) * SURFELS_PER_GROUP

    @property
    def nbytes(self) -> int:
        """Bytes on the device."""
        return int(self.place.size + self.sun_sample.size + self.sampled_in.size)

    def frame(self, plan: ShadowPlan) -> AnyArray:
        """(1,) layout.SHADOW_FRAME of the sector, kept until another plan comes."""
        if plan is not self._framed:
            self._framed, self._frame = plan, plan.frame(self.resident.sector.index.origin)
        return self._frame

    @property
    def are_there(self) -> bool:
        """Whether any surfel may have a sample."""
        return bool(self._looks)

    def look(self, to_sun: Float64) -> int:
        """Count another look, at a map for a sun towards (3,), unit: the number of the oldest look whose samples are fresh under it."""
        if self.number == LAST_NUMBER:
            device = self.resident.device
            cl.enqueue_fill_buffer(device.queue, self.sampled_in, np.uint16(0), 0, self.sampled_in.size)
            self.number, self._looks = 0, []
        self.number += 1
        if not self._looks or not is_near(self._looks[-1][1], to_sun, _ONE_LOOK_DEGREES):
            self._looks.append((self.number, to_sun))
        return self._oldest_kept(to_sun)

    def forget_old(self, to_sun: Float64) -> bool:
        """Enqueue the forgetting of samples that are not fresh under a sun towards (3,), unit; whether there may be such."""
        looks = len(self._looks)
        kept = self._oldest_kept(to_sun)
        if len(self._looks) == looks:
            return False
        if self.groups:
            self._forget.launch_1d(self.groups, np.uint32(self.groups), np.uint32(kept), self.sampled_in, self.sun_sample)
        return True

    def read(self) -> tuple[UInt8, UInt16]:
        """(S,) uint8 samples and (S,) uint16 numbers of looks: a surfel's source is the map when its number is the last look's, its last
        sample when it is an older one, and the bake where the sample is NO_SAMPLE."""
        count = self.resident.sector.surfel_count
        sample, sampled_in = np.zeros(count, np.uint8), np.zeros(count, np.uint16)
        self.resident.device.read(self.sun_sample, sample)
        self.resident.device.read(self.sampled_in, sampled_in)
        return sample, sampled_in

    def _oldest_kept(self, to_sun: Float64) -> int:
        """Leave looks out that are not fresh under a sun; the number of the oldest that is left, or of the next when none is."""
        del self._looks[: oldest_fresh([drawn_for for _, drawn_for in self._looks], to_sun)]
        return self._looks[0][0] if self._looks else self.number + 1


class ShadowMap:
    """The map that is drawn, and the one that surfels look at. Not for several threads at once."""

    def __init__(self, device: Device, casters: Callable[[SectorIndex], AnyArray], top_m: float) -> None:
        """``casters`` gives a sector's triangles as records of layout.SHADOW_TRIANGLE, local to it; ``top_m`` is the city's highest
        point, world frame."""
        self.plan: ShadowPlan | None = None
        """Of the map that surfels look at."""
        self.drawing: ShadowPlan | None = None
        """Of the map that has been begun and is not finished."""
        self._device = device
        self._casters = casters
        self._top_m = top_m
        self._left: list[SectorIndex] = []
        self._front, self._back = (cl.Buffer(device.context, cl.mem_flags.READ_WRITE, 4 * MAP_TEXELS * SHADOW_ROW_TEXELS) for _ in range(2))
        self._draw = device.shared_kernel("draw_shadow_map")
        self._sample = device.shared_kernel("sample_shadow_map")
        self._rows_apart = CPU_ITEMS_PER_CORE * device.device.max_compute_units if device.is_processor else GPU_ITEMS
        self._triangles: OrderedDict[SectorIndex, tuple[cl.Buffer, int]] = OrderedDict()
        self._kept_bytes = 0

    @property
    def nbytes(self) -> int:
        """Bytes on the device."""
        return int(self._front.size + self._back.size + self._kept_bytes)

    def begin(self, plan: ShadowPlan) -> None:
        """Start to draw another map; what was begun before is given up."""
        self.drawing, self._left = plan, list(plan.sectors)
        cl.enqueue_fill_buffer(self._device.queue, self._back, NOTHING_DRAWN, 0, self._back.size)

    def draw(self, most_triangles: int) -> bool:
        """Enqueue the drawing of some more sectors, at least one; whether the map is now whole and is the one that surfels look at.

        Raises what ``casters`` raises; the sector is then left out of this map.
        """
        plan = self.drawing
        if plan is None:
            return False
        drawn = 0
        while self._left and (drawn == 0 or drawn < most_triangles):
            index = self._left.pop(0)
            buffer, count = self._on_device(index)
            self._enqueue(plan, index.origin, buffer, count)
            drawn += count
        if self._left:
            return False
        if len(plan.boxes):
            triangles = box_triangles(plan.boxes - plan.middle)
            self._enqueue(plan, plan.middle, self._device.upload(triangle_records(triangles)), len(triangles))
        self._front, self._back = self._back, self._front
        self.plan, self.drawing = plan, None
        return True

    def sample(self, samples: SunSamples) -> None:
        """Enqueue a look at the map for all surfels of a sector, and have its next lighting use it."""
        plan, resident = self.plan, samples.resident
        if plan is None or resident.sector.surfel_count == 0:
            return
        oldest = samples.look(plan.to_sun)
        self._sample.launch_1d(
            samples.groups,
            np.uint32(samples.groups),
            samples.frame(plan),
            samples.place,
            resident.surfel_normal,
            self._front,
            np.float32(self._top_m),
            np.float32(min(plan.reach_height_m, 1e9)),
            np.uint16(samples.number),
            np.uint16(oldest),
            samples.sun_sample,
            samples.sampled_in,
        )
        resident.set_sun_sample(samples.sun_sample)

    def read(self) -> Float32:
        """The map that surfels look at: (MAP_TEXELS, MAP_TEXELS) float32 [m], rows, columns."""
        rows = np.zeros((MAP_TEXELS, SHADOW_ROW_TEXELS), np.float32)
        self._device.read(self._front, rows)
        return rows[:, :MAP_TEXELS].copy()

    def _enqueue(self, plan: ShadowPlan, origin: Float64, triangles: cl.Buffer, count: int) -> None:
        if count:
            self._draw.launch((self._rows_apart,), (1,), plan.frame(origin), np.uint32(count), triangles, self._back)

    def _on_device(self, index: SectorIndex) -> tuple[cl.Buffer, int]:
        found = self._triangles.pop(index, None)
        if found is None:
            records = self._casters(index)
            found = self._device.upload(records), len(records)
            self._kept_bytes += found[0].size
            while self._triangles and self._kept_bytes > KEPT_BYTES:
                _, (gone, _) = self._triangles.popitem(last=False)
                self._kept_bytes -= gone.size
        self._triangles[index] = found
        return found
