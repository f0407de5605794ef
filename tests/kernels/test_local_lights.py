"""Lamps on surfels: known answers of photometry and shadow, kernels against their NumPy twins, nothing left behind by a lamp."""

import math
from dataclasses import replace

import numpy as np
import pytest

from bake_jobs.rays import RayScene
from bake_jobs.solids import boxes
from gi_core import lights_twin
from gi_core.device import Device, available_devices, describe, shared_device
from gi_core.errors import InputError
from gi_core.geometry_file import Geometry
from gi_core.grid import SectorIndex
from gi_core.layout import SHADOW_END_M, SHADOW_START_M
from gi_core.light_geometry import ShadowGeometry
from gi_core.light_plan import SurfelBounds, touching_lamps
from gi_core.light_surfels import SurfelLights
from gi_core.lights import light_records
from gi_core.lights_twin import shadow_triangles, surfel_places
from gi_core.spectrum import LUMINANCE_FROM_RGB
from gi_core.world import Lamp

# The range window takes (d / range)^4 twice: with this range it is below 1e-7 of the light within 10 m.
FAR = 1000.0
# A dozen float32 operations.
EXACT = 2e-6


@pytest.fixture(scope="module", params=[describe(d) for d in available_devices()])
def device(request) -> Device:
    return shared_device(request.param)


def quads(*corners_and_edges) -> np.ndarray:
    """Triangles (2 n, 3, 3) of parallelograms (corner, edge, edge)."""
    triangles = []
    for corner, a, b in corners_and_edges:
        c, a, b = (np.asarray(v, np.float64) for v in (corner, a, b))
        triangles += [[c, c + a, c + a + b], [c, c + a + b, c + b]]
    return np.array(triangles)


HERE = SectorIndex(0, 0)


def geometry_of(triangles: np.ndarray, index: SectorIndex = HERE) -> ShadowGeometry:
    """All triangles (n, 3, 3) in one sector's file."""
    count = len(triangles)
    flat = np.zeros((count, 3), np.float32)
    geometry = Geometry(np.reshape(triangles, (-1, 3)), np.arange(3 * count, dtype=np.int32).reshape(-1, 3), flat, flat)
    return ShadowGeometry({index: geometry}.__getitem__, [index])


NOTHING = geometry_of(np.zeros((0, 3, 3)))


def at_points(sector, points, normals):
    """A sector with surfels at these sector-local points; everything else of it stays as it is, unused here."""
    count = sector.surfel_count
    position, normal = np.zeros((count, 3), np.float32), np.tile(np.float32([0, 1, 0]), (count, 1))
    # Those without a point of their own lie far below and face away from any lamp.
    position[:] = (0, -5000, 0)
    normal[:] = (0, -1, 0)
    position[: len(points)], normal[: len(points)] = points, normals
    return replace(sector, surfel_position=position, surfel_normal=normal)


def light_of(device, sector, lamps, shadows=NOTHING, dynamic=()) -> np.ndarray:
    """(S, 3) float32 [lx]; zeros when no lamp touches."""
    lit = SurfelLights(device, sector, shadows)
    lit.set_static(lamps)
    lit.set_dynamic(dynamic)
    return read(device, lit, sector)


def read(device, lit, sector) -> np.ndarray:
    values = np.zeros((sector.surfel_count, 4), np.float32)
    if lit.buffer is not None:
        device.read(lit.buffer, values)
    assert (values[:, 3] == 0).all()
    return values[:, :3]


def test_a_point_lamp_over_a_plane_follows_the_inverse_square_and_the_cosine(device, make_sector):
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(0, 20, 40), np.zeros(40), rng.uniform(0, 20, 40)])
    sector = at_points(make_sector(1, surfels=40), points, [0, 1, 0])
    light = light_of(device, sector, [Lamp("", "point", (8, 5, 9), 4000, (1, 0.5, 0.25), FAR)])
    distance = np.linalg.norm(points - (8, 5, 9), axis=1)
    expected = 4000 / (4 * math.pi) * (5 / distance) / distance**2
    np.testing.assert_allclose(light @ LUMINANCE_FROM_RGB, expected, rtol=EXACT)
    np.testing.assert_allclose(light, light[:, :1] * (1, 0.5, 0.25), rtol=EXACT)


