"""Datasets that users have stay readable, as FORMAT.md describes them: files of every format version, kept for good.

When one of these tests fails, the format has changed: raise the version (FORMAT.md, section 8) and add tests/golden/v<version> with
make_golden.py; do not write a released version's files again.
"""

import hashlib
import importlib.util
import json
import sys
from dataclasses import fields
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from gi_core import dataset, distant_file, fine_file, geometry_file, sector_file, sky_patches
from gi_core.dataset import Dataset
from gi_core.engine import Engine
from gi_core.errors import FormatVersionError
from gi_core.sector import Sector

HERE = Path(__file__).parent
# Of world.json's version, and of sector files' where that is not 1: what the dataset of each holds, decoded.
DIGESTS = {
    "v1": "f6b367f763c6b74747559c79e7d8c404",
    "v3": "2283c2edeaed38157e15ce4f9a3bd682",
    "v4": "58c4bbdb83e26e00b45ed30d40b407d8",
    "v5": "aeed474a1d5bba6557b6bc01afbbefc6",
    "v2_sector2": "d4e9deba8154c6fa0b66c46e0e8ecf95",
    "v4_sector2": "286608a0e21588e0ffdf44fac39a4619",
    "v5_sector2": "7d257cd69f93d960f01310a3f20049ae",
    "v6_sector2": "a5c6d0a21eb7c1c67e19620b36f48df9",
}
# Sector files of version 1 in harmonics.
REFUSED = "v2"
FOLDERS = sorted([*DIGESTS, REFUSED])
GOLDEN = HERE / "v4_sector2"
SECTORS = sorted(path for name in DIGESTS for path in (HERE / name / "sectors").iterdir())
GEOMETRIES = sorted(path for name in FOLDERS for path in (HERE / name / "geometry").iterdir())
DISTANT_V2 = HERE / "distant_v2" / "distant.gidist"
DISTANT_V2_DIGEST = "8ff8db0362f7c783bcf00d4cdb5c4d1f"
FINE = sorted((HERE / "v3" / "fine").iterdir())
each_folder = pytest.mark.parametrize("golden", [HERE / name for name in FOLDERS], ids=lambda path: path.name)
each_read = pytest.mark.parametrize("golden", [HERE / name for name in DIGESTS], ids=lambda path: path.name)


def name_of(path: Path) -> str:
    return f"{path.parents[1].name}_{path.stem}"


