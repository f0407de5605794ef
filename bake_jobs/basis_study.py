"""What each directional basis costs on a city's own light, transport being perfect: a study, no part of a bake.

    python -m bake_jobs.basis_study SOURCE X0:X1,Z0:Z1 [STATES]

At points in the open air of some sectors, one set of paths gives exact irradiance on surfaces that face anywhere, and as the sector's own
do, and the coefficients of every basis; so what differs is the basis alone, and no noise. Its price is told as the bytes of a volume in
halves, and as the time that NumPy takes to read it at a thousand points. Beside the three that are baked:

    cube, least squares   faces that fit irradiance over all normals best, instead of being it along the axes
    sh1, linear           without what ZH3 adds
    eight vectors         what the talk tried before the cube (its details are not published): irradiance along the eight diagonals, blended
                          by the squares of clamped cosines, normalised
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial

import numpy as np

from bake_jobs.compare_points import drawn_by_area, look_around
from bake_jobs.compare_states import parse_states
from bake_jobs.config import settings_for
from bake_jobs.inside import Solids
from bake_jobs.path_tracer import PathTracer
from bake_jobs.placement import place_probes
from bake_jobs.scene import Scene
from bake_jobs.scene_source import load_scene
from gi_core.ambient_cube import basis_weights
from gi_core.arrays import AnyArray, Float32, Float64
from gi_core.basis import evaluate, evaluation_weights, projection_weights
from gi_core.bench import side_by_side
from gi_core.constants import SECTOR_SIZE_M, VOLUME_SHAPE
from gi_core.error_report import DARKEST_SHARE_OF_MEAN
from gi_core.grid import SectorIndex
from gi_core.lighting_model import make_lighting
from gi_core.spectrum import LUMINANCE_FROM_RGB

POINTS_PER_SECTOR = 40
# Of surfaces that face anywhere, and of a sector's own.
NORMALS, OWN_NORMALS = 96, 32
TIMED_POINTS, TIMES = 20_000, 9
SAMPLES = 4096
DIAGONALS = np.array([[x, y, z] for x in (1, -1) for y in (1, -1) for z in (1, -1)], np.float64) / np.sqrt(3)


@dataclass(frozen=True)
class Study:
    """One way to hold irradiance. project : directions (m, 3) -> (m, B) per steradian; rebuild : (p, B, 3), normals (p, 3) -> (p, 3)."""

    coefficients: int
    project: Callable[[AnyArray], AnyArray]
    rebuild: Callable[[AnyArray, AnyArray], AnyArray]


def spiral(count: int) -> Float64:
    """(count, 3) unit vectors, spread evenly over the sphere."""
    y = 1 - (2 * np.arange(count) + 1) / count
    turn = np.arange(count) * np.pi * (3 - np.sqrt(5))
    level = np.sqrt(1 - y * y)
    return np.stack([level * np.cos(turn), y, level * np.sin(turn)], axis=1)


@cache
def cube_least_squares() -> Float64:
    """(6, 9): the faces whose blend lies closest to irradiance in sh2 over all normals."""
    normals = spiral(20_000)
    faces = basis_weights(normals.astype(np.float32)).astype(np.float64)
    return np.asarray(np.linalg.lstsq(faces, evaluation_weights("sh2", normals), rcond=None)[0])


def diagonal_weights(normals: AnyArray) -> AnyArray:
    """(n, 8): squares of clamped cosines to the diagonals, normalised: never negative, exact for uniform light."""
    squares = np.maximum(normals @ DIAGONALS.T, 0) ** 2
    return np.asarray(squares / squares.sum(axis=1, keepdims=True))


def _baked(basis: str, size: int) -> Study:
    return Study(size, lambda d: projection_weights(basis, d), lambda c, n: evaluate(basis, c, n))


def _linear(project: Callable[[AnyArray], AnyArray], weights: Callable[[AnyArray], AnyArray], size: int) -> Study:
    return Study(size, project, lambda c, n: np.maximum(np.einsum("pb,pbc->pc", weights(n), c), 0))


STUDIES = {
    "cube": _baked("cube", 6),
    "cube, least squares": _linear(
        lambda d: projection_weights("sh2", d) @ cube_least_squares().T.astype(d.dtype), lambda n: basis_weights(n.astype(np.float32)), 6
    ),
    "sh1, linear": _linear(lambda d: projection_weights("sh1", d), lambda n: evaluation_weights("sh1", n), 4),
    "sh1": _baked("sh1", 4),
    "sh2": _baked("sh2", 9),
    "eight vectors": _linear(lambda d: np.maximum(d @ DIAGONALS.T.astype(d.dtype), 0), diagonal_weights, 8),
}


@dataclass(frozen=True, eq=False)
class Errors:
    """Relative errors of luminance, of all points and states: (e,) on surfaces that face anywhere, (o,) as the sector's own do."""

    anywhere: Float64
    own: Float64


