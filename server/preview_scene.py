"""Which stored geometry a picture needs, merged and ready for rays."""

from collections import OrderedDict
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from gi_core.arrays import Float32, Float64, Int32
from gi_core.constants import SECTOR_SIZE_M
from gi_core.dataset import Dataset
from gi_core.grid import SectorIndex
from server.raycast import RayCaster

# 81 sectors are a square of 576 m: in a street more can't be seen, and at 20 000 triangles each they build in half a second.
MAX_SECTORS = 81
# Pictures come in runs from about one place; two neighbouring places cover a viewer that walks.
MAX_CACHED_SCENES = 2

Mesh = tuple[Float64, Int32, Float32, Float32]


@dataclass(frozen=True, eq=False)
class PreviewScene:
    """Geometry of some sectors: rays, and per triangle (m, 3) float32 albedo and emission [cd m^-2]. ``rays`` is None without triangles."""

    rays: RayCaster | None
    albedo: Float32
    emission: Float32


class PreviewScenes:
    """The scenes of the last few pictures. Not thread-safe: pictures take turns."""

    def __init__(self, dataset: Dataset) -> None:
        self._dataset = dataset
        self._scenes: OrderedDict[tuple[SectorIndex, ...], PreviewScene] = OrderedDict()

    def around(self, eye: Float64, look: Float64) -> PreviewScene:
        """The scene for a camera; CorruptFileError when a sector of it can't be read."""
        key = plan_sectors(self._dataset.world.sectors, eye, look)
        scene = self._scenes.pop(key, None) or self._load(key)
        self._scenes[key] = scene
        while len(self._scenes) > MAX_CACHED_SCENES:
            self._scenes.popitem(last=False)
        return scene

    @staticmethod
    def mesh_around(dataset: Dataset, eye: Float64, look: Float64) -> Mesh:
        """The triangles of ``around``: vertices (v, 3) [m], triangles (m, 3), albedo and emission (m, 3)."""
        return _merged(dataset, plan_sectors(dataset.world.sectors, eye, look))

    def _load(self, sectors: tuple[SectorIndex, ...]) -> PreviewScene:
        vertices, triangles, albedo, emission = _merged(self._dataset, sectors)
        return PreviewScene(RayCaster(vertices, triangles) if len(triangles) else None, albedo, emission)


def _merged(dataset: Dataset, sectors: tuple[SectorIndex, ...]) -> Mesh:
    parts = [part for part in map(dataset.geometry, sectors) if len(part.triangles)]
    if not parts:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32)
    firsts = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    triangles = np.concatenate([part.triangles + np.int32(first) for part, first in zip(parts, firsts, strict=True)])
    albedo, emission = (np.concatenate([getattr(part, name) for part in parts]) for name in ("albedo", "emission"))
    return np.concatenate([part.vertices for part in parts]), triangles.astype(np.int32), albedo, emission


def plan_sectors(available: Iterable[SectorIndex], eye: Float64, look: Float64) -> tuple[SectorIndex, ...]:
    """The MAX_SECTORS sectors closest to the stretch from the eye to what it looks at, in grid order.

    Distance is level and from the stretch, extended to 300 m, to the sector's centre.
    """
    indices = sorted(available)
    if len(indices) <= MAX_SECTORS:
        return tuple(indices)
    start, along = eye[[0, 2]], (look - eye)[[0, 2]]
    length = max(float(np.linalg.norm(along)), 1e-9)
    along = along * (max(length, 300.0) / length)
    centres = (np.array(indices, np.float64) + 0.5) * SECTOR_SIZE_M
    share = np.clip((centres - start) @ along / (along @ along + 1e-12), 0, 1)
    distance = np.linalg.norm(centres - start - share[:, None] * along, axis=1)
    closest = np.argsort(distance, kind="stable")[:MAX_SECTORS]
    return tuple(indices[i] for i in sorted(closest))
