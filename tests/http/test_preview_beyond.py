"""What a picture reads beyond the volumes. Known answers, no city needed."""

import numpy as np

from gi_core.client_light import EXTENT_M, FADE_M, MAX_VOLUMES, ServedLight, near_share, sample_distant
from gi_core.constants import SECTOR_SIZE_M, VOLUME_SHAPE, VOXEL_SIZE_M
from gi_core.engine import Distant
from gi_core.grid import SectorIndex, volume_first_voxel, voxel_centre

UP = np.array([0.0, 1.0, 0.0], np.float32)
NEAR, FAR = 300.0, 700.0


class Served:
    """A volume of the same light everywhere."""

    def __init__(self, position: np.ndarray, room: int) -> None:
        self.values = np.full((6, *VOLUME_SHAPE, 3), NEAR, np.float32)
        self.origin = voxel_centre(volume_first_voxel(position))
        self.voxel_size = np.full(3, VOXEL_SIZE_M)


def texture(values: np.ndarray, origin: tuple[int, int] = (0, 0)) -> Distant:
    """Texels whose six faces are all alike; NaN where there is no sector."""
    cubes = np.repeat(np.repeat(np.nan_to_num(values)[..., None, None], 6, axis=2), 3, axis=3).astype(np.float32)
    return Distant(cubes, SectorIndex(*origin), np.isfinite(values).astype(np.uint8))


def along_x(first: float, last: float, count: int) -> tuple[np.ndarray, np.ndarray]:
    points = np.stack([np.linspace(first, last, count), np.zeros(count), np.zeros(count)], axis=1)
    return points, np.tile(UP, (count, 1))


def test_the_one_volume_of_a_client_fades_into_the_texture() -> None:
    client = ServedLight(Served, texture(np.full((9, 40), FAR), (-20, -4)), player=np.zeros(3))
    points, normals = along_x(0, 200, 401)
    seen = client.irradiance(points, normals)[:, 0]
    edge = voxel_centre(volume_first_voxel(np.zeros(3)))[0] + EXTENT_M[0]
    beyond = points[:, 0] - edge
    assert 40 < edge < 60
    np.testing.assert_allclose(seen, NEAR + (FAR - NEAR) * np.clip(beyond / FADE_M, 0, 1), rtol=1e-5)
    mean, known = client.mean_irradiance(points)
    np.testing.assert_allclose(mean, NEAR, rtol=1e-5)
    np.testing.assert_allclose(known, 1 - np.clip(beyond / FADE_M, 0, 1), atol=1e-5)


def test_cascades_fade_into_one_another_and_the_last_into_the_texture() -> None:
    def cascade(n: int) -> Served:
        volume = Served(np.zeros(3), 0)
        volume.values = np.full_like(volume.values, NEAR + 100 * n)
        volume.voxel_size = np.full(3, VOXEL_SIZE_M * 2.0**n)
        volume.origin = -(np.array([VOLUME_SHAPE[2], VOLUME_SHAPE[0], VOLUME_SHAPE[1]]) - 1) / 2 * volume.voxel_size
        return volume

    volumes = [cascade(n) for n in range(4)]
    served = ServedLight(lambda *_: volumes[0], texture(np.full((30, 30), FAR), (-15, -15)), np.zeros(3), coarser=tuple(volumes[1:]))
    points, normals = along_x(0, 500, 1001)
    seen, edge = served.irradiance(points, normals)[:, 0], EXTENT_M[0] / 2
    # In the middle of each, at its edge, where the next one is all there is, and beyond the last.
    for x, lux in ((0, 300), (edge, 400), (2 * edge, 500), (4 * edge, 600), (8 * edge, 600), (8 * edge + FADE_M + 1, FAR)):
        np.testing.assert_allclose(served.irradiance(*along_x(x, x, 1))[:, 0], lux, rtol=1e-5)
    np.testing.assert_allclose(served.irradiance(*along_x(edge - VOXEL_SIZE_M, 0, 1))[:, 0], 350, rtol=1e-5)
    assert (np.diff(seen) >= -1e-3).all()
    assert np.abs(np.diff(seen)).max() < 10


def test_without_a_texture_the_edge_goes_on() -> None:
    points, normals = along_x(0, 1000, 50)
    np.testing.assert_allclose(ServedLight(Served, None, np.zeros(3)).irradiance(points, normals), NEAR, rtol=1e-6)


def test_where_there_are_volumes_the_texture_changes_no_bit() -> None:
    points = np.random.default_rng(1).uniform([-150, -10, -150], [150, 60, 150], (2000, 3))
    normals = np.tile(UP, (len(points), 1))
    with_texture = ServedLight(Served, texture(np.full((9, 9), FAR), (-4, -4))).irradiance(points, normals)
    np.testing.assert_array_equal(with_texture, ServedLight(Served).irradiance(points, normals))


def test_points_that_get_no_volume_read_the_texture() -> None:
    crowd, scattered = along_x(0, 20, 1000)[0], along_x(1000, 100_000, 2 * MAX_VOLUMES)[0]
    points = np.concatenate([crowd, scattered])
    served = ServedLight(Served, texture(np.full((1, 2000), FAR)))
    seen = served.irradiance(points, np.tile(UP, (len(points), 1)))[:, 0]
    np.testing.assert_allclose(seen[:1000], NEAR, rtol=1e-6)  # float32 weights of eight corners
    assert 0.4 < (np.abs(seen[1000:] - FAR) < 0.01).mean() < 0.6  # 128 volumes, one of them the crowd's, for 256 places


def test_the_face_that_a_distant_surface_turns_to_lights_it() -> None:
    cubes = np.zeros((1, 1, 6, 3), np.float32)
    cubes[0, 0, 2], cubes[0, 0, 4] = 100.0, 40.0  # +Y, +Z
    served = ServedLight(Served, Distant(cubes, SectorIndex(0, 0), np.ones((1, 1), np.uint8)), player=np.array([5000.0, 0, 0]))
    normals = np.array([[0, 1, 0], [0, 0, 1], [0, 0.6, 0.8], [1, 0, 0]], np.float32)
    seen = served.irradiance(np.full((4, 3), 32.0), normals)[:, 0]
    np.testing.assert_allclose(seen, [100, 40, 36 + 25.6, 0], rtol=1e-5)


def test_texels_blend_between_the_centres_of_sectors_that_there_are() -> None:
    found = texture(np.array([[10.0, 30.0, np.nan], [50.0, 70.0, np.nan]]), (-3, 7))
    corner = np.array([-3 * SECTOR_SIZE_M, 0, 7 * SECTOR_SIZE_M])
    places = corner + SECTOR_SIZE_M * np.array([[0.5, 0, 0.5], [1.0, 0, 0.5], [1.0, 0, 1.0], [1.75, 0, 0.5], [-3, 0, -3], [1.5, 0, 9]])
    np.testing.assert_allclose(sample_distant(found, places)[:, 0, 0], [10, 20, 40, 30, 10, 70], rtol=1e-5)


def test_a_share_is_one_inside_and_counts_all_axes_outside() -> None:
    origin = np.array([100.0, 0, -50])
    points = origin + np.array([[0, 0, 0], EXTENT_M, EXTENT_M / 2, EXTENT_M + np.array([3.0, 0, 4]), [0, -FADE_M, 0], [0, -1e4, 0]])
    np.testing.assert_allclose(near_share(origin, points), [1, 1, 1, 1 - 5 / FADE_M, 0, 0], rtol=1e-6)
