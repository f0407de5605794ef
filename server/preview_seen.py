"""What views of what lies behind a picture draw from."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from gi_core.arrays import Bool, Float32, Float64, Int64, UInt8
from gi_core.engine import Engine
from gi_core.grid import SectorIndex
from gi_core.lighting import Lighting
from server.camera import Camera
from server.live_state import Residency
from server.preview_scene import PreviewScene
from server.raycast import Surface

NO_SURFACE = (60, 60, 60)
# A surface that is seen edge-on is drawn this much darker, so that shapes show.
EDGE_SHADE = 0.5


@dataclass(frozen=True, eq=False)
class Seen:
    """What a view draws from: the camera, what its rays meet (``hit``: where they meet any), the light, and which sectors the live world
    holds."""

    engine: Engine
    scene: PreviewScene
    camera: Camera
    lighting: Lighting
    surface: Surface
    residency: Mapping[SectorIndex, Residency]

    @property
    def position(self) -> Float64:
        """(k, 3) [m], of pixels that show a surface."""
        return self.surface.position[self.surface.hit]

    @property
    def normal(self) -> Float32:
        """(k, 3), of pixels that show a surface."""
        return self.surface.normal[self.surface.hit]

    def picture(self, colours: UInt8) -> UInt8:
        """(height, width, 3) sRGB of colours (k, 3) of pixels that show a surface."""
        pixels = np.full((len(self.surface.hit), 3), NO_SURFACE, np.uint8)
        pixels[self.surface.hit] = colours
        return pixels.reshape(self.camera.height, self.camera.width, 3)

    def shaded(self, colours: UInt8) -> UInt8:
        """Colours (k, 3), darker where a surface is seen edge-on."""
        facing = -(self.normal * self.camera.rays()[self.surface.hit]).sum(axis=1)
        return np.asarray(colours * (1 - EDGE_SHADE + EDGE_SHADE * np.clip(facing, 0, 1))[:, None] + 0.5).astype(np.uint8)

    def reached(self, direction: Float64, some: Int64 | None = None) -> Bool:
        """Which pixels that show a surface, or the ``some`` of them by number, see far towards a direction (3,)."""
        position, normal = (self.position, self.normal) if some is None else (self.position[some], self.normal[some])
        return np.zeros(0, bool) if self.scene.rays is None else self.scene.rays.lit(position, normal, direction)
