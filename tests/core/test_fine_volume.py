"""Volumes of cascade -1: fine voxels where there are some, the coarse volume between them, refusals where there is none."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from gi_core import container
from gi_core.constants import FINE_VOXEL_SIZE_M, VOLUME_SHAPE, VOXEL_SIZE_M
from gi_core.dataset import Dataset, fine_path
from gi_core.engine import Engine
from gi_core.errors import CorruptFileError, FormatVersionError, InputError
from gi_core.grid import SectorIndex, voxel_centre
from gi_core.volume import sample_coefficients

GOLDEN = Path(__file__).parents[1] / "golden"
HERE, THERE = SectorIndex(0, 0), SectorIndex(-1, 0)
STREET = np.array([5.0, 2.0, 30.0])  # its fine volume reads both sectors


@pytest.fixture(scope="module")
def engine() -> Engine:
    return Engine(Dataset.open(GOLDEN / "v3"))


@pytest.fixture
def city(tmp_path) -> Path:
    copy = tmp_path / "city"
    shutil.copytree(GOLDEN / "v3", copy)
    return copy


def centres(volume) -> np.ndarray:
    """(16 * 32 * 32, 3) in the order of a coefficient's values."""
    y, z, x = np.meshgrid(*(np.arange(n) for n in VOLUME_SHAPE), indexing="ij")
    return voxel_centre(np.stack([x, y, z], axis=-1).reshape(-1, 3) + volume.first_voxel, FINE_VOXEL_SIZE_M)


def test_it_is_half_as_wide_and_on_a_lattice_of_its_own(engine):
    volume = engine.volume(STREET, engine.lighting("12:00", "clear"), cascade=-1)
    assert volume.values.shape == (6, *VOLUME_SHAPE, 3)
    np.testing.assert_array_equal(volume.voxel_size, [VOXEL_SIZE_M / 2] * 3)
    middle = volume.origin + volume.voxel_size * (np.array([32, 16, 32]) - 1) / 2
    assert (np.abs(middle - STREET) <= volume.voxel_size).all()
    np.testing.assert_allclose((volume.origin / volume.voxel_size - 0.5) % 1, 0, atol=1e-9)
    assert volume.sectors == (THERE, HERE)
    assert (volume.values > 0).all()


def test_where_there_are_no_fine_voxels_the_coarse_are_interpolated(engine):
    light = engine.lighting("12:00", "clear")
    fine, coarse = engine.volume(STREET, light, cascade=-1), engine.volume(STREET, light)
    expected = sample_coefficients(coarse.values, coarse.origin, coarse.voxel_size, centres(fine))
    found = fine.values.reshape(6, -1, 3).transpose(1, 0, 2)
    same = np.abs(found - expected).max(axis=(1, 2)) <= 1e-3 * expected.max()
    high = centres(fine)[:, 1] > 9 + 3.2  # a surface is no nearer than that
    assert same[high].all()
    assert 0.1 < same.mean() < 0.9


def test_fine_voxels_are_their_probes_blended(engine):
    light = engine.lighting("12:00", "clear")
    volume = engine.volume(STREET, light, cascade=-1)
    sector = engine.dataset.sector(HERE)
    voxels = engine.dataset.fine_voxels(sector)
    cubes = engine.lit_sector(HERE, light)
    blended = np.einsum("yzxk,yzxkbc->byzxc", voxels.weight, cubes[voxels.probe])
    checked = 0
    for y, z, x in np.argwhere(voxels.weight.any(axis=3))[::17]:
        there = np.array([x, y, z]) + voxels.first - volume.first_voxel
        if ((there >= 0) & (there < [32, 16, 32])).all():
            vx, vy, vz = there
            np.testing.assert_allclose(volume.values[:, vy, vz, vx], blended[:, y, z, x], rtol=1e-4, atol=1e-2)
            assert volume.mask[vy, vz, vx] == voxels.kind[y, z, x]
            checked += 1
    assert checked > 100


