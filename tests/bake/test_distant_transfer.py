"""Transfers of distant texels: known answers, the relighter's own fixed point, and that light is linear."""

from dataclasses import replace

import numpy as np
import pytest

from bake_jobs.distant_transfer import TransferBaker, lamplight, of_texel
from bake_jobs.rays import RayScene
from bake_jobs.scene import Scene
from gi_core import lights_twin, relight_twin, sector_file
from gi_core.basis import conversion
from gi_core.constants import SNOW_ALBEDO
from gi_core.grid import SectorIndex
from gi_core.layout import DIRECTIONAL_LIGHT, SHADOW_TRIANGLE
from gi_core.lighting import DirectionalLight, Lighting
from gi_core.lights import light_records
from gi_core.relight_input import RelightInput, relight_input
from gi_core.sector import PROBE_IN_MARGIN, Sector
from gi_core.sun_table import SunTable
from gi_core.world import Lamp, Location

TABLE = SunTable.build(Location(), 15.0, 15.0)
NOTHING = Scene(np.zeros((1, 3)), np.zeros((0, 3), np.int32), np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32))
UNLIT = DirectionalLight(np.array([0.0, 1.0, 0.0]), np.zeros(3))


def lighting(sun: DirectionalLight = UNLIT, sky: float = 0.0, snow: float = 0.0, time: str = "2024-06-21T12:00:00") -> Lighting:
    """A sun and a uniform sky of a radiance."""
    radiance = np.zeros((64, 128, 3), np.float32)
    radiance[:32] = sky
    cube = sky * np.pi * np.array([0.5, 0.5, 1.0, 0.0, 0.5, 0.5])[:, None] * np.ones(3)
    return Lighting(time, "made up", sun, UNLIT, radiance, cube, snow, 0.0, 10.0)


def sun_at(height_degrees: float, turn_degrees: float = 200.0, irradiance: float = 1e5) -> DirectionalLight:
    height, turn = np.radians([height_degrees, turn_degrees])
    direction = np.array([np.cos(height) * np.cos(turn), np.sin(height), np.cos(height) * np.sin(turn)])
    return DirectionalLight(direction, irradiance * np.array([1.0, 0.9, 0.7]))


def texel_of(sector: Sector, light: Lighting, table: SunTable, sky: str = "faces", patches: int = 6, scene: Scene = NOTHING) -> np.ndarray:
    """(6, 3): the texel under a light."""
    transfer = TransferBaker(scene, table.directions, patches).transfer(sector)
    return transfer.light(relight_input(light, table, sky, patches), light)[0]


@pytest.fixture(scope="module")
def open_plane(build, bake_arrays) -> Sector:
    """Level ground of albedo 0.3, 0.5 and 0.7, as a file would have it."""
    scene = build().ground(albedo=(0.3, 0.5, 0.7)).scene()
    return sector_file.quantised(bake_arrays(scene, sun_directions=TABLE.directions, grid_spacing_m=16.0, rays_per_face_edge=8)[0], 6)


@pytest.mark.parametrize("height", [2.0, 5.0, 20.0, 60.0])
def test_a_face_that_looks_at_open_ground_gets_what_the_ground_sends(open_plane, height):
    sun = sun_at(height)
    found = texel_of(open_plane, lighting(sun, sky=1000.0), TABLE)
    arrives = sun.irradiance * np.sin(np.radians(height)) + 1000.0 * np.pi
    # Codes of albedos are good to 0.5 %, those of factors to 0.4 %, half floats to 0.05 %; and the dome's rays stop 8 to an edge.
    np.testing.assert_allclose(found[3], np.array([0.3, 0.5, 0.7]) * arrives, rtol=0.01)
    np.testing.assert_allclose(found[2], 1000.0 * np.pi, rtol=0.01)
    # Half of what a side looks at is ground.
    np.testing.assert_allclose(found[[0, 1, 4, 5]], np.broadcast_to((found[2] + found[3]) / 2, (4, 3)), rtol=0.03)


def test_under_snow_open_ground_sends_what_snow_does(open_plane):
    found = texel_of(open_plane, lighting(sky=1000.0, snow=1.0), TABLE)
    np.testing.assert_allclose(found[3], SNOW_ALBEDO * 1000.0 * np.pi, rtol=0.01)


@pytest.mark.parametrize(("basis", "patches"), [(6, 6), (4, 20), (9, 20)])
@pytest.mark.parametrize("snow", [0.0, 1.0])
def test_a_texel_is_the_mean_of_the_probes_that_the_relighter_lights(make_sector, basis, patches, snow):
    """At the table's own suns, between which the relighter blends shadows alone and a texel all of the light."""
    rng = np.random.default_rng(basis)
    planes = 12
    sector = make_sector(seed=basis, feedback=3, patches=patches, basis=basis, planes=planes, emits=True)
    sector = replace(sector, probe_flags=np.where(rng.random(sector.probe_count) < 0.3, PROBE_IN_MARGIN, 0).astype(np.uint8))
    sector = replace(sector, surfel_albedo=sector.surfel_albedo * np.float32(0.7))  # else harmonics of random numbers never settle
    suns = np.stack([sun_at(h, t).direction for h, t in zip(rng.uniform(5, 80, planes), rng.uniform(0, 360, planes), strict=True)])
    lights = np.zeros(1, DIRECTIONAL_LIGHT.dtype)
    lights["direction"][0, :3], lights["irradiance"][0, :3] = suns[7], (3e4, 2e4, 1e4)
    lights["plane"], lights["plane_weight"] = 7, (1, 0, 0, 0)
    given = RelightInput((rng.random((patches, 3)) * 1e4).astype(np.float32), lights, snow, "patches" if patches > 6 else "faces")
    scene = replace(NOTHING, emission=np.ones((1, 3), np.float32))
    transfer = TransferBaker(scene, suns, patches).transfer(sector)
    assert transfer.schedules == ("always",)
    probes = of_texel(sector.probe_room, sector.probe_flags)
    assert 0 < probes.sum() < sector.probe_count
    name = {6: "cube", 4: "sh1", 9: "sh2"}[basis]
    lit = relight_twin.solve(sector, given)[probes].mean(axis=0)
    found = transfer.light(given, lighting())[0]
    # Not ``convert``: ZH3, which it adds to sh1, is not linear.
    expected = np.maximum(np.einsum("fb,bc->fc", conversion(name, "cube"), lit), 0)
    # Bricks of made-up harmonics send less than nothing, which the relighter cuts off and a sum can't: a little of the peak.
    np.testing.assert_allclose(found, expected, rtol=2e-3, atol=(1e-3 if basis == 6 else 0.05) * expected.max())