@pytest.mark.parametrize("cone", [1.0, 40.0, 120.0, 180.0])
def test_a_spot_gives_its_lumens_and_nothing_outside_of_its_cone(device, make_sector, cone):
    # Surfels on a sphere of 2 m about the lamp, facing it, evenly spaced in the cosine: their mean is flux / area.
    count = 4096
    edge = math.cos(math.radians(cone / 2))
    cosine = np.concatenate([1 - (np.arange(count) + 0.5) / count * (1 - edge), edge - (np.arange(1, 50) / 50) * (edge + 1)])
    away = np.column_stack([np.sqrt(1 - cosine**2), -cosine, np.zeros(len(cosine))])
    sector = at_points(make_sector(2, surfels=len(cosine)), (30, 20, 30) + 2 * away, -away)
    light = light_of(device, sector, [Lamp("", "spot", (30, 20, 30), 1000, (1, 1, 1), FAR, (0, -3, 0), cone)])[:, 1]
    assert (light[count:] == 0).all()
    flux = float(light[:count].mean(dtype=np.float64)) * 2 * math.pi * 2**2 * (1 - edge)
    # A cone of one degree is 4e-5 wide in the cosine, of which float32 knows 6e-8.
    assert flux == pytest.approx(1000, rel=5e-3 if cone == 1 else 1e-4)
    assert light[0] == pytest.approx(float(light.max()), rel=1e-5)  # positions round to 2e-6 m


def test_an_area_lamp_is_a_cosine_source_from_afar_and_fills_the_view_from_close_by(device, make_sector):
    lamp = Lamp("", "area", (20, 10, 20), 5000, (1, 1, 1), FAR, (0, -1, 0), size=(0.4, 0.3))
    below = np.array([[20, y, 20] for y in (0.0, 7.0, 9.0, 9.999)] + [[26.0, 4, 20], [20, 11, 20]])
    sector = at_points(make_sector(3, surfels=6), below, [0, 1, 0])
    light = light_of(device, sector, [lamp])[:, 1]
    radiance = 5000 / (math.pi * 0.4 * 0.3)
    for i, distance in ((0, 10.0), (1, 3.0)):
        # Half of the solid angle's next term: (half diagonal / distance)^2.
        assert light[i] == pytest.approx(radiance * 0.12 / distance**2, rel=0.25**2 / distance**2 + 1e-5)
    # One metre below its centre: the textbook's parallel rectangle, four quarters of 0.2 x 0.15 m.
    a, b = 0.2, 0.15
    quarter = (a / math.hypot(a, 1) * math.atan(b / math.hypot(a, 1)) + b / math.hypot(b, 1) * math.atan(a / math.hypot(b, 1))) / (
        2 * math.pi
    )
    assert light[2] == pytest.approx(4 * quarter * math.pi * radiance, rel=1e-5)
    # A millimetre below it hardly anything but the lamp is seen: pi L.
    assert light[3] == pytest.approx(math.pi * radiance, rel=1e-3)
    assert light[4] == pytest.approx(radiance * 0.12 * 0.5 / 72, rel=1e-3)
    assert light[5] == 0  # it shines downwards only


def test_a_wall_between_lamp_and_surfel_blocks_all_and_beside_it_nothing(device, make_sector):
    # A wall at x = 10 from z = 0 to 10, 4 m high; a lamp on one side of it, a row of surfels on the other.
    wall = geometry_of(quads(((10, 0, 0), (0, 0, 10), (0, 4, 0))))
    points = np.array([[15.0, 0, z] for z in np.arange(0.5, 30, 1)])
    sector = at_points(make_sector(4, surfels=30), points, [0, 1, 0])
    lamp = Lamp("", "point", (5, 2, 5), 1000, (1, 1, 1), FAR)
    light, free = (light_of(device, sector, [lamp], shadows)[:, 1] for shadows in (wall, NOTHING))
    # The ray to the surfel at z passes the wall's plane half way, at (z + 5) / 2, and 1 m high: blocked while that is below 10.
    blocked = points[:, 2] < 15
    assert (free > 0).all()
    assert (light[blocked] == 0).all()
    np.testing.assert_array_equal(light[~blocked], free[~blocked])


