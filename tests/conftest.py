"""What several test folders share: the folder of real cities, random sectors, built scenes."""

import importlib.util
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bake_jobs.config import settings_for
from bake_jobs.geometry_clip import SectorCutter
from bake_jobs.scene import Scene
from bake_jobs.sector_job import SectorBaker
from bake_jobs.solids import boxes, prism
from gi_core import factor_weights
from gi_core.basis import basis_of_size, projection_weights
from gi_core.grid import SectorIndex
from gi_core.sector import Sector, starts

SHARED_DATA = Path(__file__).parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Real cities; they are not part of the project."""
    if not SHARED_DATA.is_dir():
        pytest.skip("the real cities of ../shared/data are not beside this checkout")
    return SHARED_DATA


@pytest.fixture(scope="session")
def write_golden() -> Callable[..., None]:
    """What writes a scene's dataset, as golden ones were written: tests/golden/make_golden.py, which is a script."""
    spec = importlib.util.spec_from_file_location("make_golden", Path(__file__).parent / "golden" / "make_golden.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.write_golden


def random_sector(
    seed: int,
    probes: int = 40,
    surfels: int = 500,
    planes: int = 12,
    feedback: int = 1,
    emits: bool = False,
    voxel_probes: int = 4,
    patches: int = 6,
    basis: int = 6,
) -> Sector:
    """A sector of random numbers that obeys every invariant of gi_core.sector; nothing about it is a real scene."""
    rng = np.random.default_rng(seed)
    bricks, remaining = [], surfels
    while remaining:
        bricks.append(min(int(rng.integers(1, 40)), remaining))
        remaining -= bricks[-1]
    brick_cell = rng.integers(-20, 36, (len(bricks), 3)).astype(np.int32)
    brick_level = rng.integers(0, 4, len(bricks)).astype(np.uint8)
    of_surfel = np.repeat(np.arange(len(bricks)), bricks).astype(int)
    in_cell = rng.uniform(0, 1, (surfels, 3))
    position = (brick_cell[of_surfel] + in_cell) * 4.0 * 2.0 ** brick_level[of_surfel, None]
    normal = rng.normal(size=(surfels, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    per_probe = rng.integers(0, 30, probes)
    factors = int(per_probe.sum())
    probe_of_factor = np.repeat(np.arange(probes), per_probe)
    source = rng.integers(0, len(bricks) + patches, factors).astype(np.uint32)
    source = source[np.lexsort((source, probe_of_factor))]
    weight = rng.uniform(0, 1, (factors, basis)) ** 4
    for face in range(basis):
        total = np.bincount(probe_of_factor, weight[:, face], probes)
        weight[:, face] /= np.maximum(total, 1)[probe_of_factor]
    if basis != 6:
        towards = rng.normal(size=(factors, 3))
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        weight = 4 * weight[:, :1] * projection_weights(basis_of_size(basis), towards)  # a quarter is the first one's share
    codes = factor_weights.encode(weight, starts(per_probe), source >= len(bricks))
    shape = (4, 20, 20)
    voxel_weight = rng.uniform(0, 1, (*shape, voxel_probes))
    feedback_weight = rng.uniform(0.1, 1, (surfels, feedback))
    return Sector(
        index=SectorIndex(0, 0),
        probe_position=rng.uniform(0, 64, (probes, 3)).astype(np.float32),
        probe_flags=np.ones(probes, np.uint8),
        probe_room=rng.integers(0, 3, probes).astype(np.uint16),
        factor_starts=starts(per_probe),
        factor_source=source,
        **codes._asdict(),
        brick_starts=starts(np.array(bricks, np.int64)),
        brick_level=brick_level,
        brick_cell=brick_cell,
        brick_direction=rng.integers(0, 6, len(bricks)).astype(np.uint8),
        surfel_position=position.astype(np.float32),
        surfel_normal=normal.astype(np.float32),
        surfel_albedo=rng.uniform(0, 0.95, (surfels, 3)).astype(np.float32),
        surfel_snow=rng.uniform(0, 1, surfels).astype(np.float32),
        surfel_emission=rng.uniform(0, 1000, (surfels, 3)).astype(np.float32) if emits else None,
        feedback_probe=rng.integers(0, max(probes, 1), (surfels, feedback)).astype(np.uint16),
        feedback_weight=(feedback_weight / feedback_weight.sum(axis=1, keepdims=True)).astype(np.float32)
        if probes
        else np.zeros((surfels, feedback), np.float32),
        sun_visibility=_clean_bits(rng, planes, surfels),
        voxel_first=np.array([0, -1, 0], np.int32),
        voxel_class=rng.integers(0, 3, shape).astype(np.uint8),
        voxel_room=rng.integers(0, 3, shape).astype(np.uint16),
        voxel_probe=rng.integers(0, max(probes, 1), (*shape, voxel_probes)).astype(np.uint16),
        voxel_weight=(voxel_weight / voxel_weight.sum(axis=3, keepdims=True)).astype(np.float32)
        if probes
        else np.zeros((*shape, voxel_probes), np.float32),
    )


def _clean_bits(rng: np.random.Generator, planes: int, surfels: int) -> np.ndarray:
    """Random planes whose bits beyond the last surfel are zero, as a bake leaves them."""
    bits = rng.integers(0, 2, (planes, (surfels + 31) // 32 * 32)).astype(bool)
    bits[:, surfels:] = False
    return np.packbits(bits, axis=1, bitorder="little").view("<u4").astype(np.uint32)


@pytest.fixture(scope="session")
def make_sector():
    return random_sector


BOX_FACES = ("-x", "+x", "-y", "+y", "-z", "+z")  # the order of bake_jobs.solids.boxes, two triangles each


class SceneBuilder:
    """Collects flat pieces into a Scene. Colours are a number or a triple; metres, world frame."""

    def __init__(self, offset: Sequence[float] = (0.0, 0.0, 0.0)) -> None:
        """Everything is moved by ``offset`` [m]."""
        self._offset = np.asarray(offset, np.float64)
        self._parts: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]] = []

    def add(self, vertices, triangles, albedo=0.5, emission=0.0) -> "SceneBuilder":
        colours = [np.broadcast_to(np.asarray(c, np.float32), (len(triangles), 3)) for c in (albedo, emission)]
        self._parts.append((np.asarray(vertices, np.float64) + self._offset, np.asarray(triangles), *colours))
        return self

    def quad(self, corner, edge_a, edge_b, albedo=0.5, emission=0.0) -> "SceneBuilder":
        """A parallelogram whose front is the side of edge_a x edge_b."""
        corner, edge_a, edge_b = (np.asarray(v, np.float64) for v in (corner, edge_a, edge_b))
        corners = [corner, corner + edge_a, corner + edge_a + edge_b, corner + edge_b]
        return self.add(corners, [[0, 1, 2], [0, 2, 3]], albedo, emission)

    def ground(self, low=(-128.0, -128.0), high=(192.0, 192.0), y=0.0, albedo=0.5) -> "SceneBuilder":
        """A level rectangle that faces up; low and high are (x, z)."""
        return self.quad((low[0], y, low[1]), (0, 0, high[1] - low[1]), (high[0] - low[0], 0, 0), albedo)

    def box(self, low, high, albedo=0.5, emission=0.0, without=(), inward=False) -> "SceneBuilder":
        """A box; ``without`` names faces that it lacks, ``inward`` turns it inside out (a room)."""
        vertices, triangles = boxes(np.asarray(low, np.float64), np.asarray(high, np.float64))
        kept = np.repeat([face not in without for face in BOX_FACES], 2)
        return self.add(vertices, triangles[kept][:, ::-1] if inward else triangles[kept], albedo, emission)

    def wall(self, start, end, height, holes=(), thick=0.2, albedo=0.5) -> "SceneBuilder":
        """An upright wall about the line from start to end, each (x, z), 0.2 m into the ground; holes (from, bottom, to, top) along it."""
        start, end = np.array(start, np.float64), np.array(end, np.float64)
        length = np.linalg.norm(end - start)
        along = (end - start) / length
        outlines = [np.array([(a, low), (b, low), (b, high), (a, high)]) for a, low, b, high in ((0.0, -0.2, length, height), *holes)]
        vertices, triangles, _ = prism(outlines, -thick / 2, thick / 2)
        s, across, up = vertices.T
        plan = start + s[:, None] * along + across[:, None] * np.array([-along[1], along[0]])
        return self.add(np.stack([plan[:, 0], up, plan[:, 1]], axis=1), triangles[:, ::-1], albedo)

    def scene(self, **fields) -> Scene:
        first = np.cumsum([0, *(len(v) for v, _, _, _ in self._parts)])
        return Scene(
            np.concatenate([v for v, _, _, _ in self._parts]),
            np.concatenate([t + f for (_, t, _, _), f in zip(self._parts, first, strict=False)]).astype(np.int32),
            np.concatenate([a for _, _, a, _ in self._parts]).astype(np.float32),
            np.concatenate([e for _, _, _, e in self._parts]).astype(np.float32),
            **fields,
        )


@pytest.fixture(scope="session")
def build() -> type[SceneBuilder]:
    return SceneBuilder


STRAIGHT_UP = np.array([[0.0, 1.0, 0.0]])


def bake_sector_arrays(scene, index=(0, 0), sun_directions=STRAIGHT_UP, **settings):
    """One sector of a scene, baked with the talk's settings but for those given: (Sector before quantisation, meta)."""
    baker = SectorBaker(scene, replace(settings_for("talk"), **settings), np.asarray(sun_directions), "test")
    index = SectorIndex(*index)
    return baker.bake_arrays(index, SectorCutter(scene).cut(index))


@pytest.fixture(scope="session")
def bake_arrays():
    return bake_sector_arrays
