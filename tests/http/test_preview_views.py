"""Views of what lies behind a picture: colours at known pixels. No city needed but for the route."""

import io
from types import SimpleNamespace
from typing import Any, get_args

import httpx
import numpy as np
import pytest
from PIL import Image

from gi_core.constants import ROOM_OUTDOORS, VOLUME_SHAPE, VOXEL_INDOORS, VOXEL_NO_SECTOR, VOXEL_OUTDOORS, VOXEL_SIZE_M, VOXEL_SOLID
from gi_core.distant_file import DistantLight
from gi_core.engine import Distant, LitProbes
from gi_core.errors import OutsideWorldError
from gi_core.grid import SectorIndex, volume_first_voxel, voxel_centre
from gi_core.lighting import DirectionalLight, Lighting
from gi_core.sun_table import SunTable
from gi_core.world import Location
from server import preview_views, tonemap
from server.camera import Camera
from server.labels import LABEL_PIXELS, with_key
from server.preview_scene import PreviewScene
from server.preview_seen import NO_SURFACE
from server.preview_surfels import NO_SURFEL
from server.preview_views import (
    OUTDOORS_COLOUR,
    PROBE_ALBEDO,
    PROBE_RADIUS_M,
    RESIDENCY_COLOURS,
    SECTOR_COLOURS,
    SUN_COLOURS,
    VIEWS,
    VOXEL_COLOURS,
)
from server.raycast import RayCaster

UP = np.array([0.0, 1.0, 0.0])
ALBEDO = 0.2
WIDTH, HEIGHT = 33, 18


def scene() -> PreviewScene:
    """A floor of 40 m at y = 0 and, 10 m over its western half, a roof."""
    corners = [[-20, 0, -20], [20, 0, -20], [20, 0, 20], [-20, 0, 20], [-20, 10, -20], [0, 10, -20], [0, 10, 20], [-20, 10, 20]]
    triangles = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], np.int32)
    return PreviewScene(
        RayCaster(np.array(corners, np.float64), triangles), np.full((4, 3), ALBEDO, np.float32), np.zeros((4, 3), np.float32)
    )


def down(x: float, y: float = 8.0, z: float = 4.0) -> Camera:
    """From (x, y, z) straight down, rows going north to south and columns west to east."""
    return Camera(np.array([x, y, z]), np.array([x, 0.0, z]), 20.0, WIDTH)


def light(towards: np.ndarray = UP, lux: float = 1000.0) -> Lighting:
    nothing = DirectionalLight(-UP, np.zeros(3))
    sky = np.zeros((64, 128, 3), np.float32)
    return Lighting(
        "2024-06-21T12:00:00-04:00", "clear", DirectionalLight(towards, np.full(3, lux)), nothing, sky, np.zeros((6, 3)), 0.0, 0.0, 8.0
    )


class Engine:
    """What views use of one. probe_at : (3,) [m] of one probe, whose six faces are 100 to 600 lx"""

    def __init__(self, voxel_class: int = VOXEL_OUTDOORS, probe_at: tuple[float, float, float] | None = None, room: int = 0) -> None:
        self.dataset = SimpleNamespace(
            world=SimpleNamespace(bounds=np.array([[-20.0, 0, -20], [20, 10, 20]]), rooms=(), decals=(), sectors={})
        )
        self.lamps = ()
        self.voxel_class, self.probe_at, self.room = voxel_class, probe_at, room

    def volume(self, position: np.ndarray, *_: Any) -> Any:
        first = volume_first_voxel(position)
        mask = np.full(VOLUME_SHAPE, VOXEL_SOLID, np.uint8)
        # The layer that a floor at y = 0 reads.
        mask[int(np.round((VOXEL_SIZE_M / 4 - voxel_centre(first)[1]) / VOXEL_SIZE_M))] = self.voxel_class
        values = np.zeros((6, *VOLUME_SHAPE, 3), np.float32)
        return SimpleNamespace(values=values, mask=mask, origin=voxel_centre(first), voxel_size=np.full(3, VOXEL_SIZE_M))

    def distant(self, _: Lighting, light: DistantLight | None = None) -> Distant:
        return Distant(np.zeros((1, 1, 6, 3), np.float32), SectorIndex(0, 0), np.ones((1, 1), np.uint8))

    def probes(self, *_: Any) -> LitProbes:
        if self.probe_at is None:
            raise OutsideWorldError("nowhere")
        cubes = np.repeat(100 * np.arange(1, 7, dtype=np.float32)[None, :, None], 3, axis=2)
        return LitProbes(np.array([self.probe_at]), cubes, np.array([self.room], np.uint16), np.zeros(1, np.uint8), (SectorIndex(0, 0),))


