"""A dataset's binary files: swapped, foreign, oversized and forged ones are refused by name, before anything is computed from them."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import zstandard

from gi_core import container, distant_file, geometry_file, sector_file
from gi_core.dataset import DISTANT_FILE, Dataset, geometry_path, sector_path
from gi_core.errors import CorruptFileError, FormatVersionError, SectorMissingError
from gi_core.grid import SectorIndex, voxel_columns

GOLDEN = Path(__file__).parents[1] / "golden" / "v1"
NO_PAYLOAD = zstandard.ZstdCompressor().compress(b"")
HERE, THERE = SectorIndex(0, 0), SectorIndex(-1, 0)


@pytest.fixture
def root(tmp_path) -> Path:
    """A copy of the golden dataset, to be damaged."""
    copy = tmp_path / "city"
    shutil.copytree(GOLDEN, copy)
    return copy


def rewrite(path: Path, kind: str, change_meta=None, change_arrays=None) -> None:
    """Change a container's contents and give it a right digest again, as one who means harm would."""
    found = container.decode(path.read_bytes(), kind, 1, str(path))
    meta, arrays = found.meta, dict(found.arrays)
    if change_meta:
        change_meta(meta)
    if change_arrays:
        change_arrays(arrays)
    path.write_bytes(container.encode(kind, 1, meta, arrays))


def test_the_golden_dataset_opens(root):
    opened = Dataset.open(root)
    assert opened.sector(HERE).index == HERE
    assert len(opened.geometry(THERE).triangles) > 0
    assert opened.distant().valid.all()
    assert len(opened.digest) == 32


@pytest.mark.parametrize("read", [Dataset.sector, Dataset.geometry, Dataset.sector_path])
def test_a_sector_that_was_not_baked_is_named(root, read):
    with pytest.raises(SectorMissingError, match=r"sector 5,-7 is not in this dataset of 2 sectors"):
        read(Dataset.open(root), SectorIndex(5, -7))


@pytest.mark.parametrize(("read", "path_of"), [(Dataset.sector, sector_path), (Dataset.geometry, geometry_path)])
def test_another_sectors_file_is_refused(root, read, path_of):
    shutil.copy(path_of(root, THERE), path_of(root, HERE))
    with pytest.raises(CorruptFileError, match=rf"{path_of(root, HERE).name}: holds sector -1_0; bake it again"):
        read(Dataset.open(root), HERE)
    assert read(Dataset.open(root), THERE) is not None


@pytest.mark.parametrize(
    ("read", "path_of", "kind", "put"),
    [
        (Dataset.sector, sector_path, "SECT", lambda meta: meta["bake"].update(bake_id="f" * 32)),
        (Dataset.sector, sector_path, "SECT", lambda meta: meta["bake"].clear()),
        (Dataset.geometry, geometry_path, "GEOM", lambda meta: meta.update(bake_id="f" * 32)),
        (lambda d, _: d.distant(), lambda root, _: root / DISTANT_FILE, "DIST", lambda meta: meta.update(bake_id="f" * 32)),
    ],
)
def test_another_bakes_file_is_refused(root, read, path_of, kind, put):
    path = path_of(root, HERE)
    rewrite(path, kind, put)
    with pytest.raises(CorruptFileError, match=rf"{path.name}: holds .* of another bake; bake it again"):
        read(Dataset.open(root), HERE)


@pytest.mark.parametrize("read", [Dataset.sector, Dataset.geometry, lambda d, _: d.distant()])
@pytest.mark.parametrize("damage", ["removed", "a folder", "empty", "noise", "text"])
def test_a_file_that_is_not_there_or_not_ours_is_refused_by_name(root, read, damage):
    for path in (sector_path(root, HERE), geometry_path(root, HERE), root / DISTANT_FILE):
        path.unlink()
        if damage == "a folder":
            path.mkdir()
        elif damage != "removed":
            path.write_bytes({"empty": b"", "noise": bytes(range(256)) * 9, "text": b"hello world " * 99}[damage])
    with pytest.raises(CorruptFileError, match=r"0_0\.gi(sec|geo)|distant\.gidist"):
        read(Dataset.open(root), HERE)


