"""The procedural city: closed solids, real rooms, determinism, refusals."""

import numpy as np
import pytest

from bake_jobs.building import CEILING_ALBEDO, FLOOR_ALBEDO, INNER_WALL_ALBEDO, WALL_M
from bake_jobs.rays import RayScene
from bake_jobs.scene import scene_digest
from bake_jobs.scene_source import load_scene
from bake_jobs.solids import prism, signed_area
from gi_core.constants import SECTOR_SIZE_M
from gi_core.errors import SourceError

SMALL = "procedural:midtown?blocks=2x2&seed=1"


@pytest.fixture(scope="module")
def city():
    return load_scene(SMALL)


@pytest.fixture(scope="module")
def rays(city):
    return RayScene(city.vertices, city.triangles)


def volume(vertices, triangles):
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


def assert_closed(triangles):
    """Every edge is walked once each way."""
    directed = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    assert sorted(map(tuple, directed)) == sorted(map(tuple, directed[:, ::-1]))


@pytest.mark.parametrize("reverse", [False, True])
def test_a_prism_with_a_hole_is_closed_and_outward_for_either_ring_sense(reverse):
    outer = np.array([(0.0, 0), (10, 0), (10, 8), (4, 8), (4, 6), (0, 6)])
    hole = np.array([(5.0, 2), (7, 2), (7, 4), (5, 4)])
    rings = [outer[::-1], hole[::-1]] if reverse else [outer, hole]
    vertices, triangles, is_wall = prism(rings, 1.0, 4.0)
    assert_closed(triangles)
    area = 10 * 8 - 4 * 2 - 4
    assert volume(vertices, triangles) == pytest.approx(area * 3)
    assert is_wall.sum() == 2 * (6 + 4)
    assert abs(signed_area(outer)) == pytest.approx(10 * 8 - 4 * 2)


def test_it_is_deterministic_and_the_seed_counts(city):
    assert scene_digest(load_scene(SMALL)) == scene_digest(city)
    assert scene_digest(load_scene("procedural:midtown?seed=2&blocks=2x2")) != scene_digest(city)


def test_a_larger_city_contains_the_smaller(city):
    larger = load_scene("procedural:midtown?blocks=3x2&seed=1")
    assert set(city.rooms) < set(larger.rooms)
    assert set(city.lamps) < set(larger.lamps)


def test_two_by_two_blocks_are_six_whole_sectors(city):
    first, last = (np.floor(city.bounds[:, axis] / SECTOR_SIZE_M) for axis in (0, 2))
    assert first.tolist() == [0, 2]
    assert last.tolist() == [0, 1]


def test_nothing_was_dropped_and_nothing_is_seen_from_behind(city, rays):
    assert city.dropped.degenerate == city.dropped.duplicate == city.dropped.non_finite == 0
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(20_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    # From over the middle of an avenue's crossing and from a room: both in free air, so every surface shows its front.
    room = city.rooms[0]
    for eye in ((96.0, 1.7, 64.0), tuple((np.array(room.minimum) + np.array(room.maximum)) / 2)):
        hits = rays.closest(np.tile(eye, (len(directions), 1)), directions)
        assert hits.hit.any()
        assert not hits.from_back[hits.hit].any()


def test_every_room_is_enclosed_by_thick_walls_but_sees_the_street(city, rays):
    assert len(city.rooms) >= 4
    for room in city.rooms:
        low, high = np.array(room.minimum), np.array(room.maximum)
        middle = (low + high) / 2
        for axis in range(3):
            for sign, face in ((-1, low), (1, high)):
                direction = np.eye(3)[axis] * sign
                # Just under the ceiling, above every window: a ray along an axis meets the room's own wall.
                eye = middle.copy()
                eye[1] = high[1] - 0.2
                hit = rays.closest(eye[None], direction[None])
                assert hit.distance[0] == pytest.approx(abs(face[axis] - eye[axis]), abs=1e-3)  # m: float32 at this distance
                indoors = {1: {-1: FLOOR_ALBEDO, 1: CEILING_ALBEDO}[sign]}.get(axis, INNER_WALL_ALBEDO)
                assert city.albedo[hit.triangle[0]] == pytest.approx(np.array(indoors)), "indoor colours"
                if direction[1] < 0:
                    continue  # below the floor lies the street's surface
                beyond = eye + direction * (abs(face[axis] - eye[axis]) + 0.1)
                out = rays.closest(beyond[None], direction[None])
                # The far side, not nearer than the thickness; a neighbour's wall may coincide with it.
                assert out.distance[0] > WALL_M - 0.1 - 1e-3, f"{room.name}: thin wall at {sign}{'xyz'[axis]}"
        rng = np.random.default_rng(1)
        across = rng.normal(size=(4000, 3)) * (1, 0.05, 1)
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        eye = np.array([middle[0], 1.8, middle[2]])
        reach = rays.closest(np.tile(eye, (4000, 1)), across).distance
        inside = np.linalg.norm(high - low) + WALL_M
        assert (reach > inside).mean() > 0.01, f"{room.name} has no window"


def test_a_walker_can_enter_every_room(city, rays):
    """Some straight way at 1 m height, 0.5 m wide, leads out of each room: a door (windows begin at 0.9 m and doors at the floor)."""
    for room in city.rooms:
        low, high = np.array(room.minimum), np.array(room.maximum)
        ways = 0
        for axis, other in ((0, 2), (2, 0)):
            for at in np.arange(low[other] + 0.3, high[other] - 0.3, 0.25):
                for sign in (-1, 1):
                    eye = np.zeros((3, 3))
                    eye[:, other] = at + np.array([-0.25, 0.0, 0.25])
                    eye[:, axis] = (low[axis] + high[axis]) / 2
                    eye[:, 1] = 0.5  # under the window sills
                    direction = np.eye(3)[axis] * sign
                    reach = rays.closest(eye, np.tile(direction, (3, 1))).distance
                    ways += bool((reach > (high[axis] - low[axis]) / 2 + 1.0).all())
        assert ways > 0, room.name


def test_lamps_hang_in_free_air(city, rays):
    lamps = np.array([lamp.position for lamp in city.lamps])
    assert len(lamps) == 8 * 4 + len(city.rooms)
    up = rays.closest(lamps, np.tile([0.0, 1.0, 0.0], (len(lamps), 1)))
    down = rays.closest(lamps, np.tile([0.0, -1.0, 0.0], (len(lamps), 1)))
    assert down.hit.all()
    assert not up.from_back.any()
    assert not down.from_back.any()


@pytest.mark.parametrize(
    ("source", "said"),
    [
        ("procedural:paris", "expected procedural:midtown"),
        ("procedural:midtown?block=2x2", "unknown key block"),
        ("procedural:midtown?blocks=2", "two counts"),
        ("procedural:midtown?blocks=0x2", "from 1 to 64"),
        ("procedural:midtown?blocks=9999999x9999999", "from 1 to 64"),
        ("procedural:midtown?blocks=-1x2", "from 1 to 64"),
        ("procedural:midtown?seed=x", "whole number"),
        ("procedural:midtown?seed", "key=value"),
    ],
)
def test_a_wrong_name_key_or_value_is_refused(source, said):
    with pytest.raises(SourceError, match=said):
        load_scene(source)
