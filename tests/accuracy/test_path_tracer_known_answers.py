"""The path tracer against scenes whose irradiance can be written down."""

from dataclasses import dataclass
from functools import partial

import numpy as np
import pytest
from scipy import stats

from bake_jobs.path_tracer import Estimate, PathTracer, sky_radiance
from gi_core.basis import harmonics, projection_weights
from gi_core.errors import InputError
from gi_core.lighting import DirectionalLight, Lighting

NO_LIGHT = DirectionalLight(np.array([0.0, 1.0, 0.0]), np.zeros(3))
TINT = np.array([1.0, 0.8, 0.5])
UP, DOWN = 2, 3  # faces of the cube
SIDES = [0, 1, 4, 5]
# Normal tails beyond 4.5 standard errors have odds of 1 in 150 000; seeds are fixed, so a pass stays a pass.
Z_MAX = 4.5


@dataclass
class Mesh:
    vertices: np.ndarray
    triangles: np.ndarray

    def tracer(self, albedo=0.0, emission=0.0, **options):
        """albedo and emission: numbers, triples, or one triple a triangle."""
        shape = (len(self.triangles), 3)
        return PathTracer(
            self.vertices,
            self.triangles,
            np.broadcast_to(np.asarray(albedo, np.float32), shape),
            np.broadcast_to(np.asarray(emission, np.float32), shape),
            **options,
        )


def quad(corner, edge_a, edge_b):
    a, b, c = (np.asarray(v, np.float64) for v in (corner, edge_a, edge_b))
    return Mesh(np.array([a, a + b, a + b + c, a + c]), np.array([[0, 1, 2], [0, 2, 3]], np.int32))


def join(*meshes):
    starts = np.cumsum([0, *(len(m.vertices) for m in meshes)])
    triangles = [m.triangles + start for m, start in zip(meshes, starts, strict=False)]
    return Mesh(np.concatenate([m.vertices for m in meshes]), np.concatenate(triangles).astype(np.int32))


def box(minimum, maximum):
    (x, y, z), size = minimum, np.subtract(maximum, minimum)
    a, b, c = np.diag(size.astype(np.float64))
    return join(
        quad((x, y, z), b, c), quad((x, y, z), c, a), quad((x, y, z), a, b),
        quad(np.add((x, y, z), a), b, c), quad(np.add((x, y, z), b), c, a), quad(np.add((x, y, z), c), a, b),
    )  # fmt: skip


def plane(half=1e4):
    return quad((-half, 0, -half), (0, 0, 2 * half), (2 * half, 0, 0))


def lighting(sky=0.0, sun=NO_LIGHT, moon=NO_LIGHT):
    """sky: radiance of the whole upper hemisphere, number or triple."""
    radiance = np.zeros((64, 128, 3), np.float32)
    radiance[:32] = sky
    return Lighting("", "", sun, moon, radiance, np.zeros((6, 3)), 0.0, 0.0, 0.0)


def sun_at(elevation_degrees, irradiance):
    elevation = np.radians(elevation_degrees)
    return DirectionalLight(np.array([np.cos(elevation), np.sin(elevation), 0.0]), np.asarray(irradiance, np.float64))


def assert_agrees(estimate: Estimate, truth, rounding=1e-5):
    """Within Z_MAX standard errors. rounding: relative, float32 sums of one chunk (worst seen 2e-6)."""
    truth = np.broadcast_to(truth, estimate.mean.shape)
    allowed = Z_MAX * estimate.standard_error + rounding * np.abs(truth)
    wrong = np.abs(estimate.mean - truth) > allowed
    assert not wrong.any(), f"expected {truth[wrong][:4]}, got {estimate.mean[wrong][:4]} +- {estimate.standard_error[wrong][:4]}"


