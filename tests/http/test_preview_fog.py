"""Fog marched through the light. Known answers, no city needed."""

from dataclasses import replace

import numpy as np
import pytest

from gi_core.client_light import ServedLight
from gi_core.constants import VOLUME_SHAPE, VOXEL_SIZE_M
from gi_core.grid import volume_first_voxel, voxel_centre
from gi_core.lighting import DirectionalLight, Lighting
from gi_core.phase import aerosol_phase
from server.camera import Camera
from server.preview import render
from server.preview_air import mean_sky
from server.preview_fog import BLOCK, PATTERN, add_fog_light, marched, open_mean_radiance, spread_blocks, way
from server.preview_scene import PreviewScene
from server.raycast import RayCaster

UP = np.array([0.0, 1.0, 0.0])
FOG = 0.02


def quad(x0: float, x1: float, y: float) -> list[list[float]]:
    return [[x0, y, -200], [x1, y, -200], [x1, y, 200], [x0, y, 200]]


def caster(*quads: list[list[float]]) -> RayCaster:
    triangles = [[4 * i + a, 4 * i + b, 4 * i + c] for i in range(len(quads)) for a, b, c in ((0, 1, 2), (0, 2, 3))]
    return RayCaster(np.concatenate([np.array(q, np.float64) for q in quads]), np.array(triangles, np.int32))


PLAIN = caster(quad(-200, 200, 0), quad(199, 200, 100))  # the second makes the box 100 m high
ROOFED = caster(quad(-200, 200, 0), quad(-200, 0, 30))


def sunny(towards: np.ndarray = UP, lux: float = 3e4, sky: float = 500.0) -> Lighting:
    radiance = np.zeros((64, 128, 3), np.float32)
    radiance[:32] = sky
    cube = np.pi * sky * np.array([0.5, 0.5, 1, 0, 0.5, 0.5])[:, None] * np.ones(3)
    nothing = DirectionalLight(-UP, np.zeros(3))
    return Lighting("12:00", "haze", DirectionalLight(towards, np.full(3, lux)), nothing, radiance, cube, 0.0, FOG, 12.0)


def served(lighting: Lighting, share: float = 1.0) -> ServedLight:
    """Volumes that hold a share of what the open plain's fog gets, the same everywhere and on all faces."""

    class Served:
        def __init__(self, position: np.ndarray, room: int) -> None:
            self.values = np.full((6, *VOLUME_SHAPE, 3), np.pi * share * open_mean_radiance(lighting), np.float32)
            self.origin = voxel_centre(volume_first_voxel(position))
            self.voxel_size = np.full(3, VOXEL_SIZE_M)

    return ServedLight(Served)


def one_ray(towards: list[float]) -> np.ndarray:
    return np.array([towards], np.float32) / np.float32(np.linalg.norm(towards))


def test_in_an_open_plain_nothing_is_added(monkeypatch: pytest.MonkeyPatch) -> None:
    lighting, camera = sunny(), Camera(np.array([0.0, 20, 0]), np.array([-50.0, 5, 3]), 60.0, 64)
    scene = PreviewScene(PLAIN, np.full((4, 3), 0.2, np.float32), np.zeros((4, 3), np.float32))
    both = render(camera, scene, lighting, (), served(lighting))
    monkeypatch.setattr("server.preview.add_fog_light", lambda *_: None)
    analytic = render(camera, scene, lighting, (), served(lighting))
    # rtol: float32 sums of eight steps
    np.testing.assert_allclose(both, analytic, rtol=1e-5)


@pytest.mark.parametrize("share", [0.0, 0.3, 2.0])
def test_without_a_sun_fog_follows_the_volume(share: float) -> None:
    lighting = sunny(lux=0.0)
    found = marched(
        np.array([0.0, 10, 0]), one_ray([1, 0, 0]), np.zeros(1), np.array([60.0]), np.array([0.5]), PLAIN, served(lighting, share), lighting
    )
    np.testing.assert_allclose(found[0], mean_sky(lighting) * (1 - np.exp(-FOG * 60)) * (share - 1), rtol=1e-5)


def test_where_no_volume_is_nothing_is_known_and_nothing_added() -> None:
    lighting = sunny()
    elsewhere = ServedLight(served(lighting, 0.3).volume_at, player=np.array([1000.0, 0, 0]))
    found = marched(
        np.array([-10.0, 10, 0]), one_ray([-1, 0, 0]), np.zeros(1), np.array([80.0]), np.full(1, 0.5), ROOFED, elsewhere, lighting
    )
    np.testing.assert_array_equal(found, 0)


