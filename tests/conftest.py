"""What several test folders share: the folder of real cities, random sectors, built scenes."""

from pathlib import Path

import numpy as np
import pytest

from gi_core.grid import SectorIndex
from gi_core.sector import Sector, starts

SHARED_DATA = Path(__file__).parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Real cities; they are not part of the project."""
    if not SHARED_DATA.is_dir():
        pytest.skip("the real cities of ../shared/data are not beside this checkout")
    return SHARED_DATA


def random_sector(
    seed: int,
    probes: int = 40,
    surfels: int = 500,
    planes: int = 12,
    feedback: int = 1,
    emits: bool = False,
    voxel_probes: int = 4,
    patches: int = 6,
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
    source = rng.integers(0, len(bricks) + patches, factors).astype(np.uint32)
    weight = rng.uniform(0, 1, (factors, 6)) ** 4
    probe_of_factor = np.repeat(np.arange(probes), per_probe)
    for face in range(6):
        total = np.bincount(probe_of_factor, weight[:, face], probes)
        weight[:, face] /= np.maximum(total, 1)[probe_of_factor]
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
        factor_weight=weight.astype(np.float32),
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