def drawn(view: str, camera: Camera, lighting: Lighting | None = None, engine: Engine | None = None) -> np.ndarray:
    picture = preview_views.draw(view, engine or Engine(), scene(), camera, lighting or light())
    assert picture.shape == (HEIGHT, WIDTH, 3)
    assert picture.dtype == np.uint8
    return picture


MIDDLE = (HEIGHT // 2, WIDTH // 2)


def test_every_view_that_may_be_asked_for_is_drawn() -> None:
    assert set(VIEWS) == set(get_args(preview_views.ViewName))


@pytest.mark.parametrize("view", sorted(VIEWS))
def test_where_no_surface_is_nothing_is_coloured(view: str) -> None:
    up = Camera(np.array([10.0, 5, 4]), np.array([10.0, 9, 4]), 20.0, WIDTH)
    expected = (0, 0, 0) if view == "probes" else NO_SURFACE  # a black sky, drawn as it is
    assert (drawn(view, up) == expected).all()
    empty = PreviewScene(None, np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32))
    assert (preview_views.draw(view, Engine(), empty, up, light()) == NO_SURFACE).all()


def test_albedo_is_shown_as_srgb() -> None:
    assert (drawn("albedo", down(10)) == 124).all()  # IEC 61966-2-1 of 0.2: 0.4845


def test_normals_face_the_camera() -> None:
    assert drawn("normal", down(10))[MIDDLE].tolist() == [128, 255, 128]
    ceiling = Camera(np.array([-10.0, 5, 4]), np.array([-10.0, 10, 4]), 20.0, WIDTH)
    assert drawn("normal", ceiling)[MIDDLE].tolist() == [128, 0, 128]


def test_snow_would_stay_in_the_open_and_not_under_a_roof() -> None:
    assert (drawn("snow", down(10)) == 255).all()
    assert (drawn("snow", down(-10)) == 0).all()


def test_the_sun_s_view_knows_lit_shadow_and_turned_away() -> None:
    assert drawn("sun", down(10))[MIDDLE].tolist() == list(SUN_COLOURS["lit"])
    assert drawn("sun", down(-10))[MIDDLE].tolist() == list(SUN_COLOURS["shadow"])
    assert drawn("sun", down(10), light(-UP))[MIDDLE].tolist() == list(SUN_COLOURS["turned away"])
    assert drawn("sun", down(10), light(lux=0.0))[MIDDLE].tolist() == list(SUN_COLOURS["turned away"])


def test_sectors_are_a_checkerboard_with_lines() -> None:
    for x, z in ((5.0, 5.0), (5.0, -5.0)):
        expected = SECTOR_COLOURS[int(z < 0), 0]
        assert drawn("sectors", down(x, z=z))[MIDDLE].tolist() == expected.tolist()
    across = drawn("sectors", Camera(np.array([0.1, 9.0, 5.0]), np.array([0.1, 10.0, 5.0]), 20.0, WIDTH))
    assert (across[MIDDLE] == NO_SURFACE).all()
    assert drawn("sectors", down(10, z=0.0))[MIDDLE].tolist() == [30, 30, 30]


class Baked(Engine):
    """One whose sectors are baked, each with a surfel of albedo 0.2 on the floor, one of 0.5 on the roof, and one that faces down there."""

    def __init__(self) -> None:
        super().__init__()
        table = SunTable.build(Location(40.7, -74.0, 0.0, "America/New_York", 0.0), 45.0, 90.0)
        visible = np.zeros((table.plane_count, 1), np.uint32)
        visible[:] = 0b010
        sector = SimpleNamespace(
            surfel_count=3,
            surfel_position=np.array([[10, 0, 4], [54, 10, 4], [54, 10, 4.2]], np.float32),  # sector-local, of 0,0 and of -1,0
            surfel_normal=np.array([[0, 1, 0], [0, 1, 0], [0, -1, 0]], np.float32),
            surfel_albedo=np.array([[0.2] * 3, [0.5] * 3, [0.8] * 3], np.float32),
            surfel_snow=np.array([0.25, 1.0, 0.0], np.float32),
            brick_level=np.zeros(2, np.uint8),
            brick_starts=np.array([0, 1, 3]),
            sun_visibility=visible,
        )
        self.dataset.sector = lambda _: sector
        world = self.dataset.world
        world.sectors, world.sun_table, world.sky, world.sky_patches = (
            {SectorIndex(0, 0): None, SectorIndex(-1, 0): None},
            table,
            "faces",
            6,
        )