@pytest.mark.parametrize("albedo", [0.0, 0.5, 0.95])
def test_closed_furnace_has_radiosity_of_a_geometric_series(albedo):
    tracer = box((-3, -1, -2), (5, 4, 3)).tracer(albedo, 10 * TINT)
    truth = np.pi * 10 * TINT / (1 - albedo)
    assert_agrees(tracer.cube_irradiance(np.array([[0.1, 0.2, 0.3], [4.9, 3.9, 2.9]]), lighting(), samples=2048), truth)
    on_wall = tracer.surface_irradiance(np.array([[-3.0, 1, 0]]), np.array([[1.0, 0, 0]]), lighting(), samples=2048)
    assert_agrees(on_wall, truth)
    assert (on_wall.standard_error < 0.02 * truth).all()  # otherwise agreement would mean nothing


def test_white_box_without_light_is_black_and_ends():
    assert not box((0, 0, 0), (1, 1, 1)).tracer(1.0).cube_irradiance(np.full((1, 3), 0.5), lighting(), samples=64).mean.any()


def test_open_plane_under_a_uniform_sky():
    sky, albedo = 1000 * TINT, 0.3
    tracer = plane().tracer(albedo)
    cube = tracer.cube_irradiance(np.array([[0.3, 2.0, 0.1]]), lighting(sky), samples=4096)
    assert_agrees(Estimate(cube.mean[:, UP], cube.standard_error[:, UP]), np.pi * sky)
    assert_agrees(Estimate(cube.mean[:, DOWN], cube.standard_error[:, DOWN]), albedo * np.pi * sky)
    assert_agrees(Estimate(cube.mean[:, SIDES], cube.standard_error[:, SIDES]), np.pi / 2 * sky * (1 + albedo))
    on_ground = tracer.surface_irradiance(np.array([[1.0, 0, 1]]), np.array([[0.0, 1, 0]]), lighting(sky))
    assert_agrees(on_ground, np.pi * sky)


def test_sunlit_plane_gives_bounced_sun_only():
    sun, albedo = sun_at(30, 1e5 * TINT), 0.2
    tracer = plane().tracer(albedo)
    cube = tracer.cube_irradiance(np.array([[0.3, 2.0, 0.1]]), lighting(sun=sun), samples=4096)
    ground = albedo * sun.irradiance * 0.5
    assert not cube.mean[:, UP].any()
    assert_agrees(Estimate(cube.mean[:, DOWN], cube.standard_error[:, DOWN]), ground)
    assert_agrees(Estimate(cube.mean[:, SIDES], cube.standard_error[:, SIDES]), ground / 2)
    # The ground itself sees only the sun, and that is the client's to draw.
    assert not tracer.surface_irradiance(np.array([[1.0, 0, 1]]), np.array([[0.0, 1, 0]]), lighting(sun=sun)).mean.any()


def test_moon_bounces_as_the_sun_does():
    point = np.array([[0.0, 3.0, 0.0]])
    tracer = plane().tracer(0.2)
    as_sun = tracer.cube_irradiance(point, lighting(sun=sun_at(40, TINT)))
    as_moon = tracer.cube_irradiance(point, lighting(moon=sun_at(40, TINT)))
    np.testing.assert_array_equal(as_sun.mean, as_moon.mean)


def test_sun_below_the_horizon_reaches_nothing_above_ground():
    below = lighting(sun=sun_at(-10, 1e5 * TINT))
    assert not plane().tracer(0.5).cube_irradiance(np.array([[0.0, 2.0, 0.0]]), below).mean.any()


def test_closed_door_keeps_the_dark_room_exactly_dark():
    lit, dark = box((0, 0, 0), (4, 3, 4)), box((4, 0, 0), (8, 3, 4))  # they share the wall at x = 4: a plane without thickness
    emission = np.zeros((24, 3), np.float32)
    emission[:12] = 1000
    emission[6:8] = 0  # the lit room's side of the shared wall would shine through a two-sided triangle
    emission[12:14] = 0
    tracer = join(lit, dark).tracer(0.9, emission)
    bright_and_dark = np.array([[2.0, 1.5, 2.0], [6.0, 1.5, 2.0], [4.01, 0.01, 0.01], [7.99, 2.99, 3.99]])
    outside_light = lighting(sky=5000, sun=sun_at(50, 1e5 * TINT))
    mean = tracer.cube_irradiance(bright_and_dark, outside_light, samples=16384).mean
    assert (mean[0] > 1000).all()
    assert not mean[1:].any()