def own_normals(scene: Scene, index: SectorIndex) -> Float64:
    """(OWN_NORMALS, 3) of triangles whose middle is in a sector, drawn by area; of all triangles where it has none."""
    corners = scene.vertices[scene.triangles]
    here = (np.floor(corners.mean(axis=1)[:, [0, 2]] / SECTOR_SIZE_M) == np.array(index)).all(axis=1)
    drawn = (drawn_by_area(some, OWN_NORMALS, np.random.default_rng(0))[1] for some in (corners[here], corners))
    return next(normals for normals in drawn if len(normals))


def errors(source: str, sectors: list[SectorIndex], states: list[str]) -> dict[str, Errors]:
    """Errors of each way to hold irradiance."""
    scene, settings = load_scene(source), settings_for("talk")
    tracer = PathTracer(scene.vertices, scene.triangles, scene.albedo, scene.emission)
    solids = Solids(scene.vertices, scene.triangles)
    found: dict[str, list[tuple[Float64, Float64]]] = {name: [] for name in STUDIES}
    for index in sectors:
        normals = np.concatenate([spiral(NORMALS), own_normals(scene, index)])
        placed = place_probes(tracer.rays, solids, scene.bounds, index, settings, scene.rooms, scene.hints).position
        open_air = np.flatnonzero(look_around(tracer.rays, placed).open_air)
        points = placed[np.random.default_rng(0).permutation(open_air)[:POINTS_PER_SECTOR]]
        for state in parse_states(states, scene.location):
            lighting = make_lighting(scene.location, state.time, state.weather)
            ends = np.cumsum([len(normals), *(study.coefficients for study in STUDIES.values())])[:-1]

            def project(directions: Float32, normals: Float64 = normals) -> AnyArray:
                truth = np.maximum(directions @ normals.T.astype(np.float32), 0)
                return np.concatenate([truth, *(study.project(directions) for study in STUDIES.values())], axis=1)

            light = tracer.projected_irradiance(points, lighting, (), project, samples=SAMPLES).mean
            truth, *parts = np.split(light, ends, axis=1)
            exact = truth @ LUMINANCE_FROM_RGB
            scale = np.maximum(exact, DARKEST_SHARE_OF_MEAN * exact.mean())
            for (name, study), coefficients in zip(STUDIES.items(), parts, strict=True):
                rebuilt = study.rebuild(np.repeat(coefficients, len(normals), axis=0), np.tile(normals, (len(points), 1)))
                error = np.abs((rebuilt @ LUMINANCE_FROM_RGB).reshape(exact.shape) - exact) / scale
                found[name].append((error[:, :NORMALS].reshape(-1), error[:, NORMALS:].reshape(-1)))
    return {name: Errors(*(np.concatenate(kind) for kind in zip(*parts, strict=True))) for name, parts in found.items()}


def microseconds(study: Study) -> float:
    """What reading a thousand points takes, the median of several times."""
    normals = spiral(TIMED_POINTS).astype(np.float32)
    coefficients = np.ones((TIMED_POINTS, study.coefficients, 3), np.float32)
    read = partial(study.rebuild, coefficients, normals)
    return side_by_side(read, read, rounds=TIMES)[0] * 1e6 / TIMED_POINTS * 1000


def main() -> None:
    """Print the table for a source, as Markdown."""
    (x0, x1), (z0, z1) = ([int(n) for n in part.split(":")] for part in sys.argv[2].split(","))
    states = sys.argv[3].split(",") if len(sys.argv) > 3 else ["noon", "low_sun", "overcast"]
    table = errors(sys.argv[1], [SectorIndex(x, z) for x in range(x0, x1) for z in range(z0, z1)], states)
    print("| basis | numbers a channel | kB a volume | a thousand points [us] | facing anywhere | as its own surfaces |")
    print("|---|---|---|---|---|---|")
    for name, error in table.items():
        study = STUDIES[name]
        kilobytes = 2 * 3 * study.coefficients * np.prod(VOLUME_SHAPE) / 1000
        shown = [f"{100 * np.median(e):.1f} / {100 * np.quantile(e, 0.95):.0f} %" for e in (error.anywhere, error.own)]
        print(f"| {name} | {study.coefficients} | {kilobytes:.0f} | {microseconds(study):.0f} | {' | '.join(shown)} |")


if __name__ == "__main__":
    main()