def test_it_is_served_in_poorer_bases_too(engine):
    with pytest.raises(InputError, match="basis"):
        engine.volume(STREET, engine.lighting("12:00", "clear"), basis="sh2", cascade=-1)


def test_a_dataset_without_fine_voxels_refuses():
    plain = Engine(Dataset.open(GOLDEN / "v1"))
    with pytest.raises(InputError, match=r"cascade -1: this dataset has no fine voxels"):
        plain.volume(STREET, plain.lighting("12:00", "clear"), cascade=-1)


def rewritten(path: Path, change_meta=None, change_arrays=None) -> None:
    """Change a fine file's contents under a right digest."""
    found = container.decode(path.read_bytes(), "FINE", 1, str(path))
    meta, arrays = found.meta, dict(found.arrays)
    if change_meta:
        change_meta(meta)
    if change_arrays:
        change_arrays(arrays)
    path.write_bytes(container.encode("FINE", 1, meta, arrays))


@pytest.mark.parametrize(
    ("meta", "arrays", "said"),
    [
        (lambda m: m.update(bake_id="f" * 32), None, "of another bake"),
        (lambda m: m.update(sector=[-1, 0]), None, "expected voxels of sector"),
        (lambda m: m.update(sector=[10**400, 0]), None, "inconsistent contents"),
        (lambda m: m.update(voxel_first=[0, 0]), None, "expected voxels of sector"),
        (lambda m: m.pop("voxel_first"), None, "inconsistent contents"),
        (None, lambda a: a.update(voxel_probe=np.full_like(a["voxel_probe"], 900)), "expected voxels of 20 probes"),
        (
            None,
            lambda a: a.update(voxel_probe=np.full_like(a["voxel_probe"], 900), voxel_weight=np.zeros_like(a["voxel_weight"])),
            "expected voxels of 20 probes",
        ),
        (None, lambda a: a.update(voxel_probe=np.full_like(a["voxel_probe"], 1000)), "expected voxels of sector"),
        (None, lambda a: a.update(voxel_class=np.full_like(a["voxel_class"], 3)), "expected voxels of sector"),
        (None, lambda a: a.update(voxel_class=a["voxel_class"][:, 1:]), "expected voxels of sector"),
        (None, lambda a: a.update(voxel_weight=a["voxel_weight"][:1]), "expected voxels of sector"),
        (None, lambda a: a.pop("voxel_class"), "voxel_class"),
        (None, lambda a: a.update(more=np.zeros(3, np.uint8)), "more"),
    ],
)
def test_forged_files_are_refused_by_name(city, meta, arrays, said):
    path = fine_path(city, HERE)
    rewritten(path, meta, arrays)
    opened = Dataset.open(city)
    with pytest.raises(CorruptFileError, match=rf"0_0\.givox.*{said}"):
        opened.fine_voxels(opened.sector(HERE))


@pytest.mark.parametrize("damage", [None, b"", bytes(range(256)) * 9])
def test_a_file_that_is_not_there_or_not_ours_is_refused_by_name(city, damage):
    path = fine_path(city, HERE)
    path.unlink()
    if damage is not None:
        path.write_bytes(damage)
    opened = Dataset.open(city)
    with pytest.raises(CorruptFileError, match=r"0_0\.givox"):
        opened.fine_voxels(opened.sector(HERE))
    assert Engine(opened).volume(STREET, Engine(opened).lighting("12:00", "clear")).values.any()  # the coarse one needs no such file


def test_another_version_is_named(city):
    path = fine_path(city, HERE)
    data = bytearray(path.read_bytes())
    data[12] = 9
    path.write_bytes(data)
    opened = Dataset.open(city)
    with pytest.raises(FormatVersionError, match=r"0_0\.givox: format version 9"):
        opened.fine_voxels(opened.sector(HERE))
