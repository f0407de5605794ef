"""Trial light: scenes whose light can be worked out by hand, and independence of what else is asked."""

import numpy as np
import pytest

from bake_jobs.rays import RayScene
from bake_jobs.trial_light import TrialScene
from bake_jobs.trial_states import SKY_AT_HORIZON, trial_states
from gi_core.world import Lamp

SUNS = np.array([[0.0, 1, 0], [0.6, 0.8, 0], [-0.6, 0.8, 0], [0, 0.6, 0.8], [0.8, 0.6, 0], [-0.8, 0.6, 0], [0, 0.6, -0.8], [0, -0.6, 0.8]])
UNIFORM, OVERCAST = 5, 6


def trial(scene, lamps=False, edge=8):
    states = trial_states(SUNS, lamps)
    return TrialScene(RayScene(scene.vertices, scene.triangles), scene.albedo, scene.emission, scene.lamps, states, edge)


def test_suns_stand_above_the_horizon_and_far_apart_and_some_are_held_out():
    states = trial_states(SUNS, True)
    assert (states.sun_direction[:, 1] > 0).all()
    assert states.sky_of[: states.count - 2] == (0, 1, 2, 3, 4, -1, -2, -3)
    assert (states.held_out, states.judged) == (2, slice(8, 10))
    assert not states.sun_irradiance[:, UNIFORM:8].any()
    assert trial_states(SUNS[:1], False).judged == slice(0, 3)  # one sun: nothing can be held out


@pytest.mark.parametrize("albedo", [0.0, 0.5])
def test_an_open_plain(build, albedo):
    """Up: the sky's illuminance. Down: what the ground sends back, with no bounce between."""
    scene = build().ground(low=(-4000, -4000), high=(4000, 4000), albedo=albedo).scene()
    bench = trial(scene)
    cube = bench.light(np.array([[3.0, 2.0, 5.0]])).cube[0]
    states = bench.states
    for state in (UNIFORM, OVERCAST):
        # Sums over 384 directions; 16 bounce rays.
        np.testing.assert_allclose(cube[state, 2], states.sky_level[state], rtol=0.02)
        np.testing.assert_allclose(cube[state, 3], albedo * states.sky_level[state], rtol=0.1)
    noon = 0  # the sun overhead
    sky = np.pi * states.sky_radiance(bench._bounce[:, [0, 2, 1]])[:, noon].mean()
    np.testing.assert_allclose(cube[noon, 3], albedo * (states.sun_irradiance[0, noon] + sky), rtol=0.03)
    assert states.sun_irradiance[0, noon] > 5 * SKY_AT_HORIZON


def test_a_closed_room_is_not_fed_from_outside(build):
    scene = build().ground().box((0, 0, 0), (8, 4, 8), inward=True).box((-0.2, -0.2, -0.2), (8.2, 4.2, 8.2)).scene()
    assert not trial(scene).light(np.array([[4.0, 2.0, 4.0], [1.0, 1.0, 6.0]])).cube.any()


def test_lamps_light_their_own_state_and_no_other_and_walls_stop_them(build):
    lamp = Lamp("lamp", "point", (0.0, 4.0, 0.0), 4 * np.pi * 100, range_m=1000.0)
    scene = build().ground(albedo=0.5).box((3, 0, -20), (3.2, 20, 20)).scene(lamps=(lamp,))
    bench = trial(scene, lamps=True)
    below, behind = bench.light(np.array([[0.3, 2.0, 0.2], [6.0, 2.0, 0.0]])).cube
    lit = np.flatnonzero(bench.states.lamps)
    # The ground under the lamp sends up half of 100 cd / (4 m)^2, less where it is seen aslant and farther away.
    assert 0.2 * 3.1 < below[lit[0], 3] < 3.2
    assert behind[lit[0], 3] < 0.02 * below[lit[0], 3]
    dark = trial(build().ground(albedo=0.5).box((3, 0, -20), (3.2, 20, 20)).scene()).light(np.array([[0.3, 2.0, 0.2]])).cube[0]
    np.testing.assert_allclose(np.delete(below, lit, axis=0), dark, rtol=1e-5)


def test_light_at_a_point_does_not_depend_on_what_else_is_asked(build):
    scene = build().ground().box((8, 0, 8), (20, 10, 20), 0.3).box((24, 0, 4), (34, 22, 30), 0.7).scene()
    bench = trial(scene)
    points = np.random.default_rng(4).uniform((0, 0.5, 0), (40, 12, 40), (300, 3))
    together = bench.light(points)
    few = bench.light(points[[17, 203]])
    # Products of other shapes add up in another order.
    np.testing.assert_allclose(few.cube, together.cube[[17, 203]], rtol=1e-5, atol=1e-7)
    np.testing.assert_array_equal(few.clearance, together.clearance[[17, 203]])


def test_clearance_is_the_distance_to_the_nearest_wall(build):
    scene = build().ground().box((10, 0, 0), (20, 20, 40)).scene()
    clearance = trial(scene).light(np.array([[9.5, 10.0, 20.0], [4.0, 10.0, 20.0]])).clearance
    np.testing.assert_allclose(clearance, [0.5, 6.0], rtol=0.02)  # rays beside the normal
