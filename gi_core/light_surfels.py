"""A sector's lamps on the device: what they give each surfel, shadowed, evaluated when a lamp changes and at no other time."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pyopencl as cl

from gi_core.arrays import AnyArray, Float64
from gi_core.device import Device
from gi_core.layout import SHADOW_TRIANGLE, SURFEL_PLACE
from gi_core.light_geometry import ShadowGeometry
from gi_core.light_plan import SurfelBounds, TouchingLamp, plan_launches, touching_lamps
from gi_core.lights import check_lamp, light_records, reach_m, shadow_planes
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
        self._bounds: SurfelBounds | None = None
        self._static = self._dynamic = _Lit()
        self._static_sum: cl.Buffer | None = None
        self._kernels: dict[str, cl.Kernel] = {}

    @property
    def nbytes(self) -> int:
        """Bytes on the device."""
        held = [self.buffer, self._place, self._static_sum]
        held += [traced.shadow_bits for lit in (self._static, self._dynamic) for traced in lit.traced]
        return sum(int(buffer.size) for buffer in held if buffer is not None)

    @property
    def given(self) -> tuple[tuple[Lamp, ...], tuple[Lamp, ...]]:
        """The static and the dynamic lamps as they were given last."""
        return self._static.given, self._dynamic.given

    def set_static(self, lamps: Sequence[Lamp]) -> None:
        """Lamps that seldom change: all of the world that are on, not only those near. Nothing happens when they are the same as before,
        and shadows stay when only lumens and colours have changed.

        Raises InputError for a touching lamp that is out of its ranges, CorruptFileError for geometry that cannot be read; then the
        light stays as it was.
        """
        if tuple(lamps) != self._static.given:
            lit = self._changed(self._static, lamps)
            total = self._allocate() if lit.traced else None
            if total is not None:
                self._add(lit, total)
            self._static, self._static_sum = lit, total
            self._sum()

    def set_dynamic(self, lamps: Sequence[Lamp]) -> None:
        """Lamps that move or flicker, as ``set_static``."""
        if tuple(lamps) != self._dynamic.given:
            self._dynamic = self._changed(self._dynamic, lamps)
            self._sum()

    def _sum(self) -> None:
        if self._static_sum is None and not self._dynamic.traced:
            self.buffer = self._place = None
            return
        if self.buffer is None:
            self.buffer = self._allocate()
        if self._static_sum is not None:
            cl.enqueue_copy(self._device.queue, self.buffer, self._static_sum)
        else:
            cl.enqueue_fill_buffer(self._device.queue, self.buffer, np.uint8(0), 0, self.buffer.size)
        self._add(self._dynamic, self.buffer)

    def _changed(self, before: "_Lit", lamps: Sequence[Lamp]) -> "_Lit":
        """The lamps with their shadows: those of before when the lamps stand as they stood then."""
        given = tuple(lamps)
        if [_as_it_stands(lamp) for lamp in given] == [_as_it_stands(lamp) for lamp in before.given]:
            return _Lit(given, tuple(traced.relit(given) for traced in before.traced))
        return _Lit(given, self._trace(given))

    def _allocate(self) -> cl.Buffer:
        return self._device.allocate(16 * self._sector.surfel_count)

    def _trace(self, lamps: Sequence[Lamp]) -> "tuple[_Traced, ...]":
        """Shadows of the lamps that touch, in their order."""
        if not lamps:
            return ()
        self._bounds = self._bounds or SurfelBounds(self._sector)
        touching = touching_lamps(lamps, self._bounds)
        near = [shadow_triangles(self._shadows, lamp, self._sector.index.origin) for lamp in touching]
        launches = plan_launches([len(triangles) for triangles in near])
        return tuple(self._trace_launch([touching[i] for i in launch], [near[i] for i in launch]) for launch in launches)

    def _trace_launch(self, touching: list[TouchingLamp], triangles: list[AnyArray]) -> "_Traced":
        device, sector = self._device, self._sector
        lamps = tuple(found.lamp for found in touching)
        words = (sector.surfel_count + 31) // 32
        plane_counts = [shadow_planes(lamp) for lamp in lamps]
        planes = sum(plane_counts)
        # Every word is written: zeros would be a pass of their own.
        shadow_bits = cl.Buffer(device.context, cl.mem_flags.READ_WRITE, 4 * words * planes)
        arguments = [
            np.uint32(sector.surfel_count),
            np.uint32(words),
            self._places(),
            device.upload(light_records(lamps, sector.index.origin)),
            device.upload(np.repeat(np.arange(len(lamps), dtype=np.uint32), plane_counts)),
            device.upload(np.cumsum([0, *(len(t) for t in triangles)]).astype(np.uint32)),
            device.upload(np.concatenate(triangles)),
            shadow_bits,
        ]
        self._kernel("trace_shadows")(device.queue, (words, planes), None, *arguments)
        return _Traced(lamps, tuple(found.index for found in touching), shadow_bits)

    def _add(self, lit: "_Lit", target: cl.Buffer) -> None:
        """Enqueue the addition of lamps to a sum, in their order."""
        device, sector = self._device, self._sector
        for launch in lit.traced:
            arguments = [
                np.uint32(sector.surfel_count),
                np.uint32((sector.surfel_count + 31) // 32),
                self._places(),
                device.upload(light_records(launch.lamps, sector.index.origin)),
                np.uint32(len(launch.lamps)),
                launch.shadow_bits,
                target,
            ]
            self._kernel("light_surfels")(device.queue, (sector.surfel_count,), None, *arguments)

    def _kernel(self, name: str) -> cl.Kernel:
        # Making a kernel takes longer than running it.
        if name not in self._kernels:
            self._kernels[name] = self._device.kernel(name)
        return self._kernels[name]

    def _places(self) -> cl.Buffer:
        if self._place is None:
            self._place = self._device.upload(surfel_places(self._sector))
        return self._place


@dataclass(frozen=True, eq=False)
class _Traced:
    """The lamps of one launch, where they stand in the list that they were given in, and their shadow bits."""

    lamps: tuple[Lamp, ...]
    indices: tuple[int, ...]
    shadow_bits: cl.Buffer

    def relit(self, lamps: Sequence[Lamp]) -> "_Traced":
        """The same shadows with other lumens and colours, from a list of as many lamps. Raises InputError."""
        chosen = tuple(lamps[i] for i in self.indices)
        for lamp in chosen:
            check_lamp(lamp)
        return replace(self, lamps=chosen)


@dataclass(frozen=True, eq=False)
class _Lit:
    """A list of lamps as it was given, and what was traced for those of them that touch."""

    given: tuple[Lamp, ...] = ()
    traced: tuple[_Traced, ...] = ()


def _as_it_stands(lamp: Lamp) -> Lamp:
    """A lamp without what its shadows do not depend on."""
    return replace(lamp, name="", lumens=0.0, color=(0.0, 0.0, 0.0), schedule="always")


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
    corners = corners[np.einsum("ij,ij->i", beyond, beyond) < reach_m(touching.lamp) ** 2] - origin
    records = np.zeros(len(corners), SHADOW_TRIANGLE.dtype)
    records["corner"] = corners[:, 0]
    records["edge_a"], records["edge_b"] = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return records
