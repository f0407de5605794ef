"""Cleaning: what is dropped, what is turned, what is refused; and the digest."""

import dataclasses

import numpy as np
import pytest

from bake_jobs.clean import MAX_TRIANGLES, clean_mesh
from bake_jobs.scene import Mesh, ProbeHint, Scene, join_meshes, scene_digest
from bake_jobs.solids import boxes
from gi_core.constants import ALBEDO_MAX
from gi_core.errors import SourceError
from gi_core.world import Lamp, Location, Room


def box_mesh(low=(0.0, 0.0, 0.0), high=(1.0, 1.0, 1.0), *, inward=False):
    vertices, triangles = boxes(np.array(low), np.array(high))
    return Mesh.of_colour(vertices, triangles[:, ::-1] if inward else triangles, (0.5, 0.5, 0.5))


def volume(mesh):
    a, b, c = (mesh.vertices[mesh.triangles[:, i]] for i in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


def test_a_box_is_closed_and_faces_outward():
    mesh, dropped = clean_mesh(box_mesh((-1, 0, 2), (1, 3, 6)), "box")
    assert volume(mesh) == pytest.approx(2 * 3 * 4)
    assert len(mesh.triangles) == 12
    assert len(mesh.vertices) == 8
    assert dataclasses.astuple(dropped) == (0, 0, 0)


def test_each_defect_is_dropped_and_counted_once():
    good = box_mesh()
    vertices = np.concatenate([good.vertices, [[np.nan, 0, 0], [np.inf, 1, 0], [0, 0, 2], [0, 0, 3], [1.0, 1.0, 1.0]]])
    bad = [
        [0, 1, 8],  # NaN corner
        [0, 9, 2],  # infinite corner
        [0, 1, 99],  # index beyond the vertices
        [0, -1, 2],  # negative index
        [3, 3, 5],  # a point twice
        [0, 10, 11],  # three in a line
        [*good.triangles[0][[1, 2, 0]]],  # the first triangle, turned
        [12 if corner == 7 else corner for corner in good.triangles[3]],  # the fourth, over a vertex stored twice
    ]
    mesh, dropped = clean_mesh(Mesh.of_colour(vertices, np.concatenate([good.triangles, bad]), (0.5, 0.5, 0.5)), "dirty")
    assert 7 in good.triangles[3], "the case above needs corner 7"
    assert (dropped.non_finite, dropped.degenerate, dropped.duplicate) == (2, 4, 2)
    assert len(mesh.triangles) == 12
    assert volume(mesh) == pytest.approx(1)


def test_walls_of_two_houses_that_touch_are_both_kept():
    good = box_mesh()
    behind = good.triangles[1][::-1][None]
    mesh, dropped = clean_mesh(Mesh.of_colour(good.vertices, np.concatenate([good.triangles, behind]), (0.5, 0.5, 0.5)), "row")
    assert dropped.duplicate == 0
    assert len(mesh.triangles) == 13


@pytest.mark.parametrize("offset", [0.0, 5e4, -4e5])
def test_an_inside_out_solid_is_turned_wherever_it_stands(offset):
    at = np.array([offset, 0.0, offset])
    ground = box_mesh(at - np.array([50, 1, 50]), at + np.array([50, 0, 50]))
    mesh, _ = clean_mesh(join_meshes([ground, box_mesh(at, at + 4, inward=True)]), "two solids")
    local = Mesh(mesh.vertices - at, mesh.triangles, mesh.albedo, mesh.emission)
    assert volume(local) == pytest.approx(100 * 100 + 4**3)


def test_touching_solids_are_turned_each_on_its_own():
    mesh, _ = clean_mesh(join_meshes([box_mesh((0, 0, 0), (2, 2, 2)), box_mesh((2, 2, 0), (4, 4, 2), inward=True)]), "edge to edge")
    assert volume(mesh) == pytest.approx(16)


def test_a_cavity_keeps_its_inward_walls():
    shell = join_meshes([box_mesh((0, 0, 0), (10, 10, 10)), box_mesh((1, 1, 1), (9, 9, 9), inward=True)])
    assert volume(clean_mesh(shell, "hollow")[0]) == pytest.approx(1000 - 512)


def test_a_room_seen_from_within_is_not_turned_into_a_solid():
    furnace = box_mesh((0, 0, 0), (4, 3, 5), inward=True)
    assert volume(clean_mesh(furnace, "the whole scene")[0]) == pytest.approx(-60)
    beside = box_mesh((20, 0, 20), (22, 2, 22))
    assert volume(clean_mesh(join_meshes([furnace, beside]), "beside")[0]) == pytest.approx(60 + 8)
    room = Room("inside", (0.5, 0, 0.5), (3.5, 3, 4.5))
    assert volume(clean_mesh(join_meshes([furnace, beside]), "with a room", (room,))[0]) == pytest.approx(-60 + 8)


def test_a_room_with_a_table_in_it_is_not_turned():
    furnished = [box_mesh((0, 0, 0), (4, 3, 5), inward=True), box_mesh((1, 0.5, 1), (2, 1, 2)), box_mesh((20, 0, 20), (22, 2, 22))]
    assert volume(clean_mesh(join_meshes(furnished), "furnished")[0]) == pytest.approx(-60 + 0.5 + 8)


def test_an_open_surface_is_never_turned():
    roof = Mesh.of_colour(np.array([[0.0, 5, 0], [1, 5, 0], [0, 5, 1]]), np.array([[0, 1, 2]]), (0.5, 0.5, 0.5))
    mesh, _ = clean_mesh(roof, "roof")
    normal = np.cross(*(mesh.vertices[mesh.triangles[0, i]] - mesh.vertices[mesh.triangles[0, 0]] for i in (1, 2)))
    assert normal[1] < 0


def test_albedo_is_clamped_and_emission_is_not_negative():
    mesh = dataclasses.replace(box_mesh(), albedo=np.tile(np.float32([-1, 0.5, 7]), (12, 1)), emission=np.full((12, 3), -2, np.float32))
    cleaned, _ = clean_mesh(mesh, "colours")
    assert np.array_equal(cleaned.albedo, np.tile(np.float32([0, 0.5, ALBEDO_MAX]), (12, 1)))
    assert (cleaned.emission == 0).all()


def test_nothing_left_is_an_error_that_says_where():
    nothing = join_meshes([])
    with pytest.raises(SourceError, match=r"empty\.ply: expected triangles"):
        clean_mesh(nothing, "empty.ply")
    line = Mesh.of_colour(np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]), np.array([[0, 1, 2]]), (0.5, 0.5, 0.5))
    with pytest.raises(SourceError, match=r"found none among 1 \(1 without one, 0 with NaN"):
        clean_mesh(line, "line.ply")