def test_a_ray_along_the_edge_between_two_triangles_does_not_slip_through(device, make_sector):
    wall = geometry_of(quads(((10, -10, -10), (0, 0, 20), (0, 20, 0))))
    # All rays pass the diagonal that the wall's two triangles share.
    points = np.array([[20.0, d, d] for d in np.linspace(-8, 8, 33)])
    sector = at_points(make_sector(5, surfels=33), points, [-1, 0, 0])
    lamp = Lamp("", "point", (0, 0, 0), 1000, (1, 1, 1), FAR)
    assert not light_of(device, sector, [lamp], wall).any()


def test_half_an_area_lamp_behind_a_wall_gives_about_half(device, make_sector):
    # An edge that hides the lamp's half on the far side of x = 10 from a surfel straight below it.
    shade = geometry_of(quads(((10, 5, 0), (20, 0, 0), (0, 0, 20))))
    sector = at_points(make_sector(6, surfels=1), [[10, 0, 10]], [0, 1, 0])
    lamp = Lamp("", "area", (10, 10, 10), 1000, (1, 1, 1), FAR, (0, -1, 0), size=(2.0, 2.0))
    half, full = (light_of(device, sector, [lamp], shadows)[0, 1] for shadows in (shade, NOTHING))
    assert half == pytest.approx(full / 2, rel=1e-6)


def test_a_lamp_on_a_ceiling_shines_and_one_inside_a_box_does_not(device, make_sector):
    ceiling = quads(((0, 3, 0), (10, 0, 0), (0, 0, 10)))
    box = quads(*[((4, y, 4), (2, 0, 0), (0, 0, 2)) for y in (1, 2)], *[((x, 1, 4), (0, 1, 0), (0, 0, 2)) for x in (4, 6)],
                *[((4, 1, z), (0, 1, 0), (2, 0, 0)) for z in (4, 6)])  # fmt: skip
    sector = at_points(make_sector(7, surfels=3), [[1, 0, 1], [5, 0, 5], [5, 2.5, 5]], [[0, 1, 0], [0, 1, 0], [0, -1, 0]])
    on_ceiling = Lamp("", "area", (5, 3, 5), 1000, (1, 1, 1), FAR, (0, -1, 0), size=(0.5, 0.5))
    assert light_of(device, sector, [on_ceiling], geometry_of(ceiling))[0].min() > 0
    assert not light_of(device, sector, [Lamp("", "point", (5, 1.5, 5), 1000, range_m=FAR)], geometry_of(box)).any()


def test_a_lamp_of_a_billion_lumens_on_a_surfel_is_finite(device, make_sector):
    sector = at_points(make_sector(8, surfels=3), [[5, 0, 5], [5, 0.01, 5], [5, 0, 6]], [0, 1, 0])
    for kind in ("point", "spot", "area"):
        for lumens in (1e9, 1e12):
            light = light_of(device, sector, [Lamp("", kind, (5, 0, 5), lumens, (0, 0, 1e6), FAR)])
            assert np.isfinite(light).all()
            assert (light >= 0).all()
    above = light_of(device, sector, [Lamp("", "point", (5, 1, 5), 1e9, range_m=FAR)])
    assert above[0, 1] == pytest.approx(1e9 / (4 * math.pi), rel=EXACT)


def test_light_fades_to_nothing_at_its_range_without_a_step(device, make_sector):
    points = np.array([[x, 0.0, 0] for x in np.linspace(0, 12, 1201)])
    sector = at_points(make_sector(9, surfels=1201), points, [-1, 0, 0])
    light = light_of(device, sector, [Lamp("", "point", (-1, 0, 0), 1000, range_m=10.0)])[:, 1]
    beyond = points[:, 0] >= 9
    assert (light[beyond] == 0).all()
    assert (light[~beyond] > 0).all()
    assert (np.diff(light[~beyond]) < 0).all()
    # A tenth of the range before its end the window is (1 - 0.9^4)^2 = 0.118; at a fifth it takes 0.3 %.
    assert light[800] == pytest.approx(1000 / (4 * math.pi) / 81 * (1 - 0.9**4) ** 2, rel=1e-4)
    assert light[100] == pytest.approx(1000 / (4 * math.pi) / 4 * 0.9968, rel=1e-4)


