"""What do voxels cost in rooms? Surfaces lit by exact light in voxels of several sizes, beside what is served.

python -m bake_jobs.room_voxel_study DATASET [--sectors N] [--points N] [--samples N] [STATE...]     a table on stdout

Exact light is path-traced at the centres of all voxels that lie in a room, which are then sampled as interior volumes are: the others
hold what the nearest of these does, and at openings what is beyond is mixed in, as it is served. Where a room holds no voxel's centre,
what is served stands.
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bake_jobs.compare import Reference, choose_sectors, dataset_tracer, room_points_of, sector_rng
from bake_jobs.compare_report import StageSamples, summarise
from bake_jobs.compare_states import parse_states
from gi_core.arrays import Float64
from gi_core.client_light import Look, ServedLight, VolumeAt
from gi_core.constants import SECTOR_SIZE_M, VOXEL_SIZE_M
from gi_core.dataset import Dataset
from gi_core.engine import Engine
from gi_core.grid import voxel_centre
from gi_core.lights import lamps_on
from gi_core.rooms import holds, nearest
from gi_core.volume import Volume
from gi_core.world import Room

# Of voxels of 3.1, 1.6 and 0.8 m.
CASCADES = (0, -1, -2)
STATES = ("noon", "overcast")


def main() -> None:
    """The command line that the module's docstring shows."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dataset")
    parser.add_argument("states", nargs="*", default=list(STATES))
    parser.add_argument("--sectors", type=int, default=3)
    parser.add_argument("--points", type=int, default=40, help="in rooms, a sector")
    parser.add_argument("--samples", type=int, default=1024, help="paths a value")
    options = parser.parse_args()
    print("| state | light | n | median | p95 | bias | noise |\n|---|---|---|---|---|---|---|")
    for state, rows in study(Dataset.open(options.dataset), options.states, options.sectors, options.points, options.samples).items():
        for name, found in rows.items():
            numbers = summarise(found)
            shares = " | ".join(f"{100 * numbers[key]:.1f}" for key in ("median", "p95", "bias", "noise"))
            print(f"| {state} | {name} | {numbers['n']} | {shares} |")


def study(
    dataset: Dataset, states: Sequence[str], sectors: int, points: int, samples: int, cascades: Sequence[int] = CASCADES
) -> dict[str, dict[str, StageSamples]]:
    """Per state: what is served, and exact light in voxels of each cascade's size; each beside the path tracer at the same points."""
    world, engine = dataset.world, Engine(dataset)
    chosen = choose_sectors(dataset, 0, sectors)
    tracer = dataset_tracer(dataset, chosen)
    names = ["served", *(f"exact, {VOXEL_SIZE_M * 2.0**cascade:.2f} m" for cascade in cascades)]
    moments = parse_states(states, world.location)
    found = {state.name: {name: StageSamples() for name in names} for state in moments}
    for state in moments:
        lighting = engine.lighting(state.time, state.weather)
        for index in chosen:
            surface, normal = room_points_of(dataset, index, points, 0)
            if not len(surface):
                continue
            rng = sector_rng(0, index, lighting.digest)
            reference = Reference(tracer, lighting, lamps_on(engine.lamps, lighting), samples, rng, world.basis)
            truth = reference.surfaces(surface, normal)
            served = ServedLight.of(engine, lighting, Look(distant="off"), index.origin + SECTOR_SIZE_M / 2, basis=world.basis)
            lights = [served, *(replace(served, volume_at=_exactly(served, reference, world.rooms, c)) for c in cascades)]
            for name, light in zip(names, lights, strict=True):
                found[state.name][name].add(light.irradiance(surface, normal.astype(np.float32)), truth)
    return found


def _exactly(served: ServedLight, reference: Reference, rooms: tuple[Room, ...], cascade: int) -> VolumeAt:
    """``served``'s volumes, but of rooms those of exact light."""
    known: dict[int, Volume] = {}

    def volume_at(position: Float64, room: int) -> Volume:
        if not room:
            return served.volume_at(position, room)
        if room not in known:
            known[room] = _exact(rooms[room - 1], cascade, reference) or served.volume_at(position, room)
        return known[room]

    return volume_at


def _exact(room: Room, cascade: int, reference: Reference) -> Volume | None:
    """Of the voxels around a room; None where none has its centre in it."""
    size_m = VOXEL_SIZE_M * 2.0**cascade
    first = np.floor(np.array(room.minimum) / size_m).astype(np.int64)
    shape = np.ceil(np.array(room.maximum) / size_m).astype(np.int64) - first
    y, z, x = np.indices(shape[[1, 2, 0]].tolist())
    inside = holds(room, voxel_centre(np.stack([x, y, z], axis=-1).reshape(-1, 3) + first, size_m)).reshape(y.shape)
    if not inside.any():
        return None
    y, z, x = np.nonzero(inside)
    traced = reference.exact(voxel_centre(np.stack([x, y, z], axis=1) + first, size_m), (reference.basis,))[0].mean
    values = np.zeros((*inside.shape, *traced.shape[1:]), np.float32)
    values[y, z, x] = traced
    values = np.ascontiguousarray(np.moveaxis(values[nearest(inside)], 3, 0))
    return Volume(values, inside.astype(np.uint8), first, (), reference.basis, cascade=cascade)


if __name__ == "__main__":
    main()