@pytest.mark.parametrize("read", [Dataset.sector, Dataset.geometry, lambda d, _: d.distant()])
def test_a_huge_file_is_refused_before_it_is_read(root, read, monkeypatch):
    for path in (sector_path(root, HERE), geometry_path(root, HERE), root / DISTANT_FILE):
        with path.open("r+b") as file:
            file.truncate(container.MAX_FILE_BYTES + 1)  # sparse: takes no disk
    opened = Dataset.open(root)

    def never(_: Path) -> bytes:
        raise AssertionError("read")

    monkeypatch.setattr(Path, "read_bytes", never)
    with pytest.raises(CorruptFileError, match=r"expected at most \d+ bytes"):
        read(opened, HERE)


@pytest.mark.parametrize("read", [Dataset.sector, Dataset.geometry, lambda d, _: d.distant()])
def test_a_file_of_another_version_is_named(root, read):
    for path in (sector_path(root, HERE), geometry_path(root, HERE), root / DISTANT_FILE):
        data = bytearray(path.read_bytes())
        data[12] = 9
        path.write_bytes(data)
    with pytest.raises(FormatVersionError, match=r"(0_0|distant)\..*: format version 9, .* version 1( or 2)?; bake the dataset again"):
        read(Dataset.open(root), HERE)


def test_a_sector_with_more_sky_patches_than_the_world_is_refused(root):
    """The device holds as many patches as world.json says: a factor beyond them would read another buffer's bytes."""
    path = sector_path(root, HERE)

    def read_far(arrays):
        source = arrays["factor_source"]
        arrays["factor_source"] = np.where(source >= len(arrays["brick_level"]), source + 94, source).astype(np.uint32)

    rewrite(path, "SECT", lambda meta: meta.update(sky_patches=100), read_far)
    with pytest.raises(CorruptFileError, match=r"0_0\.gisec: expected factors of 6 sky patches"):
        Dataset.open(root).sector(HERE)


def test_a_sector_with_other_sun_planes_is_refused(root):
    rewrite(sector_path(root, HERE), "SECT", None, lambda arrays: arrays.update(sun_visibility=arrays["sun_visibility"][:-1]))
    with pytest.raises(CorruptFileError, match=r"0_0\.gisec: 20 sun planes, expected 21"):
        Dataset.open(root).sector(HERE)


def voxels(slices):
    def cut(arrays):
        for name in ("voxel_class", "voxel_room", "voxel_probe", "voxel_weight"):
            arrays[name] = arrays[name][(..., *slices)]

    return cut