def random_lamps(rng: np.random.Generator, count: int) -> list[Lamp]:
    return [
        Lamp(
            str(i),
            ("point", "spot", "area")[i % 3],
            tuple(rng.uniform(-20, 90, 3).tolist()),
            float(rng.uniform(100, 20_000)),
            tuple(rng.uniform(0.1, 1, 3).tolist()),
            float(rng.uniform(5, 120)),
            tuple(rng.normal(size=3).tolist()),
            float(rng.uniform(10, 180)),
            tuple(rng.uniform(0.1, 8, 2).tolist()),
        )
        for i in range(count)
    ]


def in_one_column(sector, seed):
    """The sector with its surfels spread over its own 64 m cube, so that lamps and triangles find many."""
    spread = np.random.default_rng(seed).uniform(0, 64, (sector.surfel_count, 3))
    return replace(sector, surfel_position=spread.astype(np.float32))


@pytest.mark.parametrize(("seed", "lamps", "surfels", "triangles"), [(1, 12, 500, 60), (2, 40, 333, 8), (3, 40, 1, 5), (4, 70, 64, 0)])
def test_the_kernels_equal_their_twins_on_random_sectors(device, make_sector, seed, lamps, surfels, triangles):
    rng = np.random.default_rng(seed)
    sector = in_one_column(make_sector(seed, surfels=surfels), seed)
    shadows = geometry_of(rng.uniform(-30, 100, (triangles, 1, 3)) + rng.normal(size=(triangles, 3, 3)) * 12)
    given = random_lamps(rng, lamps)
    touching = touching_lamps(given, SurfelBounds(sector))
    records = light_records([t.lamp for t in touching], sector.index.origin)
    near = [shadow_triangles(shadows, t, sector.index.origin) for t in touching]
    expected = lights_twin.light_surfels(records, surfel_places(sector), near)
    found = light_of(device, sector, given, shadows)
    # Sums of up to 70 lamps. A corner of a far polygon cancels to 1e-4 of the lamp's light where only a sliver is above the horizon.
    close = np.isclose(found, expected, rtol=3e-5, atol=1e-5 * expected.max(initial=0)).all(axis=1)
    # A ray that grazes an edge may fall on either side of it: one in a thousand surfels, at most.
    assert (~close).sum() <= surfels // 1000
    assert expected.any()
    if triangles > 5:
        assert (light_of(device, sector, given) > 1.01 * found).any(), "no triangle stood in any lamp's way"


def test_shadows_are_those_that_embree_traces(device, make_sector):
    rng = np.random.default_rng(21)
    low = rng.uniform(0, 56, (25, 3))
    solids = [boxes(corner, corner + rng.uniform(2, 8, 3)) for corner in low]
    triangles = np.concatenate([vertices[faces] for vertices, faces in solids])
    rays = RayScene(triangles.reshape(-1, 3), np.arange(3 * len(triangles), dtype=np.int32).reshape(-1, 3))
    sector = in_one_column(make_sector(21, surfels=2000), 21)
    places = surfel_places(sector)
    start = places["position"] + places["normal"] * np.float32(SHADOW_START_M)
    shadows = geometry_of(triangles)
    for lamp in [replace(lamp, kind="point", range_m=FAR) for lamp in random_lamps(rng, 6)]:
        light, free = (light_of(device, sector, [lamp], between)[:, 1] for between in (shadows, NOTHING))
        way = np.array(lamp.position) - start
        distance = np.linalg.norm(way, axis=1)
        unit = (way / distance[:, None]).astype(np.float32)
        blocked = rays.occluded(start.astype(np.float64), unit, (distance - SHADOW_END_M).astype(np.float32))
        # Two float32 roundings of a ray that grazes an edge differ: one in a thousand.
        assert ((light == np.where(blocked, 0, free)) | (free == 0)).mean() > 0.999
        assert 0.1 < blocked[free > 0].mean() < 0.95


