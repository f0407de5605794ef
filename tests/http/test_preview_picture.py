"""What a picture is made of: rays, shadows, volumes that cover it, exposure. Known answers, no city needed."""

import io

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from PIL import Image

from bake_jobs.solids import boxes
from gi_core.ambient_cube import FACE_DIRECTIONS
from gi_core.client_light import MAX_VOLUMES, Look, ServedLight, plan_volumes
from gi_core.constants import VOLUME_SHAPE, VOXEL_SIZE_M
from gi_core.grid import SectorIndex, volume_first_voxel, voxel_centre
from gi_core.lighting import DirectionalLight, Lighting
from gi_core.world import Room
from server import tonemap
from server.camera import Camera
from server.preview import indirect_pixels, render
from server.preview_air import background
from server.preview_scene import MAX_SECTORS, PreviewScene, plan_sectors
from server.raycast import RayCaster

FAR = 50_000.0  # a world this far from its origin must look the same


def floor_with_roof(at: float) -> RayCaster:
    """A floor of 40 m at y = 0 and, 10 m over its western half, a roof; moved by ``at`` in x and z."""
    floor = [[-20, 0, -20], [20, 0, -20], [20, 0, 20], [-20, 0, 20]]
    roof = [[-20, 10, -20], [0, 10, -20], [0, 10, 20], [-20, 10, 20]]
    vertices = np.array(floor + roof, np.float64) + np.array([at, 0, at])
    return RayCaster(vertices, np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], np.int32))


def light(sun: tuple[float, float, float], lux: float, sky: float) -> Lighting:
    radiance = np.zeros((64, 128, 3), np.float32)
    radiance[:32] = sky
    towards = np.array(sun, np.float64) / np.linalg.norm(sun)
    half, whole = np.pi * sky / 2, np.pi * sky
    cube = np.repeat(np.array([half, half, whole, 0, half, half])[:, None], 3, axis=1)
    nothing = DirectionalLight(-towards, np.zeros(3))
    return Lighting("12:00", "clear", DirectionalLight(towards, np.full(3, lux)), nothing, radiance, cube, 0.0, 0.0, 10.0)


@pytest.mark.parametrize("at", [0.0, FAR])
def test_rays_meet_the_first_surface_and_its_side(at: float) -> None:
    rays = floor_with_roof(at)
    down, up = np.array([[0, -1, 0]], np.float32), np.array([[0, 1, 0]], np.float32)
    under, open_air = np.array([at - 10, 5, at]), np.array([at + 10, 5, at])
    found = rays.first_surface(under, up)
    np.testing.assert_allclose(found.position[0], [at - 10, 10, at], atol=1e-4)  # float32 at 20 m from its anchor: 2e-6
    np.testing.assert_array_equal(found.normal[0], [0, -1, 0])  # the underside faces the camera
    np.testing.assert_allclose(rays.first_surface(open_air, down).position[0], [at + 10, 0, at], atol=1e-4)
    assert not rays.first_surface(open_air, up).hit[0]


@pytest.mark.parametrize("at", [0.0, FAR])
def test_the_roof_casts_a_shadow(at: float) -> None:
    rays = floor_with_roof(at)
    points = np.array([[at - 10, 0, at], [at + 10, 0, at]])
    normals = np.array([[0, 1, 0], [0, 1, 0]], np.float32)
    assert rays.lit(points, normals, np.array([0.0, 1.0, 0.0])).tolist() == [False, True]
    # From the west at 45 degrees the shadow moves 10 m east, to x = 10 m.
    slanted = np.array([-1.0, 1.0, 0.0]) / np.sqrt(2)
    points[:, 0] = [at + 9.5, at + 10.5]
    assert rays.lit(points, normals, slanted).tolist() == [False, True]
    assert not rays.lit(points, normals, np.array([0.0, -1.0, 0.0])).any()