def test_absurd_sizes_are_refused():
    with pytest.raises(SourceError, match="across"):
        clean_mesh(box_mesh((0, 0, 0), (2e6, 1, 1)), "wide.glb")
    # A view of one row, so that the count is tested without its memory.
    many = np.broadcast_to(np.array([[0, 1, 2]]), (MAX_TRIANGLES + 1, 3))
    colours = np.broadcast_to(np.float32([[0.5, 0.5, 0.5]]), many.shape)
    with pytest.raises(SourceError, match="at most 50,000,000 triangles"):
        clean_mesh(Mesh(np.zeros((3, 3)), many, colours, colours), "many.glb")


def test_a_stray_vertex_that_no_triangle_uses_is_forgotten():
    mesh = box_mesh()
    stray = dataclasses.replace(mesh, vertices=np.concatenate([mesh.vertices, [[1e9, 0, 0]]]))
    assert len(clean_mesh(stray, "stray")[0].vertices) == 8


def test_cleaning_twice_changes_nothing():
    rng = np.random.default_rng(5)
    soup = Mesh.of_colour(rng.normal(size=(40, 3)).round(1), rng.integers(-1, 41, (200, 3)), (0.4, 0.4, 0.4))
    once, _ = clean_mesh(soup, "soup")
    twice, dropped = clean_mesh(once, "soup")
    assert dataclasses.astuple(dropped) == (0, 0, 0)
    assert np.array_equal(once.vertices, twice.vertices)
    assert np.array_equal(once.triangles, twice.triangles)


def scene():
    mesh, _ = clean_mesh(box_mesh(), "box")
    return Scene(mesh.vertices, mesh.triangles.astype(np.int32), mesh.albedo, mesh.emission)


CHANGES = {
    "a vertex": lambda s: {"vertices": s.vertices + np.array([1e-12, 0, 0])},
    "a triangle's order": lambda s: {"triangles": s.triangles[::-1]},
    "albedo": lambda s: {"albedo": s.albedo * np.float32(0.999)},
    "emission": lambda s: {"emission": s.emission + np.float32(1)},
    "a room": lambda s: {"rooms": (Room("a", (0, 0, 0), (1, 1, 1)),)},
    "a lamp": lambda s: {"lamps": (Lamp("a", "point", (0, 0, 0), 1.0),)},
    "a hint": lambda s: {"hints": (ProbeHint("add", (0, 0, 0), (1, 1, 1)),)},
    "north": lambda s: {"location": Location(north_degrees=1.0)},
}


@pytest.mark.parametrize("change", CHANGES)
def test_the_digest_sees_every_change(change):
    before = scene()
    assert scene_digest(dataclasses.replace(before, **CHANGES[change](before))) != scene_digest(before)


def test_the_digest_is_of_content_not_of_objects_or_names():
    assert scene_digest(scene()) == scene_digest(dataclasses.replace(scene(), name="another"))
    assert len(scene_digest(scene())) == 32
