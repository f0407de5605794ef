"""Decals: boxes above the ground that hide light from it, by one gradient (slide "Ambient occlusion": a textured box under each vehicle).

    g(t) = (1 - t / sqrt(1 + t^2)) / 2     what a box with one straight edge hides of level ground, cosine-weighted: 1 deep under it,
                                           1/2 at its edge, 0 far off

t is the level distance from the edge, positive outside, over a height above the ground: the top's outside, the underside's within. A box
hides the product over its two axes of g(near edge) - g(far edge). That is exact for an endless strip; beside a box the height within is
seen aslant, so that the other axis's distance counts as much as it. MATH.md, "Decals".
"""

import math
from collections.abc import Iterable

import numpy as np

from gi_core.arrays import Float32, Float64, UInt8
from gi_core.errors import InputError
from gi_core.world import Decal

MIN_SIZE_M, MAX_SIZE_M = 0.01, 1000.0
MAX_YAW_DEGREES = 360.0
# The gradient ends here: what is left of g, 1.5 %, is taken off it, since a box of finite length hides less at such distances anyway.
REACH = 4.0
_REST = (1 - REACH / math.hypot(1, REACH)) / 2
# Ground farther below a box's underside is not the ground that it stands on, but the street under its bridge.
BELOW_M = 1.5
# A box that stands on the ground leaves no gap; one of this much tells inside from outside, and stored geometry is that exact.
_LEAST_GAP_M = 0.01
GRADIENT_TEXELS = 256


def check_decal(decal: Decal) -> None:
    """Raise InputError, naming the decal and the field, unless it is a box somewhere."""

    def expect(ok: bool, field: str, what: str) -> None:
        if not ok:
            raise InputError(f"decal {decal.name[:60]!a}: {field}: expected {what}, found {getattr(decal, field)!r:.60}")

    expect(len(decal.position) == 3 and all(-1e9 <= v <= 1e9 for v in decal.position), "position", "three numbers of -1e9..1e9")
    sides = len(decal.size) == 3 and all(MIN_SIZE_M <= v <= MAX_SIZE_M for v in decal.size)
    expect(sides, "size", f"three numbers of {MIN_SIZE_M:g}..{MAX_SIZE_M:g}")
    expect(-MAX_YAW_DEGREES <= decal.yaw_degrees <= MAX_YAW_DEGREES, "yaw_degrees", f"{-MAX_YAW_DEGREES:g}..{MAX_YAW_DEGREES:g}")


def world_from_box(decal: Decal) -> Float64:
    """(4, 4) float64: from the box's own metres, origin in the middle of its underside, to the world's."""
    turn = math.radians(decal.yaw_degrees)
    cos, sin = math.cos(turn), math.sin(turn)
    x, y, z = decal.position
    return np.array([[cos, 0, sin, x], [0, 1, 0, y], [-sin, 0, cos, z], [0, 0, 0, 1]])


def edge_share(distance: Float64) -> Float64:
    """g of distances from an edge over heights: the cosine-weighted share of the hemisphere hidden by what begins there and never ends."""
    return np.asarray((1 - distance / np.hypot(1, distance)) / 2)


def gradient(distance: Float64) -> Float64:
    """``edge_share``, brought to 0 at REACH and to 1 at -REACH."""
    return np.clip((edge_share(distance) - _REST) / (1 - 2 * _REST), 0, 1)


def gradient_texels() -> UInt8:
    """The gradient as a texture (GRADIENT_TEXELS,): 255 times what is hidden, linear, centres evenly from -REACH to REACH."""
    distance = ((np.arange(GRADIENT_TEXELS) + 0.5) / GRADIENT_TEXELS * 2 - 1) * REACH
    return np.rint(gradient(distance) * 255).astype(np.uint8)


def hidden_share(decal: Decal, position: Float64, normal: Float32) -> Float32:
    """How much of the indirect light of surface points (n, 3) [m] with normals (n, 3) a decal's box hides: (n,) 0..1.

    Derived for level ground; of a surface that leans it takes n.y as much, and nothing from what faces down. None from its top on, none
    more than BELOW_M under it, and none within it: that is the vehicle itself.
    """
    local = (position - np.array(decal.position)) @ world_from_box(decal)[:3, :3]
    width, height, length = decal.size
    half = np.array([width, length]) / 2
    near, rise = np.abs(local[:, [0, 2]]) - half, local[:, 1]
    on_it = (normal[:, 1] > 0) & (rise < height) & (rise >= -BELOW_M) & (near < REACH * (height - rise)[:, None]).all(axis=1)
    some = np.flatnonzero(on_it & ((rise <= _LEAST_GAP_M) | (near > _LEAST_GAP_M).any(axis=1)))
    hidden = np.zeros(len(position), np.float32)
    near, rise = near[some], rise[some]
    far = near + 2 * half
    above = np.maximum(height - rise, _LEAST_GAP_M)[:, None]
    under = np.hypot(np.maximum(-rise, _LEAST_GAP_M)[:, None], np.maximum(near, 0)[:, ::-1])
    # Far off a corner both would be below 0, and their product above it.
    share = np.maximum(gradient(near / np.where(near > 0, above, under)) - gradient(far / under), 0)
    hidden[some] = normal[some, 1] * share[:, 0] * share[:, 1]
    return hidden


def reach_m(decal: Decal, lowest: float = -math.inf) -> float:
    """How far from its position [m] a decal hides anything of what lies at ``lowest`` [m] or above."""
    width, height, length = decal.size
    tallest = height + min(max(decal.position[1] - lowest, 0.0), BELOW_M)
    return math.hypot(width / 2 + REACH * tallest, length / 2 + REACH * tallest, tallest)


def decals_near(decals: Iterable[Decal], position: tuple[float, float, float], radius: float) -> list[tuple[float, Decal]]:
    """Those whose position lies within ``radius`` [m] of a place, each with its distance [m], closest first."""
    found = [(distance, decal) for decal in decals if (distance := math.dist(decal.position, position)) <= radius]
    return sorted(found, key=lambda pair: pair[0])