def form_factor_from_above_a_corner(width, depth, height):
    """Of a rectangle seen from a parallel patch below its corner (Siegel and Howell, configuration B-3)."""
    a, b = width / height, depth / height
    along_a = a / np.sqrt(1 + a * a) * np.arctan(b / np.sqrt(1 + a * a))
    along_b = b / np.sqrt(1 + b * b) * np.arctan(a / np.sqrt(1 + b * b))
    return (along_a + along_b) / (2 * np.pi)


def test_emissive_rectangle_has_its_form_factor():
    tracer = quad((0, 2, 0), (3, 0, 0), (0, 0, 5)).tracer(0.0, 100 * TINT)
    truth = np.pi * 100 * TINT * form_factor_from_above_a_corner(3, 5, 2)
    below = np.zeros((1, 3))
    assert_agrees(tracer.surface_irradiance(below, np.array([[0.0, 1, 0]]), lighting(), samples=8192), truth, rounding=2e-3)  # 2 mm offset
    cube = tracer.cube_irradiance(below, lighting(), samples=8192)
    assert_agrees(Estimate(cube.mean[:, UP], cube.standard_error[:, UP]), truth)
    assert not cube.mean[:, [DOWN, 1, 5]].any()


def test_standard_errors_are_calibrated():
    tracer = quad((0, 2, 0), (3, 0, 0), (0, 0, 5)).tracer(0.0, 1.0)
    truth = np.pi * form_factor_from_above_a_corner(3, 5, 2)
    cube = tracer.cube_irradiance(np.zeros((600, 3)), lighting(), samples=2048, replicates=8)
    z = (cube.mean[:, UP, 0] - truth) / cube.standard_error[:, UP, 0]
    assert stats.kstest(z, stats.t(df=7).cdf).pvalue > 1e-3
    # The same for a noise that paths, not primary directions, cause: many bounces in a dim furnace of unequal walls.
    furnace = box((0, 0, 0), (2, 2, 2)).tracer(0.8, 1.0)
    wall = furnace.surface_irradiance(np.tile([[0.0, 1, 1]], (600, 1)), np.tile([[1.0, 0, 0]], (600, 1)), lighting(), samples=2048)
    z = (wall.mean[:, 0] - np.pi / 0.2) / wall.standard_error[:, 0]
    assert stats.kstest(z, stats.t(df=7).cdf).pvalue > 1e-3


def test_result_depends_on_the_seed_and_on_nothing_else():
    mesh = join(plane(100.0), box((2, 0, 2), (6, 8, 6)))
    points = np.array([[0.0, 1, 0], [7.0, 2, 4], [1.0, 9, 1], [3, 10, 3]])
    light = lighting(sky=3000, sun=sun_at(35, 8e4 * TINT))
    first = mesh.tracer(0.4, threads=1).cube_irradiance(points, light, samples=32768, seed=5)
    again = mesh.tracer(0.4, threads=3).cube_irradiance(points, light, samples=32768, seed=5)
    other = mesh.tracer(0.4).cube_irradiance(points, light, samples=32768, seed=6)
    np.testing.assert_array_equal(first.mean, again.mean)
    np.testing.assert_array_equal(first.standard_error, again.standard_error)
    assert (first.mean[:, :2] != other.mean[:, :2]).any()
    assert_agrees(Estimate(first.mean, np.hypot(first.standard_error, other.standard_error)), other.mean)


def test_far_from_the_origin_it_is_the_same():
    mesh, shift = join(plane(100.0), box((2, 0, 2), (6, 8, 6))), np.array([49984.0, 0.0, -50048.0])  # whole sectors
    points = np.array([[0.0, 1, 0], [7.0, 2, 4]])
    light = lighting(sky=3000, sun=sun_at(35, 8e4))
    near = mesh.tracer(0.4).cube_irradiance(points, light)
    far = Mesh(mesh.vertices + shift, mesh.triangles).tracer(0.4).cube_irradiance(points + shift, light)
    # Float64 rounds 50 km to 7e-12 m; the odd path that this sends elsewhere is one of 1024.
    np.testing.assert_allclose(far.mean, near.mean, rtol=5e-3)


