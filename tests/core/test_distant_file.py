"""The far view's texels: one per sector, in their place, and refused where they can't be."""

import numpy as np
import pytest

from gi_core import container, distant_file
from gi_core.distant_file import KIND, MAX_SCHEDULES, SKY_VERSION, VERSION
from gi_core.distant_transfer import DistantTransfer
from gi_core.errors import CorruptFileError
from gi_core.grid import SectorIndex

BAKE_ID = "b" * 32
TEXELS = {
    SectorIndex(-2, 5): [0.1, 0.2, 0.3, 0.0, 0.5, 0.6],
    SectorIndex(1, 4): [0.6, 0.5, 1.0, 0.0, 0.2, 0.1],
    SectorIndex(-1, 6): [0.0] * 6,
}


def test_each_sector_is_at_its_texel_and_the_others_are_dark():
    found, bake_id = distant_file.decode(distant_file.encode(distant_file.assemble(TEXELS), BAKE_ID), "here")
    assert bake_id == BAKE_ID
    assert found.origin == (-2, 4)
    assert found.sky.shape == (3, 4, 6)
    for row in range(3):
        for column in range(4):
            index = SectorIndex(-2 + column, 4 + row)
            assert found.valid[row, column] == (index in TEXELS)
            np.testing.assert_array_equal(found.sky[row, column], np.array(TEXELS.get(index, [0.0] * 6), np.float32))


def test_no_sector_gives_no_texel():
    found, _ = distant_file.decode(distant_file.encode(distant_file.assemble({}), BAKE_ID), "here")
    assert found.sky.shape == (0, 0, 6)


def test_the_order_of_baking_does_not_matter():
    backwards = dict(reversed(TEXELS.items()))
    first, second = (distant_file.encode(distant_file.assemble(texels), BAKE_ID) for texels in (TEXELS, backwards))
    assert first == second


@pytest.mark.parametrize(
    ("meta", "arrays"),
    [
        ({}, {"sky": np.zeros((2, 2, 5), np.float32)}),
        ({}, {"sky": np.zeros((2, 3, 6), np.float32)}),
        ({}, {"sky": np.full((2, 2, 6), np.nan, np.float32)}),
        ({}, {"sky": np.full((2, 2, 6), np.inf, np.float32)}),
        ({}, {"sky": np.full((2, 2, 6), -0.1, np.float32)}),
        ({}, {"sky": np.full((2, 2, 6), 1.1, np.float32)}),
        ({}, {"valid": np.full((2, 2), 2, np.uint8)}),
        ({}, {"valid": np.zeros((2, 2), np.uint16)}),
        ({}, {"extra": np.zeros(1, np.uint8)}),
        ({"origin": 3}, {}),
        ({"origin": [1]}, {}),
        ({"origin": ["west", 2]}, {}),
        ({"origin": [float("inf"), 2]}, {}),
        ({"extra": 1}, {}),
    ],
)
def test_contents_that_do_not_fit_are_refused_by_name(meta, arrays):
    whole = {"sky": np.zeros((2, 2, 6), np.float32), "valid": np.ones((2, 2), np.uint8)} | arrays
    data = container.encode(KIND, SKY_VERSION, {"origin": [0, 0], "bake_id": BAKE_ID} | meta, whole)
    with pytest.raises(CorruptFileError, match=r"^bad\.gidist: .*; bake it again$"):
        distant_file.decode(data, "bad.gidist")


@pytest.mark.parametrize("missing", ["sky", "valid", "origin", "bake_id"])
def test_contents_that_are_missing_are_refused_by_name(missing):
    arrays = {"sky": np.zeros((2, 2, 6), np.float32), "valid": np.ones((2, 2), np.uint8)}
    meta = {"origin": [0, 0], "bake_id": BAKE_ID}
    arrays.pop(missing, None)
    meta.pop(missing, None)
    with pytest.raises(CorruptFileError, match=rf"^bad\.gidist: .*{missing.replace('_', '.')}"):
        distant_file.decode(container.encode(KIND, SKY_VERSION, meta, arrays), "bad.gidist")


def transfer(seed: int) -> DistantTransfer:
    """One texel's, of random numbers."""
    rng = np.random.default_rng(seed)
    sky, sun, glow = rng.random((2, 8, 3, 1, 6)), rng.random((2, 5, 2, 3, 1, 6)), rng.random((2, 2, 3, 1, 6))
    return DistantTransfer(sky.astype(np.float16).astype(np.float32), sun.astype(np.float16), glow.astype(np.float32), ("always", "night"))