def test_light_adds_up(make_sector):
    sector = make_sector(seed=3, planes=TABLE.plane_count)
    transfer = TransferBaker(NOTHING, TABLE.directions, 6).transfer(sector)

    def lit(light: Lighting) -> np.ndarray:
        return transfer.light(relight_input(light, TABLE), light)

    sun, sky = lit(lighting(sun_at(40.0))), lit(lighting(sky=2000.0))
    assert sun.min() >= 0
    assert sky.max() > 0
    np.testing.assert_allclose(lit(lighting(sun_at(40.0), sky=2000.0)), sun + sky, rtol=1e-5)
    np.testing.assert_allclose(lit(lighting(sun_at(40.0, irradiance=3e5))), 3 * sun, rtol=1e-5)
    bare, white = lit(lighting(sky=2000.0)), lit(lighting(sky=2000.0, snow=1.0))
    np.testing.assert_allclose(lit(lighting(sky=2000.0, snow=0.25)), 0.75 * bare + 0.25 * white, rtol=1e-5)
    assert not lit(lighting()).any()


def test_a_sector_without_an_outdoor_probe_has_a_dark_texel(make_sector):
    sector = make_sector(seed=4, planes=TABLE.plane_count)
    inside = replace(sector, probe_room=np.ones(sector.probe_count, np.uint16))
    for some in (inside, make_sector(seed=5, probes=0, planes=TABLE.plane_count), make_sector(seed=6, surfels=0, planes=TABLE.plane_count)):
        found = texel_of(some, lighting(sun_at(30.0)), TABLE)
        assert not found.any()


LAMPS = (
    Lamp("street", "point", (20.0, 5.0, 20.0), 8000.0, (1.0, 0.8, 0.6), 40.0, schedule="night"),
    Lamp("sign", "area", (30.0, 6.0, 32.0), 4000.0, direction=(0.0, -1.0, 0.3), size=(2.0, 1.0), range_m=50.0, schedule="18:00-23:00"),
    Lamp("stage", "spot", (40.0, 8.0, 40.0), 9000.0, direction=(0.2, -1.0, 0.0), cone_degrees=60.0, range_m=50.0, schedule="night"),
)


@pytest.fixture(scope="module")
def street(build, bake_arrays) -> tuple[Scene, Sector]:
    scene = build().ground(albedo=0.4).box((24, 0, 22), (30, 7, 28), 0.6).box((36, 0, 34), (39, 3, 44), 0.5).scene(lamps=LAMPS)
    return scene, sector_file.quantised(bake_arrays(scene, sun_directions=TABLE.directions, grid_spacing_m=8.0, rays_per_face_edge=8)[0], 6)


def test_lamps_shine_on_surfels_as_their_twin_says(street):
    scene, sector = street
    corners = scene.vertices[scene.triangles].astype(np.float32)
    triangles = np.zeros(len(corners), SHADOW_TRIANGLE.dtype)
    triangles["corner"] = corners[:, 0]
    triangles["edge_a"], triangles["edge_b"] = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    records = light_records(LAMPS, SectorIndex(0, 0).origin)
    expected = lights_twin.light_surfels(records, lights_twin.surfel_places(sector), [triangles] * len(LAMPS))
    found = lamplight(RayScene(scene.vertices, scene.triangles), sector, LAMPS)
    off = np.abs(found - expected).max(axis=1) > 1e-4 * expected.max()
    # Rays along an edge are either tracer's own.
    assert off.mean() < 0.01
    assert (expected > 0).any()


def test_lamps_glow_when_their_schedule_says(street):
    scene, sector = street
    transfer = TransferBaker(scene, TABLE.directions, 6).transfer(sector)
    assert transfer.schedules == ("18:00-23:00", "night")
    down = DirectionalLight(np.array([0.6, -0.8, 0.0]), np.zeros(3))

    def lit(time: str, sun: DirectionalLight) -> np.ndarray:
        light = lighting(sun, time=f"2024-06-21T{time}:00")
        return transfer.light(relight_input(light, TABLE), light)[0]

    sign, night, both, day = lit("19:00", UNLIT), lit("03:00", down), lit("22:00", down), lit("12:00", UNLIT)
    assert not day.any()
    assert sign.max() > 0.1
    np.testing.assert_allclose(both, sign + night, rtol=1e-5)
    light = lighting(down, time="2024-06-21T22:00:00")
    shine = lamplight(RayScene(scene.vertices, scene.triangles), sector, LAMPS)
    probes = of_texel(sector.probe_room, sector.probe_flags)
    solved = relight_twin.solve(sector, relight_input(light, TABLE), lamps=shine)[probes].mean(axis=0)
    np.testing.assert_allclose(both, solved, rtol=2e-3, atol=1e-3 * solved.max())
