"""Planes of shadow bits on a device, a bit for each surfel, that come and go with the lamps they belong to."""

from collections.abc import Collection
from dataclasses import dataclass

import pyopencl as cl

from gi_core.device import Device
from gi_core.lights import shadow_planes
from gi_core.world import Lamp

Stand = tuple[object, ...]
FIRST_PLANES = 32


@dataclass(frozen=True, eq=False)
class Shadow:
    """What the surfels see of a lamp that stands in one way: its planes, ``plane`` the first of them."""

    stand: Stand
    plane: int
    planes: int


def stand_of(lamp: Lamp) -> Stand:
    """What a lamp's shadows depend on, and nothing else of it."""
    if lamp.kind == "point":
        return (lamp.kind, lamp.position, lamp.range_m)
    return (lamp.kind, lamp.position, lamp.range_m, lamp.direction, lamp.cone_degrees if lamp.kind == "spot" else lamp.size)


class ShadowBits:
    """One buffer of planes (n, words) uint32. It grows by doubling."""

    def __init__(self, device: Device, words: int) -> None:
        self.buffer: cl.Buffer | None = None
        self._device, self._plane_bytes = device, 4 * words
        self._shadows: dict[Stand, Shadow] = {}
        self._free: dict[int, list[int]] = {}
        self._used = 0

    @property
    def nbytes(self) -> int:
        """Bytes on the device."""
        return 0 if self.buffer is None else int(self.buffer.size)

    def find(self, lamp: Lamp) -> Shadow | None:
        """The shadow of a lamp that stands as this one does, if it is here."""
        return self._shadows.get(stand_of(lamp))

    def add(self, lamp: Lamp) -> Shadow:
        """Planes for a lamp that has none here. What they hold is the caller's to write."""
        planes = shadow_planes(lamp)
        free = self._free.get(planes)
        if free:
            plane = free.pop()
        else:
            plane, self._used = self._used, self._used + planes
        shadow = self._shadows[stand_of(lamp)] = Shadow(stand_of(lamp), plane, planes)
        return shadow

    def keep(self, wanted: Collection[Shadow | None]) -> None:
        """Give back the planes of all other shadows."""
        for shadow in [shadow for shadow in self._shadows.values() if shadow not in wanted]:
            del self._shadows[shadow.stand]
            self._free.setdefault(shadow.planes, []).append(shadow.plane)
        if not self._shadows:
            self._used, self._free = 0, {}

    def clear(self) -> None:
        """Give all back, and the buffer with it."""
        self.buffer, self._used, self._free, self._shadows = None, 0, {}, {}

    def ready(self) -> cl.Buffer:
        """The buffer, with room for all that was added; what it held is in it still."""
        wanted = self._used * self._plane_bytes
        if self.buffer is None or wanted > self.buffer.size:
            held, self.buffer = self.buffer, self._device.allocate(max(wanted, FIRST_PLANES * self._plane_bytes, 2 * self.nbytes))
            if held is not None:
                cl.enqueue_copy(self._device.queue, self.buffer, held)
        return self.buffer
