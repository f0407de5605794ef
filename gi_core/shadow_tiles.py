"""Shadow trees on a device: one buffer of nodes and one of triangles for all sectors, so that one launch walks any of them."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import pyopencl as cl

from gi_core.arrays import AnyArray
from gi_core.device import Device
from gi_core.grid import SectorIndex
from gi_core.layout import SHADOW_NODE, SHADOW_TILE, SHADOW_TRIANGLE
from gi_core.shadow_tree import ShadowTree

_FIRST_BYTES = 1 << 18


@dataclass
class _Pool:
    """A buffer that is filled from its start and grows by copying; its records are numbered."""

    device: Device
    record_bytes: int
    buffer: cl.Buffer | None = None
    used: int = 0

    def add(self, records: AnyArray) -> int:
        """Number of the first of some records, now in the buffer."""
        first, wanted = self.used, (self.used + len(records)) * self.record_bytes
        if self.buffer is None or wanted > self.buffer.size:
            held, self.buffer = self.buffer, self.device.allocate(max(wanted, _FIRST_BYTES, 2 * self.nbytes))
            if held is not None:
                cl.enqueue_copy(self.device.queue, self.buffer, held)
        if len(records):
            cl.enqueue_copy(self.device.queue, self.buffer, records, dst_offset=first * self.record_bytes)
        self.used += len(records)
        return first

    @property
    def nbytes(self) -> int:
        return 0 if self.buffer is None else int(self.buffer.size)


class ShadowTiles:
    """Trees of sectors on one device, added when first wanted. When they outgrow ``kept_bytes``, all go and those wanted come again."""

    def __init__(self, device: Device, tree: Callable[[SectorIndex], ShadowTree], kept_bytes: int) -> None:
        """Nothing is allocated before the first tile is wanted."""
        self._device, self._tree, self._kept_bytes = device, tree, kept_bytes
        self._clear()

    def _clear(self) -> None:
        self._nodes, self._triangles = _Pool(self._device, SHADOW_NODE.dtype.itemsize), _Pool(self._device, SHADOW_TRIANGLE.dtype.itemsize)
        self._held: dict[SectorIndex, tuple[int, int, int]] = {}

    @property
    def nbytes(self) -> int:
        """Bytes on the device."""
        return self._nodes.nbytes + self._triangles.nbytes

    def groups(self, wanted: Iterable[SectorIndex]) -> Iterator[tuple[frozenset[SectorIndex], cl.Buffer, cl.Buffer]]:
        """Wanted sectors, in groups that fit on the device together; with each the nodes and the triangles, good until the next group.

        At least one group, if an empty one. Raises as the trees' maker does.
        """
        groups = split_by_size([(index, self._tree(index).nbytes) for index in sorted(set(wanted))], self._kept_bytes)
        for group in groups or [[]]:
            missing = [index for index in group if index not in self._held]
            arriving = sum(self._tree(index).nbytes for index in missing)
            if self._held and arriving and self._used_bytes + arriving > self._kept_bytes:
                self._clear()
                missing = group
            for index in missing:
                tree = self._tree(index)
                first = self._nodes.add(tree.nodes)
                self._held[index] = (first, first + len(tree.nodes), self._triangles.add(tree.triangles))
            if self._nodes.buffer is None or self._triangles.buffer is None:
                self._nodes.add(np.zeros(0, SHADOW_NODE.dtype))
                self._triangles.add(np.zeros(0, SHADOW_TRIANGLE.dtype))
            yield frozenset(group), self._nodes.buffer, self._triangles.buffer

    @property
    def _used_bytes(self) -> int:
        return sum(pool.used * pool.record_bytes for pool in (self._nodes, self._triangles))

    def records(self, tiles: Sequence[SectorIndex], origin: SectorIndex) -> AnyArray:
        """(n,) layout.SHADOW_TILE of tiles of the present group, for surfels local to the sector ``origin``."""
        records = np.zeros(len(tiles), SHADOW_TILE.dtype)
        for record, index in zip(records, tiles, strict=True):
            record["offset"] = origin.origin - index.origin
            record["first_node"], record["end_node"], record["first_triangle"] = self._held[index]
        return records


def split_by_size(sizes: Sequence[tuple[SectorIndex, int]], most: int) -> list[list[SectorIndex]]:
    """Runs of sectors, all in their order, whose sizes come to at most ``most`` together; one that is bigger stands alone."""
    groups: list[list[SectorIndex]] = []
    held = 0
    for index, size in sizes:
        if not groups or held + size > most:
            groups.append([])
            held = 0
        groups[-1].append(index)
        held += size
    return groups
