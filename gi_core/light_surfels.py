"""A sector's lamps on the device: what they give each surfel, shadowed, evaluated when a lamp changes and at no other time."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import count

import numpy as np
import pyopencl as cl

from gi_core.arrays import AnyArray, Float32
from gi_core.device import Device
from gi_core.grid import SectorIndex
from gi_core.layout import AREA_SHADOW_RAYS, LOCAL_AREA, LOCAL_LIGHT, SURFEL_WORD, SURFELS_PER_WORD
from gi_core.light_geometry import ShadowGeometry
from gi_core.light_plan import MAX_LIGHTS_PER_LAUNCH, SurfelBounds, changed_spheres, surfel_words, touching_lamps
from gi_core.lights import check_lamp, light_records
from gi_core.sector import Sector
from gi_core.shadow_bits import FIRST_PLANES, Shadow, ShadowBits
from gi_core.world import Lamp

# Work-items per work-group; kernels guard against the last group's excess.
GROUP = 8
# light_surfels.cl lights eight surfels in one work-item.
_ITEMS_PER_WORD = SURFELS_PER_WORD // 8


@dataclass(frozen=True, eq=False)
class _Lit:
    """A list of lamps as it was given, each one's shadow, None where it touches nothing, and layout.LOCAL_LIGHT of those that touch."""

    given: tuple[Lamp, ...] = ()
    shadows: tuple[Shadow | None, ...] = ()
    records: AnyArray = field(default_factory=lambda: np.zeros(0, LOCAL_LIGHT.dtype))


