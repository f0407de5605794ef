"""One building of the procedural city: setback tiers, and a ground floor that is solid or a room with windows and a door.

Side view of an enterable one; every wall, floor and ceiling is at least WALL_M thick, so that light and probes tell inside from out:

        +-----------+        tiers, solid
      +-+-----------+-+
      |               |
      +---------------+      ceiling = underside of the lowest tier
      |               |
     window   room   door    wall panels with holes
    =+---------------+=      floor slab, a little above the sidewalk
"""

from dataclasses import dataclass

import numpy as np

from bake_jobs.scene import Mesh, join_meshes
from bake_jobs.solids import boxes, prism
from gi_core.arrays import Float32, Float64
from gi_core.world import Room

WALL_M = 0.3
FLOOR_TOP_M = 0.2  # above the sidewalk's 0.15, so that no two floors coincide
BELOW_GROUND_M = -0.3
OVERLAP_M = 0.1  # solids that meet reach this far into each other: coinciding edges would leak rays
WINDOW_SILL_M, WINDOW_HEAD_M = 0.9, 3.1
DOOR_WIDTH_M, DOOR_HEAD_M = 1.6, 2.5
BAY_M = 3.2  # one window or door a bay
MULLION_M = 0.9  # wall between two openings
ROOF_ALBEDO = (0.3, 0.3, 0.3)
FLOOR_ALBEDO, CEILING_ALBEDO, INNER_WALL_ALBEDO = (0.3, 0.26, 0.22), (0.75, 0.75, 0.73), (0.6, 0.58, 0.55)


@dataclass(frozen=True)
class Rectangle:
    """Part of the ground: x0 < x1, z0 < z1 [m]."""

    x0: float
    z0: float
    x1: float
    z1: float

    def inset(self, metres: float) -> "Rectangle":
        return Rectangle(self.x0 + metres, self.z0 + metres, self.x1 - metres, self.z1 - metres)


@dataclass(frozen=True)
class Tier:
    """A solid storey block from ``bottom`` to ``top`` [m]."""

    plan: Rectangle
    bottom: float
    top: float


@dataclass(frozen=True)
class Building:
    """tiers from the bottom up; streets: those of "x-" "x+" "z-" "z+" on which a facade faces a street.

    room_height : height of the ceiling [m] of an enterable ground floor, None when it is solid
    """

    name: str
    tiers: tuple[Tier, ...]
    streets: tuple[str, ...]
    wall_albedo: tuple[float, float, float]
    room_height: float | None


def room_of(building: Building) -> Room | None:
    """The air inside the ground floor."""
    if building.room_height is None:
        return None
    inner = building.tiers[0].plan.inset(WALL_M)
    return Room(building.name, (inner.x0, FLOOR_TOP_M, inner.z0), (inner.x1, building.room_height, inner.z1))


def build(building: Building) -> Mesh:
    """Closed, overlapping solids with outward triangles."""
    low = [(tier.plan.x0, tier.bottom, tier.plan.z0) for tier in building.tiers]
    high = [(tier.plan.x1, tier.top, tier.plan.z1) for tier in building.tiers]
    panels = []
    room = room_of(building)
    if room is not None:
        low[0] = (low[0][0], room.maximum[1], low[0][2])
        plan = building.tiers[0].plan
        low.append((plan.x0, BELOW_GROUND_M, plan.z0))
        high.append((plan.x1, FLOOR_TOP_M, plan.z1))
        door = building.streets[0]
        panels = [
            _wall(plan, side, room.maximum[1], building.wall_albedo, side in building.streets, side == door)
            for side in ("x-", "x+", "z-", "z+")
        ]
    vertices, triangles = boxes(np.array(low), np.array(high))
    solid = Mesh.of_colour(vertices, triangles, _outside_colour(vertices[triangles], building.wall_albedo))
    mesh = join_meshes([solid, *panels])
    return mesh if room is None else _painted_inside(mesh, room)


def _wall(plan: Rectangle, side: str, ceiling: float, albedo: tuple[float, float, float], windows: bool, door: bool) -> Mesh:
    """The ground floor's wall along one side: a panel WALL_M thick, with openings where it faces a street."""
    along_x = side[0] == "z"
    begin, end = (plan.x0, plan.x1) if along_x else (plan.z0, plan.z1)
    edge = {"x-": plan.x0, "x+": plan.x1, "z-": plan.z0, "z+": plan.z1}[side]
    near, far = (edge, edge + WALL_M) if side[1] == "-" else (edge - WALL_M, edge)
    rings = [_ring(begin, BELOW_GROUND_M, end, ceiling + OVERLAP_M)]
    if windows:
        bays = max(int((end - begin - 2 * WALL_M) / BAY_M), 1)
        bay = (end - begin - 2 * WALL_M) / bays
        for number in range(bays):
            middle = begin + WALL_M + (number + 0.5) * bay
            if door and number == bays // 2:
                rings.append(_ring(middle - DOOR_WIDTH_M / 2, FLOOR_TOP_M, middle + DOOR_WIDTH_M / 2, DOOR_HEAD_M))
            else:
                half = (bay - MULLION_M) / 2
                rings.append(_ring(middle - half, WINDOW_SILL_M, middle + half, WINDOW_HEAD_M))
    # The prism stands on the plane (along the wall, up); turning it upright is an odd permutation of the axes in one of two cases.
    vertices, triangles, _ = prism(rings, near, far)
    along, through, up = vertices.T
    upright = np.stack([along, up, through] if along_x else [through, up, along], axis=1)
    return Mesh.of_colour(upright, triangles[:, ::-1] if along_x else triangles, albedo)


def _ring(x0: float, y0: float, x1: float, y1: float) -> Float64:
    return np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])


def _outside_colour(corners: Float64, wall: tuple[float, float, float]) -> Float32:
    """(m, 3) albedo of triangles (m, 3, 3): roofs where they face up, walls elsewhere."""
    level = np.ptp(corners[:, :, 1], axis=1) == 0
    return np.where(level[:, None], ROOF_ALBEDO, wall).astype(np.float32)


def _painted_inside(mesh: Mesh, room: Room) -> Mesh:
    """The mesh with the surfaces that bound a room, from inside, in indoor colours."""
    corners = mesh.vertices[mesh.triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    albedo = mesh.albedo.copy()
    tolerance = 1e-6  # m: rounding of coordinates within some kilometres of the origin
    for axis in range(3):
        from_low = (np.abs(corners[:, :, axis] - room.minimum[axis]) < tolerance).all(axis=1) & (normal[:, axis] > 0)
        from_high = (np.abs(corners[:, :, axis] - room.maximum[axis]) < tolerance).all(axis=1) & (normal[:, axis] < 0)
        albedo[from_low] = FLOOR_ALBEDO if axis == 1 else INNER_WALL_ALBEDO
        albedo[from_high] = CEILING_ALBEDO if axis == 1 else INNER_WALL_ALBEDO
    return Mesh(mesh.vertices, mesh.triangles, albedo, mesh.emission)
