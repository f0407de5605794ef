"""The sun's shadow map in NumPy, written to be read: twin of draw_shadow_map.cl and sample_shadow_map.cl."""

import numpy as np

from gi_core.arrays import AnyArray, Bool, Float32, Float64, UInt8
from gi_core.layout import SHADOW_BIAS_CELLS, SHADOW_BIAS_M, SHADOW_TAPS, WHOLE_SAMPLE
from gi_core.shadow_plan import MAP_TEXELS, TEXELS_PER_METRE, ShadowPlan

NOTHING_DRAWN = np.float32(-1e30)
LEAST_COSINE = 0.01
# Across and down a cell, as shares of half its size: (SHADOW_TAPS, 2).
TAPS = np.array([[-0.75, -0.75], [-0.25, 0.25], [0.25, -0.25], [0.75, 0.75]])
assert len(TAPS) == SHADOW_TAPS


def map_from_world(plan: ShadowPlan, points: AnyArray) -> AnyArray:
    """Columns, rows [texels] and depths [m] (..., 3) of world points (..., 3) [m], in the points' own precision."""
    local = (points - plan.middle).astype(points.dtype)
    on_map = local @ np.stack([plan.across, plan.down, plan.to_sun], axis=1).astype(points.dtype)
    on_map[..., :2] = on_map[..., :2] * TEXELS_PER_METRE + MAP_TEXELS / 2
    return np.asarray(on_map)


def draw(plan: ShadowPlan, corners: Float64) -> Float32:
    """The map (MAP_TEXELS, MAP_TEXELS) float32 [m] of triangles (n, 3, 3) [m], world frame: for each texel the greatest depth over its
    centre."""
    depth = np.full((MAP_TEXELS, MAP_TEXELS), NOTHING_DRAWN)
    for a, b, c in map_from_world(plan, corners):
        low, high = np.min([a, b, c], axis=0), np.max([a, b, c], axis=0)
        x0, y0 = np.maximum(np.ceil(low[:2] - 0.5), 0).astype(int)
        x1, y1 = np.minimum(np.floor(high[:2] - 0.5), MAP_TEXELS - 1).astype(int)
        area = (b - a)[0] * (c - a)[1] - (c - a)[0] * (b - a)[1]
        if x1 < x0 or y1 < y0 or abs(area) <= 1e-6:
            continue
        x, y = np.meshgrid(np.arange(x0, x1 + 1) + 0.5, np.arange(y0, y1 + 1) + 0.5)
        # Barycentric coordinates of b and c.
        v = ((x - a[0]) * (c - a)[1] - (c - a)[0] * (y - a[1])) / area
        w = ((b - a)[0] * (y - a[1]) - (x - a[0]) * (b - a)[1]) / area
        inside = (v >= 0) & (w >= 0) & (v + w <= 1)
        here = depth[y0 : y1 + 1, x0 : x1 + 1]
        np.maximum(here, np.where(inside, a[2] + v * (b - a)[2] + w * (c - a)[2], NOTHING_DRAWN), out=here)
    return depth.astype(np.float32)


def sample(plan: ShadowPlan, depth: Float32, position: AnyArray, normal: Float32, size: Float32, top_m: float) -> tuple[UInt8, Bool]:
    """Samples (S,) uint8 of surfels at positions (S, 3) [m], world frame, with normals (S, 3) and cells of size (S,) [m]; and whether
    each is valid (S,): where it is not, the sample means nothing. Those that face away from the sun are valid, and 0.

    Worked out in the positions' precision.
    """
    normal = normal.astype(position.dtype)
    to_map = np.stack([plan.across, plan.down, plan.to_sun], axis=1).astype(position.dtype)
    across, down, cosine = (normal @ to_map).T
    bias = SHADOW_BIAS_M + SHADOW_BIAS_CELLS * size
    middle = map_from_world(plan, position + bias[:, None] * normal)
    spread = size / 2 * TEXELS_PER_METRE
    # The cell seen from the sun is shortened along the direction in which it is slanted; what faces away is not looked up.
    shorten = spread / (1 + np.maximum(cosine, 0))
    lit: AnyArray = np.zeros(len(position), np.int32)
    for a, b in TAPS.astype(position.dtype):
        aside = spread * a - (a * across + b * down) * across * shorten
        below = spread * b - (a * across + b * down) * down * shorten
        left = np.floor(middle[:, :2] + np.stack([aside - position.dtype.type(0.5), below], axis=1)).astype(int)
        for texel in (left, left + np.array([1, 0])):
            step = (texel + 0.5).astype(position.dtype) - middle[:, :2]
            slope = step[:, 0] * across + step[:, 1] * down
            expected = middle[:, 2] - slope / np.maximum(cosine, LEAST_COSINE) / TEXELS_PER_METRE
            column, row = np.clip(texel, 0, MAP_TEXELS - 1).T
            lit += expected >= depth[row, column]
    inside = ((middle[:, :2] - spread[:, None] >= 0) & (middle[:, :2] + spread[:, None] < MAP_TEXELS)).all(axis=1)
    valid = inside & (position[:, 1] + plan.reach_height_m >= top_m)
    away = cosine <= LEAST_COSINE
    share = np.where(away, 0, (lit * WHOLE_SAMPLE + SHADOW_TAPS) // (2 * SHADOW_TAPS))
    return share.astype(np.uint8), np.asarray(valid | away)
