"""Triangles -> a tree of boxes that shadow rays walk: balanced, in one order, the same for the same triangles. Pure NumPy."""

import math
from dataclasses import dataclass

import numpy as np

from gi_core.arrays import AnyArray, Float32, Float64, Int64
from gi_core.layout import SHADOW_NODE, SHADOW_TRIANGLE

LEAF_TRIANGLES = 4
# A hit counts a little beside its triangle (trace_shadows.cl, EDGE_SLACK), and boxes are met in rounded numbers: by this share of a
# triangle's extent, and this much [m], boxes are bigger than what is in them.
_BOX_SLACK, _BOX_MARGIN_M = 2e-5, 1e-3


@dataclass(frozen=True, eq=False)
class ShadowTree:
    """nodes : (n,) layout.SHADOW_NODE, a parent before its children, the first child next: a walk needs no stack, only ``skip``
    triangles : (m,) layout.SHADOW_TRIANGLE, leaf by leaf
    """

    nodes: AnyArray
    triangles: AnyArray

    @property
    def nbytes(self) -> int:
        """Bytes of both arrays."""
        return self.nodes.nbytes + self.triangles.nbytes

    @property
    def corners(self) -> Float64:
        """(m, 3, 3) float64 [m]: triangle, corner, coordinate."""
        corner = self.triangles["corner"].astype(np.float64)
        return np.stack([corner, corner + self.triangles["edge_a"], corner + self.triangles["edge_b"]], axis=1)


def build_tree(corners: Float64) -> ShadowTree:
    """The tree of triangles (m, 3, 3) [m]: halves of equally many along their longest axis, down to LEAF_TRIANGLES or fewer."""
    triangles = np.zeros(len(corners), SHADOW_TRIANGLE.dtype)
    if not len(corners):
        return ShadowTree(np.zeros(0, SHADOW_NODE.dtype), triangles)
    depth = max(0, math.ceil(math.log2(len(corners) / LEAF_TRIANGLES)))
    order = _by_halves((corners.min(axis=1) + corners.max(axis=1)) / 2, depth)
    local = corners[order].astype(np.float32)
    triangles["corner"] = local[:, 0]
    triangles["edge_a"], triangles["edge_b"] = local[:, 1] - local[:, 0], local[:, 2] - local[:, 0]
    return ShadowTree(_nodes(local, depth), triangles)


def _bounds(count: int, level: int) -> Int64:
    """(2^level + 1,): where the parts of a level begin and end; each part's halves are parts of the next."""
    return np.arange((1 << level) + 1, dtype=np.int64) * count >> level


def _by_halves(centre: Float64, depth: int) -> Int64:
    """(m,): an order in which every part of every level is one run."""
    order = np.arange(len(centre))
    for level in range(depth):
        bounds = _bounds(len(centre), level)
        sorted_centre = centre[order]
        extent = np.maximum.reduceat(sorted_centre, bounds[:-1]) - np.minimum.reduceat(sorted_centre, bounds[:-1])
        part = np.repeat(np.arange(1 << level), np.diff(bounds))
        along = np.take_along_axis(sorted_centre, extent.argmax(axis=1)[part, None], axis=1)[:, 0]
        order = order[np.lexsort((along, part))]  # stable: equal centres keep their order
    return order


def _nodes(corners: Float32, depth: int) -> AnyArray:
    low, high = corners.min(axis=1), corners.max(axis=1)
    margin = (high - low).max(axis=1, keepdims=True) * np.float32(_BOX_SLACK) + np.float32(_BOX_MARGIN_M)
    bounds = _bounds(len(corners), depth)
    low, high = np.minimum.reduceat(low - margin, bounds[:-1]), np.maximum.reduceat(high + margin, bounds[:-1])
    nodes = np.zeros((2 << depth) - 1, SHADOW_NODE.dtype)
    places = [np.zeros(1, np.int64)]
    for level in range(depth):
        left = places[-1] + 1
        places.append(np.stack([left, left + (1 << depth - level) - 1], axis=1).reshape(-1))
    for level in range(depth, -1, -1):
        here = places[level]
        nodes["low"][here], nodes["high"][here] = low, high
        nodes["skip"][here] = here + (2 << depth - level) - 1
        low, high = np.minimum(low[::2], low[1::2]) if level else low, np.maximum(high[::2], high[1::2]) if level else high
    nodes["leaf"][places[depth]] = bounds[:-1] * 8 + np.diff(bounds)
    return nodes