def test_the_camera_is_level_and_centred() -> None:
    camera = Camera(np.zeros(3), np.array([0.0, 0.0, -5.0]), 90.0, 64)
    directions = camera.rays().reshape(camera.height, 64, 3)
    np.testing.assert_allclose(directions.mean((0, 1)) / np.linalg.norm(directions.mean((0, 1))), [0, 0, -1], atol=1e-6)
    assert (directions[0, :, 1] > 0).all()  # the first row looks up
    assert (directions[:, -1, 0] > 0).all()  # looking north, the right column looks east
    np.testing.assert_allclose(np.linalg.norm(directions, axis=2), 1, atol=1e-6)
    edge = directions[camera.height // 2, -1]
    assert np.degrees(np.arctan2(edge[0], -edge[2])) == pytest.approx(45, abs=0.5)  # half a pixel is 0.45 degrees there


def test_the_camera_may_look_straight_down() -> None:
    directions = Camera(np.zeros(3), np.array([0.0, -5.0, 0.0]), 60.0, 32).rays()
    assert np.isfinite(directions).all()
    assert (directions[:, 1] < -0.7).all()


def served(values: np.ndarray) -> ServedLight:
    class Served:
        """What a volume's readers use of it."""

        def __init__(self, position: np.ndarray, room: int) -> None:
            self.values = values
            self.origin = voxel_centre(volume_first_voxel(position))
            self.voxel_size = np.full(3, VOXEL_SIZE_M)

    return ServedLight(Served)


def one_scene(albedo: float) -> PreviewScene:
    rays = floor_with_roof(0.0)
    return PreviewScene(rays, np.full((4, 3), albedo, np.float32), np.zeros((4, 3), np.float32))


def test_a_picture_adds_direct_and_served_light_by_lambert_s_law() -> None:
    uniform = np.full((6, *VOLUME_SHAPE, 3), 300.0, np.float32)
    camera = Camera(np.array([10.0, 8.0, 0.0]), np.array([10.0, 0.0, 0.001]), 30.0, 16)
    lighting = light((0, 1, 0), 1000.0, 50.0)
    on = render(camera, one_scene(0.5), lighting, (), served(uniform), Look("on"))
    off = render(camera, one_scene(0.5), lighting, (), served(uniform), Look("off"))
    # rtol 1e-4: float32 normals and cosines
    np.testing.assert_allclose(on, 0.5 / np.pi * 1300, rtol=1e-4)
    np.testing.assert_allclose(off, 0.5 / np.pi * 1000, rtol=1e-4)
    split = render(camera, one_scene(0.5), lighting, (), served(uniform), Look("split"))
    np.testing.assert_array_equal(split[:, :8], off[:, :8])
    np.testing.assert_array_equal(split[:, 8:], on[:, 8:])


def test_a_camera_inside_a_wall_sees_its_faces_from_behind_without_the_sun() -> None:
    low, high = np.array([-2.0, 0.0, -2.0]), np.array([2.0, 9.0, 2.0])
    wall = PreviewScene(RayCaster(*boxes(low, high)), np.full((12, 3), 0.5, np.float32), np.zeros((12, 3), np.float32))
    uniform = np.full((6, *VOLUME_SHAPE, 3), 300.0, np.float32)
    for towards in ((1.9, 4.0, 0.3), (0.1, 8.9, 0.0), (-0.4, 0.1, -1.0)):
        camera = Camera(np.array([0.0, 4.0, 0.0]), np.array(towards), 90.0, 16)
        picture = render(camera, wall, light((0, 1, 0), 1000.0, 50.0), (), served(uniform), Look("on"))
        np.testing.assert_allclose(picture, 0.5 / np.pi * 300, rtol=1e-4)  # float32 normals


def test_the_face_that_a_surface_turns_to_lights_it() -> None:
    faces = np.zeros((6, *VOLUME_SHAPE, 3), np.float32)
    faces[3] = 700.0  # -Y: light from below
    below = Camera(np.array([-10.0, 5.0, 0.0]), np.array([-10.0, 10.0, 0.001]), 30.0, 16)
    picture = render(below, one_scene(0.5), light((0, 1, 0), 0.0, 0.0), (), served(faces), Look("on"))
    np.testing.assert_allclose(picture, 0.5 / np.pi * 700, rtol=1e-4)


def test_emission_needs_no_light() -> None:
    scene = PreviewScene(floor_with_roof(0.0), np.zeros((4, 3), np.float32), np.full((4, 3), 12.0, np.float32))
    camera = Camera(np.array([10.0, 8.0, 0.0]), np.array([10.0, 0.0, 0.001]), 30.0, 16)
    np.testing.assert_array_equal(
        render(camera, scene, light((0, 1, 0), 0.0, 0.0), (), served(np.zeros((6, 16, 32, 32, 3))), Look("off")), 12.0
    )


def test_the_background_is_the_sky_and_an_open_plain() -> None:
    lighting = light((0, 1, 0), 1000.0, 50.0)
    seen = background(lighting, FACE_DIRECTIONS)
    np.testing.assert_allclose(seen[2], 50, rtol=1e-6)
    np.testing.assert_allclose(seen[0], 50, rtol=1e-6)  # at the horizon too: no dark line
    # An open plain: sun and dome times albedo / pi.
    np.testing.assert_allclose(seen[3], 0.2 / np.pi * (1000 + np.pi * 50), rtol=1e-5)


def test_the_sky_is_not_mirrored() -> None:
    lighting = light((0, 1, 0), 0.0, 1.0)
    lighting.sky_radiance[:32, 32] = 100.0  # p = 2 pi 32.5 / 128: towards +Z
    p = 2 * np.pi * 32.5 / 128
    towards = np.array([[np.cos(p) * 0.8, 0.6, np.sin(p) * 0.8], [np.cos(p) * 0.8, 0.6, -np.sin(p) * 0.8]], np.float32)
    seen = background(lighting, towards)
    assert seen[0, 0] == pytest.approx(100, rel=1e-3)  # the very centre of the column
    assert seen[1, 0] == pytest.approx(1)


def test_volumes_cover_every_point_between_voxel_centres() -> None:
    points = np.random.default_rng(1).uniform([-150, -10, -150], [150, 60, 150], (5000, 3))
    centres, which = plan_volumes(points)
    assert len(centres) <= MAX_VOLUMES
    if len(centres) < MAX_VOLUMES:  # then no tile was left out
        first = np.array([voxel_centre(volume_first_voxel(centre)) for centre in centres])[which]
        last = first + (np.array([32, 16, 32]) - 1) * VOXEL_SIZE_M
        assert (points >= first).all()
        assert (points <= last).all()


def test_too_many_volumes_leave_the_emptiest_out() -> None:
    generator = np.random.default_rng(2)
    crowd = generator.uniform(0, 20, (1000, 3))
    scattered = generator.uniform(1000, 5000, (200, 3))
    centres, which = plan_volumes(np.concatenate([crowd, scattered]))
    assert len(centres) == MAX_VOLUMES
    assert (np.abs(centres[which[:1000]] - crowd) < 60).all()


def test_split_is_the_right_half() -> None:
    assert indirect_pixels(np.arange(12), 4, "split").tolist() == [2, 3, 6, 7, 10, 11]
    assert indirect_pixels(np.arange(4), 4, "off").tolist() == []
    assert indirect_pixels(np.arange(4), 4, "on").tolist() == [0, 1, 2, 3]


def test_a_camera_in_a_large_city_loads_what_it_looks_at() -> None:
    city = [SectorIndex(x, z) for x in range(-30, 30) for z in range(-30, 30)]
    eye = np.array([0.0, 5.0, 0.0])
    chosen = plan_sectors(city, eye, np.array([0.0, 5.0, -1.0]))
    assert len(chosen) == MAX_SECTORS
    assert list(chosen) == sorted(chosen)
    assert {SectorIndex(0, 0), SectorIndex(-1, -1), SectorIndex(0, -5)} <= set(chosen)
    assert SectorIndex(0, 5) not in chosen


def test_white_is_where_the_exposure_says() -> None:
    # ISO 12232: EV100 of 10 exposes 1.2 x 2^10 cd/m2 to white; pictures are one stop brighter.
    assert tonemap.exposed(np.full((1, 1, 3), 1228.8 / 2, np.float32), 10.0).max() == pytest.approx(1.0)


def test_tone_mapping_is_monotone_and_bounded() -> None:
    ramp = np.concatenate([[0], np.logspace(-6, 30, 500)]).astype(np.float32)
    mapped = tonemap.filmic(ramp)
    assert mapped[0] == 0
    assert (np.diff(mapped) >= 0).all()
    assert mapped.max() <= 1
    codes = tonemap.srgb_bytes(mapped)
    assert (codes[0], codes[-1]) == (0, 255)


pixels_of_any_radiance = arrays(np.float32, (3, 4, 3), elements=st.floats(-(2.0**127), 2.0**127, width=32))


@given(pixels_of_any_radiance, st.floats(-60, 140, exclude_max=True))
@example(np.full((3, 4, 3), -1.02e38, np.float32), -1.0)  # beyond float32 once it is exposed
@settings(max_examples=100, deadline=None)
def test_any_finite_radiance_makes_a_picture(radiance: np.ndarray, sky_ev100: float) -> None:
    ev100 = tonemap.metered(radiance, sky_ev100)
    assert sky_ev100 <= ev100 < 140  # 2 ** 127 cd/m2 reads 130
    assert np.isfinite(tonemap.exposed(np.abs(radiance), sky_ev100)).all()
    linear = tonemap.exposed(radiance, ev100)
    assert np.isfinite(linear).all()
    mapped = tonemap.filmic(linear)
    assert ((mapped >= 0) & (mapped <= 1)).all()
    codes = tonemap.srgb_bytes(mapped)
    # What is brighter is no darker in the picture.
    order = np.argsort(radiance, axis=None)
    assert (np.diff(codes.reshape(-1)[order].astype(int)) >= 0).all()
    pixels = np.asarray(Image.open(io.BytesIO(tonemap.png(radiance, sky_ev100))))
    np.testing.assert_array_equal(pixels, codes)


def test_srgb_codes_are_the_standard_s() -> None:
    linear = np.array([0, 0.0031308, 0.21404114, 0.5, 1.0], np.float32)
    assert tonemap.srgb_bytes(linear).tolist() == [0, 10, 128, 188, 255]


def test_a_png_keeps_rows_and_columns() -> None:
    radiance = np.zeros((9, 16, 3), np.float32)
    radiance[0, -1] = [1e6, 0, 0]
    pixels = np.asarray(Image.open(io.BytesIO(tonemap.png(radiance, 10.0))))
    assert pixels.shape == (9, 16, 3)
    assert pixels[0, -1, 0] == 255
    assert pixels.sum() == 255


def test_the_meter_follows_lamps_but_never_opens_beyond_the_sky():
    gray = np.full((4, 4, 3), 100.0, np.float32)
    # 100 cd/m2 reads EV 9.64 on a meter with K = 12.5.
    assert tonemap.metered(gray, 0.0) == pytest.approx(np.log2(800), abs=1e-3)
    assert tonemap.metered(gray, 15.0) == 15.0
    assert tonemap.metered(np.zeros((4, 4, 3), np.float32), -3.0) == -3.0
    under_black_sky = gray.copy()
    under_black_sky[:2] = 1e-5
    assert tonemap.metered(under_black_sky, 0.0) == pytest.approx(np.log2(800) - 3, abs=0.05)  # half the lightness


def test_what_lies_in_a_room_reads_the_rooms_volume() -> None:
    asked = []

    def volume_at(position: np.ndarray, room: int) -> object:
        asked.append(room)
        values = np.full((6, 16, 32, 32, 3), 100.0 if room == 1 else 7.0, np.float32)
        return served(values).volume_at(position, room)

    hall = Room("hall", (0.0, 0.0, 0.0), (10.0, 4.0, 10.0))
    points = np.array([[5.0, 0.0, 5.0], [5.0, 4.0, 5.0], [10.1, 2.0, 5.0], [30.0, 0.0, 5.0]])
    normals = np.array([[0, 1, 0], [0, 1, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    light = ServedLight(volume_at, rooms=(hall,)).irradiance(points, normals)
    np.testing.assert_allclose(light[:, 0], [100, 7, 7, 7], rtol=1e-6)  # the hall's floor, its roof, its wall from outside, the street
    assert sorted(set(asked)) == [0, 1]