def test_sh2_of_a_half_bright_sphere():
    empty = PathTracer(np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32))
    sh = empty.projected_irradiance(np.zeros((1, 3)), lighting(sky=TINT), (), partial(projection_weights, "sh2"), samples=16384)
    truth = np.zeros(9)
    truth[0] = np.pi * 2 * np.pi * np.sqrt(1 / (4 * np.pi))
    truth[1] = 2 * np.pi / 3 * np.pi * np.sqrt(3 / (4 * np.pi))
    assert_agrees(sh, truth[None, :, None] * TINT)


def test_sh2_is_exact_for_radiance_of_degree_two(sphere_directions):
    # A radiance of degree <= 2 is its own projection; its irradiance is the cosine convolution, summed here by brute force.
    coefficients = np.array([1.0, 0.3, -0.2, 0.1, 0.15, -0.1, 0.05, 0.2, -0.12])
    solid_angle = 4 * np.pi / len(sphere_directions)
    radiance = harmonics(sphere_directions) @ coefficients
    projected = projection_weights("sh2", sphere_directions).T @ radiance * solid_angle
    normals = sphere_directions[::997]
    brute_force = np.maximum(normals @ sphere_directions.T, 0) @ radiance * solid_angle
    np.testing.assert_allclose(harmonics(normals) @ projected, brute_force, atol=2e-4)  # lattice of 20 000 directions, mean 0.9


@pytest.fixture(scope="module")
def sphere_directions():
    n = 20_000
    y = 1 - (2 * np.arange(n) + 1) / n
    turn = np.arange(n) * np.pi * (3 - np.sqrt(5))
    level = np.sqrt(1 - y * y)
    return np.stack([level * np.cos(turn), y, level * np.sin(turn)], axis=1).astype(np.float32)


def test_sky_lookup_finds_every_texel_from_its_contract_direction():
    t = np.pi * (np.arange(64) + 0.5) / 64
    p = 2 * np.pi * (np.arange(128) + 0.5) / 128
    t, p = np.meshgrid(t, p, indexing="ij")
    towards = np.stack([np.sin(t) * np.cos(p), np.cos(t), np.sin(t) * np.sin(p)], axis=-1).reshape(-1, 3).astype(np.float32)
    sky = np.arange(64 * 128 * 3, dtype=np.float32).reshape(64, 128, 3)
    np.testing.assert_array_equal(sky_radiance(sky, towards), sky.reshape(-1, 3))


def test_sky_lookup_holds_at_poles_and_seam():
    sky = np.arange(64 * 128 * 3, dtype=np.float32).reshape(64, 128, 3)
    found = sky_radiance(sky, np.array([[0, 1, 0], [0, -1, 0], [1, 0, -0.0], [1, -1e-9, -1e-9]], np.float32))
    np.testing.assert_array_equal(found[:3], [sky[0, 0], sky[63, 0], sky[32, 0]])
    np.testing.assert_array_equal(found[3], sky[32, 127])


@pytest.mark.parametrize(
    ("albedo", "emission", "said"), [(1.5, 0.0, "albedo <= 1"), (-0.1, 0.0, "albedo >= 0"), (0.5, np.nan, "finite emission")]
)
def test_materials_out_of_range_are_refused(albedo, emission, said):
    with pytest.raises(InputError, match=said):
        plane().tracer(albedo, emission)


def test_materials_of_another_count_are_refused():
    with pytest.raises(InputError, match="shape"):
        PathTracer(np.zeros((3, 3)), np.array([[0, 1, 2]], np.int32), np.zeros((2, 3), np.float32), np.zeros((1, 3), np.float32))


@pytest.mark.parametrize(("samples", "replicates"), [(16, 1), (4, 8)])
def test_too_few_samples_for_a_noise_estimate_are_refused(samples, replicates):
    with pytest.raises(InputError, match="replicates"):
        plane().tracer().cube_irradiance(np.zeros((1, 3)), lighting(), samples=samples, replicates=replicates)
