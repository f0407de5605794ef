"""Does a line show on a wall that crosses a border of sectors? Served light along such walls, read as a client reads it.

python -m bake_jobs.seam_walls DATASET     a table on stdout

A wall is read every quarter of a metre along a level line: in a window around the border, and in one to either side of it. A line is a bend
in the light: the greatest second difference in the border's window, beside those in the other two.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bake_jobs.compare_points import CLIENT_OFFSET_M
from bake_jobs.compare_states import parse_states
from bake_jobs.rays import RayScene
from bake_jobs.seam_study import STATES
from bake_jobs.street_lamps import ray_scene_of
from gi_core.arrays import Bool, Float64
from gi_core.constants import SECTOR_SIZE_M
from gi_core.dataset import Dataset
from gi_core.engine import Engine
from gi_core.errors import InputError, SectorlightError
from gi_core.grid import SectorIndex
from gi_core.lighting import Lighting
from gi_core.spectrum import LUMINANCE_FROM_RGB
from gi_core.volume import Volume, sample_volume

STEP_M = 0.25
# Walls cross a border at nearly right angles: so much of their normal points along its line. The two voxels whose light meets at the border
# then lie in the border's window.
LEAST_ACROSS = 0.8
WINDOW_M = 8.5
WINDOWS = (-1, 0, 1)
# Heights over the lowest point of a world at which walls are looked for; half a volume.
HEIGHTS_M = np.arange(4.0, 44.0, 5.0)
# From how far apart along a border line walls are looked for, both ways.
SEARCH_M = 4.0
# A wall is one plane: its points lie this close to it.
FLAT_M = 0.02


@dataclass(frozen=True, eq=False)
class Walls:
    """Level lines on flat walls, each through a border line in its middle.

    middle, normal, along : (n, 3) float64 [m], unit, unit; world frame, the normal towards the air
    """

    middle: Float64
    normal: Float64
    along: Float64


def main(arguments: Sequence[str]) -> None:
    """The command line that the module's docstring shows."""
    match arguments:
        case [path]:
            print_table(Engine(Dataset.open(path)))
        case _:
            raise SystemExit(__doc__)


