"""The path tracer's lamps against scenes whose light can be written down."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy import stats

from bake_jobs.lamp_sampling import LampSampler
from bake_jobs.path_tracer import PathTracer
from gi_core.lighting import DirectionalLight, Lighting
from gi_core.spectrum import LUMINANCE_FROM_RGB
from gi_core.world import Lamp

DARK = Lighting(
    *("", ""),
    *[DirectionalLight(np.array([0.0, 1.0, 0.0]), np.zeros(3))] * 2,
    *(np.zeros((64, 128, 3), np.float32), np.zeros((6, 3)), 0.0, 0.0, 0.0),
)
UP, DOWN_NORMAL = np.array([[0.0, 1.0, 0.0]]), np.array([[0.0, -1.0, 0.0]])
WARM = (1.0, 0.7, 0.4)
# Normal tails beyond 4.5 standard errors have odds of 1 in 150 000; seeds are fixed, so a pass stays a pass.
Z_MAX = 4.5
ALBEDO = 0.4
# An off-centre place, a window that takes a part, a colour.
POINT = Lamp("point", "point", (0.5, 3.0, -0.3), 8000.0, WARM, 12.0)
SPOT = replace(POINT, name="spot", kind="spot", direction=(0.5, -1.0, 0.2), cone_degrees=70.0)
AREA = replace(POINT, name="area", kind="area", direction=(0.3, -1.0, 0.6), size=(1.5, 0.6))


def tracer_of(scene, **options):
    return PathTracer(scene.vertices, scene.triangles, scene.albedo, scene.emission, **options)


def assert_agrees(estimate, truth, tolerance):
    """Within Z_MAX standard errors and a relative tolerance for what truth itself leaves out."""
    allowed = Z_MAX * estimate.standard_error + tolerance * np.abs(truth)
    assert (np.abs(estimate.mean - truth) <= allowed).all(), f"expected {truth}, got {estimate.mean} +- {estimate.standard_error}"


@pytest.fixture(scope="module")
def floor(build):
    """One bounce and no more: what leaves an endless floor never comes back."""
    return tracer_of(build().ground((-1e3, -1e3), (1e3, 1e3), albedo=ALBEDO).scene())


def direct_irradiance(lamp, points):
    """Lux (n, 3) on level ground at points (n, 3), by the formulas that gi_core/lights.py states, written out again."""
    color = np.array(lamp.color) / (LUMINANCE_FROM_RGB @ np.array(lamp.color))
    axis = np.array(lamp.direction) / np.linalg.norm(lamp.direction)
    from_middle = points - np.array(lamp.position)
    window = np.maximum(1 - (np.linalg.norm(from_middle, axis=1) / lamp.range_m) ** 4, 0) ** 2
    places, edges = [np.zeros(3)], 8
    if lamp.kind == "area":
        across = np.cross((0, 1, 0), axis)
        across /= np.linalg.norm(across)
        up = np.cross(axis, across)
        steps = (np.arange(edges) + 0.5) / edges - 0.5
        places = [lamp.size[0] * u * across + lamp.size[1] * v * up for u in steps for v in steps]
    total = np.zeros(len(points))
    for place in places:
        along = from_middle - place
        squared = (along**2).sum(axis=1)
        ray = along / np.sqrt(squared)[:, None]
        if lamp.kind == "point":
            intensity = np.full(len(points), lamp.lumens / (4 * np.pi))
        elif lamp.kind == "spot":
            half = np.radians(lamp.cone_degrees / 2)
            outer, inner = np.cos(half), np.cos(0.8 * half)
            x = np.clip((ray @ axis - outer) / (inner - outer), 0, 1)
            intensity = lamp.lumens / (2 * np.pi * (1 - (inner + outer) / 2)) * x * x * (3 - 2 * x)
        else:
            intensity = lamp.lumens / np.pi * np.maximum(ray @ axis, 0)
        total += intensity * np.maximum(-ray[:, 1], 0) / squared / len(places)
    return (window * total)[:, None] * color


def bounced_irradiance(lamp, point, step=0.1, half=14.0):
    """Lux (3,) on a surface at ``point`` that faces the floor: the floor's first bounce, summed over squares of ``step``."""
    side = np.arange(-half, half, step) + step / 2
    x, z = (grid.ravel() for grid in np.meshgrid(side, side))
    ground = np.stack([x, np.zeros_like(x), z], axis=1) + np.array([lamp.position[0], 0, lamp.position[2]])
    between = ground - point
    squared = (between**2).sum(axis=1)
    form = point[1] ** 2 / squared**2 / np.pi * step**2
    return ALBEDO * form @ direct_irradiance(lamp, ground)