def test_a_roof_takes_the_sun_s_share() -> None:
    lighting, towards = sunny(), one_ray([-1, 0, 0])
    found = marched(np.array([-10.0, 10, 0]), towards, np.zeros(1), np.array([80.0]), np.array([0.5]), ROOFED, served(lighting), lighting)
    sun = 3e4 * float(aerosol_phase(np.zeros(1))[0])  # the sun stands at right angles to the ray
    lost = sun / (sun + open_mean_radiance(lighting)[0])
    assert lost > 0.1
    np.testing.assert_allclose(found[0], -mean_sky(lighting) * (1 - np.exp(-FOG * 80)) * lost, rtol=1e-4)


def test_a_shadow_s_edge_is_where_the_roof_ends() -> None:
    lighting = sunny()
    shifts = (np.arange(16) + 0.5) / 16
    rays = np.repeat(one_ray([-1, 0, 0]), 16, axis=0)
    # 40 m of sun, then 60 m of shadow.
    found = marched(np.array([40.0, 10, 0]), rays, np.zeros(16), np.full(16, 100.0), shifts, ROOFED, served(lighting), lighting).mean(
        axis=0
    )
    sun = 3e4 * float(aerosol_phase(np.zeros(1))[0])
    shadow = np.exp(-FOG * 40) - np.exp(-FOG * 100)
    # One part in 128 steps.
    np.testing.assert_allclose(found, -mean_sky(lighting) * shadow * sun / (sun + open_mean_radiance(lighting)[0]), rtol=0.02)


def test_the_way_is_what_lies_in_the_box_before_a_surface() -> None:
    rays = np.array([[1, 0, 0], [0, 1, 0], [0.6, 0.8, 0], [0, -1, 0]], np.float32)
    start, end = way(PLAIN, np.array([0.0, 20, 0]), rays, np.array([50.0, np.inf, np.inf, 20.0]))
    np.testing.assert_allclose(start, 0)
    np.testing.assert_allclose(end, [50, 80, 100, 20], rtol=1e-6)
    start, end = way(PLAIN, np.array([0.0, 120, 0]), rays, np.array([1e6, 1e6, 1e6, 110.0]))
    np.testing.assert_allclose(end - start, [0, 0, 0, 90], rtol=1e-6)
    assert start[3] == pytest.approx(20)


def test_fog_before_the_box_dims_what_is_added_in_it() -> None:
    lighting, down = sunny(lux=0.0), one_ray([0, -1, 0])
    found = marched(
        np.array([0.0, 150, 0]), down, np.array([50.0]), np.array([150.0]), np.full(1, 0.5), PLAIN, served(lighting, 0.5), lighting
    )
    np.testing.assert_allclose(found[0], -0.5 * mean_sky(lighting) * (np.exp(-FOG * 50) - np.exp(-FOG * 150)), rtol=1e-5)


def test_blocks_of_one_value_stay_so_and_the_pattern_s_shifts_cancel() -> None:
    depth, pixels = np.full((16, 16), 40.0), np.full((64, 64), 40.0)
    np.testing.assert_allclose(spread_blocks(np.full((16, 16, 3), 7.0, np.float32), depth, pixels), 7, rtol=1e-5)
    dithered = np.tile(PATTERN, (4, 4))[..., None].repeat(3, axis=2).astype(np.float32)
    inner = slice(3 * BLOCK, -4 * BLOCK)
    np.testing.assert_allclose(spread_blocks(dithered, depth, pixels)[inner, inner], PATTERN.mean(), rtol=1e-5)


def test_light_does_not_leak_past_an_edge_in_depth() -> None:
    found, depth, pixels = np.zeros((8, 16, 3), np.float32), np.full((8, 16), 10.0), np.full((32, 64), 10.0)
    found[:, 8:], depth[:, 8:], pixels[:, 32:] = -5.0, 100.0, 100.0
    spread = spread_blocks(found, depth, pixels)
    # The floor of all weights, 1e-4, for a few taps.
    np.testing.assert_allclose(spread[:, :32], 0, atol=0.01)
    np.testing.assert_allclose(spread[:, 32:], -5, atol=0.01)


def test_without_fog_no_volume_is_asked_for() -> None:
    clear = replace(sunny(), fog_density=0.0)
    picture = np.ones((36 * 64, 3), np.float32)
    camera = Camera(np.array([0.0, 20, 0]), np.array([50.0, 5, 3]), 60.0, 64)

    def refuse(_: np.ndarray) -> None:
        raise AssertionError

    add_fog_light(picture, camera, PLAIN, ServedLight(refuse), clear, np.full(len(picture), 10.0))
    assert (picture == 1).all()
