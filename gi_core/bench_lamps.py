"""Timings of lamps that move, beside their baselines: a made-up sector of the talk's size in a made-up city of boxes."""

import itertools
from dataclasses import replace

import numpy as np

from gi_core import lights_twin
from gi_core.arrays import Float64
from gi_core.bench import Measurement, side_by_side, talk_size_sector
from gi_core.constants import SECTOR_SIZE_M
from gi_core.device import Device
from gi_core.geometry_file import Geometry
from gi_core.grid import SectorIndex
from gi_core.light_geometry import ShadowGeometry
from gi_core.light_plan import SurfelBounds, touching_lamps
from gi_core.light_surfels import SurfelLights
from gi_core.lights import light_records
from gi_core.sector import Sector, counts
from gi_core.world import Lamp

BOXES_PER_SECTOR = 40  # 400 triangles; Midtown has 300 to 600
MANY_LAMPS = 200
LAMP_HEIGHT_M = 8.0
_BRICK_M = 4.0


def bench_lamps(device: Device, quick: bool = False) -> list[Measurement]:
    """A moved street lamp (8 m up, range 30 m) on one sector, host and device: retraced, and the sector's surfels summed anew.

    Baselines: the NumPy twin, which looks at every triangle near the lamp; and, for one of many, all of them anew.
    """
    rng = np.random.default_rng(0)
    here = SectorIndex(0, 0)
    boxes = {SectorIndex(x, z): _boxes(rng) for x in (-1, 0, 1) for z in (-1, 0, 1)}
    shadows = ShadowGeometry({index: _geometry(index, *corners) for index, corners in boxes.items()}.__getitem__, boxes)
    sector = _sector(rng, *boxes[here])
    low, high = boxes[here]
    places = rng.uniform(4, SECTOR_SIZE_M - 4, (4096, 3)) * (1, 0, 1) + (0, LAMP_HEIGHT_M, 0)
    in_air = [p for p in places if not ((p > low - 0.5) & (p < high + 0.5)).all(axis=1).any()]
    lamps = [Lamp(str(i), "point", (float(x), float(y), float(z)), 8000.0) for i, (x, y, z) in enumerate(in_air[: 2 * MANY_LAMPS])]
    turn = itertools.count()

    alone = SurfelLights(device, sector, shadows)
    bounds = SurfelBounds(sector)
    surfel_places = lights_twin.surfel_places(sector)

    def move() -> None:
        alone.set_dynamic([lamps[next(turn) % len(lamps)]])
        device.queue.finish()

    def twin() -> None:
        (found,) = touching_lamps([lamps[next(turn) % len(lamps)]], bounds)
        near = lights_twin.shadow_triangles(shadows, found, sector.index.origin)
        lights_twin.light_surfels(light_records([found.lamp], sector.index.origin), surfel_places, [near])

    triangles = len(lights_twin.shadow_triangles(shadows, touching_lamps(lamps[:1], bounds)[0], sector.index.origin))
    sizes = {"lamps": 1, "surfels": sector.surfel_count, "triangles": triangles}
    moved = _row(
        "lamp_moved", side_by_side(move, twin, 1 if quick else 7, calls=20), sizes, device, "NumPy twin, every triangle near the lamp"
    )
    if quick:
        return [moved]

    among, anew = SurfelLights(device, sector, shadows), SurfelLights(device, sector, shadows)
    given = lamps[:MANY_LAMPS]

    def move_one() -> None:
        number = next(turn)
        given[number % MANY_LAMPS] = lamps[number % len(lamps)]
        among.set_dynamic(given)
        device.queue.finish()

    def light_all() -> None:
        anew.set_dynamic([])
        anew.set_dynamic(given)
        device.queue.finish()

    sizes = {"lamps": MANY_LAMPS, "surfels": sector.surfel_count}
    return [moved, _row("lamp_moved_among_many", side_by_side(move_one, light_all, 7, calls=20), sizes, device, "all of the lamps anew")]


def _row(name: str, seconds: tuple[float, float], sizes: dict[str, int], device: Device, baseline_is: str) -> Measurement:
    median, baseline = (1e3 * value for value in seconds)
    return Measurement(name, median, "ms", baseline, baseline / median, sizes, device.name, baseline_is)


def _boxes(rng: np.random.Generator) -> tuple[Float64, Float64]:
    """Lowest and highest corners (n, 3) [m], sector-local, of houses."""
    low = rng.uniform(0, SECTOR_SIZE_M - 14, (BOXES_PER_SECTOR, 3)) * (1, 0, 1)
    return low, low + np.column_stack(
        [rng.uniform(4, 14, low.shape[0]), rng.uniform(5, 60, low.shape[0]), rng.uniform(4, 14, low.shape[0])]
    )


def _geometry(index: SectorIndex, low: Float64, high: Float64) -> Geometry:
    """Boxes without a bottom, and the ground."""
    corner = np.array(list(itertools.product((0, 1), repeat=3)))  # x, y, z; corner 4 x + 2 y + z
    quads = np.array([[2, 3, 7, 6], [0, 1, 3, 2], [4, 6, 7, 5], [0, 2, 6, 4], [1, 5, 7, 3]])
    vertices = (low[:, None] + corner * (high - low)[:, None]).reshape(-1, 3)
    faces = (8 * np.arange(len(low))[:, None, None] + quads).reshape(-1, 4)
    ground = np.array([[0, 0, 0], [0, 0, 1], [1, 0, 1], [1, 0, 0]]) * SECTOR_SIZE_M
    faces = np.concatenate([faces, len(vertices) + np.arange(4)[None]])
    triangles = np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]]).astype(np.int32)
    grey = np.full((len(triangles), 3), 0.4, np.float32)
    return Geometry(np.concatenate([vertices, ground]) + index.origin, triangles, grey, np.zeros_like(grey))


def _sector(rng: np.random.Generator, low: Float64, high: Float64) -> Sector:
    """The talk's size, its bricks on the boxes' sides and roofs."""
    sector = talk_size_sector(0)
    bricks = len(sector.brick_starts) - 1
    box, axis, side = rng.integers(0, len(low), bricks), rng.integers(0, 3, bricks), rng.integers(0, 2, bricks)
    side = np.where(axis == 1, 1, side)
    order = np.lexsort((axis, box))
    box, axis, side = box[order], axis[order], side[order]
    patch = low[box] + rng.uniform(0, 1, (bricks, 3)) * np.maximum(high[box] - low[box] - _BRICK_M, 0)
    of_surfel = np.repeat(np.arange(bricks), counts(sector.brick_starts))
    position = patch[of_surfel] + rng.uniform(0, _BRICK_M, (len(of_surfel), 3))
    on_face = np.where(side == 1, high[box, axis], low[box, axis])[of_surfel]
    np.put_along_axis(position, axis[of_surfel, None], on_face[:, None], axis=1)
    normal = np.zeros_like(position)
    np.put_along_axis(normal, axis[of_surfel, None], (2.0 * side - 1)[of_surfel, None], axis=1)
    return replace(sector, surfel_position=position.astype(np.float32), surfel_normal=normal.astype(np.float32))