def test_two_hundred_lamps_are_all_there(device, make_sector):
    rng = np.random.default_rng(11)
    sector = in_one_column(make_sector(11, surfels=700), 11)
    lamps = random_lamps(rng, 200)
    together = light_of(device, sector, lamps)
    alone = np.sum([light_of(device, sector, [lamp]).astype(np.float64) for lamp in lamps], axis=0)
    np.testing.assert_allclose(together, alone, rtol=2e-5)  # 200 float32 additions
    assert len(touching_lamps(lamps, SurfelBounds(sector))) > 150


def test_a_lamp_that_goes_off_gives_the_first_bytes_back(device, make_sector):
    rng = np.random.default_rng(12)
    sector = in_one_column(make_sector(12, surfels=400), 12)
    shadows = geometry_of(rng.uniform(0, 64, (30, 3, 3)))
    static, dynamic = random_lamps(rng, 8), random_lamps(rng, 5)
    lit = SurfelLights(device, sector, shadows)
    lit.set_static(static)
    first, buffer = read(device, lit, sector), lit.buffer
    for step in range(50):
        lit.set_dynamic([replace(lamp, position=(step, 5.0, lamp.position[2])) for lamp in dynamic])
    lit.set_dynamic(dynamic)
    both = read(device, lit, sector)
    assert not np.array_equal(both, first)
    lit.set_dynamic([])
    assert read(device, lit, sector).tobytes() == first.tobytes()
    assert lit.buffer is buffer
    lit.set_static([])
    assert lit.buffer is None
    assert lit.nbytes == 0
    lit.set_dynamic(dynamic)
    lit.set_static(static)
    assert read(device, lit, sector).tobytes() == both.tobytes()


def test_lamps_that_do_not_touch_cost_nothing(device, make_sector):
    sector = make_sector(13, surfels=50)

    def never(index):
        raise AssertionError("no geometry is needed")

    lit = SurfelLights(device, sector, ShadowGeometry(never, [SectorIndex(0, 0)]))
    lit.set_static([Lamp("", "point", (5000, 0, 0), 1e9)])
    lit.set_dynamic([Lamp("", "point", (0, -5000, 0), 1e9)])
    assert lit.buffer is None
    assert lit.nbytes == 0
    empty = make_sector(13, surfels=0)
    assert light_of(device, empty, [Lamp("", "point", (5, 0, 0), 1e9)]).shape == (0, 3)


def test_zero_lumens_or_a_black_lamp_give_zero(device, make_sector):
    sector = make_sector(14, surfels=100)
    for lamp in (Lamp("", "area", (30, 20, 30), 0, range_m=FAR), Lamp("", "point", (30, 20, 30), 5, (0, 0, 0), FAR)):
        assert not light_of(device, sector, [lamp]).any()


def test_a_touching_lamp_out_of_its_ranges_is_refused_and_changes_nothing(device, make_sector):
    sector = make_sector(15, surfels=100)
    lit = SurfelLights(device, sector, NOTHING)
    lit.set_static([Lamp("good", "point", (30, 20, 30), 500, range_m=FAR)])
    before = read(device, lit, sector)
    with pytest.raises(InputError, match="lamp 'bad': direction"):
        lit.set_static([Lamp("bad", "spot", (30, 20, 30), 500, range_m=FAR, direction=(0, 0, 0))])
    assert read(device, lit, sector).tobytes() == before.tobytes()


def test_far_from_the_worlds_origin_nothing_changes(device, make_sector):
    rng = np.random.default_rng(16)
    here = in_one_column(make_sector(16, surfels=300), 16)
    away = replace(here, index=SectorIndex(800, -800))  # 51.2 km each way
    triangles = rng.integers(-64 * 8, 128 * 8, (40, 3, 3)) / 8.0
    lamps = [replace(lamp, position=tuple(np.round(lamp.position, 1).tolist())) for lamp in random_lamps(rng, 9)]
    moved = [replace(lamp, position=tuple((lamp.position + away.index.origin).tolist())) for lamp in lamps]
    near = light_of(device, here, lamps, geometry_of(triangles))
    far = light_of(device, away, moved, geometry_of(triangles + away.index.origin, away.index))
    # A double 50 km from the origin is good to 7e-12 m; sector-local float32 to 4e-6 m here as there.
    np.testing.assert_allclose(far, near, rtol=1e-5, atol=1e-5 * near.max())


