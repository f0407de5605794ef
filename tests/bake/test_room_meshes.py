"""Rooms drawn as meshes: their air is what the mesh encloses, whatever way it was drawn, and what encloses nothing is refused by name."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from bake_jobs.room_meshes import mesh_room
from bake_jobs.room_search import world_rooms
from bake_jobs.scene import Mesh
from bake_jobs.scene_source import load_scene
from bake_jobs.solids import boxes, prism
from gi_core.constants import ROOM_CELL_M
from gi_core.errors import InputError, SourceError
from gi_core.rooms import holds, rooms_of
from gi_core.world import Room

BEYOND = ROOM_CELL_M / 4 * np.sqrt(3)  # a cell's diagonal: so far may what its room holds reach out of a mesh that follows no cells
L_SHAPE = np.array([(2, 2), (12, 2), (12, 6), (6, 6), (6, 12), (2, 12)], float)
HEIGHT = 3.2


def coloured(vertices, triangles) -> Mesh:
    return Mesh.of_colour(np.asarray(vertices, np.float64), np.asarray(triangles, np.int64), (0.5, 0.5, 0.5))


def turned_up(plan, low, high) -> Mesh:
    """A prism over a plan (n, 2), x and z."""
    vertices, triangles, _ = prism([np.asarray(plan, np.float64)], low, high)
    return coloured(vertices, triangles)


def of_trimesh(mesh: trimesh.Trimesh) -> Mesh:
    return coloured(mesh.vertices, mesh.faces)


def points_around(mesh: Mesh, count: int = 4000) -> np.ndarray:
    return np.random.default_rng(1).uniform(mesh.vertices.min(axis=0) - 1, mesh.vertices.max(axis=0) + 1, (count, 3))


def assert_holds_what(room: Room, points: np.ndarray, depth: np.ndarray) -> None:
    """``depth`` (n,) [m] is how far each point lies inside the surface, negative outside."""
    held = holds(room, points)
    deep, off = depth > 0.001, depth < -BEYOND  # corners are looked at up to 0.7 mm off them
    assert deep.any()
    assert off.any()
    assert held[deep].all()
    assert not held[off].any()


def test_a_round_room_is_round():
    ball = of_trimesh(trimesh.creation.icosphere(subdivisions=4, radius=4.0).apply_translation((70, 5, -3)))
    room = mesh_room("dome", ball, "here")
    assert (room.name, room.is_found, room.openings) == ("dome", False, ())
    points = points_around(ball)
    assert_holds_what(room, points, 4.0 - np.linalg.norm(points - [70, 5, -3], axis=1))


def test_a_slanted_room_is_slanted():
    """An attic 8 m wide, 3 m high under the ridge and nothing at the eaves."""
    vertices, triangles, _ = prism([np.array([(-4.0, 0.0), (4.0, 0.0), (0.0, 3.0)])], 10, 20)
    attic = coloured(vertices[:, [0, 2, 1]] + [0, 6, 0], triangles[:, ::-1])
    room = mesh_room("attic", attic, "here")
    points = points_around(attic)
    x, y, z = points.T
    slope = (3 - 0.75 * np.abs(x) - (y - 6)) / 1.25
    assert_holds_what(room, points, np.minimum.reduce([slope, y - 6, z - 10, 20 - z]))


def depth_in_l(points: np.ndarray) -> np.ndarray:
    """How deep points are in the L: at its sides sharp, since its box ends there; exact but for the outer side of the inner corner."""
    x, y, z = points.T
    one = np.minimum.reduce([x - 2, 12 - x, z - 2, 6 - z, y, HEIGHT - y])
    other = np.minimum.reduce([x - 2, 6 - x, z - 2, 12 - z, y, HEIGHT - y])
    return np.maximum(one, other)


@pytest.mark.parametrize("drawn", ["whole", "seen from within", "two boxes", "two boxes that touch"])
def test_an_l_is_an_l_however_it_was_drawn(drawn):
    mesh = turned_up(L_SHAPE, 0, HEIGHT)
    if drawn == "seen from within":
        mesh = coloured(mesh.vertices, mesh.triangles[:, ::-1])
    elif drawn != "whole":
        start = 2 if drawn == "two boxes" else 6
        mesh = coloured(*boxes(np.array([(2, 0, 2), (2, 0, start)]), np.array([(12, HEIGHT, 6), (6, HEIGHT, 12)])))
    room = mesh_room("hall", mesh, "here")
    assert (room.minimum, room.maximum) == ((2, 0, 2), (12, HEIGHT, 12))
    points = points_around(mesh)
    assert_holds_what(room, points, depth_in_l(points))
    assert mesh_room("hall", turned_up(L_SHAPE, 0, HEIGHT), "here").cells == room.cells


def test_a_part_turned_inside_out_in_another_is_a_hole():
    vertices, triangles = boxes(np.array([(0, 0, 0), (4, 0.1, 4)]), np.array([(10, 4, 10), (6, 3.9, 6)]))
    triangles[12:] = triangles[12:, ::-1]
    hall = mesh_room("hall", coloured(vertices, triangles), "here")
    assert holds(hall, np.array([[2, 2, 2], [8, 2, 5]])).all()
    assert not holds(hall, np.array([[5.0, 2, 5], [5, 0.5, 5]])).any()


def test_what_encloses_no_air_is_refused_by_name():
    box = of_trimesh(trimesh.creation.box((4, 3, 4)))
    for mesh, words in (
        (coloured(box.vertices, box.triangles[1:]), "expected a closed mesh, found holes in 1 of 1 parts"),
        (coloured(box.vertices, box.triangles[:0]), "expected triangles, found none"),
        (coloured(box.vertices * [1, 0.01, 1] + 0.05, box.triangles), "expected a mesh around air"),
        (coloured(box.vertices * 1000, box.triangles), "expected a room in a box of at most 1000000 m3, found one of 48000000000 m3"),
    ):
        with pytest.raises(SourceError, match=f"^there: {words}"):
            mesh_room("hall", mesh, "there")
    with pytest.raises(SourceError, match="another name than 'found-3'"):
        mesh_room("found-3", box, "there")


WORLD = '[[source]]\npath = "city.ply"\n[[room]]\nname = "hall"\nmesh = "hall.obj"\n'


@pytest.fixture
def folder(tmp_path):
    mesh = turned_up(L_SHAPE, 0, HEIGHT)
    trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False).export(tmp_path / "hall.obj")
    trimesh.creation.box((40, 1, 40)).export(tmp_path / "city.ply")
    return tmp_path


def load(folder, text):
    (folder / "world.toml").write_text(text)
    return load_scene(folder / "world.toml")


def test_a_world_file_names_a_mesh_and_where_it_stands(folder):
    (room,) = load(folder, WORLD).rooms
    assert (room.minimum, room.maximum) == ((2, 0, 2), (12, HEIGHT, 12))
    (moved,) = load(folder, WORLD + "offset = [100.0, 0.0, -50.0]\n").rooms
    assert (moved.minimum, moved.maximum) == ((102, 0, -48), (112, HEIGHT, -38))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (WORLD.replace("hall.obj", "lost.obj"), r"\[\[room\]\] 1: mesh: expected a file, found none at .*lost.obj"),
        (WORLD.replace("hall.obj", "world.toml"), r"\[\[room\]\] 1: mesh: expected .glb .gltf .obj .ply, found"),
        (WORLD + "minimum = [0, 0, 0]\n", r"\[\[room\]\] 1: expected a mesh, or minimum and maximum, found both"),
        (WORLD + "scale = 2\n", r"\[\[room\]\] 1: unknown key scale"),
        (WORLD.replace("hall.obj", "open.obj"), r"\[\[room\]\] 1: .*open.obj: expected a closed mesh"),
        (WORLD.replace("hall.obj", "broken.ply"), r"broken.ply: expected a readable PLY mesh"),
    ],
)
def test_a_wrong_mesh_is_named(folder, text, words):
    mesh = turned_up(L_SHAPE, 0, HEIGHT)
    trimesh.Trimesh(mesh.vertices, mesh.triangles[:-1], process=False).export(folder / "open.obj")
    (folder / "broken.ply").write_text("ply\n")
    with pytest.raises(InputError, match=words) as refused:
        load(folder, text)
    assert "\n" not in str(refused.value)


def l_house(build, with_holes=True):
    """The L with 10 cm walls around it and a roof; a door in the longer wall along x, a window in the inner corner's wall along z."""
    block = build().ground((-64, -64), (128, 128))
    out = L_SHAPE + np.array([(-1, -1), (1, -1), (1, 1), (1, 1), (1, 1), (-1, 1)]) * 0.05
    holes = [[(3.0, -0.1, 4.0, 2.1)], [], [], [(2.0, 0.9, 3.5, 2.2)], [], []]
    for number in range(6):
        block.wall(out[number], out[(number + 1) % 6], HEIGHT + 0.1, holes[number] if with_holes else (), thick=0.1)
    vertices, triangles, _ = prism([L_SHAPE + np.array([(-1, -1), (1, -1), (1, 1), (1, 1), (1, 1), (-1, 1)]) * 0.1], HEIGHT, HEIGHT + 0.2)
    return block.add(vertices, triangles)