@pytest.mark.parametrize(
    ("change_meta", "change_arrays", "says"),
    [
        # Kernels index voxels by these, without a look at the sizes of the arrays.
        (lambda meta: meta.update(voxel_first=[-5, -1, 0]), None, "column"),
        (lambda meta: meta.update(voxel_first=[0, -1]), None, "column"),
        (lambda meta: meta.update(voxel_first=[0, 2**40, 0]), None, "inconsistent"),
        (lambda meta: meta.update(voxel_first=[float("inf"), 0, 0]), None, "inconsistent"),
        (lambda meta: meta.update(sector=[float("inf"), 0]), None, "inconsistent"),
        (lambda meta: meta.update(sector="here"), None, "inconsistent"),
        (lambda meta: meta.update(sector=[10**400, 0]), None, "inconsistent"),
        (lambda meta: meta.update(sector=[True, 0]), None, "inconsistent"),
        (None, lambda a: a.update(voxel_room=np.full_like(a["voxel_room"], 9)), "expected rooms of 1 to"),
        (None, lambda a: a.update(probe_room=np.full_like(a["probe_room"], 9)), "expected rooms of 1 to"),
        (lambda meta: meta.update(sky_patches=[]), None, "inconsistent"),
        (lambda meta: meta.update(bake=7), None, "inconsistent"),
        (lambda meta: meta.update(unheard_of=1), None, "unheard_of"),
        (None, lambda a: a.update(unheard_of=np.zeros(3, np.uint8)), "unheard_of"),
        (None, voxels((slice(None), slice(None), slice(0, 19))), "20 by 20 voxel columns"),
        (None, voxels((slice(0, 0), slice(None), slice(None))), "with a layer"),
        (None, lambda a: a.update(voxel_probe=a["voxel_probe"][:0], voxel_weight=a["voxel_weight"][:0]), "1 to 32 probes"),
        (
            None,
            lambda a: a.update(voxel_probe=np.repeat(a["voxel_probe"], 9, 0), voxel_weight=np.repeat(a["voxel_weight"], 9, 0)),
            "1 to 32",
        ),
        (None, lambda a: a.update(feedback_probe=a["feedback_probe"][:0], feedback_weight=a["feedback_weight"][:0]), "1 to 32 probes"),
        (None, lambda a: a.update({n: np.repeat(a[n], 17, 0) for n in ("feedback_probe", "feedback_weight")}), "1 to 32 probes"),
        (None, lambda a: a.update(surfel_emission=-1 - a["surfel_emission"]), "negative"),
        (None, lambda a: a.update(factor_scale=np.ones_like(a["factor_scale"])), "at most 1"),
        (None, lambda a: a.update(brick_level=a["brick_level"] + np.uint8(8)), "brick levels"),
    ],
)
def test_a_forged_sector_is_refused_by_name(root, change_meta, change_arrays, says):
    path = sector_path(root, HERE)
    rewrite(path, "SECT", change_meta, change_arrays)
    with pytest.raises(CorruptFileError, match=rf"0_0\.gisec: .*({says})"):
        Dataset.open(root).sector(HERE)


@pytest.mark.parametrize("sector", [[10**400, 0], [1_000_001, 0], [0], "here"])
def test_geometry_of_no_sector_is_refused_by_name(root, sector):
    rewrite(geometry_path(root, HERE), "GEOM", lambda meta: meta.update(sector=sector), None)
    with pytest.raises(CorruptFileError, match=r"0_0\.gigeo: inconsistent contents"):
        Dataset.open(root).geometry(HERE)


@pytest.mark.parametrize("kind", ["SECT", "GEOM", "DIST"])
@pytest.mark.parametrize(
    "header",
    [
        b'{"arrays":[],"meta":' + b"[" * 100_000 + b"]" * 100_000 + b"}",
        b'{"arrays":[],"meta":[]}',
        b'{"arrays":[{"name":"x","dtype":"u1","shape":[' + b"1," * 99 + b'0],"delta":false}],"meta":{}}',
    ],
    ids=["deep", "meta is a list", "a hundred axes"],
)
def test_a_forged_header_is_refused(kind, header):
    prefix = container._PREFIX.pack(container.MAGIC, kind.encode(), 1, len(header), 0, len(NO_PAYLOAD), 0, bytes(16))
    data = prefix[:40] + container._digest(prefix, header, NO_PAYLOAD) + prefix[56:] + header + NO_PAYLOAD
    decode = {"SECT": sector_file.decode, "GEOM": geometry_file.decode, "DIST": distant_file.decode}[kind]
    with pytest.raises(CorruptFileError, match=r"^bad\.file: "):
        decode(data, "bad.file")


def test_a_frame_that_states_another_size_is_refused_before_it_unpacks():
    """The decompressor allocates what a frame states: 2 TiB here, whatever the prefix says."""
    whole = container.encode("TEST", 1, {}, {"x": np.zeros(400, np.uint8)})
    header_bytes = int.from_bytes(whole[16:20], "little")
    frame = bytearray(whole[64 + header_bytes :])
    # Single segment, 2-byte size (0x64) -> 8-byte size (0xe4): RFC 8878, 3.1.1.1.
    assert frame[4] & 0xE0 == 0x60
    forged = bytes(frame[:4]) + bytes([frame[4] | 0xC0]) + (2 << 40).to_bytes(8, "little") + bytes(frame[7:])
    header = whole[64 : 64 + header_bytes]
    prefix = container._PREFIX.pack(container.MAGIC, b"TEST", 1, len(header), 0, len(forged), 400, bytes(16))
    data = prefix[:40] + container._digest(prefix, header, forged) + prefix[56:] + header + forged
    with pytest.raises(CorruptFileError, match="one zstd frame of 400 bytes"):
        container.decode(data, "TEST", 1, "here")