def test_each_sector_has_its_own_transfer_whatever_the_order_of_baking():
    given = {index: transfer(seed) for seed, index in enumerate(TEXELS)}
    first, second = (
        distant_file.encode(distant_file.assemble(texels, transfers), BAKE_ID)
        for texels, transfers in ((TEXELS, given), (dict(reversed(TEXELS.items())), dict(reversed(given.items()))))
    )
    assert first == second
    found, _ = distant_file.decode(first, "here")
    assert found.lights == ("sky", "full")
    apart = distant_file.taken_apart(found)
    assert set(apart) == set(TEXELS)
    for index, part in apart.items():
        assert part.schedules == ("always", "night")
        for name in ("sky", "sun", "glow"):
            np.testing.assert_array_equal(getattr(part, name), getattr(given[index], name))


def test_texels_without_transfers_are_of_the_version_that_older_programs_read():
    data = distant_file.encode(distant_file.assemble(TEXELS), BAKE_ID)
    assert data[12] == SKY_VERSION
    found, _ = distant_file.decode(data, "here")
    assert found.lights == ("sky",)
    assert distant_file.taken_apart(found) == {}


def test_transfers_that_no_file_may_hold_are_left_out(monkeypatch):
    given = {index: transfer(seed) for seed, index in enumerate(TEXELS)}
    monkeypatch.setattr(container, "MAX_RAW_BYTES", 3 * given[SectorIndex(1, 4)].nbytes)
    assert distant_file.assemble(TEXELS, given).lights == ("sky",)


@pytest.mark.parametrize(
    ("meta", "arrays"),
    [
        ({}, {"sky_transfer": np.zeros((2, 0, 3, 4, 6), np.float16)}),
        ({}, {"sky_transfer": np.zeros((2, 1025, 3, 4, 6), np.float16)}),
        ({}, {"sky_transfer": np.zeros((2, 8, 3, 3, 6), np.float16)}),
        ({}, {"sky_transfer": np.zeros((1, 8, 3, 4, 6), np.float16)}),
        ({}, {"sky_transfer": np.zeros((2, 8, 3, 4, 6), np.float32)}),
        ({}, {"sky_transfer": np.full((2, 8, 3, 4, 6), np.inf, np.float16)}),
        ({}, {"sun_transfer": np.full((2, 5, 2, 3, 4, 6), np.nan, np.float16)}),
        ({}, {"sun_transfer": np.zeros((2, 0, 2, 3, 4, 6), np.float16)}),
        ({}, {"sun_transfer": np.zeros((2, 5, 3, 3, 4, 6), np.float16)}),
        ({}, {"sun_transfer": np.zeros((2, 5, 3, 4, 6), np.float16)}),
        ({}, {"glow": np.zeros((2, 2, 3, 4, 6), np.float32)}),
        ({}, {"glow": np.full((2, 1, 3, 4, 6), np.nan, np.float32)}),
        ({}, {"glow": np.full((2, 1, 3, 4, 6), 2e30, np.float32)}),
        ({"schedules": "night"}, {}),
        ({"schedules": ["at dusk"]}, {}),
        ({"schedules": [7]}, {}),
        ({"schedules": []}, {}),
        ({"schedules": ["night", "night"]}, {"glow": np.zeros((2, 2, 3, 4, 6), np.float32)}),
        (
            {"schedules": [f"00:{minute:02}-12:00" for minute in range(60)] + [f"01:0{minute}-12:00" for minute in range(5)]},
            {"glow": np.zeros((2, MAX_SCHEDULES + 1, 3, 4, 6), np.float32)},
        ),
        ({}, {"valid": np.array([[1, 1], [1, 0]], np.uint8)}),
    ],
)
def test_transfers_that_do_not_fit_are_refused_by_name(meta, arrays):
    whole = {
        "sky": np.zeros((2, 2, 6), np.float32),
        "valid": np.ones((2, 2), np.uint8),
        "sky_transfer": np.zeros((2, 8, 3, 4, 6), np.float16),
        "sun_transfer": np.zeros((2, 5, 2, 3, 4, 6), np.float16),
        "glow": np.zeros((2, 1, 3, 4, 6), np.float32),
    }
    about = {"origin": [0, 0], "bake_id": BAKE_ID, "schedules": ["night"]}
    assert distant_file.decode(container.encode(KIND, VERSION, about, whole), "good.gidist")[0].transfer is not None
    with pytest.raises(CorruptFileError, match=r"^bad\.gidist: .*; bake it again$"):
        distant_file.decode(container.encode(KIND, VERSION, about | meta, whole | arrays), "bad.gidist")