def test_a_mesh_has_openings_where_its_walls_have_and_nowhere_else(build):
    block = l_house(build)
    hall = mesh_room("hall", turned_up(L_SHAPE, 0, HEIGHT), "here")
    (room,) = world_rooms(block.scene(rooms=(hall,)), "open")  # what was drawn is not found again
    door, window = sorted(room.openings, key=lambda opening: opening.minimum[1])
    np.testing.assert_allclose((door.minimum, door.maximum), ((4.95, -2.1, 1.9), (5.95, 2.1, 2)), atol=0.012)
    # The wall of the inner corner lies beside the cells' sides, up to half a cell off.
    x, z = (6, slice(8.05, 9.55))
    np.testing.assert_allclose((window.minimum[1:], window.maximum[1:]), ((0.9, z.start), (2.2, z.stop)), atol=2e-3)
    assert window.minimum[0] == pytest.approx(x, abs=ROOM_CELL_M / 2 + 1e-6)
    assert window.maximum[0] == pytest.approx(x + 0.1, abs=0.012)
    # A room beyond the window, drawn as a box: the same window, through the rest of the wall, leads to it.
    hall_again, yard = world_rooms(block.scene(rooms=(hall, Room("yard", (6.1, 0, 6.1), (11, 3, 11)))), "none")
    inner = [opening for opening in hall_again.openings if opening.to == 2]
    assert inner == [replace(window, minimum=inner[0].minimum, maximum=inner[0].maximum, to=2)]
    np.testing.assert_allclose(inner[0].minimum, window.minimum, atol=2e-3)
    np.testing.assert_allclose(inner[0].maximum, (6.1, 2.2, 9.55), atol=0.011)
    assert replace(inner[0], to=1) in yard.openings
    (closed,) = world_rooms(l_house(build, with_holes=False).scene(rooms=(hall,)), "none")
    assert closed.openings == ()


def test_where_a_mesh_overlaps_a_box_the_first_one_counts():
    hall, box = mesh_room("hall", turned_up(L_SHAPE, 0, HEIGHT), "here"), Room("box", (0, 0, 0), (8, 3, 8))
    at = np.array([[3.0, 1, 3], [7, 1, 7], [11, 1, 3], [11, 1, 11]])
    assert rooms_of(at, (hall, box)).tolist() == [1, 2, 1, 0]
    assert rooms_of(at, (box, hall)).tolist() == [1, 1, 2, 0]