@pytest.mark.parametrize("shape", [[0, 1 << 20, 1 << 20], [1 << 20, 0, 1 << 20], [1 << 28, 2, 0]])
def test_an_axis_of_length_0_hides_no_size(shape):
    """Sums over the empty axis would be as large as the others say: 4 TiB here."""
    header = json.dumps({"meta": {}, "arrays": [{"name": "x", "dtype": "f4", "shape": shape, "delta": False}]}).encode()
    prefix = container._PREFIX.pack(container.MAGIC, b"TEST", 1, len(header), 0, len(NO_PAYLOAD), 0, bytes(16))
    data = prefix[:40] + container._digest(prefix, header, NO_PAYLOAD) + prefix[56:] + header + NO_PAYLOAD
    with pytest.raises(CorruptFileError, match=r"^here: array 'x' has shape"):
        container.decode(data, "TEST", 1, "here")


def test_bytes_after_the_frame_are_refused():
    whole = container.encode("TEST", 1, {}, {"x": np.zeros(400, np.uint8)})
    header_bytes = int.from_bytes(whole[16:20], "little")
    header, payload = whole[64 : 64 + header_bytes], whole[64 + header_bytes :] + b"more"
    prefix = container._PREFIX.pack(container.MAGIC, b"TEST", 1, len(header), 0, len(payload), 400, bytes(16))
    data = prefix[:40] + container._digest(prefix, header, payload) + prefix[56:] + header + payload
    with pytest.raises(CorruptFileError, match=r"^here: "):
        container.decode(data, "TEST", 1, "here")


def test_a_container_without_arrays_is_whole():
    assert container.decode(container.encode("TEST", 1, {"a": 1}, {}), "TEST", 1, "here").arrays == {}


@pytest.mark.parametrize("index", [(-7, 3), (-1, -1), (1000, -999)])
def test_sectors_of_any_index_keep_their_voxels(make_sector, index):
    """A sector owns 20 or 21 voxel columns along each side."""
    sector = make_sector(1)
    (x0, x1), (z0, z1) = voxel_columns(index[0]), voxel_columns(index[1])
    pad = ((0, 0), (0, z1 - z0 - 20), (0, x1 - x0 - 20))
    moved = replace(
        sector,
        index=SectorIndex(*index),
        voxel_first=np.array([x0, -1, z0], np.int32),
        voxel_class=np.pad(sector.voxel_class, pad),
        voxel_room=np.pad(sector.voxel_room, pad),
        voxel_probe=np.pad(sector.voxel_probe, (*pad, (0, 0))),
        voxel_weight=np.pad(sector.voxel_weight, (*pad, (0, 0)), mode="edge"),
    )
    found = sector_file.quantised(moved, 6)
    assert found.index == index
    np.testing.assert_array_equal(found.voxel_first, moved.voxel_first)
    # In whatever order a voxel lists its probes: its weights are whole thirty-firsts of the largest.
    light = np.linspace(0, 1, sector.probe_count)
    blended = [(s.voxel_weight * light[s.voxel_probe]).sum(axis=3) / s.voxel_weight.sum(axis=3) for s in (found, moved)]
    np.testing.assert_allclose(*blended, atol=2 / 31)


def test_what_a_resumed_bake_must_not_keep_is_noticed(root):
    """A distant file that lacks a sector, or has one too many, belongs to another bake of the same id (--sectors)."""
    record = json.loads((root / "world.json").read_bytes())
    del record["sectors"]["-1,0"]
    (root / "world.json").write_text(json.dumps(record))
    with pytest.raises(CorruptFileError, match=r"distant\.gidist: holds 2 sectors"):
        Dataset.open(root).distant()