def test_a_lamp_that_flickers_keeps_its_shadows_and_one_that_moves_does_not(device, make_sector):
    rng = np.random.default_rng(17)
    sector = in_one_column(make_sector(17, surfels=300), 17)
    shadows = geometry_of(rng.uniform(0, 64, (30, 3, 3)))
    lamps = random_lamps(rng, 40)
    lit = SurfelLights(device, sector, shadows)
    lit.set_dynamic(lamps)
    planes = [shadow.plane for shadow in lit._dynamic.shadows if shadow]
    assert len(planes) > 30
    dimmed = [replace(lamp, lumens=lamp.lumens * 0.3, color=(0.2, 0.9, 0.4)) for lamp in lamps]
    lit.set_dynamic(dimmed)
    assert [shadow.plane for shadow in lit._dynamic.shadows if shadow] == planes
    assert read(device, lit, sector).tobytes() == light_of(device, sector, dimmed, shadows).tobytes()
    with pytest.raises(InputError, match="lumens"):
        lit.set_dynamic([replace(lamp, lumens=-1.0) for lamp in lamps])
    for others in (lamps[:-1], lamps[::-1], [replace(lamp, cone_degrees=20.0) for lamp in lamps]):
        lit.set_dynamic(others)
        assert read(device, lit, sector).tobytes() == light_of(device, sector, others, shadows).tobytes()
    moved = [replace(lamp, position=(5.0, float(i), 9.0)) for i, lamp in enumerate(lamps)]
    lit.set_dynamic(moved)
    assert read(device, lit, sector).tobytes() == light_of(device, sector, moved, shadows).tobytes()
    held = lit.nbytes
    for _ in range(20):  # planes are used again
        lit.set_dynamic(lamps)
        lit.set_dynamic(moved)
    assert lit.nbytes == held
    lit.set_dynamic([])
    for brightened in (lamps, dimmed):
        lit.set_static(brightened)
        assert read(device, lit, sector).tobytes() == light_of(device, sector, brightened, shadows).tobytes()


def split_by_sector(triangles: np.ndarray, kept_bytes: int = 1 << 28) -> ShadowGeometry:
    """Triangles (n, 3, 3) in files of the sectors that their first corners lie in; each must lie in that sector's column."""
    index = [SectorIndex(*np.floor(t[0, [0, 2]] / 64).astype(int).tolist()) for t in triangles]
    files = {}
    for i in set(index):
        own = triangles[[j == i for j in index]]
        flat = np.zeros((len(own), 3), np.float32)
        files[i] = Geometry(own.reshape(-1, 3), np.arange(3 * len(own), dtype=np.int32).reshape(-1, 3), flat, flat)
    return ShadowGeometry(files.__getitem__, files, kept_bytes)


def triangles_of_four_sectors(rng: np.random.Generator, count: int) -> np.ndarray:
    corner = rng.uniform(0, 128, (count, 1, 3)) * (1, 0.5, 1) - (64, 0, 64)
    cell = np.floor(corner / 64) * 64
    triangles = corner + rng.normal(size=(count, 3, 3)) * 8
    triangles[..., [0, 2]] = np.clip(triangles, cell, cell + 63.999)[..., [0, 2]]
    return triangles


