"""What a bake reads: triangles with albedo and emission, and what a world.toml says about them."""

from dataclasses import dataclass, field

import numpy as np

from gi_core.arrays import Float32, Float64, Int32
from gi_core.world import Lamp, Location, Room


@dataclass(frozen=True)
class DroppedTriangles:
    """How many triangles of the source were not used, and why."""

    degenerate: int = 0
    duplicate: int = 0
    non_finite: int = 0


@dataclass(frozen=True)
class ProbeHint:
    """A box in which the author wants probes added ("add", spaced by spacing_m) or none ("forbid")."""

    kind: str
    minimum: tuple[float, float, float]
    maximum: tuple[float, float, float]
    spacing_m: float = 4.0


@dataclass(frozen=True, eq=False)
class Scene:
    """A city, ready to bake. World frame, metres.

    vertices : (v, 3) float64 [m]
    triangles : (m, 3) int32, counter-clockwise seen from outside where the source knows an outside
    albedo : (m, 3) float32, linear sRGB, 0..ALBEDO_MAX
    emission : (m, 3) float32 [cd m^-2]
    """

    vertices: Float64
    triangles: Int32
    albedo: Float32
    emission: Float32
    name: str = "scene"
    location: Location = field(default_factory=Location)
    rooms: tuple[Room, ...] = ()
    lamps: tuple[Lamp, ...] = ()
    hints: tuple[ProbeHint, ...] = ()
    dropped: DroppedTriangles = field(default_factory=DroppedTriangles)

    @property
    def bounds(self) -> Float64:
        """(2, 3) float64 [m]: minimum and maximum of the vertices."""
        return np.array([self.vertices.min(axis=0), self.vertices.max(axis=0)])
