"""Ambient occlusion in a picture. Known answers, no city needed."""

from collections.abc import Iterable

import numpy as np
import pytest

from gi_core.client_light import Look, ServedLight
from gi_core.constants import VOLUME_SHAPE, VOXEL_SIZE_M
from gi_core.decals import hidden_share
from gi_core.grid import volume_first_voxel, voxel_centre
from gi_core.world import Decal
from server.camera import Camera
from server.preview import indirect_irradiance
from server.preview_occlusion import NEAR_ALBEDO, RAYS, REACH_M, kept_by_decals, kept_in_picture, kept_share, sphere_lattice
from server.raycast import RayCaster

UP = np.array([[0.0, 1.0, 0.0]], np.float32)


def floor_and_wall(at: float) -> RayCaster:
    """A floor at y = 0, and a wall at x = 0 that faces +x."""
    floor = [[0, 0, -40], [40, 0, -40], [40, 0, 40], [0, 0, 40]]
    wall = [[0, 0, -40], [0, 40, -40], [0, 40, 40], [0, 0, 40]]
    corners = np.array(floor + wall, np.float64) + np.array([at, 0, at])
    return RayCaster(corners, np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], np.int32))


@pytest.mark.parametrize("at", [0.0, 50_000.0])
def test_it_falls_from_a_corner_to_nothing_within_reach(at: float) -> None:
    distances = np.array([0.01, 0.5, 1.0, 2.0, REACH_M + 0.05, 20.0])
    points = np.stack([distances, np.zeros(6), np.zeros(6)], axis=1) + np.array([at, 0, at])
    kept = kept_share(floor_and_wall(at), points, UP.repeat(6, axis=0))
    assert (np.diff(kept[:5]) > 0).all()
    np.testing.assert_allclose(kept[4:], 1, atol=1e-6)
    # Right in the corner the wall takes half of all rays, and gives some back.
    assert kept[0] == pytest.approx(0.5 / (1 - NEAR_ALBEDO * 0.5), abs=0.08)  # 12 rays: one is 0.08


def test_a_surface_counts_by_how_near_it_is() -> None:
    lid = RayCaster(np.array([[-90.0, 1, -90], [90, 1, -90], [0, 1, 90]]), np.array([[0, 1, 2]], np.int32))
    towards = sphere_lattice(1 << 12)
    # Cosine-distributed: sin^2 of the angle is uniform, so 1 / cos has the mean 2, and REACH_M cos > 1 m is where the lid is met.
    cosine = ((UP + towards) / np.maximum(np.linalg.norm(UP + towards, axis=1, keepdims=True), 1e-9))[:, 1]
    free = np.where(REACH_M * cosine > 1, 1 / (REACH_M * np.maximum(cosine, 1e-9)), 1.0).mean()
    kept = kept_share(lid, np.zeros((1, 3)), UP)[0]
    assert kept == pytest.approx(free / (1 - NEAR_ALBEDO * (1 - free)), abs=0.02)


def test_pixels_that_share_rays_see_as_much_as_those_that_cast_all(monkeypatch: pytest.MonkeyPatch) -> None:
    rays = floor_and_wall(0.0)
    camera = Camera(np.array([9.0, 4.0, -6.0]), np.array([0.0, 0.0, 3.0]), 75.0, 240)
    seen = rays.first_surface(camera.eye, camera.rays())
    pixel = np.flatnonzero(seen.hit)
    position, normal = seen.position[pixel], seen.normal[pixel]
    monkeypatch.setattr("server.preview_occlusion.RAYS", 512)
    truth = kept_share(rays, position, normal)
    monkeypatch.setattr("server.preview_occlusion.RAYS", RAYS)
    alone = kept_share(rays, position, normal)
    cast: list[int] = []
    free_share = RayCaster.free_share

    def counted(rays: RayCaster, position: np.ndarray, normal: np.ndarray, ways: Iterable[np.ndarray]) -> np.ndarray:
        every = list(ways)
        cast.append(len(position) * len(every))
        return free_share(rays, position, normal, every)

    monkeypatch.setattr(RayCaster, "free_share", counted)
    shared = kept_in_picture(rays, position, normal, pixel, camera.width)
    assert sum(cast) < 0.3 * RAYS * len(pixel)
    assert truth.min() < 0.7 < 0.99 < truth.max()
    errors = [np.sqrt(np.mean((found - truth) ** 2)) for found in (alone, shared)]
    assert errors[1] < 1.5 * errors[0]
    assert abs(np.mean(shared - alone)) < 0.0005


