"""Triangles survive their file within 1 mm, and files whose indices lie are refused."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gi_core import container, geometry_file
from gi_core.errors import CorruptFileError, FormatVersionError, InputError
from gi_core.geometry_file import KIND, VERSION, Geometry
from gi_core.grid import SectorIndex

BAKE_ID = "b" * 32


def some_triangles(seed: int, count: int, index: SectorIndex, emission: float = 0.0) -> Geometry:
    rng = np.random.default_rng(seed)
    return Geometry(
        vertices=rng.uniform(0, 64, (3 * count, 3)) + index.origin,
        triangles=rng.permutation(3 * count).reshape(-1, 3).astype(np.int32),
        albedo=rng.uniform(0, 0.95, (count, 3)).astype(np.float32),
        emission=np.full((count, 3), emission, np.float32),
    )


def corners(geometry: Geometry) -> np.ndarray:
    return geometry.vertices[geometry.triangles]


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32), st.integers(0, 40), st.integers(-900, 900), st.integers(-900, 900))
def test_triangles_come_back_in_order_where_they_were(seed, count, x, z):
    index = SectorIndex(x, z)
    given_ = some_triangles(seed, count, index, emission=seed % 3 * 100.0)
    found, found_index, bake_id = geometry_file.decode(geometry_file.encode(index, given_, BAKE_ID), "here")
    assert (found_index, bake_id) == (index, BAKE_ID)
    assert found.triangles.dtype == np.int32
    assert found.vertices.dtype == np.float64
    # Half a step of 1/512 m along each axis, and float64's own rounding at 60 km.
    np.testing.assert_allclose(corners(found), corners(given_), atol=0.5 / 512 + 1e-9)
    # The square root's step is 1/255.
    assert (np.abs(found.albedo - given_.albedo) <= np.sqrt(given_.albedo) / 255 + 4e-6).all()
    np.testing.assert_array_equal(found.emission, given_.emission)


def test_a_vertex_on_a_border_is_the_same_number_in_both_sectors():
    edge = np.array([[64.0, 1.2345678, 7.7777], [64.0, 3.3333, 7.7777], [64.0, 1.1, 9.87654]])
    triangle = np.array([[0, 1, 2]], np.int32)
    colour = np.full((1, 3), 0.5, np.float32)
    geometry = Geometry(edge, triangle, colour, 0 * colour)
    here, there = (corners(geometry_file.decode(geometry_file.encode(SectorIndex(x, 0), geometry, BAKE_ID), "here")[0]) for x in (0, 1))
    np.testing.assert_array_equal(here, there)


def test_triangles_that_rounding_flattens_are_left_out_and_the_others_keep_their_colours():
    vertices = np.array([[0.0, 0, 0], [1e-4, 0, 0], [0, 1, 0], [5, 0, 0], [6, 0, 0], [5, 1, 0]])
    triangles = np.array([[0, 1, 2], [3, 4, 5]], np.int32)
    albedo = np.array([[0.1, 0.1, 0.1], [0.9, 0.2, 0.0]], np.float32)
    geometry = Geometry(vertices, triangles, albedo, np.zeros((2, 3), np.float32))
    found, _, _ = geometry_file.decode(geometry_file.encode(SectorIndex(0, 0), geometry, BAKE_ID), "here")
    np.testing.assert_array_equal(corners(found)[0], vertices[3:])
    assert len(found.triangles) == 1
    assert (np.abs(found.albedo[0] - albedo[1]) < 0.004).all()  # a step of the square root


@pytest.mark.parametrize("height", [4.2e6, -4.2e6, np.inf, np.nan])
def test_what_the_steps_cannot_hold_is_refused_and_does_not_wrap(height):
    vertices = np.array([[0.0, height, 0], [1, height, 0], [0, height, 1]])
    colour = np.full((1, 3), 0.5, np.float32)
    with pytest.raises(InputError, match="4000 km"):
        geometry_file.encode(SectorIndex(0, 0), Geometry(vertices, np.array([[0, 1, 2]], np.int32), colour, 0 * colour), BAKE_ID)


def test_winding_is_kept():
    geometry = some_triangles(3, 20, SectorIndex(0, 0))
    found, _, _ = geometry_file.decode(geometry_file.encode(SectorIndex(0, 0), geometry, BAKE_ID), "here")

    def normals(c):
        n = np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0])
        return n / np.linalg.norm(n, axis=1, keepdims=True)

    # Vertices move by 1 mm in triangles of some 20 m.
    assert ((normals(corners(geometry)) * normals(corners(found))).sum(axis=1) > 0.99).all()


@pytest.mark.parametrize(
    "change",
    [
        lambda a: a.update(triangle=a["triangle"] + 100),
        lambda a: a.update(triangle=-1 - a["triangle"]),
        lambda a: a.update(triangle=a["triangle"][:2]),
        lambda a: a.update(triangle=a["triangle"][:, :-1]),
        lambda a: a.update(vertex=a["vertex"][:2]),
        lambda a: a.update(material=a["material"] + np.uint32(1000)),
        lambda a: a.update(material=a["material"].astype(np.uint16)),
        lambda a: a.update(material_albedo=a["material_albedo"][:, :2]),
        lambda a: a.update(material_emission=a["material_emission"] * np.float32(np.nan)),
        lambda a: a.pop("material"),
        lambda a: a.update(extra=a["material"]),
    ],
)
def test_contents_that_do_not_fit_are_refused_by_name(change):
    found = container.decode(geometry_file.encode(SectorIndex(0, 0), some_triangles(1, 10, SectorIndex(0, 0)), BAKE_ID), KIND, VERSION, "x")
    arrays = dict(found.arrays)
    change(arrays)
    with pytest.raises(CorruptFileError, match=r"^bad\.gigeo: .*; bake it again$"):
        geometry_file.decode(container.encode(KIND, VERSION, found.meta, arrays), "bad.gigeo")


@pytest.mark.parametrize(
    "meta",
    [{}, {"sector": [0, 0]}, {"bake_id": "x"}, *({"sector": s, "bake_id": "x"} for s in (0, [1], [1, 2, 3], ["a", 0], [float("inf"), 0]))],
)
def test_meta_that_is_not_whole_is_refused_by_name(meta):
    found = container.decode(geometry_file.encode(SectorIndex(0, 0), some_triangles(1, 10, SectorIndex(0, 0)), BAKE_ID), KIND, VERSION, "x")
    with pytest.raises(CorruptFileError, match=r"^bad\.gigeo: .*; bake it again$"):
        geometry_file.decode(container.encode(KIND, VERSION, meta, found.arrays), "bad.gigeo")


def test_another_version_is_named():
    data = bytearray(geometry_file.encode(SectorIndex(0, 0), some_triangles(1, 1, SectorIndex(0, 0)), BAKE_ID))
    data[12] = 2
    with pytest.raises(FormatVersionError, match=r"old\.gigeo: format version 2"):
        geometry_file.decode(bytes(data), "old.gigeo")
