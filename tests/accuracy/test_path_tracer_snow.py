"""Snow in the path tracer: whiter where it lies, by the rule that the bake follows."""

import numpy as np
import pytest

from bake_jobs.path_tracer import PathTracer
from gi_core.constants import SNOW_ALBEDO
from gi_core.lighting import DirectionalLight, Lighting

NO_LIGHT = DirectionalLight(np.array([0.0, 1.0, 0.0]), np.zeros(3))
ALBEDO, SKY = 0.2, 1000.0
DOWN_FACE = 3
# Normal tails beyond 4.5 standard errors have odds of 1 in 150 000; seeds are fixed, so a pass stays a pass.
Z_MAX = 4.5
# Of a path that leaves through the cells of the sky nearest the horizon, and of float32 sums.
ROUNDING = 2e-3


def lighting(snow, sky=SKY):
    radiance = np.zeros((64, 128, 3), np.float32)
    radiance[:32] = sky
    return Lighting("", "", NO_LIGHT, NO_LIGHT, radiance, np.zeros((6, 3)), snow, 0.0, 0.0)


def tracer_of(scene):
    return PathTracer(scene.vertices, scene.triangles, scene.albedo, scene.emission)


def tilted(build, degrees):
    """A vast plane through the origin that rises along +X, and its normal."""
    angle = np.radians(degrees)
    along, normal = np.array([np.cos(angle), np.sin(angle), 0.0]), np.array([-np.sin(angle), np.cos(angle), 0.0])
    return tracer_of(build().quad(-1e4 * along - [0, 0, 1e4], (0, 0, 2e4), 2e4 * along, albedo=ALBEDO).scene()), normal


@pytest.mark.parametrize("snow", [0.0, 0.5, 1.0])
@pytest.mark.parametrize(("degrees", "stays"), [(0, 1.0), (44, 1.0), (60, (0.5 - 0.3) / (0.7071 - 0.3)), (75, 0.0)])
def test_a_slope_turns_as_white_as_its_snow(build, snow, degrees, stays):
    tracer, normal = tilted(build, degrees)
    above = normal[None] * 2
    received = np.pi * SKY * (1 + np.cos(np.radians(degrees))) / 2
    albedo = ALBEDO + snow * stays * (SNOW_ALBEDO - ALBEDO)
    found = tracer.surface_irradiance(above, -normal[None], lighting(snow), samples=8192)
    assert (np.abs(found.mean - albedo * received) <= Z_MAX * found.standard_error + ROUNDING * received).all()
    assert (found.standard_error < 0.01 * received).all()


def test_no_snow_lies_under_a_roof_nor_hangs_from_it(build):
    glow = 100.0
    roofed = build().ground((-1e4, -1e4), (1e4, 1e4), albedo=ALBEDO)
    roofed.quad((-1e4, 10, -1e4), (2e4, 0, 0), (0, 0, 2e4), albedo=0.0, emission=glow)
    dry, snowy = (
        tracer_of(roofed.scene()).cube_irradiance(np.array([[0.0, 5.0, 0.0]]), lighting(snow), samples=2048).mean for snow in (0.0, 1.0)
    )
    np.testing.assert_array_equal(dry, snowy)
    np.testing.assert_allclose(snowy[0, DOWN_FACE], ALBEDO * np.pi * glow, rtol=0.01)  # the noise of 2048 paths
