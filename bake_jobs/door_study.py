"""Does light step in a door? Volumes sampled on a way through one, beside the path tracer.

python -m bake_jobs.door_study DATASET SOURCE X,Y,Z X,Y,Z [STATE...]     a table on stdout, of a way from one place to the other

Light is the mean of irradiance over all directions, as it falls on somebody who walks there. A client may sample one volume alone, the
outdoor one or a room's; switch sharply from one to the next where that one's room begins; or mix them by ``light_shares``.
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
from gi_core.rooms import light_shares, rooms_of
from gi_core.spectrum import LUMINANCE_FROM_RGB
from gi_core.volume import Volume, sample_coefficients

STEP_M = 0.1
STATES = ("noon", "overcast", "night")
SAMPLES = 16384
# Errors are relative to at least this share of the mean on the way, as in ``compare``.
DARKEST = 0.02


@dataclass(frozen=True, eq=False)
class Walk:
    """Light [lx] at places (n, 3) [m], STEP_M apart: (n,) of each volume that has a part in it, by its room (0: outdoors), and mixed."""

    place: Float64
    volumes: dict[int, Float64]
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
        names = {number: f"volume of {room.name}" for number, room in enumerate(engine.dataset.world.rooms, 1)}
        volumes = [(names.get(number, "outdoor volume"), light) for number, light in walk.volumes.items()]
        for name, light in (*volumes, ("hard", walk.hard), ("blended", walk.blended), ("path tracer", truth)):
            error = np.mean(np.abs(light - truth) / np.maximum(truth, DARKEST * truth.mean()))
            step = largest_step(light)
            print(f"| {state.name} | {name} | {step:.3g} | {100 * step / np.ptp(truth):.1f} | {100 * error:.0f} |")


def walk_through(engine: Engine, start: Float64, end: Float64, lighting: Lighting) -> Walk:
    """Light on the straight way between two places (3,) [m] that passes into or out of a room.

    Raises InputError for a way that touches no room, and what ``Engine.interior`` raises.
    """
    length = float(np.linalg.norm(end - start))
    place = start + np.arange(0, length, STEP_M)[:, None] * (end - start) / length
    rooms = engine.dataset.world.rooms
    shares, own = light_shares(place, rooms), rooms_of(place, rooms)
    touched = np.unique(shares.room).tolist()
    if touched == [ROOM_OUTDOORS]:
        raise InputError("expected a way into a room, found one that touches none")
    middle = (start + end) / 2
    volumes = {
        number: _sampled(
            engine.interior(middle, lighting, basis="cube", room=str(number)) if number else engine.volume(middle, lighting, basis="cube"),
            place,
        )
        for number in touched
    }
    blended = sum((shares.of(number, len(place)) * light for number, light in volumes.items()), start=np.zeros(len(place)))
    if ROOM_OUTDOORS not in touched:  # a switch in the middle of the wall, where no room is
        inside = np.flatnonzero(own != ROOM_OUTDOORS)
        own = own[inside[np.abs(np.arange(len(place))[:, None] - inside).argmin(axis=1)]]
    return Walk(place, volumes, np.choose(np.searchsorted(touched, own), list(volumes.values())), blended)


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
