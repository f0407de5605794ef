"""Lamps, snow and fog in a picture. Known answers, no city needed."""

import numpy as np
import pytest

from gi_core.client_light import ServedLight
from gi_core.constants import SNOW_ALBEDO, VOLUME_SHAPE, VOXEL_SIZE_M
from gi_core.grid import volume_first_voxel, voxel_centre
from gi_core.lighting import DirectionalLight, Lighting
from gi_core.spectrum import LUMINANCE_FROM_RGB
from gi_core.world import Lamp
from server.camera import Camera
from server.preview import render
from server.preview_air import mean_sky, plain_distance, through_fog
from server.preview_lamps import PixelCells, draw_lamps, lamp_irradiance
from server.preview_scene import PreviewScene
from server.raycast import RayCaster

UP = np.array([0.0, 1.0, 0.0])
ALBEDO = 0.2


def rays(at: float = 0.0) -> RayCaster:
    """A floor of 40 m at y = 0 and, 10 m over its western half, a roof; moved by ``at`` in x and z."""
    corners = [[-20, 0, -20], [20, 0, -20], [20, 0, 20], [-20, 0, 20], [-20, 10, -20], [0, 10, -20], [0, 10, 20], [-20, 10, 20]]
    return RayCaster(
        np.array(corners, np.float64) + np.array([at, 0, at]), np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], np.int32)
    )


def night(sky: float = 0.0, snow: float = 0.0, fog: float = 0.0) -> Lighting:
    radiance = np.zeros((64, 128, 3), np.float32)
    radiance[:32] = sky
    cube = np.pi * sky * np.array([0.5, 0.5, 1, 0, 0.5, 0.5])[:, None] * np.ones(3)
    nothing = DirectionalLight(-UP, np.zeros(3))
    return Lighting("23:00", "clear", nothing, nothing, radiance, cube, snow, fog, 0.0)


def point(position: tuple[float, float, float], **changed: object) -> Lamp:
    return Lamp("lamp", "point", position, 1000.0, **{"range_m": 1e5, **changed})


def drawn(camera: Camera, lamps: tuple[Lamp, ...], lighting: Lighting, irradiance: float = 0.0) -> np.ndarray:
    class Served:
        def __init__(self, position: np.ndarray, room: int) -> None:
            self.values = np.full((6, *VOLUME_SHAPE, 3), irradiance, np.float32)
            self.origin = voxel_centre(volume_first_voxel(position))
            self.voxel_size = np.full(3, VOXEL_SIZE_M)

    scene = PreviewScene(rays(), np.full((4, 3), ALBEDO, np.float32), np.zeros((4, 3), np.float32))
    return render(camera, scene, lighting, lamps, ServedLight(Served))


@pytest.mark.parametrize("at", [0.0, 50_000.0])
def test_a_lamp_lights_by_the_inverse_square_and_its_cosine_past_no_roof(at):
    above = point((at + 10, 20, at))
    position = np.array([[10, 0, 0], [19, 0, 0], [-15, 0, 0]]) + np.array([at, 0, at])
    found = lamp_irradiance(rays(at), [above], position, np.tile(UP.astype(np.float32), (3, 1))) @ LUMINANCE_FROM_RGB
    candela = 1000 / (4 * np.pi)
    # rtol: float32 places 20 m from their anchor. The third point lies under the roof.
    np.testing.assert_allclose(found, [candela / 400, candela * 20 / 481**1.5, 0], rtol=1e-5)


def test_a_lamp_beneath_the_floor_or_out_of_range_gives_nothing():
    position, normal = np.array([[10.0, 0, 0]]), UP[None].astype(np.float32)
    assert not lamp_irradiance(rays(), [point((10, -1, 0)), point((10, 9, 0), range_m=8.9)], position, normal).any()
    assert lamp_irradiance(rays(), [point((10, 9, 0), range_m=9.1)], position, normal).all()


def test_an_area_lamp_that_half_the_roof_hides_gives_half_its_rays():
    panel = Lamp("panel", "area", (0, 20, 0), 1000.0, range_m=1e5, size=(2.0, 2.0))
    position, normal = np.array([[0.0, 0, 0]]), UP[None].astype(np.float32)
    open_floor = RayCaster(np.array([[-20.0, 0, -20], [20, 0, -20], [20, 0, 20]]), np.array([[0, 1, 2]], np.int32))
    half, whole = (lamp_irradiance(scene, [panel], position, normal) for scene in (rays(), open_floor))
    np.testing.assert_allclose(half, whole / 2, rtol=1e-6)
    radiance = 1000 / (np.pi * 4)
    assert whole[0] @ LUMINANCE_FROM_RGB == pytest.approx(radiance * 4 / 400, rel=5e-3)  # a 2 m square seen from 20 m is nearly a point


def test_cells_miss_no_pixel_that_a_lamp_reaches():
    position = np.random.default_rng(3).uniform(-60, 60, (4000, 3))
    cells = PixelCells.of(position)
    assert np.array_equal(np.sort(cells.order), np.arange(4000))
    for centre in (np.zeros(3), np.array([70.0, 3, -20])):
        reached = np.flatnonzero(np.linalg.norm(position - centre, axis=1) < 25)
        taken = cells.order[cells.within(centre, 25.0)]
        assert set(reached) <= set(taken)
        assert len(taken) < 2 * len(reached) < 4000


