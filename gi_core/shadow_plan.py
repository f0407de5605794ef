"""Plans for the sun's shadow map: where it lies, what is drawn into it, when it is drawn anew. Pure; ``shadow_map`` carries them out."""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from gi_core.arrays import AnyArray, Float32, Float64
from gi_core.constants import SECTOR_SIZE_M
from gi_core.geometry_file import Geometry
from gi_core.grid import SectorIndex
from gi_core.layout import SHADOW_FRAME, SHADOW_TRIANGLE

# 256 m across, so that all of a 100 m volume and the streets around it are inside; texels a quarter of a surfel's cell.
MAP_TEXELS = 1024
TEXELS_PER_METRE = 4.0
HALF_MAP_M = MAP_TEXELS / TEXELS_PER_METRE / 2
# Geometry up to this far towards the sun is drawn [m]: beyond, a surfel's ray must be above the city or the baked visibility is used. Far
# enough for towers of 500 m and a sun at 5 degrees, whose baked visibility is the worst.
MAX_REACH_M = 6000.0
# The sun's disc is half a degree wide: a shadow's edge drawn this far off is still within its own penumbra.
SUN_MOVED_DEGREES = 0.25
BOX_MOVED_M = 0.5
# A sample of a map drawn for a sun this far away still says more than baked directions many degrees apart.
FRESH_DEGREES = 1.0
# Below this the map's prism is longer than the reach for anything taller than a storey.
LOWEST_SUN_DEGREES = 1.0

NO_BOXES: Float64 = np.zeros((0, 8, 3))
# Sides of its middle that a box's corners lie on, along its own x, y and z; and the two triangles of each face.
_CORNER_SIDES = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
_FACES = ((0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5))
_FACE_TRIANGLES = np.array([corner for a, b, c, d in _FACES for corner in ((a, b, c), (a, c, d))])


@dataclass(frozen=True)
class MovingBox:
    """Something that moves and stands in the sun: a vehicle, a door.

    position : (x, y, z) [m], world frame, the middle; half_size : along its own x, y and z [m]
    turned_degrees : about the vertical, from +X towards -Z
    """

    position: tuple[float, float, float]
    half_size: tuple[float, float, float]
    turned_degrees: float = 0.0


@dataclass(frozen=True, eq=False)
class ShadowPlan:
    """One drawing of the map.

    middle : (3,) float64 [m], world frame; to_sun, across, down : (3,) float64, unit, at right angles
    sectors : those whose geometry is drawn; boxes : (b, 8, 3) float64 [m], world frame, corners of moving ones, drawn last
    reach_m : level distance towards the sun from any point of the map up to which all geometry is drawn
    reach_height_m : how much higher a ray to the sun is by then; inf where it is above the whole city
    """

    middle: Float64
    to_sun: Float64
    across: Float64
    down: Float64
    sectors: tuple[SectorIndex, ...]
    boxes: Float64
    reach_m: float
    reach_height_m: float

    def frame(self, origin: Float64) -> AnyArray:
        """(1,) layout.SHADOW_FRAME for points local to ``origin`` (3,) [m], world frame."""
        record = np.zeros(1, SHADOW_FRAME.dtype)
        record["across"], record["down"], record["to_sun"] = self.across, self.down, self.to_sun
        record["texels_per_metre"], record["size"] = TEXELS_PER_METRE, MAP_TEXELS
        record["origin"] = origin - self.middle
        return record

    def covers_whole(self, index: SectorIndex) -> bool:
        """Whether a sector's own ground lies in the map as far as its level extent goes."""
        return self.away_m(index) + SECTOR_SIZE_M / 2 <= HALF_MAP_M

    def away_m(self, index: SectorIndex) -> float:
        """From the map's middle to that of a sector's ground [m], along x or z, whichever is more."""
        return float(np.abs((index.origin + SECTOR_SIZE_M / 2 - self.middle)[[0, 2]]).max())


def plan_map(
    position: Float64, to_sun: Float64, sectors: Collection[SectorIndex], low_m: float, top_m: float, boxes: Float64 = NO_BOXES
) -> ShadowPlan | None:
    """The map around a player at ``position`` (3,) [m] for a sun towards ``to_sun`` (3,), unit; None when the sun is too low for one.

    sectors : all that have geometry; low_m, top_m : the city's lowest and highest point; boxes : ``box_corners`` of moving ones
    """
    if to_sun[1] < math.sin(math.radians(LOWEST_SUN_DEGREES)):
        return None
    level = np.cross((0.0, 1.0, 0.0), to_sun)
    length = float(np.linalg.norm(level))
    across = level / length if length > 1e-6 else np.array([1.0, 0.0, 0.0])
    down = np.cross(to_sun, across)
    # Whole texels along the map's own axes: under an unchanged sun, a map that has moved says the same of the same place.
    steps = np.round(np.stack([across, down]) @ position * TEXELS_PER_METRE) / TEXELS_PER_METRE
    middle = position + (steps - np.stack([across, down]) @ position) @ np.stack([across, down])
    horizontal = math.hypot(to_sun[0], to_sun[2])
    above_all = (top_m - low_m) * horizontal / float(to_sun[1])
    reach = min(MAX_REACH_M, above_all)
    height = math.inf if above_all <= MAX_REACH_M else MAX_REACH_M * float(to_sun[1]) / horizontal
    drawn = _sectors_towards_sun(middle, to_sun, np.stack([across, down]), sectors, (low_m, top_m), reach)
    return ShadowPlan(middle, to_sun, across, down, drawn, boxes, reach, height)