class SurfelLights:
    """Irradiance that lamps give a sector's surfels. Static ones are summed once and kept; dynamic ones are added to a copy of that sum.

    The same lamps in the same order give the same bits, whatever was lit before: a lamp that goes off gives the first bytes back. When
    one of many changes, only its shadows are traced, and only surfels near it are summed anew.
    """

    def __init__(self, device: Device, sector: Sector, shadows: ShadowGeometry) -> None:
        """Nothing is allocated and no geometry read before a lamp touches the sector."""
        self.buffer: cl.Buffer | None = None
        """(S, 4) float32 [lx], the fourth 0: all lamps that touch. None when none does. Replaced only when it turns from or to None;
        its contents change with the lamps, in the device's queue."""
        self._device, self._sector, self._geometry = device, sector, shadows
        self._words = -(-sector.surfel_count // SURFELS_PER_WORD)
        self._bounds: SurfelBounds | None = None
        self._places: cl.Buffer | None = None
        self._bits = ShadowBits(device, self._words)
        self._static = self._dynamic = _Lit()
        self._static_sum: cl.Buffer | None = None

    @property
    def nbytes(self) -> int:
        """Bytes on the device, without the geometry's, which all sectors share."""
        held = (self.buffer, self._places, self._static_sum)
        return self._bits.nbytes + sum(int(buffer.size) for buffer in held if buffer is not None)

    @property
    def unused_nbytes(self) -> int:
        """Bytes on the device that the first lamps to touch the sector would take: both sums, places, and the first planes of shadows."""
        room = 2 * 16 * self._sector.surfel_count + (SURFEL_WORD.dtype.itemsize + 4 * FIRST_PLANES) * self._words
        return max(room - self.nbytes, 0)

    @property
    def given(self) -> tuple[tuple[Lamp, ...], tuple[Lamp, ...]]:
        """The static and the dynamic lamps as they were given last."""
        return self._static.given, self._dynamic.given

    def set_static(self, lamps: Sequence[Lamp], may_read: bool = True) -> None:
        """Lamps that seldom change: all of the world that are on, not only those near. Nothing happens when they are the same as before,
        and shadows stay when only lumens and colours have changed.

        Raises InputError for a touching lamp that is out of its ranges, CorruptFileError for geometry that cannot be read, and
        UnreadGeometryError for geometry that has not been where none ``may_read``; then the light stays as it was.
        """
        before, after = self._static, self._changed(self._static, tuple(lamps), self._dynamic, may_read)
        self._static = after
        if after.records.tobytes() == before.records.tobytes():
            return
        changed = changed_spheres(before.given, after.given, self._sector.index.origin)
        if not len(after.records):
            self._static_sum = None
        else:
            if self._static_sum is None:
                self._static_sum, changed = self._allocate(), None
            self._sum(after, None, self._static_sum, changed)
        self._sum_all(changed)

    def set_dynamic(self, lamps: Sequence[Lamp], may_read: bool = True) -> None:
        """Lamps that move or flicker, as ``set_static``."""
        before, after = self._dynamic, self._changed(self._dynamic, tuple(lamps), self._static, may_read)
        self._dynamic = after
        if after.records.tobytes() != before.records.tobytes():
            self._sum_all(changed_spheres(before.given, after.given, self._sector.index.origin))

    def _sum_all(self, changed: Float32 | None) -> None:
        if not len(self._static.records) and not len(self._dynamic.records):
            self.buffer = self._places = None
            self._bits.clear()
            return
        if self.buffer is None:
            self.buffer, changed = self._allocate(), None
        self._sum(self._dynamic, self._static_sum, self.buffer, changed)

    def _allocate(self) -> cl.Buffer:
        return self._device.allocate(16 * self._sector.surfel_count)

    def _changed(self, before: _Lit, given: tuple[Lamp, ...], others: _Lit, may_read: bool) -> _Lit:
        """Lamps with their shadows, traced for those that stand as none did before. Raises before anything has changed."""
        if given == before.given:
            return before
        place = {id(lamp): i for i, lamp in enumerate(before.given)}
        was = [place.get(id(lamp), -1) for lamp in given]
        shadows = [before.shadows[at] if at >= 0 else self._bits.find(lamp) for at, lamp in zip(was, given, strict=True)]
        arrived = [i for i, at in enumerate(was) if at < 0]
        for i in arrived:
            if shadows[i] is not None:
                check_lamp(given[i])
        unknown = [i for i in arrived if shadows[i] is None]
        touching = self._touching([given[i] for i in unknown], may_read)

        self._bits.keep({*others.shadows, *shadows})
        untraced: dict[int, list[SectorIndex]] = {}
        for number, about in touching.items():
            i = unknown[number]
            shadows[i] = self._bits.find(given[i])  # there is one when the same list has two lamps that stand alike
            if shadows[i] is None:
                shadows[i] = self._bits.add(given[i])
                untraced[i] = about
        planes = {i: shadow.plane for i in arrived if (shadow := shadows[i]) is not None}
        records = light_records([given[i] for i in planes], self._sector.index.origin)
        records["first_plane"] = list(planes.values())
        self._trace(records[[i in untraced for i in planes]], list(untraced.values()))
        return _Lit(given, tuple(shadows), _in_order(before, was, shadows, records))

    def _touching(self, lamps: Sequence[Lamp], may_read: bool) -> dict[int, list[SectorIndex]]:
        """Which of the lamps touch, and for each the sectors whose triangles may shadow it. Those have been read when this returns."""
        if not lamps:
            return {}
        self._bounds = self._bounds or SurfelBounds(self._sector)
        touching = {found.index: self._geometry.sectors_in(found.low, found.high) for found in touching_lamps(lamps, self._bounds)}
        self._geometry.read({index for about in touching.values() for index in about}, may_read)
        return touching

    def _trace(self, records: AnyArray, about: Sequence[list[SectorIndex]]) -> None:
        """Enqueue the tracing of lamps' shadows (n,) layout.LOCAL_LIGHT, each against the triangles of the sectors about it."""
        device, tiles = self._device, self._geometry.on_device(self._device)
        for first in range(0, len(records), MAX_LIGHTS_PER_LAUNCH):
            some, near = records[first : first + MAX_LIGHTS_PER_LAUNCH], about[first : first + MAX_LIGHTS_PER_LAUNCH]
            rays = np.where(some["kind"] == LOCAL_AREA, AREA_SHADOW_RAYS, 1)
            planes = [light * AREA_SHADOW_RAYS + ray for light, count in enumerate(rays.tolist()) for ray in range(count)]
            lights, plane_buffer, bits = device.upload(some), device.upload(np.array(planes, np.uint32)), self._bits.ready()
            for again, (group, nodes, triangles) in enumerate(tiles.groups({index for indices in near for index in indices})):
                chosen = [[index for index in indices if index in group] for indices in near]
                arguments = [
                    np.uint32(self._words),
                    self._surfel_places(),
                    lights,
                    plane_buffer,
                    device.upload(np.cumsum([0, *map(len, chosen)]).astype(np.uint32)),
                    device.upload(tiles.records([index for indices in chosen for index in indices], self._sector.index)),
                    nodes,
                    triangles,
                    np.uint32(again),
                    bits,
                ]
                self._run("trace_shadows", (self._words, len(planes)), arguments)

    def _sum(self, lit: _Lit, base: cl.Buffer | None, target: cl.Buffer, changed: Float32 | None) -> None:
        """Enqueue target = base + lamps in their order, where ``changed`` spheres reach, or everywhere."""
        device = self._device
        spheres = np.zeros((0, 4), np.float32) if changed is None else changed
        sphere_buffer, bits = device.upload(spheres), self._bits.ready()
        for first in range(0, max(len(lit.records), 1), MAX_LIGHTS_PER_LAUNCH):
            some = lit.records[first : first + MAX_LIGHTS_PER_LAUNCH]
            before = target if first else base
            arguments = [
                np.uint32(self._sector.surfel_count),
                np.uint32(self._words),
                self._surfel_places(),
                device.upload(some),
                np.uint32(len(some)),
                bits,
                sphere_buffer,
                np.uint32(len(spheres)),
                target if before is None else before,
                np.uint32(before is not None),
                target,
            ]
            self._run("light_surfels", (_ITEMS_PER_WORD * self._words, 1), arguments)

    def _run(self, name: str, size: tuple[int, int], arguments: list[object]) -> None:
        rounded = -(-size[0] // GROUP) * GROUP
        self._device.shared_kernel(name).launch((rounded, size[1]), (GROUP, 1), *arguments)

    def _surfel_places(self) -> cl.Buffer:
        if self._places is None:
            self._places = self._device.upload(surfel_words(self._sector))
        return self._places


def _in_order(before: _Lit, was: Sequence[int], shadows: Sequence[Shadow | None], arrived: AnyArray) -> AnyArray:
    """Records of the lamps that touch: from before where ``was`` tells a lamp's place there, else the next of those that arrived."""
    row = count()
    old = [next(row) if shadow is not None else -1 for shadow in before.shadows]
    rows = [next(row) if at < 0 else old[at] for at, shadow in zip(was, shadows, strict=True) if shadow is not None]
    # As bytes: NumPy compares the types of records field by field, which takes longer than all the rest.
    both = np.concatenate([records.view(np.uint8).reshape(-1, LOCAL_LIGHT.dtype.itemsize) for records in (before.records, arrived)])
    return both[rows].view(LOCAL_LIGHT.dtype)[:, 0] if rows else arrived
