"""Lamps in a picture: their direct light on what is seen, with shadow rays, and the lamps themselves.

The photometry is that of the relighter's twin. Each lamp is worked out for the pixels within its range only: pixels are sorted into
cells of the world, and a lamp takes the cells that it reaches.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gi_core.arrays import AnyArray, Float32, Float64, Int64
from gi_core.layout import LAMP_RADIUS_M, LOCAL_AREA, LOCAL_SPOT, SHADOW_END_M
from gi_core.lights import light_records
from gi_core.lights_twin import PLACE, ray_targets, unshadowed, visible_share
from gi_core.world import Lamp
from server.camera import Camera
from server.raycast import RayCaster

# Edge of the cells that pixels are sorted into: a thousand cells in a street, and little beyond a lamp's range in any of them.
CELL_M = 4.0
# A lamp dazzles: its light reaches the eye from about this far around it (standard deviation), or from a pixel where those are larger.
GLARE_RADIANS = np.radians(0.1)
GLARE_MIN_PIXELS = 0.7
# Beyond this many standard deviations even a floodlight's glare is black.
GLARE_EXTENT = 6.0


@dataclass(frozen=True, eq=False)
class PixelCells:
    """Surface points sorted by cell of the world.

    order : (n,) the points' numbers, cell by cell
    starts : (c + 1,), where each cell's begin in ``order``
    low, high : (c, 3) [m], the box around each cell's points
    """

    order: Int64
    starts: Int64
    low: Float64
    high: Float64

    @classmethod
    def of(cls, position: Float64) -> "PixelCells":
        """Cells of points (n, 3) [m], n > 0."""
        cell = np.floor(position / CELL_M).astype(np.int64)
        cell -= cell.min(axis=0)
        key = np.ravel_multi_index(tuple(cell.T), tuple(cell.max(axis=0) + 1))
        order = np.argsort(key, kind="stable")
        first = np.flatnonzero(np.diff(key[order], prepend=-1))
        low, high = (bound.reduceat(position[order], first, axis=0) for bound in (np.minimum, np.maximum))
        return cls(order, np.append(first, len(order)), low, high)

    def within(self, centre: Float64, reach: float) -> Int64:
        """Places in ``order`` of the points in all cells that come within ``reach`` [m] of a place (3,)."""
        beyond = centre - np.clip(centre, self.low, self.high)
        cells = np.flatnonzero(np.einsum("ij,ij->i", beyond, beyond) < reach**2)
        runs = [np.arange(self.starts[cell], self.starts[cell + 1]) for cell in cells]
        return np.concatenate(runs) if runs else self.order[:0]


def lamp_irradiance(rays: RayCaster, lamps: Sequence[Lamp], position: Float64, normal: Float32) -> Float32:
    """Direct light (n, 3) float32 [lx] of lamps on surface points (n, 3) [m] with normals (n, 3), shadowed."""
    irradiance = np.zeros((len(position), 3), np.float32)
    if not len(position) or not lamps:
        return irradiance
    cells = PixelCells.of(position)
    # In the cells' order a lamp's points lie side by side: gathering them costs half as much.
    places = np.zeros(len(position), PLACE)
    places["position"], places["normal"] = (position - rays.anchor)[cells.order], normal[cells.order]
    total = np.zeros_like(irradiance)
    for light in light_records(lamps, rays.anchor):
        near = cells.within(light["position"] + rays.anchor, float(light["range"]))
        received = unshadowed(light, _rows(places, near))
        lit = np.flatnonzero(received)
        near, received = near[lit], received[lit]
        some = _rows(places, near)
        arrives = np.stack(
            [rays.sees(some["position"] + rays.anchor, some["normal"], target + rays.anchor) for target in ray_targets(light)]
        )
        total[near] += (received * visible_share(light, some, arrives))[:, None] * light["intensity"]
    irradiance[cells.order] = total
    return irradiance


def _rows(places: AnyArray, numbers: Int64) -> AnyArray:
    """``places[numbers]``: NumPy gathers rows of floats in a third of the time that it takes for records."""
    return places.view(np.float32).reshape(len(places), -1).take(numbers, axis=0).view(places.dtype)[:, 0]


def draw_lamps(picture: Float32, camera: Camera, rays: RayCaster, lamps: Sequence[Lamp], distance: Float64, fog_density: float) -> None:
    """Draw the lamps that are seen into a picture (rows, columns, 3) [cd m^-2], in place.

    distance : (rows * columns,) [m] to what each pixel shows, inf for the sky; fog_density : extinction [m^-1]
    Lamps outside the box of the loaded geometry are left out: they would shine through what is not loaded.
    """
    here = [lamp for lamp in lamps if rays.contains(np.array(lamp.position))]
    for light in light_records(here, rays.anchor):
        if light["kind"] == LOCAL_AREA:
            _draw_area(picture, camera, rays.anchor, light, distance, fog_density)
        else:
            _draw_glare(picture, camera, rays, light, fog_density)


def _draw_glare(picture: Float32, camera: Camera, rays: RayCaster, light: AnyArray, fog_density: float) -> None:
    """A point or a spot: what reaches the eye of it, spread by a Gaussian that keeps its sum."""
    place = light["position"].astype(np.float64) + rays.anchor
    column, row, depth = camera.project(place[None])[0]
    if depth <= 0:
        return
    way = camera.eye - place
    length = max(float(np.linalg.norm(way)), LAMP_RADIUS_M)
    strength = np.exp(-fog_density * length) / length**2
    if light["kind"] == LOCAL_SPOT:
        edge = np.clip((way @ light["axis"] / length - light["cos_outer"]) / (light["cos_inner"] - light["cos_outer"]), 0, 1)
        strength *= edge * edge * (3 - 2 * edge)
    # A disc's variance along a line is a quarter of its radius squared.
    spread = max(float(np.hypot(GLARE_RADIANS, LAMP_RADIUS_M / 2 / length)) / camera.pixel_size, GLARE_MIN_PIXELS)
    rows, columns = (_around(at, GLARE_EXTENT * spread, size) for at, size in zip((row, column), picture.shape[:2], strict=True))
    if strength <= 0 or not len(rows) or not len(columns) or not rays.sees_from(camera.eye, place):
        return
    across, down = (np.exp(-(((at - centre) / spread) ** 2) / 2) for at, centre in ((columns, column), (rows, row)))
    cosine = depth / max(float(np.linalg.norm(camera.eye - place)), 1e-9)
    solid_angle = camera.pixel_size**2 * cosine**3 * 2 * np.pi * spread**2
    glare = np.outer(down, across)[..., None] * (light["intensity"] * (strength / solid_angle))
    picture[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] += glare.astype(np.float32)


def _around(centre: float, reach: float, size: int) -> Int64:
    """Pixels 0..size - 1 within ``reach`` of a place along one axis."""
    return np.arange(max(int(np.ceil(centre - reach)), 0), min(int(np.floor(centre + reach)), size - 1) + 1)


def _draw_area(picture: Float32, camera: Camera, anchor: Float64, light: AnyArray, distance: Float64, fog_density: float) -> None:
    """A rectangle, where a pixel's ray meets its bright side before anything else."""
    to_centre = light["position"] + anchor - camera.eye
    facing = float(to_centre @ light["axis"])
    if facing >= 0:
        return
    directions = camera.rays()
    falling = directions @ light["axis"]
    ahead = np.flatnonzero(falling < 0)
    along = facing / falling[ahead]
    offset = along[:, None] * directions[ahead] - to_centre
    inside = along < distance[ahead] + SHADOW_END_M  # it may lie in a surface, as one in a ceiling does
    for half in (light["half_u"], light["half_v"]):
        inside &= np.abs(offset @ half) <= half @ half
    seen, kept = ahead[inside], np.exp(-fog_density * along[inside])[:, None]
    flat = picture.reshape(-1, 3)
    flat[seen] = light["intensity"] * kept + flat[seen] * (1 - kept)