def _sectors_towards_sun(
    middle: Float64, to_sun: Float64, axes: Float64, sectors: Collection[SectorIndex], heights: tuple[float, float], reach: float
) -> tuple[SectorIndex, ...]:
    """Sectors whose columns meet the map's prism within the reach, in grid order."""
    half = HALF_MAP_M
    # No point of the map's receivers is further from its middle than its diagonal and the city's height allow.
    radius = half * math.sqrt(2) + SECTOR_SIZE_M + reach + (heights[1] - heights[0])
    x0, z0 = np.floor((middle[[0, 2]] - radius) / SECTOR_SIZE_M).astype(int)
    x1, z1 = np.floor((middle[[0, 2]] + radius) / SECTOR_SIZE_M).astype(int)
    near = sorted(i for i in sectors if x0 <= i.x <= x1 and z0 <= i.z <= z1)
    if not near:
        return ()
    corner = np.array([[x, y, z] for x in (0.0, SECTOR_SIZE_M) for y in heights for z in (0.0, SECTOR_SIZE_M)])
    corners = np.array([index.origin for index in near])[:, None] + corner - middle  # (n, 8, 3)
    on_map = corners @ axes.T
    meets = ((on_map.min(axis=1) <= half) & (on_map.max(axis=1) >= -half)).all(axis=1)
    level = np.array([to_sun[0], to_sun[2]])
    level /= max(float(np.linalg.norm(level)), 1e-9)
    ahead = (corners[..., [0, 2]] @ level).min(axis=1)
    # A receiver may lie as far ahead of the middle as the map reaches on the ground: its edge, stretched by a low sun.
    stretched = half / max(float(to_sun[1]), 1e-3)
    meets &= ahead <= min(stretched, half * 4) + reach
    return tuple(index for index, ok in zip(near, meets.tolist(), strict=True) if ok)


def sun_or_box_moved(last: ShadowPlan, to_sun: Float64, boxes: Float64) -> bool:
    """Whether the sun, or a corner of a box (b, 8, 3) [m], has moved enough since a map was planned for another to be drawn. The map's
    place is not asked for."""
    if not is_near(last.to_sun, to_sun, SUN_MOVED_DEGREES) or len(boxes) != len(last.boxes):
        return True
    return len(boxes) > 0 and bool((np.linalg.norm(boxes - last.boxes, axis=2) > BOX_MOVED_M).any())


def is_near(a: Float64, b: Float64, degrees: float = FRESH_DEGREES) -> bool:
    """Whether two suns, directions (3,), unit, stand within so many degrees of each other: by default, whether samples of a map that was
    drawn for the one are fresh under the other."""
    return float(a @ b) >= math.cos(math.radians(degrees))


def oldest_fresh(drawn_for: Sequence[Float64], to_sun: Float64) -> int:
    """Index of the first of a run of maps, oldest first, from which on each was drawn for a sun within FRESH_DEGREES of ``to_sun``."""
    first = len(drawn_for)
    while first > 0 and is_near(drawn_for[first - 1], to_sun):
        first -= 1
    return first


def box_corners(boxes: Sequence[MovingBox]) -> Float64:
    """The corners of boxes: (b, 8, 3) float64 [m], world frame, in the order of _CORNER_SIDES."""
    half_size = np.array([box.half_size for box in boxes]).reshape(-1, 1, 3)
    position = np.array([box.position for box in boxes]).reshape(-1, 1, 3)
    return np.asarray(position + (_CORNER_SIDES * half_size) @ box_axes(boxes))


def box_axes(boxes: Sequence[MovingBox]) -> Float64:
    """Unit vectors along each box's own x, y and z: (b, 3, 3) float64, world frame."""
    turn = np.radians([box.turned_degrees for box in boxes])
    level = np.zeros_like(turn)
    ahead = np.stack([np.cos(turn), level, -np.sin(turn)], axis=1)
    side = np.stack([np.sin(turn), level, np.cos(turn)], axis=1)
    return np.stack([ahead, np.broadcast_to([0.0, 1.0, 0.0], ahead.shape), side], axis=1)


def box_triangles(corners: Float64) -> Float64:
    """The twelve triangles of each box with ``corners`` (b, 8, 3) [m]: (12 b, 3, 3) float64 [m]."""
    return corners[:, _FACE_TRIANGLES].reshape(-1, 3, 3)


def triangle_records(corners: Float64 | Float32) -> AnyArray:
    """(n,) layout.SHADOW_TRIANGLE of triangles (n, 3, 3) [m], in their own frame."""
    records = np.zeros(len(corners), SHADOW_TRIANGLE.dtype)
    records["corner"] = corners[:, 0]
    records["edge_a"], records["edge_b"] = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return records


def caster_records(geometry: Geometry, index: SectorIndex) -> AnyArray:
    """(n,) layout.SHADOW_TRIANGLE of a sector's geometry, local to the sector."""
    return triangle_records(geometry.vertices[geometry.triangles] - index.origin)
