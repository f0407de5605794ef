"""Does light step in a door? Volumes sampled on a way through one, beside the path tracer.

python -m bake_jobs.door_study DATASET SOURCE X,Y,Z X,Y,Z [STATE...]     a table on stdout, of a way from one place to the other

Light is the mean of irradiance over all directions, as it falls on somebody who walks there. A client may sample the outdoor volume alone;
switch sharply to the interior one where the room begins; or mix the two by ``indoor_shares``.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bake_jobs.compare_states import parse_states
from bake_jobs.path_tracer import PathTracer
from bake_jobs.scene_source import load_scene
from gi_core.arrays import Float32, Float64
from gi_core.basis import average
from gi_core.constants import ROOM_OUTDOORS
from gi_core.dataset import Dataset
from gi_core.engine import Engine
from gi_core.errors import InputError
from gi_core.lighting import Lighting
from gi_core.lights import lamps_on
from gi_core.rooms import indoor_shares, rooms_of
from gi_core.spectrum import LUMINANCE_FROM_RGB
from gi_core.volume import Volume, sample_coefficients

STEP_M = 0.1
STATES = ("noon", "overcast", "night")
SAMPLES = 16384
# Errors are relative to at least this share of the mean on the way, as in ``compare``.
DARKEST = 0.02


@dataclass(frozen=True, eq=False)
class Walk:
    """Light [lx] at places (n, 3) [m], STEP_M apart: each way of sampling it (n,)."""

    place: Float64
    outdoor: Float64
    hard: Float64
    blended: Float64


def main(arguments: Sequence[str]) -> None:
    """The command line that the module's docstring shows."""
    if len(arguments) < 4:
        raise SystemExit(__doc__)
    dataset, source, start, end, *states = arguments
    ends = [np.array([float(part) for part in text.split(",")]) for text in (start, end)]
    print_table(Engine(Dataset.open(dataset)), source, ends[0], ends[1], states or STATES)


def print_table(engine: Engine, source: str, start: Float64, end: Float64, states: Sequence[str]) -> None:
    """A row per state and way of sampling: the largest step [lx] and as a share of the light's range; the mean relative error [%]."""
    scene = load_scene(source)
    tracer = PathTracer(scene.vertices, scene.triangles, scene.albedo, scene.emission)
    print("| state | light | largest step in 0.1 m [lx] | of the walk's range [%] | mean error [%] |\n|---|---|---|---|---|")
    for state in parse_states(states, engine.dataset.world.location):
        lighting = engine.lighting(state.time, state.weather)
        walk = walk_through(engine, start, end, lighting)
        estimate = tracer.cube_irradiance(walk.place, lighting, lamps_on(engine.lamps, lighting), samples=SAMPLES)
        truth = _mean_light(estimate.mean.astype(np.float32))
        for name, light in (("outdoor volume", walk.outdoor), ("hard", walk.hard), ("blended", walk.blended), ("path tracer", truth)):
            error = np.mean(np.abs(light - truth) / np.maximum(truth, DARKEST * truth.mean()))
            step = largest_step(light)
            print(f"| {state.name} | {name} | {step:.3g} | {100 * step / np.ptp(truth):.1f} | {100 * error:.0f} |")


def walk_through(engine: Engine, start: Float64, end: Float64, lighting: Lighting) -> Walk:
    """Light on the straight way between two places (3,) [m] that passes into or out of one room.

    Raises InputError for a way that touches no room, and what ``Engine.interior`` raises.
    """
    length = float(np.linalg.norm(end - start))
    place = start + np.arange(0, length, STEP_M)[:, None] * (end - start) / length
    rooms = engine.dataset.world.rooms
    room, share = indoor_shares(place, rooms)
    touched = np.unique(room[room != ROOM_OUTDOORS])
    if len(touched) != 1:
        raise InputError(f"expected a way into one room, found {len(touched)}")
    middle = (start + end) / 2
    outdoor = _sampled(engine.volume(middle, lighting, basis="cube"), place)
    indoor = _sampled(engine.interior(middle, lighting, basis="cube", room=str(touched[0])), place)
    hard = np.where(rooms_of(place, rooms) != ROOM_OUTDOORS, indoor, outdoor)
    return Walk(place, outdoor, hard, (1 - share) * outdoor + share * indoor)


def largest_step(light: Float64) -> float:
    """Between neighbouring places."""
    return float(np.abs(np.diff(light)).max())


def _sampled(volume: Volume, place: Float64) -> Float64:
    mean = average(volume.values)[None]
    return np.asarray(sample_coefficients(mean, volume.origin, volume.voxel_size, place)[:, 0] @ LUMINANCE_FROM_RGB, np.float64)


def _mean_light(cubes: Float32) -> Float64:
    """(n,) of cubes (n, 6, 3)."""
    return np.asarray(cubes.mean(axis=1) @ LUMINANCE_FROM_RGB, np.float64)


if __name__ == "__main__":
    main(sys.argv[1:])