def neighbour(name: str) -> ModuleType:
    """A module beside this file: test folders are no packages."""
    spec = importlib.util.spec_from_file_location(f"golden_{name}", Path(__file__).parent / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


reader = neighbour("reader")


def stored_arrays(path: Path) -> set[tuple[str, str, bool, int]]:
    """Name, dtype, delta and rank of each array of a file."""
    data = path.read_bytes()
    header = json.loads(data[64 : 64 + int.from_bytes(data[16:20], "little")])
    return {(a["name"], a["dtype"], a["delta"], len(a["shape"])) for a in header["arrays"]}


@each_folder
def test_the_golden_dataset_is_small_and_whole(golden):
    assert sum(path.stat().st_size for path in golden.rglob("*") if path.is_file()) < 75_000
    folders = ("sectors", "geometry", "fine") if golden.name == "v3" else ("sectors", "geometry")
    assert {path.name for path in golden.iterdir() if path.is_dir()} == set(folders)
    for folder in folders:
        assert sorted(path.stem for path in (golden / folder).iterdir()) == ["-1_0", "0_0"]


def decoded_names() -> list[str]:
    """A sector's arrays, codes of weights as what they stand for."""
    names = [field.name for field in fields(Sector) if field.name not in ("index", "factor_scale", "factor_trim")]
    return ["factor_weight" if name == "factor_code" else name for name in names]


def test_every_golden_version_is_read_or_refused_by_name():
    assert sorted(path.name for path in HERE.glob("v*") if path.is_dir()) == FOLDERS
    assert set(neighbour("make_golden").WRITTEN) <= set(FOLDERS), "a new format version needs its golden dataset: run make_golden.py"
    assert {geometry_file.VERSION, fine_file.VERSION} == {1}, "give tests of their v2 what these have"
    assert distant_file.VERSION == 2, "a new version needs its golden file, as distant_v2 is"
    for name in FOLDERS:
        assert json.loads((HERE / name / "world.json").read_bytes())["version"] == int(name[1])
        assert all(path.read_bytes()[12] == int(name.partition("_sector")[2] or 1) for path in (HERE / name / "sectors").iterdir())


def test_harmonics_of_before_are_refused_by_name():
    opened = Dataset.open(HERE / REFUSED)
    with pytest.raises(FormatVersionError, match=r"-1_0\.gisec: format version 1 in harmonics.*reads version 2; bake the dataset again"):
        opened.sector(min(opened.world.sectors))


@pytest.mark.parametrize("path", SECTORS, ids=name_of)
def test_a_sector_read_from_format_md_alone_is_the_sector(path):
    meta, expected = reader.read_sector(path.read_bytes())
    sector, bake = sector_file.read(path)
    assert list(sector.index) == meta["sector"]
    assert meta["bake"] == bake
    # The golden scene was made to have every array that a sector can have.
    assert set(expected) == set(decoded_names())
    for name, values in expected.items():
        found = getattr(sector, name)
        assert found.shape == values.shape, name
        if found.dtype.kind == "f":
            # One rounding to float32 of a float64 calculation, or two of float32's own.
            np.testing.assert_allclose(found, values, rtol=2.5e-7, atol=1e-7, err_msg=name)
        else:
            np.testing.assert_array_equal(found, values, err_msg=name)


@pytest.mark.parametrize("path", GEOMETRIES, ids=name_of)
def test_geometry_read_from_format_md_alone_is_the_geometry(path):
    meta, expected = reader.read_geometry(path.read_bytes())
    geometry, index, bake_id = geometry_file.read(path)
    assert (list(index), bake_id) == (meta["sector"], meta["bake_id"])
    np.testing.assert_array_equal(geometry.vertices, expected["vertices"])
    np.testing.assert_array_equal(geometry.triangles, expected["triangles"])
    np.testing.assert_allclose(geometry.albedo, expected["albedo"], rtol=2.5e-7)  # float32 against float64
    np.testing.assert_array_equal(geometry.emission, expected["emission"])


@pytest.mark.parametrize("path", FINE, ids=name_of)
def test_fine_voxels_read_from_format_md_alone_are_the_voxels(path):
    meta, expected = reader.read_fine(path.read_bytes())
    voxels, index, bake_id = fine_file.read(path)
    assert (list(index), bake_id) == (meta["sector"], meta["bake_id"])
    for name in ("first", "kind", "probe"):
        np.testing.assert_array_equal(getattr(voxels, name), expected[name], err_msg=name)
    np.testing.assert_allclose(voxels.weight, expected["weight"], rtol=2.5e-7)
    assert (voxels.weight.sum(axis=3) > 0).any()


@each_folder
def test_distant_texels_read_from_format_md_alone_are_the_texels(golden):
    meta, expected = reader.read_distant((golden / "distant.gidist").read_bytes())
    texels, bake_id = distant_file.read(golden / "distant.gidist")
    assert (list(texels.origin), bake_id) == (meta["origin"], meta["bake_id"])
    np.testing.assert_array_equal(texels.sky, expected["sky"])
    np.testing.assert_array_equal(texels.valid, expected["valid"])


def test_distant_transfers_read_from_format_md_alone_are_the_transfers():
    meta, expected = reader.read_distant(DISTANT_V2.read_bytes())
    texels, bake_id = distant_file.read(DISTANT_V2)
    transfer = texels.transfer
    assert (list(texels.origin), bake_id, list(transfer.schedules)) == (meta["origin"], meta["bake_id"], meta["schedules"])
    for name, values in (("sky_transfer", transfer.sky), ("sun_transfer", transfer.sun), ("glow", transfer.glow), ("sky", texels.sky)):
        assert values.any()
        np.testing.assert_array_equal(values, expected[name], err_msg=name)
    digest = hashlib.blake2b(b"".join(expected[name].tobytes() for name in sorted(expected)), digest_size=16).hexdigest()
    assert digest == DISTANT_V2_DIGEST


@each_read
def test_world_json_agrees_with_the_files_it_names(golden):
    world = json.loads((golden / "world.json").read_bytes())
    assert {f"{x},{z}" for x, z in ((-1, 0), (0, 0))} == set(world["sectors"])
    for key, facts in world["sectors"].items():
        name = key.replace(",", "_")
        data = (golden / "sectors" / f"{name}.gisec").read_bytes()
        meta, arrays = reader.read_sector(data)
        assert facts["bytes"] == len(data)
        assert facts["digest"] == hashlib.blake2b(data, digest_size=16).hexdigest()
        assert (
            facts.get("fine_bytes") == (golden / "fine" / f"{name}.givox").stat().st_size
            if golden.name == "v3"
            else "fine_bytes" not in facts
        )
        assert facts["geometry_bytes"] == (golden / "geometry" / f"{name}.gigeo").stat().st_size
        assert meta["bake"]["bake_id"] == world["bake_id"]
        assert len(arrays["probe_position"]) == facts["probes"]
        assert len(arrays["surfel_position"]) == facts["surfels"]
        assert arrays["voxel_class"].size == facts["voxels"]
        assert len(arrays["sun_visibility"]) == world["sun_table"]["planes"]
        assert arrays["factor_weight"].shape[1] == {"cube": 6, "sh1": 4, "sh2": 9}[world["basis"]]
        assert meta["sky_patches"] == world["sky_patches"]
    table = world["sun_table"]
    planes = reader.sun_plane_count(
        table["latitude_degrees"], table["north_degrees"], table["declination_step_degrees"], table["hour_angle_step_degrees"]
    )
    assert planes == table["planes"]


@pytest.mark.parametrize("patches", [4, 8, 24, 48, 145, 1024])
def test_patches_of_the_sky_are_where_format_md_says(patches):
    assert tuple(reader.patches_in_rows(patches)) == sky_patches.patches_in_rows(patches)
    direction = np.random.default_rng(patches).normal(size=(500, 3))
    direction[:, 1] = np.abs(direction[:, 1])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    found = sky_patches.patch_of(direction, patches)
    assert found.tolist() == [reader.patch_at(patches, *one) for one in direction.tolist()]


@each_read
def test_what_a_version_holds_has_not_changed(golden):
    """The digest is over decoded integers and bit patterns of floats: decoding uses only IEEE operations that round one way."""
    opened = Dataset.open(golden)
    h = hashlib.blake2b(digest_size=16)
    for index in sorted(opened.world.sectors):
        sector, geometry = opened.sector(index), opened.geometry(index)
        arrays = [getattr(sector, name) for name in decoded_names()]
        for values in (*arrays, *vars(geometry).values()):
            h.update(f"{values.dtype.str}{values.shape}".encode())
            h.update(np.ascontiguousarray(values).tobytes())
        if opened.world.has_fine_voxels:
            for values in vars(opened.fine_voxels(sector)).values():
                h.update(f"{values.dtype.str}{values.shape}".encode() + np.ascontiguousarray(values).tobytes())
    texels = opened.distant()
    h.update(texels.sky.tobytes() + texels.valid.tobytes())
    h.update(json.dumps(opened.world.to_json(), sort_keys=True).encode())
    assert h.hexdigest() == DIGESTS[golden.name]


@each_read
def test_the_golden_dataset_still_lights_a_street(golden):
    engine = Engine(Dataset.open(golden))
    volume = engine.volume(np.array([5.0, 2.0, 30.0]), engine.lighting("12:00", "clear"), basis="cube")
    assert volume.sectors == ((-1, 0), (0, 0))
    # A street in a spring noon: tens of thousands of lux from the sky and the ground, none of them negative.
    assert volume.values.min() >= 0
    assert 5e3 < float(np.median(volume.values[2, ..., 1])) < 5e4


@pytest.mark.parametrize(
    ("version", "like"), [(1, "v4_sector2"), (2, "v2_sector2"), (3, "v4_sector2"), (4, "v4_sector2"), (5, "v5_sector2"), (6, "v6_sector2")]
)
def test_a_dataset_made_today_is_described_by_format_md(tmp_path, version, like):
    make = neighbour("make_golden")
    settings = {2: make.SETTINGS_V2, 3: make.SETTINGS_V3}.get(version, make.SETTINGS)
    scene = {4: make.scene_v4, 5: make.scene_v5, 6: make.scene_v6}.get(version, make.tiny_scene)()
    world = make.write_golden(tmp_path, settings, scene)
    assert json.loads((tmp_path / "world.json").read_bytes())["version"] == version
    golden = HERE / like
    opened = Dataset.open(tmp_path)
    for index in world.sectors:
        path = opened.sector_path(index)
        _, arrays = reader.read_sector(path.read_bytes())
        assert stored_arrays(path) == stored_arrays(golden / "sectors" / path.name), "another array, dtype or encoding is another version"
        sector = opened.sector(index)
        np.testing.assert_array_equal(arrays["voxel_probe"], sector.voxel_probe)
        np.testing.assert_array_equal(arrays["factor_source"], sector.factor_source)
        cut = dataset.geometry_path(tmp_path, index)
        reader.read_geometry(cut.read_bytes())
        assert stored_arrays(cut) == stored_arrays(golden / "geometry" / cut.name)
        if opened.world.has_fine_voxels:
            fine = dataset.fine_path(tmp_path, index)
            np.testing.assert_array_equal(reader.read_fine(fine.read_bytes())[1]["probe"], opened.fine_voxels(sector).probe)
            assert stored_arrays(fine) == stored_arrays(HERE / "v3" / "fine" / fine.name)
    assert stored_arrays(tmp_path / "distant.gidist") == stored_arrays(DISTANT_V2)
    assert stored_arrays(HERE / "v1" / "distant.gidist") < stored_arrays(DISTANT_V2)


def test_the_hexdump_in_format_md_is_the_golden_sector():
    text = (Path(dataset.__file__).parent / "FORMAT.md").read_text(encoding="utf-8")
    prefix = (GOLDEN / "sectors" / "0_0.gisec").read_bytes()[:64]
    for offset in range(0, 64, 16):
        assert f"    {offset:04x}  {prefix[offset : offset + 16].hex(' ')}  " in text