@pytest.mark.parametrize("lamp", [POINT, SPOT, AREA], ids=lambda lamp: lamp.kind)
@pytest.mark.parametrize("point", [(1.0, 2.0, 1.0), (-4.0, 5.0, 3.0)])
def test_the_first_bounce_is_what_quadrature_says(floor, lamp, point):
    found = floor.surface_irradiance(np.array([point]), DOWN_NORMAL, DARK, [lamp], samples=16384)
    truth = bounced_irradiance(lamp, np.array(point))[None]
    assert_agrees(found, truth, 2e-3)  # the receiver's offset of 2 mm; squares of 10 cm are worth 5e-4 at a spot's edge
    assert (found.standard_error < 0.02 * truth).all()  # otherwise agreement would mean nothing


SPHERE_ALBEDO = 0.6


@pytest.fixture(scope="module")
def integrating_sphere():
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=5.0)
    shape = (len(mesh.faces), 3)
    albedo, emission = np.full(shape, SPHERE_ALBEDO, np.float32), np.zeros(shape, np.float32)
    return PathTracer(np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int32), albedo, emission), mesh


@pytest.mark.parametrize("lamp", [POINT, SPOT, AREA], ids=lambda lamp: lamp.kind)
def test_an_integrating_sphere_measures_the_lumens_of_any_lamp_anywhere(integrating_sphere, lamp):
    """Whatever leaves any part of a sphere's wall lights all of it alike: after the direct light it is a furnace."""
    tracer, mesh = integrating_sphere
    # A range so long that the window takes nothing.
    inside = replace(lamp, position=(1.0, 2.0, -0.5), range_m=1e4)
    color = np.array(WARM) / (LUMINANCE_FROM_RGB @ np.array(WARM))
    truth = color * lamp.lumens / float(mesh.area) * SPHERE_ALBEDO / (1 - SPHERE_ALBEDO)
    some = [0, 1234, 4321]
    points, normals = np.asarray(mesh.triangles_center[some]), -np.asarray(mesh.face_normals[some])
    found = tracer.surface_irradiance(points, normals, DARK, [inside], samples=8192)
    assert_agrees(found, np.broadcast_to(truth, (3, 3)), 5e-3)  # 5120 flat triangles are no sphere
    assert (found.standard_error < 0.03 * truth).all()


def test_lamps_shine_on_the_receiver_only_by_way_of_surfaces(floor):
    on_ground = floor.surface_irradiance(np.zeros((1, 3)), UP, DARK, [POINT, SPOT, AREA], samples=64)
    assert not on_ground.mean.any()


@pytest.mark.parametrize("kind", ["point", "spot", "area"])
def test_a_closed_door_keeps_the_dark_room_exactly_dark(build, kind):
    rooms = build().box((0, 0, 0), (4, 3, 4), albedo=0.9).box((4, 0, 0), (8, 3, 4), albedo=0.9)  # one wall without thickness
    lamp = Lamp("lamp", kind, (3.9, 1.5, 2.0), 1e6, range_m=100.0, direction=(1.0, 0.0, 0.0))
    lit_and_dark = np.array([[1.0, 1.5, 2.0], [6.0, 1.5, 2.0], [4.01, 0.01, 0.01], [7.99, 2.99, 3.99]])
    mean = tracer_of(rooms.scene()).cube_irradiance(lit_and_dark, DARK, [lamp], samples=8192).mean
    assert (mean[0] > 1000).all()
    assert not mean[1:].any()


def test_nothing_is_lit_out_of_range_or_behind_an_area(floor):
    near = replace(POINT, range_m=2.9)  # it hangs 3 m above the floor
    looks_up = replace(AREA, direction=(0.0, 1.0, 0.0))
    looks_away = replace(SPOT, direction=(0.0, 1.0, 0.0))
    assert not floor.cube_irradiance(np.array([[0.0, 1.0, 0.0]]), DARK, [near, looks_up, looks_away], samples=4096).mean.any()


def random_lamps(count, half, seed):
    rng = np.random.default_rng(seed)
    lamps = []
    for number in range(count):
        x, z = rng.uniform(-half, half, 2)
        look = tuple((rng.normal(size=3) - [0, 2, 0]).tolist())
        kind = ("point", "spot", "area")[number % 3]
        color, lumens = tuple(rng.uniform(0.2, 1, 3).tolist()), float(10 ** rng.uniform(2.5, 4.5))
        lamps.append(
            Lamp(str(number), kind, (x, float(rng.uniform(2, 8)), z), lumens, color, float(rng.uniform(6, 30)), look, 80.0, (1.0, 0.5))
        )
    return lamps


def test_many_lamps_add_up(floor):
    """Each light adds to the others, whichever is drawn: beside the sum of quadratures of one lamp at a time."""
    lamps = random_lamps(40, 25.0, 3)
    points = np.array([[0.0, 3.0, 0.0], [15.0, 5.0, -10.0]])
    found = floor.surface_irradiance(points, np.repeat(DOWN_NORMAL, 2, axis=0), DARK, lamps, samples=1 << 16)
    truth = np.array([sum(bounced_irradiance(lamp, point, 0.25, lamp.range_m) for lamp in lamps) for point in points])
    assert_agrees(found, truth, 5e-3)  # squares of 25 cm under lamps 2 m up
    assert (found.standard_error < 0.02 * truth).all()