def print_table(engine: Engine) -> None:
    """A row per state: walls, median / 95th percentile of bends at borders and elsewhere [% of the wall's light], and on how many walls the
    border has the greatest of the three. Raises InputError for a dataset without a wall across a border."""
    walls = find_walls(engine.dataset)
    print("| state | walls | bends at the border | elsewhere | the border has the greatest of three |")
    print("|---" * 5 + "|")
    for state in parse_states(STATES, engine.dataset.world.location):
        bends = wall_bends(engine, engine.lighting(state.time, state.weather), walls)
        at_border, others = bends[:, len(WINDOWS) // 2], np.delete(bends, len(WINDOWS) // 2, axis=1)
        cells = ["{:.2f} / {:.1f}".format(*(100 * np.quantile(some, (0.5, 0.95)))) for some in (at_border, others)]
        print(f"| {state.name} | {len(bends)} | {' | '.join(cells)} | {(at_border > others.max(axis=1)).mean():.0%} |")


def find_walls(dataset: Dataset) -> Walls:
    """Walls across the border lines between sectors of a dataset. Raises InputError where there is none."""
    sectors = sorted(dataset.world.sectors)
    rays = ray_scene_of([dataset.geometry(index) for index in sectors])
    low = float(dataset.world.bounds[0, 1])
    found = [(np.empty((0, 3)),) * 3]
    for index in sectors:
        for axis, before in ((0, SectorIndex(index.x - 1, index.z)), (2, SectorIndex(index.x, index.z - 1))):
            if before in dataset.world.sectors:
                found.append(across(rays, index.origin, low, axis))
    middle, normal, along = (np.concatenate([part[n] for part in found]) for n in range(3))
    # A ray along a border line goes on past the sector that it starts in: several find the same wall.
    _, first = np.unique(np.round(middle, 2), axis=0, return_index=True)
    walls = Walls(middle[first], normal[first], along[first])
    if not len(walls.middle):
        raise InputError(f"{dataset.path}: expected a flat wall of {len(WINDOWS) * WINDOW_M:.0f} m across a border of sectors, found none")
    return walls


def across(rays: RayScene, origin: Float64, low_m: float, axis: int) -> tuple[Float64, Float64, Float64]:
    """Middles, normals and directions of walls across a sector's border at its lower end of an axis: looked for along the border line."""
    other = 2 - axis
    starts = np.arange(SEARCH_M / 2, SECTOR_SIZE_M, SEARCH_M)
    y, line, sign = (grid.ravel() for grid in np.meshgrid(low_m + HEIGHTS_M, starts, (-1.0, 1.0), indexing="ij"))
    start = np.zeros((len(y), 3))
    start[:, axis], start[:, 1], start[:, other] = origin[axis], y, origin[other] + line
    way = np.zeros_like(start)
    way[:, other] = sign
    hits = rays.closest(start, way)
    # Seen from its front: a ray that starts in a building meets walls from behind.
    wall = hits.hit & ~hits.from_back & (np.abs(hits.normal[:, 1]) < 0.01) & (np.abs(hits.normal[:, other]) > LEAST_ACROSS)
    middle = start[wall] + way[wall] * hits.distance[wall, None]
    _, first = np.unique(np.round(middle, 2), axis=0, return_index=True)
    middle, normal = middle[first], hits.normal[wall][first].astype(np.float64)
    along = np.cross(normal, [0.0, 1.0, 0.0])
    flat = _is_flat(rays, middle, normal, along) if len(middle) else np.zeros(0, bool)
    return middle[flat], normal[flat], along[flat]


def _is_flat(rays: RayScene, middle: Float64, normal: Float64, along: Float64) -> Bool:
    """(n,) bool: whether lines lie on one plane all along, with nothing before it where a client reads."""
    at = _places()
    air = (middle + CLIENT_OFFSET_M * normal)[:, None] + at[:, None] * along[:, None]
    hits = rays.closest(air.reshape(-1, 3), np.repeat(-normal, len(at), axis=0))
    on_plane = (np.abs(hits.distance - CLIENT_OFFSET_M) < FLAT_M).reshape(len(middle), -1).all(axis=1)
    length = np.full(len(middle), at[-1] - at[0])
    return on_plane & ~rays.occluded(air[:, 0], along, length)


def wall_bends(engine: Engine, lighting: Lighting, walls: Walls) -> Float64:
    """(n, windows): ``bends_along`` each wall, of the volume around its middle."""
    each = zip(walls.middle, walls.normal, walls.along, strict=True)
    return np.array([bends_along(engine.volume(wall[0], lighting, basis="cube"), *wall) for wall in each])


def bends_along(volume: Volume, middle: Float64, normal: Float64, along: Float64) -> Float64:
    """(windows,): the greatest second difference of the light along a wall in each window, as a share of the mean light of all."""
    at = _places()
    points = middle + at[:, None] * along
    light = sample_volume(volume.values, volume.origin, volume.voxel_size, points, np.broadcast_to(normal, points.shape))
    luminance = light @ LUMINANCE_FROM_RGB.astype(np.float64)
    bend = np.abs(np.diff(luminance, 2)) / max(float(luminance.mean()), np.finfo(np.float64).tiny)
    window = np.floor(at[1:-1] / WINDOW_M + 0.5).astype(np.int64)
    return np.array([bend[window == number].max() for number in WINDOWS])


def _places() -> Float64:
    """Where along a wall its light is read [m]: as many steps to both sides of the border, which none of them meets."""
    half = len(WINDOWS) * WINDOW_M / 2
    return np.asarray(np.arange(-half - STEP_M / 2, half + STEP_M, STEP_M))


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except SectorlightError as error:
        raise SystemExit(str(error)) from error