@pytest.mark.parametrize(
    ("view", "floor", "roof", "ceiling"),
    [
        ("surfel_albedo", (124,) * 3, (188,) * 3, (231,) * 3),
        ("surfel_normal", (128, 255, 128), (128, 255, 128), (128, 0, 128)),
        ("surfel_snow", (64,) * 3, (255,) * 3, (0,) * 3),
        ("surfel_sun", (0,) * 3, (255,) * 3, (0,) * 3),
    ],
)
def test_surfaces_have_the_colours_of_their_surfels(view: str, floor: tuple, roof: tuple, ceiling: tuple) -> None:
    def middle(camera: Camera) -> tuple[int, ...]:
        return tuple(drawn(view, camera, engine=Baked())[MIDDLE].tolist())

    assert middle(down(10)) == floor
    assert middle(down(-10, y=14.0)) == roof
    assert middle(Camera(np.array([-10.0, 5, 4.2]), np.array([-10.0, 10, 4.2]), 20.0, WIDTH)) == ceiling
    assert middle(down(15)) == NO_SURFEL  # 5 m from the only one


def test_residency_is_the_live_world_s() -> None:
    seen = {SectorIndex(0, 0): "read by a player", SectorIndex(-1, 0): "failed"}
    for x, word in ((10.0, "read by a player"), (-10.0, "failed")):
        picture = preview_views.draw("residency", Engine(), scene(), down(x), light(), seen)
        assert picture[MIDDLE].tolist() == list(RESIDENCY_COLOURS[word])
    assert drawn("residency", down(10))[MIDDLE].tolist() == list(RESIDENCY_COLOURS["not resident"])


@pytest.mark.parametrize("voxel_class", [VOXEL_SOLID, VOXEL_OUTDOORS, VOXEL_INDOORS, VOXEL_NO_SECTOR])
def test_a_surface_has_the_colour_of_the_voxel_before_it(voxel_class: int) -> None:
    picture = drawn("voxels", down(10), engine=Engine(voxel_class))
    assert picture[MIDDLE].tolist() == list(VOXEL_COLOURS[voxel_class][0])


def test_a_probe_is_a_sphere_of_its_light() -> None:
    camera = down(10)
    dim = light(lux=1.0)  # the sky's exposure holds
    picture = drawn("probes", camera, dim, Engine(probe_at=(10, 5, 4)))
    without = drawn("probes", camera, dim)
    # From above the middle shows the face +Y, 300 lx, at the exposure of the picture without spheres.
    expected = tonemap.developed(np.full((1, 3), 300 * PROBE_ALBEDO / np.pi, np.float32), 8.0)
    np.testing.assert_allclose(picture[MIDDLE].astype(int), expected[0].astype(int), atol=1)  # the middle of a pixel beside the sphere's
    assert expected[0, 0] != without[MIDDLE][0]
    changed = (picture != without).any(axis=2)
    area = np.pi * (PROBE_RADIUS_M / (3 * camera.pixel_size)) ** 2
    assert changed.sum() == pytest.approx(area, rel=0.15)
    hidden = drawn("probes", camera, dim, Engine(probe_at=(10, -5, 4)))
    np.testing.assert_array_equal(hidden, without)


def test_rooms_have_colours_of_their_own() -> None:
    camera = down(10)
    colours = {room: tuple(drawn("rooms", camera, engine=Engine(probe_at=(10, 5, 4), room=room))[MIDDLE].tolist()) for room in range(5)}
    assert colours[ROOM_OUTDOORS] == OUTDOORS_COLOUR
    assert len(set(colours.values())) == 5
    assert colours[3] == preview_views.room_colour(3)


def test_a_key_names_colours_in_the_corner_of_a_picture_that_has_room() -> None:
    picture = np.full((180, 320, 3), 90, np.uint8)
    keyed = with_key(picture, {"one": (255, 0, 0), "two": (0, 255, 0)})
    assert (keyed[:-LABEL_PIXELS] == 90).all()
    line = keyed[-LABEL_PIXELS + 6]
    assert line[5].tolist() == [255, 0, 0]
    assert (line == (0, 255, 0)).all(axis=1).any()
    small = picture[:, :160]
    assert with_key(small, {"one": (255, 0, 0)}) is small


QUERY = {"time": "12:00", "weather": "clear", "eye": "-10,20,-10", "look": "30,0,30", "width": "32"}


def test_the_route_draws_each_view(http: httpx.Client) -> None:
    bodies = set()
    for view in ("lit", *VIEWS):
        reply = http.get("/v1/preview.png", params={**QUERY, "view": view})
        assert reply.status_code == 200, reply.text
        assert np.asarray(Image.open(io.BytesIO(reply.content))).shape == (18, 32, 3)
        if view == "residency":
            assert reply.headers["cache-control"] == "no-store"
            assert "etag" not in reply.headers
            continue
        bodies.add((reply.headers["etag"], reply.content))
    assert len(bodies) == len({etag for etag, _ in bodies}) == len(VIEWS)


def test_errors_have_no_other_view(http: httpx.Client) -> None:
    reply = http.get("/v1/preview.png", params={**QUERY, "gi": "error", "view": "sun"})
    assert (reply.status_code, reply.json()["code"]) == (400, "bad_parameter")
    assert "not both" in reply.json()["detail"]
