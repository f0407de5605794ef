"""A sector's lamps on the device: what they give each surfel, shadowed, evaluated when a lamp changes and at no other time."""

from collections.abc import Sequence

import numpy as np
import pyopencl as cl

from gi_core.arrays import AnyArray, Float64
from gi_core.device import Device
from gi_core.layout import SHADOW_TRIANGLE, SURFEL_PLACE
from gi_core.light_geometry import ShadowGeometry
from gi_core.light_plan import TouchingLamp, plan_launches, touching_lamps
from gi_core.lights import light_records, reach_m, shadow_planes
from gi_core.sector import Sector
from gi_core.world import Lamp


class SurfelLights:
    """Irradiance that lamps give a sector's surfels. Static ones are summed once and kept; dynamic ones are added to a copy of that sum.

    The same lamps in the same order give the same bits, whatever was lit before: a lamp that goes off gives the first bytes back.
    """

    def __init__(self, device: Device, sector: Sector, shadows: ShadowGeometry) -> None:
        """Nothing is allocated and no geometry read before a lamp touches the sector."""
        self.buffer: cl.Buffer | None = None
        """(S, 4) float32 [lx], the fourth 0: all lamps that touch. None when none does. Replaced only when it turns from or to None;
        its contents change with the lamps, in the device's queue."""
        self._device = device
        self._sector = sector
        self._shadows = shadows
        self._place: cl.Buffer | None = None
        self._static: cl.Buffer | None = None
        self._given_static: tuple[Lamp, ...] = ()
        self._given_dynamic: tuple[Lamp, ...] = ()
        self._dynamic: tuple[TouchingLamp, ...] = ()

    @property
    def nbytes(self) -> int:
        """Bytes on the device."""
        return sum(int(held.size) for held in (self.buffer, self._place, self._static) if held is not None)

    def set_static(self, lamps: Sequence[Lamp]) -> None:
        """Lamps that seldom change: all of the world that are on, not only those near. Nothing happens when they are the same as before.

        Raises InputError for a touching lamp that is out of its ranges, CorruptFileError for geometry that cannot be read.
        """
        if tuple(lamps) != self._given_static:
            touching = touching_lamps(lamps, self._sector)
            static = self._allocate() if touching else None
            if static is not None:
                self._add(touching, static)
            self._static = static
            self._given_static = tuple(lamps)
            self._sum()

    def set_dynamic(self, lamps: Sequence[Lamp]) -> None:
        """Lamps that move or flicker, as ``set_static``."""
        if tuple(lamps) != self._given_dynamic:
            self._dynamic = touching_lamps(lamps, self._sector)
            self._given_dynamic = tuple(lamps)
            self._sum()

    def _sum(self) -> None:
        if self._static is None and not self._dynamic:
            self.buffer = self._place = None
            return
        if self.buffer is None:
            self.buffer = self._allocate()
        if self._static is not None:
            cl.enqueue_copy(self._device.queue, self.buffer, self._static)
        else:
            cl.enqueue_fill_buffer(self._device.queue, self.buffer, np.uint8(0), 0, self.buffer.size)
        self._add(self._dynamic, self.buffer)

    def _allocate(self) -> cl.Buffer:
        return self._device.allocate(16 * self._sector.surfel_count)

    def _add(self, touching: Sequence[TouchingLamp], target: cl.Buffer) -> None:
        """Enqueue the addition of lamps to a sum, in their order."""
        near = [shadow_triangles(self._shadows, lamp, self._sector.index.origin) for lamp in touching]
        for launch in plan_launches([len(triangles) for triangles in near]):
            self._launch([touching[i].lamp for i in launch], [near[i] for i in launch], target)

    def _launch(self, lamps: list[Lamp], triangles: list[AnyArray], target: cl.Buffer) -> None:
        device, sector = self._device, self._sector
        if self._place is None:
            self._place = device.upload(surfel_places(sector))
        surfels, words = np.uint32(sector.surfel_count), np.uint32((sector.surfel_count + 31) // 32)
        planes = np.array([shadow_planes(lamp) for lamp in lamps])
        plane_light = device.upload(np.repeat(np.arange(len(lamps), dtype=np.uint32), planes))
        starts = device.upload(np.cumsum([0, *(len(t) for t in triangles)]).astype(np.uint32))
        lights, between = device.upload(light_records(lamps, sector.index.origin)), device.upload(np.concatenate(triangles))
        shadow_bits = device.allocate(4 * int(words) * int(planes.sum()))
        trace, add = device.kernel("trace_shadows"), device.kernel("light_surfels")
        trace(
            device.queue,
            (int(words), int(planes.sum())),
            None,
            surfels,
            words,
            self._place,
            lights,
            plane_light,
            starts,
            between,
            shadow_bits,
        )
        add(device.queue, (int(surfels),), None, surfels, words, self._place, lights, np.uint32(len(lamps)), shadow_bits, target)


def surfel_places(sector: Sector) -> AnyArray:
    """(S,) records of layout.SURFEL_PLACE."""
    places = np.zeros(sector.surfel_count, SURFEL_PLACE.dtype)
    places["position"], places["normal"] = sector.surfel_position, sector.surfel_normal
    return places


def shadow_triangles(shadows: ShadowGeometry, touching: TouchingLamp, origin: Float64) -> AnyArray:
    """(n,) records of layout.SHADOW_TRIANGLE, local to ``origin`` (3,) [m]: all that can come between a lamp and what it lights."""
    corners = shadows.triangles_in(touching.low, touching.high)
    position = np.array(touching.lamp.position)
    beyond = position - np.clip(position, corners.min(axis=1), corners.max(axis=1))
    corners = corners[(beyond**2).sum(axis=1) < reach_m(touching.lamp) ** 2] - origin
    records = np.zeros(len(corners), SHADOW_TRIANGLE.dtype)
    records["corner"] = corners[:, 0]
    records["edge_a"], records["edge_b"] = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return records
