"""The artists' panel: neutral by default, linear in every gain, and never part of the loop of bounces."""

from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gi_core.basis import evaluate
from gi_core.device import shared_device
from gi_core.errors import InputError
from gi_core.lighting import DirectionalLight, Lighting
from gi_core.lights import MAX_LUMENS, check_lamp
from gi_core.relight import Relighter
from gi_core.relight_input import relight_input
from gi_core.resident_sector import ResidentSector
from gi_core.settings import MAX_AMBIENT_LX, MAX_FACTOR, NEUTRAL, Settings
from gi_core.sun_table import SunTable
from gi_core.world import Lamp, Location

TABLE = SunTable.build(Location(), 30, 30)


def lighting(sun: float = 5e4, sky: float = 3e3) -> Lighting:
    radiance = np.zeros((64, 128, 3), np.float32)
    radiance[:32] = sky
    cube = np.pi * sky * np.array([0.5, 0.5, 1, 0, 0.5, 0.5])[:, None] * np.ones(3)
    up = np.array([0.0, 1.0, 0.0])
    return Lighting(
        "now", "made", DirectionalLight(up, np.full(3, sun)), DirectionalLight(-up, np.zeros(3)), radiance, cube, 0.0, 0.0, 10.0
    )


@pytest.fixture(scope="module")
def lit(make_sector):
    """Cubes of one sector under a lighting and settings."""
    sector = make_sector(17, planes=TABLE.plane_count)
    resident, relighter = ResidentSector(shared_device(), sector, 6), Relighter(shared_device())

    def run(light: Lighting, settings: Settings):
        found = relighter.converge(resident, relight_input(settings.light(light), TABLE))
        return settings.cubes(found.first_bounce, found.cubes, sector.probe_room)

    return run


def test_the_default_changes_no_byte(lit):
    light = lighting()
    assert NEUTRAL.light(light) is light
    cubes = np.ones((3, 6, 3), np.float32)
    assert NEUTRAL.cubes(cubes * 0.5, cubes, np.zeros(3, np.uint16)) is cubes


def test_gains_on_the_sources_are_gains_on_the_light(lit):
    sun, sky = lit(lighting(sky=0), NEUTRAL), lit(lighting(sun=0), NEUTRAL)
    found = lit(lighting(), Settings(sun_factor=2.0, sky_factor=0.25))
    # Two solves with a residual of 1e-5 each, in float32.
    np.testing.assert_allclose(found, 2 * sun + 0.25 * sky, atol=5e-5 * found.max())


def test_bounce_factor_runs_from_one_bounce_to_all(lit):
    none, all_ = lit(lighting(), Settings(bounce_factor=0.0)), lit(lighting(), NEUTRAL)
    half = lit(lighting(), Settings(bounce_factor=0.5))
    assert (none <= all_ * (1 + 1e-5)).all()
    np.testing.assert_allclose(half, (none + all_) / 2, rtol=1e-5)


def test_sky_boost_is_a_uniform_sky(lit):
    boosted = lit(lighting(sky=0, sun=0), Settings(sky_boost=(3e3, 3e3, 3e3)))
    np.testing.assert_allclose(boosted, lit(lighting(sun=0), NEUTRAL), rtol=1e-4)


def test_ambient_colours_reach_their_faces_and_rooms():
    settings = Settings(ambient_up=(8, 0, 0), ambient_down=(0, 4, 0), ambient_factor=0.5, interior_ambient_scale=0.25)
    dark = np.zeros((2, 6, 3), np.float32)
    outdoors, indoors = settings.cubes(dark, dark, np.array([0, 1], np.uint16))
    np.testing.assert_allclose(outdoors[2], (4, 0, 0))
    np.testing.assert_allclose(outdoors[3], (0, 2, 0))
    np.testing.assert_allclose(outdoors[0], (2, 1, 0))
    np.testing.assert_allclose(indoors, outdoors / 4)


def test_ambient_colours_are_the_same_light_in_harmonics():
    settings = Settings(ambient_up=(8, 0, 2), ambient_down=(0, 4, 1))
    dark = np.zeros((1, 9, 3), np.float32)
    light = settings.cubes(dark, dark, np.array([0], np.uint16))
    normal = np.array([[0.6, 0.0, 0.8], [0.0, 1.0, 0.0], [0.0, 0.6, -0.8]], np.float32)
    found = evaluate("sh2", np.repeat(light, 3, axis=0), normal)
    # Between up and down it is their mean by height: 1/2 (1 + n_y) of up.
    share = (1 + normal[:, 1:2]) / 2
    np.testing.assert_allclose(found, share * settings.ambient_up + (1 - share) * settings.ambient_down, rtol=1e-5, atol=1e-5)


def test_every_gain_at_its_maximum_stays_finite(lit):
    colours = (MAX_AMBIENT_LX,) * 3
    most = Settings(**{f.name: colours if isinstance(f.default, tuple) else MAX_FACTOR for f in fields(Settings)})
    assert np.isfinite(lit(lighting(), most)).all()


def test_a_lamp_that_gives_the_most_there_is_takes_any_gain():
    lamp = Lamp("", "point", (0.0, 0.0, 0.0), MAX_LUMENS)
    (found,) = Settings(lights_factor=MAX_FACTOR).brightened((lamp,))
    check_lamp(found)
    assert found.lumens == MAX_LUMENS


@given(st.sampled_from([f.name for f in fields(Settings)]), st.sampled_from([-1.0, float("nan"), float("inf"), 1e9]))
def test_impossible_values_are_refused_by_name(name, value):
    wrong = (value,) * 3 if isinstance(getattr(NEUTRAL, name), tuple) else value
    with pytest.raises(InputError, match=name):
        replace(NEUTRAL, **{name: wrong})