@pytest.mark.parametrize(("kept_bytes", "groups"), [(1 << 28, 1), (12_000, 2), (1, 4)])
def test_shadows_fall_across_sectors_and_do_not_depend_on_what_fits_on_the_device(device, make_sector, kept_bytes, groups):
    rng = np.random.default_rng(31)
    sector = in_one_column(make_sector(31, surfels=400), 31)
    triangles = triangles_of_four_sectors(rng, 200)
    given = random_lamps(rng, 20)
    shadows = split_by_sector(triangles, kept_bytes)
    found = light_of(device, sector, given, shadows)
    everywhere = shadows.sectors_in(np.full(3, -1e6), np.full(3, 1e6))
    assert len(everywhere) == 4
    assert len(list(shadows.on_device(device).groups(everywhere))) == groups
    assert found.tobytes() == light_of(device, sector, given, split_by_sector(triangles)).tobytes()
    touching = touching_lamps(given, SurfelBounds(sector))
    near = [shadow_triangles(shadows, t, sector.index.origin) for t in touching]
    expected = lights_twin.light_surfels(light_records([t.lamp for t in touching], sector.index.origin), surfel_places(sector), near)
    assert np.isclose(found, expected, rtol=3e-5, atol=1e-5 * expected.max()).all(axis=1).sum() >= 399  # one may graze an edge
    here = split_by_sector(triangles[(triangles[:, 0, [0, 2]] >= 0).all(axis=1)])
    assert (light_of(device, sector, given, here) > 1.01 * found).any(), "no triangle of a neighbour stood in any lamp's way"


def test_whatever_was_lit_before_the_same_lamps_give_the_same_bytes(device, make_sector):
    rng = np.random.default_rng(32)
    sector = in_one_column(make_sector(32, surfels=500), 32)
    shadows = split_by_sector(triangles_of_four_sectors(rng, 60))
    lists = [random_lamps(rng, 12), random_lamps(rng, 12)]
    lit = SurfelLights(device, sector, shadows)
    for _ in range(60):
        which = int(rng.integers(2))
        lamps, what, i = list(lists[which]), int(rng.integers(6)), int(rng.integers(100))
        other = random_lamps(rng, 3)[int(rng.integers(3))]
        if what == 0 or not lamps:
            lamps.insert(i % (len(lamps) + 1), other)
        elif what == 1:
            del lamps[i % len(lamps)]
        elif what == 2:
            lamps[i % len(lamps)] = replace(lamps[i % len(lamps)], lumens=float(rng.uniform(1, 1e4)))
        elif what == 3:
            lamps.append(lamps[i % len(lamps)])  # twice
        elif what == 4:
            lamps.append(replace(lists[1 - which][0]) if lists[1 - which] else other)  # as one of the other list
        else:
            lamps[i % len(lamps)] = replace(other, range_m=12.0)
        lists[which] = lamps
        (lit.set_static if which == 0 else lit.set_dynamic)(lamps)
        if rng.random() < 0.4:
            assert read(device, lit, sector).tobytes() == light_of(device, sector, lists[0], shadows, lists[1]).tobytes()
    assert read(device, lit, sector).any()
    lit.set_static([])
    lit.set_dynamic([])
    assert lit.nbytes == 0


def test_of_many_lamps_only_the_one_that_moved_is_traced(device, make_sector, monkeypatch):
    rng = np.random.default_rng(33)
    sector = in_one_column(make_sector(33, surfels=300), 33)
    lamps = [replace(lamp, kind="point") for lamp in random_lamps(rng, 300)]
    lit = SurfelLights(device, sector, geometry_of(rng.uniform(0, 64, (30, 3, 3))))
    launched = []
    run = SurfelLights._run

    def spy(self, name, size, arguments):
        launched.append((name, size[1]))
        run(self, name, size, arguments)

    monkeypatch.setattr(SurfelLights, "_run", spy)
    lit.set_dynamic(lamps)
    assert sum(planes for name, planes in launched if name == "trace_shadows") == len(touching_lamps(lamps, SurfelBounds(sector))) > 250
    for other in (replace(lamps[70], position=(20.0, 9.0, 30.0)), replace(lamps[70], position=(30.0, 9.0, 30.0))):
        launched.clear()
        lamps[70] = other
        lit.set_dynamic(lamps)
        assert [planes for name, planes in launched if name == "trace_shadows"] == [1]
    launched.clear()
    lit.set_dynamic([*lamps[:9], replace(lamps[9], lumens=7.0), *lamps[10:], replace(lamps[0], position=(9e5, 0.0, 0.0))])
    assert all(name == "light_surfels" for name, _ in launched)
    assert launched
    launched.clear()
    lit.set_dynamic([*lamps[:9], replace(lamps[9], lumens=7.0), *lamps[10:], replace(lamps[0], position=(8e5, 0.0, 0.0))])
    assert launched == []  # what moves far away costs nothing here
