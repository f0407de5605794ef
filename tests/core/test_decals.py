"""What a box hides of the ground: the formula against rays, its limits, and who is near."""

import numpy as np
import pytest

from gi_core.decals import (
    BELOW_M,
    GRADIENT_TEXELS,
    REACH,
    check_decal,
    decals_near,
    edge_share,
    gradient_texels,
    hidden_share,
    reach_m,
    world_from_box,
)
from gi_core.errors import InputError
from gi_core.world import Decal

CAR = Decal("car", (0.0, 0.25, 0.0), (1.8, 1.25, 4.6))
RAYS = 40_000


def traced_share(points: np.ndarray, low: np.ndarray, high: np.ndarray, seed: int = 0) -> np.ndarray:
    """How many of RAYS cosine-distributed rays from level points (n, 3) meet a box: (n,). One standard deviation is 0.0025 at most."""
    rng = np.random.default_rng(seed)
    radius, turn = np.sqrt(rng.random(RAYS)), 2 * np.pi * rng.random(RAYS)
    way = np.stack([radius * np.cos(turn), np.sqrt(1 - radius**2), radius * np.sin(turn)], axis=1)
    share = []
    for point in points:
        bounds = np.sort(np.stack([(low - point) / way, (high - point) / way]), axis=0)
        enters, leaves = bounds[0].max(axis=1), bounds[1].min(axis=1)
        share.append(np.mean((leaves >= enters) & (leaves > 0)))
    return np.array(share)


def on_ground(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    return np.stack([x, np.zeros_like(x), z], axis=1)


def up(count: int) -> np.ndarray:
    return np.tile(np.array([[0, 1, 0]], np.float32), (count, 1))


def test_an_edge_hides_what_rays_say():
    distance = np.array([-3.0, -1.0, -0.3, 0.0, 0.3, 1.0, 3.0])
    # A box from x = 0 to -1e6 m and as long: its top is at 1.5 m, its underside at 0.5 m.
    traced = traced_share(on_ground(distance, np.zeros(7)), np.array([-1e6, 0.5, -1e6]), np.array([0.0, 1.5, 1e6]))
    expected = edge_share(np.where(distance > 0, distance / 1.5, distance / 0.5))
    np.testing.assert_allclose(traced, expected, atol=0.01)  # four standard deviations


def test_the_texture_is_the_gradient():
    texels = gradient_texels().astype(np.float64) / 255
    distance = REACH * (2 * (np.arange(GRADIENT_TEXELS) + 0.5) / GRADIENT_TEXELS - 1)
    # Half a step of 8 bits, and what is taken off so that it ends: 1.5 %, all of it at the ends.
    np.testing.assert_allclose(texels, edge_share(distance), atol=0.5 / 255 + edge_share(np.float64(REACH)))
    np.testing.assert_allclose(texels + texels[::-1], 1, atol=1.01 / 255)
    assert (texels[0], texels[-1]) == (1, 0)
    assert (np.diff(texels) <= 0).all()


@pytest.mark.slow
def test_a_parked_car_hides_about_what_rays_say():
    x, z = (axis.ravel() for axis in np.meshgrid(np.linspace(0, 6, 25), np.linspace(0, 8, 33)))
    points = on_ground(x, z)
    traced = traced_share(points, np.array([-0.9, 0.25, -2.3]), np.array([0.9, 1.5, 2.3]))
    error = hidden_share(CAR, points, up(len(points))) - traced
    # A product of two strips is not the box, and the gradient ends: 0.0086 on the mean and 0.037 at worst, which MATH.md quotes.
    print(f"mean {np.abs(error).mean():.4f}, worst {np.abs(error).max():.4f}, bias {error.mean():+.4f}")
    assert np.abs(error).mean() < 0.01
    assert np.abs(error).max() < 0.045


@pytest.mark.parametrize("way", [(1.0, 0.0), (0.0, 1.0), (0.7, 0.7), (0.3, 0.95)])
def test_nothing_comes_back_farther_off(way):
    hidden = hidden_share(CAR, np.linspace(0, 30, 600)[:, None] * np.array([way[0], 0, way[1]]), up(600))
    assert (np.diff(hidden) <= 1e-7).all()
    assert hidden.min() == 0


def test_it_goes_down_evenly_to_nothing_within_reach():
    x = np.linspace(0, reach_m(CAR) + 1, 400)
    hidden = hidden_share(CAR, on_ground(x, np.zeros(400)), up(400))
    assert hidden[0] > 0.9
    assert (np.diff(hidden) <= 0).all()
    # No step: the gradient is steepest at the edge from below, half a share per height of 0.25 m, and 3 % more for ending at REACH.
    assert np.abs(np.diff(hidden)).max() < 1.04 * 0.5 / 0.25 * x[1]
    assert (hidden[x > 0.9 + REACH * 1.5] == 0).all()


def test_only_ground_below_and_beside_is_darkened():
    heights = np.array([0.0, -BELOW_M + 0.3, -BELOW_M + 0.2, 1.0, 1.6])
    points = np.stack([np.full(5, 1.2), heights, np.zeros(5)], axis=1)
    hidden = hidden_share(CAR, points, up(5))
    assert hidden[0] > 0.3
    assert (hidden[[2, 4]] == 0).all()
    assert (hidden[[1, 3]] > 0).all()
    leaning = np.array([[0, 0.6, 0.8], [0, 0, 1], [0, -1, 0]], np.float32)
    found = hidden_share(CAR, points[[0, 0, 0]], leaning)
    np.testing.assert_allclose(found, hidden[0] * np.array([0.6, 0, 0]), rtol=1e-6)


def test_a_box_on_the_ground_hides_what_is_under_it_and_no_number_is_none():
    points = on_ground(np.array([0.0, 0.89, 0.9, 0.91, 1e7]), np.zeros(5))
    hidden = hidden_share(Decal("crate", (0.0, 0.0, 0.0), (1.8, 1.0, 4.0)), points, up(5))
    np.testing.assert_allclose(hidden, [1, 0.85, 0.5, 0.5, 0], atol=0.05)


def test_it_turns_counter_clockwise_seen_from_above_and_stands_anywhere():
    turned = Decal("car", (50_000.0, 0.25, -300.0), (1.8, 1.25, 4.6), 90.0)
    np.testing.assert_allclose(world_from_box(turned) @ [1, 0, 0, 1], [50_000, 0.25, -301, 1], atol=1e-9)
    local = on_ground(np.array([0.5, 2.0, 0.0]), np.array([3.0, 0.0, 2.0]))
    there = np.stack([local[:, 2] + 50_000, local[:, 1], -local[:, 0] - 300], axis=1)
    np.testing.assert_allclose(hidden_share(turned, there, up(3)), hidden_share(CAR, local, up(3)), atol=1e-6)


def test_those_near_a_point_come_closest_first():
    row = [Decal(str(i), (10.0 * i, 0.0, 0.0), (1, 1, 1)) for i in range(5)]
    assert [(distance, decal.name) for distance, decal in decals_near(row, (21.0, 0, 0), 11.0)] == [(1, "2"), (9, "3"), (11, "1")]


@pytest.mark.parametrize("change", [{"position": (0, float("nan"), 0)}, {"size": (1, 0, 1)}, {"yaw_degrees": 1e4}], ids=str)
def test_what_is_no_box_is_refused_by_field(change):
    check_decal(CAR)
    with pytest.raises(InputError, match=next(iter(change))):
        check_decal(Decal(**({"name": "car", "position": (0, 0, 0), "size": (1, 1, 1)} | change)))