def test_glare_carries_what_reaches_the_eye_of_a_lamp():
    camera = Camera(np.array([10.0, 5, 10]), np.array([10.0, 5, 0]), 40.0, 320)
    picture = np.zeros((camera.height, camera.width, 3), np.float32)
    draw_lamps(picture, camera, rays(), [point((11, 6, 0))], np.full(picture.size // 3, np.inf), 0.0)
    cosine = camera.rays() @ camera.axes[2]
    solid_angle = (camera.pixel_size**2 * cosine**3).reshape(picture.shape[:2])
    received = (picture @ LUMINANCE_FROM_RGB * solid_angle).sum()
    assert received == pytest.approx(1000 / (4 * np.pi) / 102, rel=1e-3)  # the Gaussian's sum over pixels, cut at six deviations
    row, column = np.unravel_index(picture[..., 0].argmax(), picture.shape[:2])
    seen = camera.rays().reshape(*picture.shape[:2], 3)[row, column]
    towards = np.array([1, 1, -10]) / np.sqrt(102)
    assert seen @ towards > np.cos(camera.pixel_size)


def test_glare_is_hidden_by_what_stands_before_the_lamp():
    above_roof, lamp = Camera(np.array([-10.0, 15, 0]), np.array([-10.0, 0, 0.01]), 60.0, 32), point((-10, 5, 0))
    picture = np.zeros((18, 32, 3), np.float32)
    draw_lamps(picture, above_roof, rays(), [lamp], np.full(18 * 32, 5.0), 0.0)
    assert not picture.any()
    beneath = Camera(np.array([-10.0, 9, 0]), np.array([-10.0, 0, 0.01]), 60.0, 32)
    draw_lamps(picture, beneath, rays(), [lamp], np.full(18 * 32, 9.0), 0.0)
    assert picture.any()


def test_a_panel_shows_its_radiance_on_one_side():
    panel = Lamp("panel", "area", (10, 9, 0), 1000.0, size=(4.0, 4.0))
    below = drawn(Camera(np.array([10.0, 5, 0]), np.array([10.0, 9, 0.01]), 20.0, 32), (panel,), night())
    np.testing.assert_allclose(below @ LUMINANCE_FROM_RGB, 1000 / (np.pi * 16), rtol=1e-5)
    above = Camera(np.array([10.0, 12, 0]), np.array([10.0, 9, 0.01]), 20.0, 32)
    floor = drawn(above, (panel,), night())
    assert 0 < (floor @ LUMINANCE_FROM_RGB).max() < 10  # the lit floor past it, as if it were not there


def test_snow_whitens_what_is_open_to_the_sky():
    received = 300.0

    def seen(x: float, snow: float) -> float:
        camera = Camera(np.array([x, 9.0, 0]), np.array([x, 0, 0.01]), 20.0, 16)
        picture = drawn(camera, (), night(snow=snow), received) * np.pi / received
        np.testing.assert_allclose(picture, picture[0, 0, 0], rtol=1e-5)
        return float(picture[0, 0, 0])

    assert seen(10.0, 0.5) == pytest.approx((ALBEDO + SNOW_ALBEDO) / 2, rel=1e-5)
    assert seen(-10.0, 0.5) == pytest.approx(ALBEDO, rel=1e-5)  # under the roof
    ceiling = Camera(np.array([-10.0, 5, 0]), np.array([-10.0, 10, 0.01]), 20.0, 16)
    np.testing.assert_allclose(drawn(ceiling, (), night(snow=1.0), received) * np.pi / received, ALBEDO, rtol=1e-5)


def test_fog_turns_everything_into_the_mean_sky():
    lighting = night(sky=50.0, fog=0.01)
    np.testing.assert_allclose(mean_sky(lighting), 50, rtol=1e-6)
    seen = through_fog(np.full((3, 3), 10.0, np.float32), np.array([0.0, 100.0, 1e5]), lighting)
    np.testing.assert_allclose(seen[:, 0], [10, 50 - 40 * np.exp(-1), 50], rtol=1e-6)
    unchanged = np.full((1, 3), 10.0, np.float32)
    assert through_fog(unchanged, np.array([1e9]), night(sky=50.0)) is unchanged


def test_the_plain_s_fog_begins_at_the_eye_and_the_sky_has_its_own():
    directions = np.array([[0, -1, 0], [0.8, -0.6, 0], [0.8, 0.6, 0], [1, 0, 0]], np.float32)
    np.testing.assert_allclose(plain_distance(np.array([0.0, 5, 0]), directions, -1.0), [6, 10, 0, 0], rtol=1e-6)


def test_fog_dims_a_lamp_s_light_to_the_eye():
    camera = Camera(np.array([10.0, 5, 10]), np.array([10.0, 5, 0]), 40.0, 64)
    clear, foggy = (np.zeros((36, 64, 3), np.float32) for _ in range(2))
    for picture, fog in ((clear, 0.0), (foggy, 0.1)):
        draw_lamps(picture, camera, rays(), [point((10, 5, 0))], np.full(36 * 64, np.inf), fog)
    np.testing.assert_allclose(foggy, clear * np.exp(-1), rtol=1e-5)


def test_a_camera_finds_its_own_pixels():
    camera = Camera(np.array([3.0, 4, 5]), np.array([-3.0, 2, 1]), 70.0, 48)
    column, row, depth = camera.project(camera.eye + 7 * camera.rays().astype(np.float64)).T
    expected = np.meshgrid(np.arange(48), np.arange(camera.height))
    np.testing.assert_allclose(column, expected[0].ravel(), atol=1e-4)  # rays are float32
    np.testing.assert_allclose(row, expected[1].ravel(), atol=1e-4)
    assert (depth > 0).all()
    assert camera.project(2 * camera.eye - camera.look[None])[0, 2] < 0  # what lies behind