def test_a_pixel_without_neighbours_in_its_plane_casts_all_rays_itself() -> None:
    """Of a floor and a wall that touch in the picture; and what shows in one row alone."""
    rays = floor_and_wall(0.0)
    position = np.array([[0.5, 0.0, 0.0], [0.0, 0.5, 0.0], [0.5, 0.0, 1.0]])
    normal = np.array([[0, 1, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    pixel = np.array([41, 42, 43])
    np.testing.assert_array_equal(kept_in_picture(rays, position, normal, pixel, 40), kept_share(rays, position, normal))
    assert kept_in_picture(rays, position[:0], normal[:0], pixel[:0], 40).shape == (0,)


def test_the_lattice_is_even() -> None:
    lattice = sphere_lattice(64)
    np.testing.assert_allclose(np.linalg.norm(lattice, axis=1), 1, rtol=1e-6)
    np.testing.assert_allclose(lattice.mean(axis=0), 0, atol=0.02)
    np.testing.assert_allclose((lattice**2).mean(axis=0), 1 / 3, atol=0.02)


def test_decals_multiply_and_the_order_of_pixels_is_kept() -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform([0, 0, 0], [40, 0, 40], (2000, 3))
    parked = [Decal(str(i), (10.0 + 3 * i, 0.25, 12.0), (1.8, 1.25, 4.6), 15.0 * i) for i in range(3)]
    elsewhere = Decal("far", (500.0, 0.25, 0.0), (1.8, 1.25, 4.6))
    kept = kept_by_decals([*parked, elsewhere], points, UP.repeat(2000, axis=0))
    expected = np.prod([1 - hidden_share(decal, points, UP.repeat(2000, axis=0)) for decal in parked], axis=0)
    np.testing.assert_allclose(kept, expected, rtol=1e-6)
    assert (kept < 0.2).any()
    assert (kept == 1).any()


def test_without_decals_or_pixels_nothing_is_sorted(monkeypatch: pytest.MonkeyPatch) -> None:
    def never(_: np.ndarray) -> None:
        raise AssertionError("sorted")

    monkeypatch.setattr("server.preview_occlusion.PixelCells.of", never)
    np.testing.assert_array_equal(kept_by_decals((), np.zeros((3, 3)), UP.repeat(3, axis=0)), 1)
    assert kept_by_decals([Decal("car", (0, 0, 0), (1, 1, 1))], np.zeros((0, 3)), UP[:0]).shape == (0,)


def test_only_a_look_that_asks_for_it_has_it() -> None:
    class Served:
        def __init__(self, position: np.ndarray, room: int) -> None:
            self.values = np.full((6, *VOLUME_SHAPE, 3), 200.0, np.float32)
            self.origin = voxel_centre(volume_first_voxel(position))
            self.voxel_size = np.full(3, VOXEL_SIZE_M)

    rays, point = floor_and_wall(0.0), np.array([[0.5, 0, 0]])
    plain, dimmed = (indirect_irradiance(rays, ServedLight(Served), Look(occlusion=on), point, UP) for on in (False, True))
    np.testing.assert_allclose(plain, 200, rtol=1e-6)
    np.testing.assert_allclose(dimmed, 200 * kept_share(rays, point, UP)[0], rtol=1e-6)
    assert dimmed[0, 0] < 190