def test_standard_errors_are_calibrated_under_many_lamps(floor):
    lamps = [replace(POINT, position=(x, 4.0, z), range_m=20.0) for x in (-8.0, 0.0, 8.0) for z in (-8.0, 0.0, 8.0)]
    point = np.array([[1.0, 2.0, 1.0]])
    truth = sum(bounced_irradiance(lamp, point[0], half=20.0) for lamp in lamps)
    found = floor.surface_irradiance(np.repeat(point, 500, axis=0), np.repeat(DOWN_NORMAL, 500, axis=0), DARK, lamps, samples=1024)
    # The receiver's offset moves all by the same share.
    truth *= found.mean.mean(axis=0) / truth
    z = (found.mean[:, 0] - truth[0]) / found.standard_error[:, 0]
    assert stats.kstest(z, stats.t(df=7).cdf).pvalue > 1e-3


def test_two_runs_are_equal_whatever_the_threads(build):
    scene = build().ground().box((2, 0, 2), (6, 8, 6)).scene()
    lamps, points = random_lamps(20, 20.0, 1), np.array([[0.0, 1, 0], [7.0, 2, 4], [1.0, 9, 1], [3, 10, 3]])
    one, three = (tracer_of(scene, threads=n).cube_irradiance(points, DARK, lamps, samples=32768, seed=5).mean for n in (1, 3))
    assert one.any()
    np.testing.assert_array_equal(one, three)


def test_draws_average_to_the_sum_of_all_lamps():
    """At one point, without surfaces: the drawn lamp's light over its probability, against every lamp's own."""
    lamps = [lamp for lamp in random_lamps(30, 10.0, 7) if lamp.kind != "area"]
    points = np.repeat(np.array([[1.3, 0.0, -2.2]]), 200_000, axis=0)
    drawn = LampSampler(lamps).draw(points, np.random.default_rng(0))
    shares = drawn.irradiance * drawn.direction[:, 1:2]
    mean, error = shares.sum(axis=0) / len(points), shares.std(axis=0) / np.sqrt(len(points))
    truth = sum(direct_irradiance(lamp, points[:1])[0] for lamp in lamps)
    assert (np.abs(mean - truth) < Z_MAX * error + 1e-5 * truth).all()
    assert (error < 0.01 * truth).all()


def test_lamps_that_reach_nowhere_near_are_never_drawn():
    far = replace(POINT, position=(500.0, 3.0, 0.0))
    near = LampSampler([far, POINT, far]).draw(np.zeros((1000, 3)), np.random.default_rng(0))
    assert len(near.point) == 1000
    np.testing.assert_allclose(near.irradiance, np.repeat(near.irradiance[:1], 1000, axis=0), rtol=1e-6)
    assert len(LampSampler([far]).draw(np.zeros((10, 3)), np.random.default_rng(0)).point) == 0


@pytest.mark.parametrize("albedo", [0.3, 0.8])
def test_walls_of_a_closed_room_get_a_lamps_flux_as_often_as_light_returns(build, albedo):
    """What a lamp gives, walls absorb: their mean irradiance, without the lamp's own, is flux / area times rho / (1 - rho), in any room."""
    low, size = np.array([-5.0, 0.0, -6.0]), np.array([16.0, 8.0, 12.0])
    tracer = tracer_of(build().box(low, low + size, albedo, inward=True).scene())
    points, normals = [], []
    for axis in range(3):
        step = np.delete(np.meshgrid(*(np.arange(0.5, n) for n in np.where(np.arange(3) == axis, 1, size)), indexing="ij"), axis, 0)
        for side in (0, size[axis]):
            wall = np.insert(step.reshape(2, -1), axis, side, axis=0).T
            points.append(low + wall)
            normals.append(np.tile(np.eye(3)[axis] * (1 if side == 0 else -1), (len(wall), 1)))
    lamp = replace(POINT, range_m=1000.0)
    found = tracer.surface_irradiance(np.concatenate(points), np.concatenate(normals), DARK, lamps=(lamp,), samples=64)
    area = 2 * size @ np.roll(size, 1)
    assert len(found.mean) == area  # a point for each square metre
    flux = lamp.lumens * np.array(lamp.color) / (LUMINANCE_FROM_RGB @ np.array(lamp.color))
    mean, error = found.mean.mean(axis=0), np.sqrt((found.standard_error**2).sum(axis=0)) / area
    assert (error < 0.005 * mean).all()
    # Half a percent for squares of a metre, which are lit unevenly where the lamp hangs near.
    np.testing.assert_array_less(np.abs(mean - flux / area * albedo / (1 - albedo)), Z_MAX * error + 0.005 * mean)
