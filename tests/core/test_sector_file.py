"""Sectors survive their file within its precision, and files that lie are refused."""

from dataclasses import replace

import numpy as np
import pytest

from gi_core import container, quantise, sector_file
from gi_core.errors import CorruptFileError
from gi_core.sector import counts
from gi_core.sector_file import KIND, VERSION

PATCHES = 6


def weight_of_probes(sector) -> np.ndarray:
    """(voxels, P) the weight of every probe in every voxel, whatever order a voxel lists them in."""
    of_probe = np.zeros((sector.voxel_class.size, max(sector.probe_count, 1)))
    slots = sector.voxel_probe.shape[3]
    np.add.at(of_probe, (np.arange(len(of_probe))[:, None], sector.voxel_probe.reshape(-1, slots)), sector.voxel_weight.reshape(-1, slots))
    return of_probe


@pytest.mark.parametrize(
    "shape",
    [
        {},
        {"emits": True},
        {"feedback": 3},
        {"probes": 1},
        {"probes": 1000},
        {"surfels": 0},
        {"probes": 0, "surfels": 0},
        {"voxel_probes": 8},
        {"basis": 4},
        {"basis": 9},
    ],
    ids=str,
)
def test_a_sector_survives_its_file(make_sector, shape):
    sector = make_sector(1, **shape)
    found, meta = sector_file.decode(sector_file.encode(sector, {"bake_id": "x"}, PATCHES), "here")
    assert meta == {"bake_id": "x"}
    assert found.index == sector.index
    for name in (
        "factor_starts",
        "factor_source",
        "factor_code",
        "factor_scale",
        "factor_trim",
        "brick_starts",
        "brick_level",
        "brick_cell",
        "brick_direction",
        "sun_visibility",
    ):
        np.testing.assert_array_equal(getattr(found, name), getattr(sector, name))
    for name in ("voxel_class", "voxel_room", "voxel_first", "probe_flags", "probe_room", "feedback_probe"):
        np.testing.assert_array_equal(getattr(found, name), getattr(sector, name))
    # Half a step of 1/512 m, and float32's own 4e-6 at 64 m.
    np.testing.assert_allclose(found.probe_position, sector.probe_position, atol=0.5 / 512 + 1e-5)
    if sector.surfel_count:
        size = 4.0 * 2.0 ** np.repeat(sector.brick_level, counts(sector.brick_starts))[:, None]
        # Half a step of 1/256 of a brick's cell across the surface, along it of 1/32, and half of the fine step by which its middle is off.
        across = np.repeat(sector.brick_direction // 2, counts(sector.brick_starts))[:, None] == np.arange(3)
        assert (np.abs(found.surfel_position - sector.surfel_position) <= size * np.where(across, 1, 9) / 512 + 1e-3).all()
        assert np.degrees(np.arccos(np.clip((found.surfel_normal * sector.surfel_normal).sum(axis=1), -1, 1))).max() < 0.95
        # The square root's step is 1/255: at most 2 sqrt(a) / 510 + (1/510)^2.
        assert (np.abs(found.surfel_albedo - sector.surfel_albedo) <= np.sqrt(sector.surfel_albedo) / 255 + 4e-6).all()
    # Half a step of 31 of the largest weight, and what all of them move the sum by.
    before, after = (weight_of_probes(s) for s in (sector, found))
    np.testing.assert_allclose(
        after, before, atol=(1 + sector.voxel_weight.shape[3]) / 2 / 31 / (sector.voxel_weight.sum(axis=3).max() or 1)
    )
    if sector.surfel_emission is not None:
        np.testing.assert_array_equal(found.surfel_emission, sector.surfel_emission)
    else:
        assert found.surfel_emission is None


def test_writing_what_was_read_gives_the_same_arrays(make_sector):
    once = sector_file.quantised(make_sector(3), PATCHES)
    twice = sector_file.quantised(once, PATCHES)
    np.testing.assert_array_equal(once.factor_code, twice.factor_code)
    np.testing.assert_array_equal(once.surfel_position, twice.surfel_position)
    np.testing.assert_array_equal(once.surfel_normal, twice.surfel_normal)
    np.testing.assert_array_equal(once.surfel_albedo, twice.surfel_albedo)
    np.testing.assert_array_equal(once.voxel_probe, twice.voxel_probe)
    np.testing.assert_array_equal(once.voxel_weight, twice.voxel_weight)


@pytest.mark.parametrize("basis", [4, 6, 9])
@pytest.mark.parametrize("patches", [1, 145, 1024])
def test_the_file_holds_any_basis_and_any_dome_of_patches(make_sector, basis, patches):
    sector = make_sector(13, basis=basis, patches=patches)
    found = sector_file.quantised(sector, patches)
    np.testing.assert_array_equal(found.factor_code, sector.factor_code)
    np.testing.assert_array_equal(found.factor_scale, sector.factor_scale)
    np.testing.assert_array_equal(found.factor_trim, sector.factor_trim)
    np.testing.assert_array_equal(found.factor_weight, sector.factor_weight)


@pytest.mark.parametrize("patches", [0, 1025])
def test_an_impossible_dome_is_refused(make_sector, patches):
    with pytest.raises(CorruptFileError, match="sky patches"):
        sector_file.quantised(make_sector(13), patches)


@pytest.mark.parametrize(
    ("array", "change"),
    [
        ("factor_source", lambda a: np.full(a.shape, 10_000_000, np.uint32)),
        ("factor_source", lambda a: a[:, None]),
        ("feedback_probe", lambda a: np.full_like(a, 60_000)),
        ("voxel_probe", lambda a: np.full_like(a, 999)),
        ("factor_count", lambda a: np.full_like(a, 65_535)),
        ("brick_count", lambda a: np.full_like(a, 65_535)),
        ("brick_count", lambda a: np.concatenate([[0, a[0] + a[1]], a[2:]]).astype(a.dtype)),
        ("brick_direction", lambda a: np.full_like(a, 6)),
        ("brick_level", lambda a: np.full_like(a, 200)),
        ("factor_scale", lambda a: np.full_like(a, np.inf)),
        ("factor_scale", lambda a: np.full_like(a, np.nan)),
        ("factor_scale", lambda a: -a - 1),
        ("factor_scale", lambda a: a + 1),
        ("factor_weight", lambda a: np.full_like(a, 255)),
        ("factor_source", lambda a: a[::-1]),
        ("voxel_class", lambda a: np.full_like(a, 3)),
        ("voxel_class", lambda a: a[:1]),
        ("sun_visibility", lambda a: a[:, :-1]),
        ("sun_visibility", lambda a: a[:, :-4]),
        ("voxel_list", lambda a: a[:1]),
        ("voxel_list", lambda a: np.full_like(a, 1)),
        ("voxel_list", lambda a: 0 * a),
        ("voxel_list", lambda a: np.full(a.shape, 65_535, np.uint16)),
        ("voxel_list", lambda a: np.concatenate([a[:1] + a.dtype.type(1), a[1:]])),
        ("voxel_probe", lambda a: a[:, :-1]),
        ("factor_trim", lambda a: a[:, :4]),
        ("factor_trim", lambda a: a[:, :, :-1]),
        ("factor_direction", lambda a: a + np.int8(60)),
        ("factor_direction", lambda a: a[:, :-1]),
        ("factor_direction", lambda a: a[:2]),
        ("surfel_normal", lambda a: a[:, :-1]),
        ("probe_flags", lambda a: a[:-1]),
        ("probe_position", lambda a: a[:2]),
        ("voxel_weight", lambda a: a.astype(np.uint16)),
    ],
    ids=lambda v: v if isinstance(v, str) else "",
)
def test_an_array_that_does_not_fit_the_others_is_refused(make_sector, array, change):
    basis = 9 if array in ("factor_trim", "factor_direction") else 6
    sector = make_sector(4, basis=basis)
    # Neighbours in a bake repeat each other's lists, random ones do not.
    repeats = replace(
        sector, voxel_probe=np.repeat(sector.voxel_probe[:, :, ::2], 2, 2), voxel_weight=np.repeat(sector.voxel_weight[:, :, ::2], 2, 2)
    )
    found = container.decode(sector_file.encode(repeats, {}, PATCHES), KIND, VERSION, "here")
    arrays = dict(found.arrays)
    arrays[array] = change(arrays[array])
    with pytest.raises(CorruptFileError, match=r"bad\.gisec"):
        sector_file.decode(container.encode(KIND, VERSION, found.meta, arrays), "bad.gisec")


def test_voxels_that_blend_the_same_share_a_list(make_sector):
    sector = make_sector(7, voxel_probes=3)
    probe, weight = (np.repeat(a[:, :, ::4], 4, axis=2) for a in (sector.voxel_probe, sector.voxel_weight))
    weight[..., 0] = 0  # a probe without weight, and another order, make no other list
    probe[:, :, 1::4, 0] += 1
    probe[:, :, 2::4], weight[:, :, 2::4] = probe[:, :, 2::4, ::-1], weight[:, :, 2::4, ::-1]
    weight[:, :, 3::4] *= 0.5
    alike = replace(sector, voxel_probe=probe % sector.probe_count, voxel_weight=weight)
    found = container.decode(sector_file.encode(alike, {}, PATCHES), KIND, VERSION, "here")
    assert found.arrays["voxel_probe"].shape[1] <= probe[:, :, ::4, 0].size
    again = sector_file.quantised(alike, PATCHES)
    expected = weight_of_probes(alike)
    np.testing.assert_allclose(weight_of_probes(again), expected / expected.sum(axis=1, keepdims=True), atol=1 / 31)


def test_a_negative_weight_of_harmonics_is_refused(make_sector):
    sector = make_sector(4, basis=9)
    below = replace(sector, factor_code=sector.factor_code * np.array([-1, 1, 1, 1], np.int8))
    with pytest.raises(CorruptFileError, match="no negative factor weights"):
        sector_file.quantised(below, PATCHES)


@pytest.mark.parametrize("basis", [4, 9])
def test_a_missing_array_or_meta_is_refused_of_harmonics(make_sector, basis):
    found = container.decode(sector_file.encode(make_sector(4, basis=basis), {}, PATCHES), KIND, VERSION, "here")
    for name in ("factor_weight", "factor_direction", "factor_trim", "factor_scale"):
        rest = {key: value for key, value in found.arrays.items() if key != name}
        with pytest.raises(CorruptFileError, match=r"bad\.gisec"):
            sector_file.decode(container.encode(KIND, VERSION, found.meta, rest), "bad.gisec")


def test_a_missing_array_or_meta_is_refused(make_sector):
    found = container.decode(sector_file.encode(make_sector(4), {}, PATCHES), KIND, VERSION, "here")
    for name in found.arrays:
        rest = {key: value for key, value in found.arrays.items() if key != name}
        with pytest.raises(CorruptFileError, match=r"bad\.gisec"):
            sector_file.decode(container.encode(KIND, VERSION, found.meta, rest), "bad.gisec")
    for name in found.meta:
        rest = {key: value for key, value in found.meta.items() if key != name}
        with pytest.raises(CorruptFileError, match=r"bad\.gisec"):
            sector_file.decode(container.encode(KIND, VERSION, rest, found.arrays), "bad.gisec")


def test_more_than_a_thousand_probes_are_refused(make_sector):
    with pytest.raises(CorruptFileError, match="1000 probes"):
        sector_file.quantised(make_sector(5, probes=1001), PATCHES)


def test_octahedral_axes_are_exact():
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    np.testing.assert_array_equal(quantise.decode_unit(quantise.encode_unit(axes)), axes.astype(np.float32))


def test_a_surfel_outside_its_cell_stays_finite(make_sector):
    sector = make_sector(6)
    outside = replace(sector, surfel_position=sector.surfel_position + np.float32(3.0))
    assert np.isfinite(sector_file.quantised(outside, PATCHES).surfel_position).all()
