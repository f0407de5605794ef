"""Ambient occlusion at the scale of pixels: what a volume's 3 m voxels cannot know of corners and reveals (slide "Ambient occlusion").

    open    how much of REACH_M cosine-distributed rays get on the mean: a surface counts less the farther it is, so that no step shows
    kept    open / (1 - NEAR_ALBEDO (1 - open)): what is near gives some of it back, bounce after bounce

In a picture each pixel casts a quarter of the rays, its neighbours the others, and those in its own plane share what they found: a pixel
that lacks any of the four, at an edge, casts all itself.

Decals, which stand for vehicles that the mesh does not have, dim it besides (gi_core.decals).

The talk multiplies indirect light by probe sky visibility, a screen-space and a baked term; the first is in the served light already.
Against the path tracer it mends corners, and where served light is too dark it adds to that (MATH.md, "Pictures"): pictures leave it
out unless asked.
"""

from collections.abc import Sequence

import numpy as np

from gi_core.arrays import Bool, Float32, Float64, Int64
from gi_core.decals import hidden_share, reach_m
from gi_core.world import Decal
from server.preview_lamps import PixelCells
from server.raycast import RayCaster

# A voxel's edge: what is farther, probes and voxels have seen.
REACH_M = 3.0
RAYS = 12
NEAR_ALBEDO = 0.35  # a light facade's
# Pixels two by two cast different quarters of the rays; the nine around one have each quarter four times, as 1 2 1 counts them.
TURNS = 4
# Neighbours are in one plane where their normals are equal to a hundredth and their planes this [m] or less apart.
SAME_PLANE_M = 0.02
_SAME_NORMAL_STEPS = 100


def kept_share(rays: RayCaster, position: Float64, normal: Float32) -> Float32:
    """How much of the indirect light at surface points (n, 3) [m] with normals (n, 3) nearby surfaces leave: (n,) 0..1."""
    return _kept(_open_share(rays, position, normal, sphere_lattice(RAYS)))


def kept_in_picture(rays: RayCaster, position: Float64, normal: Float32, pixel: Int64, width: int) -> Float32:
    """``kept_share`` of what pixels (n,) of a picture so many pixels wide show, for a third of the rays' time."""
    row, column = np.divmod(pixel, width)
    turn = (row % 2) * 2 + column % 2
    towards = sphere_lattice(RAYS)
    own = np.empty(len(pixel), np.float32)
    for number in range(TURNS):
        some = np.flatnonzero(turn == number)
        own[some] = _open_share(rays, position[some], normal[some], towards[number::TURNS])
    share, is_whole = _shared_in_planes(own, position - rays.anchor, normal, pixel, width)
    lacks = np.flatnonzero(~is_whole)
    share[lacks] = _open_share(rays, position[lacks], normal[lacks], towards)
    return _kept(share)


def _open_share(rays: RayCaster, position: Float64, normal: Float32, towards: Float32) -> Float32:
    return rays.free_share(position, normal, (cosine_way(normal, point) for point in towards))


def _kept(share: Float32) -> Float32:
    return np.asarray(share / (1 - np.float32(NEAR_ALBEDO) * (1 - share)), np.float32)


def _shared_in_planes(own: Float32, local: Float64, normal: Float32, pixel: Int64, width: int) -> tuple[Float32, Bool]:
    """The mean of the four turns (n,), each the mean of those of the nine pixels around, in one plane, that have it; and which pixels have
    all four. own (n,), of pixels (n,) that show places (n, 3) [m], near the origin, with normals (n, 3)."""
    if not len(own):
        return own, np.zeros(0, np.bool_)
    # A frame of pixels that show nothing.
    shape = (int(pixel.max()) // width + 3, width + 2)
    place = pixel + width + 3 + 2 * (pixel // width)
    found, offset = np.zeros(shape, np.float32), np.full(shape, np.nan, np.float32)
    facing = np.zeros(shape, np.int32)
    found.reshape(-1)[place] = own
    offset.reshape(-1)[place] = np.einsum("ij,ij->i", local, normal)
    x, y, z = np.rint(normal * _SAME_NORMAL_STEPS).astype(np.int32).T
    facing.reshape(-1)[place] = (x << 16) + (y << 8) + z
    middle = slice(1, -1), slice(1, -1)
    total, count = np.zeros((2, TURNS, shape[0] - 2, width), np.float32)
    for down in (-1, 0, 1):
        for across in (-1, 0, 1):
            there = slice(1 + down, shape[0] - 1 + down), slice(1 + across, shape[1] - 1 + across)
            alike = (facing[there] == facing[middle]) & (np.abs(offset[there] - offset[middle]) <= SAME_PLANE_M)
            turn = 2 * abs(down) + abs(across)
            total[turn] += np.where(alike, found[there], 0)
            count[turn] += alike
    share = (total / np.maximum(count, 1)).mean(axis=0).reshape(-1)[pixel]
    return np.asarray(share, np.float32), np.asarray((count > 0).all(axis=0).reshape(-1)[pixel], np.bool_)


def kept_by_decals(decals: Sequence[Decal], position: Float64, normal: Float32) -> Float32:
    """How much of the indirect light at surface points (n, 3) [m] with normals (n, 3) decals leave: (n,) 0..1."""
    kept = np.ones(len(position), np.float32)
    if not len(position) or not decals:
        return kept
    cells, (low, high) = PixelCells.of(position), (position.min(axis=0), position.max(axis=0))
    centres, reach = np.array([decal.position for decal in decals]), np.array([reach_m(decal, low[1]) for decal in decals])
    # A city has thousands; a street's picture needs dozens.
    for number in np.flatnonzero(np.linalg.norm(centres - np.clip(centres, low, high), axis=1) < reach).tolist():
        near = cells.order[cells.within(centres[number], float(reach[number]))]
        kept[near] *= 1 - hidden_share(decals[number], position[near], normal[near])
    return kept


def cosine_way(normal: Float32, towards: Float32) -> Float32:
    """Ways (n, 3) [m] of REACH_M: to a point of the unit sphere, ``towards`` (3,), that touches each surface with its normal (n, 3).

    For points that are uniform on the sphere their density is the cosine.
    """
    way = normal + towards
    length = np.sqrt(np.einsum("ij,ij->i", way, way))
    return np.asarray(way * (np.float32(REACH_M) / np.maximum(length, np.float32(1e-6)))[:, None], np.float32)


def sphere_lattice(count: int) -> Float32:
    """Unit vectors (count, 3), spread evenly over the sphere on a Fibonacci spiral (Swinbank and Purser 2006)."""
    number = np.arange(count) + 0.5
    height = 1 - 2 * number / count
    level, turn = np.sqrt(1 - height**2), np.pi * (3 - np.sqrt(5)) * number
    return np.stack([level * np.cos(turn), height, level * np.sin(turn)], axis=1).astype(np.float32)
