"""How wrong is what a dataset serves? Measured against the path tracer, on the dataset's own triangles, under the same lighting.

    stage    served                                                reference
    probes   lit probe cubes                                       six-face irradiance at the probe
    near     volume voxels within 3.2 m of a surface               six-face irradiance at the voxel's centre
    mid      volume voxels 6 m or more from any surface            the same
    shaded   the volume, sampled as a client samples it            irradiance on the surface point itself
    floor    exact light in place of the volume's, sampled alike   the same

``floor`` is what basis and voxel size cost when transport and interpolation are perfect: exact light at all open-air voxels, each
other voxel filled from the nearest of them. Voxels in walls that are fitted to their readers (wall_weights=fitted) can be better than that.

All is in the dataset's basis: of harmonics, what they say of the six faces is compared with what exact harmonics would say. Their
dataset has two stages more, ``shaded_cube`` and ``floor_cube``: the same points when the cube is served instead.

A dataset with fine voxels has ``shaded_fine``: the same points read from volumes of cascade -1. One with rooms has ``shaded_rooms``:
points on surfaces in rooms, which read interior volumes, and near openings a mix with what is beyond.

Of the dataset only the served light is believed. Points come from ``compare_points``; surroundings that a partial bake leaves out
must be handed in as ``scene``, or the reference is lit through the gap.
"""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bake_jobs.compare_points import CLIENT_OFFSET_M, SectorPoints, choose_points, corner_voxels, nearest_open_voxel, points_in_rooms
from bake_jobs.compare_report import StageSamples, summarise
from bake_jobs.compare_states import DEFAULT_STATES, parse_states
from bake_jobs.path_tracer import Estimate, PathTracer, Projector, cube_projector
from bake_jobs.scene import Scene
from gi_core.arrays import Float32, Float64, Int64
from gi_core.basis import conversion, projection_weights
from gi_core.client_light import Look, ServedLight
from gi_core.constants import BASIS_SIZES, FINE_VOXEL_SIZE_M, SECTOR_SIZE_M, VOLUME_SHAPE, VOXEL_NO_SECTOR, VOXEL_OUTDOORS
from gi_core.dataset import Dataset
from gi_core.engine import Engine
from gi_core.errors import InputError
from gi_core.grid import SectorIndex, voxel_centre
from gi_core.lighting import Lighting
from gi_core.lights import lamps_digest, lamps_on
from gi_core.volume import Volume, sample_volume
from gi_core.world import Lamp

# Beyond this, a building hides less of the sky than the reference's noise.
GEOMETRY_REACH_M = 1024.0
DEFAULT_SECTORS = 9
DAYLIGHT_LX = 100.0
STAGES = ("probes", "near", "mid", "shaded", "floor")
CUBE_STAGES = ("shaded_cube", "floor_cube")
FINE_STAGES, ROOM_STAGES = ("shaded_fine",), ("shaded_rooms", "shaded_rooms_cube")
# Of the draw of points in rooms; those outdoors are the same with rooms and without.
_IN_ROOMS = "1"
# A volume of cascade -1 covers this much around its centre, wherever the lattice has it.
FINE_TILE_M = FINE_VOXEL_SIZE_M * (np.array([VOLUME_SHAPE[2], VOLUME_SHAPE[0], VOLUME_SHAPE[1]]) - 4)
Progress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class Reference:
    """The path tracer under one lighting and its lamps. Every call draws its own seed, so that no two stages share their noise."""

    tracer: PathTracer
    lighting: Lighting
    lamps: tuple[Lamp, ...]
    samples: int
    rng: np.random.Generator
    basis: str = "cube"
    known: dict[bytes, list[Estimate]] | None = None
    """Estimates by what was asked for: shared by comparisons of bakes of one scene, whose points off the probes are the same."""

    def cubes(self, points: Float64) -> Estimate:
        """(n, 3) [m] -> Estimate of (n, 6, 3) [lx]: the six faces as the dataset's basis has them."""
        faces = cube_projector(self.basis)
        return self._once(("cubes", self.basis), (points,), lambda seed: [self._projected(points, faces, seed)])[0]

    def exact(self, points: Float64, bases: tuple[str, ...]) -> list[Estimate]:
        """(n, 3) [m] -> Estimate of (n, B, 3) [lx] in each basis, from the same paths."""
        ends = np.cumsum([BASIS_SIZES[basis] for basis in bases])[:-1].tolist()
        if bases == ("cube",):
            return [self.cubes(points)]

        def trace(seed: int) -> list[Estimate]:
            found = self._projected(points, lambda d: np.concatenate([projection_weights(basis, d) for basis in bases], axis=1), seed)
            parts = (np.split(values, ends, axis=1) for values in (found.mean, found.standard_error))
            return [Estimate(mean, noise) for mean, noise in zip(*parts, strict=True)]

        return self._once(("exact", *bases), (points,), trace)

    def surfaces(self, points: Float64, normals: Float64) -> Estimate:
        """(n, 3) [m] and unit normals -> Estimate of (n, 3) [lx]."""

        def trace(seed: int) -> list[Estimate]:
            return [self.tracer.surface_irradiance(points, normals, self.lighting, self.lamps, samples=self.samples, seed=seed)]

        return self._once(("surfaces",), (points, normals), trace)[0]

    def _projected(self, points: Float64, project: Projector, seed: int) -> Estimate:
        return self.tracer.projected_irradiance(points, self.lighting, self.lamps, project, samples=self.samples, seed=seed)

    def _once(self, what: tuple[str, ...], places: tuple[Float64, ...], trace: Callable[[int], list[Estimate]]) -> list[Estimate]:
        """``trace`` with a seed of its own, or what it gave when it was last asked for the same."""
        seed = int(self.rng.integers(1 << 62))
        if self.known is None:
            return trace(seed)
        asked = repr((what, seed, self.samples, self.lighting.digest, lamps_digest(self.lamps)))
        key = hashlib.blake2b(asked.encode() + b"".join(place.tobytes() for place in places)).digest()
        if key not in self.known:
            self.known[key] = trace(seed)
        return self.known[key]


def compare_dataset(
    dataset_path: Path | str,
    states: Sequence[str] = DEFAULT_STATES,
    *,
    sectors: Sequence[SectorIndex] | None = None,
    points_per_sector: int = 100,
    samples: int = 4096,
    seed: int = 0,
    device: str | None = None,
    scene: Scene | None = None,
    lamps: Sequence[Lamp] | None = None,
    progress: Progress | None = None,
    known: dict[bytes, list[Estimate]] | None = None,
) -> dict[str, Any]:
    """Measure a dataset's error; the same arguments give the same report.

    Parameters
    ----------
    states : names of ``compare_states.parse_states``
    sectors : which to compare; None takes nine, spread over those whose neighbours are in the dataset too
    points_per_sector : of each kind; samples : paths per reference value; seed : of both
    device : OpenCL device, as Engine takes it
    scene : the source's triangles, wanted when the bake left out what surrounds these sectors; otherwise the dataset's are used
    lamps : lit with these instead of the dataset's own
    progress : called with (steps done, steps in all, what was done)
    known : reference values of earlier comparisons in the same scene, which are not traced again; new ones are added

    Returns
    -------
    report : ``{preset, basis, states: {state: {stage: {n, median, p95, bias, nrmse, noise}}}, ...}``; see ``compare_report``

    Raises InputError for unknown states or sectors that hold nothing to compare, and what Dataset and Engine raise.
    """
    if points_per_sector < 1:
        raise InputError(f"compare: expected at least 1 point per sector, got {points_per_sector}")
    dataset = Dataset.open(dataset_path)
    world = dataset.world
    moments = parse_states(states, world.location)
    chosen = list(sectors) if sectors is not None else choose_sectors(dataset, seed)
    engine = Engine(dataset, device)
    engine.lamps = world.lamps if lamps is None else tuple(lamps)
    lightings = {state.name: engine.lighting(state.time, state.weather) for state in moments}
    tracer = dataset_tracer(dataset, chosen, scene)
    bases = (world.basis,) if world.basis == "cube" else (world.basis, "cube")
    all_stages = STAGES + (CUBE_STAGES if len(bases) > 1 else ()) + (FINE_STAGES if world.has_fine_voxels else ())
    all_stages += ROOM_STAGES[: len(bases)] if world.rooms else ()
    found = {state: {stage: StageSamples() for stage in all_stages} for state in lightings}
    air = {"open": 0, "called_solid": 0}
    dark: list[str] = []

    for number, index in enumerate(chosen):
        points = points_of(tracer, dataset, index, points_per_sector, seed)
        in_rooms = room_points_of(dataset, index, points_per_sector, seed) if world.rooms else None
        for place, (state, lighting) in enumerate(lightings.items()):
            volume = engine.volume(points.eye, lighting)
            if place == 0:
                open_air = points.open_voxel & (volume.mask != VOXEL_NO_SECTOR)
                air["open"] += int(open_air.sum())
                air["called_solid"] += int((open_air & (volume.mask < VOXEL_OUTDOORS)).sum())
            stages = found[state]
            shining, rng = lamps_on(engine.lamps, lighting), sector_rng(seed, index, lighting.digest)
            reference = Reference(tracer, lighting, shining, samples, rng, world.basis, known)
            lit = engine.lit_sector(index, lighting)[points.probe]
            stages["probes"].add(_six_faces(lit, world.basis), reference.cubes(points.probe_position))
            _compare_voxels(stages["near"], volume, points.near, reference)
            _compare_voxels(stages["mid"], volume, points.mid, reference)
            served = [volume, *(engine.volume(points.eye, lighting, basis=basis) for basis in bases[1:])]
            truth = reference.surfaces(points.surface, points.normal)
            on_surfaces = [(stages[a], stages[b]) for a, b in (STAGES[3:], CUBE_STAGES)[: len(bases)]]
            _compare_surfaces(on_surfaces, served, points, reference, truth)
            if world.has_fine_voxels:
                stages["shaded_fine"].add(_fine_light(engine, lighting, points), truth)
            if in_rooms is not None and len(in_rooms[0]):
                truth = reference.surfaces(*in_rooms)
                for stage, basis in zip(ROOM_STAGES, bases, strict=False):
                    light = ServedLight.of(engine, lighting, Look(distant="off"), points.eye, basis=basis)
                    stages[stage].add(light.irradiance(in_rooms[0], in_rooms[1].astype(np.float32)), truth)
            if any(stages[stage].lacks_light(is_day(lighting)) for stage in STAGES[:-1]):
                dark.append(f"{index.x},{index.z} {state}")
            if progress is not None:
                progress(number * len(lightings) + place + 1, len(chosen) * len(lightings), f"sector {index.x},{index.z} {state}")
    if not any(samples.count for stages in found.values() for samples in stages.values()):
        raise InputError(f"{dataset_path}: nothing to compare in sectors {', '.join(str(i) for i in chosen)}: no open air there")
    return {
        "preset": world.preset,
        "basis": world.basis,
        "states": {state: {stage: summarise(stages[stage]) for stage in all_stages} for state, stages in found.items()},
        "moments": {state.name: {"time": lightings[state.name].time, "weather": state.weather} for state in moments},
        "lamps_on": {state: len(lamps_on(engine.lamps, lighting)) for state, lighting in lightings.items()},
        "sectors": [[index.x, index.z] for index in chosen],
        "dataset": world.bake_id,
        "points_per_sector": points_per_sector,
        "samples": samples,
        "seed": seed,
        # A client gets filled light where the mask says solid; the judge's voxels there count all the same.
        "open_air_called_solid": air["called_solid"] / max(air["open"], 1),
        # Sectors and states with a value of exactly zero where the reference is lit by day, or one that is no number.
        "dark_by_day": dark,
        "floor_fill": "voxels outside open air are filled from the nearest voxel in it",
    }


def is_day(lighting: Lighting) -> bool:
    """Whether the open sky lights level ground by a hundred lux or more."""
    return bool(lighting.sky_cube[2].max() >= DAYLIGHT_LX)


def choose_sectors(dataset: Dataset, seed: int, count: int = DEFAULT_SECTORS) -> list[SectorIndex]:
    """At most ``count`` sectors with probes, drawn from those whose eight neighbours are in the dataset too, when any are."""
    known = dataset.world.sectors
    with_probes = [index for index in sorted(known) if known[index].probes]
    around = [(dx, dz) for dx in (-1, 0, 1) for dz in (-1, 0, 1)]
    inner = [i for i in with_probes if all(SectorIndex(i.x + dx, i.z + dz) in known for dx, dz in around)]
    pool = inner or with_probes
    if not pool:
        raise InputError(f"{dataset.path}: no sector has a probe, so there is nothing to compare")
    picks = np.random.default_rng(seed).choice(len(pool), min(count, len(pool)), replace=False)
    return [pool[i] for i in sorted(picks)]


def dataset_tracer(dataset: Dataset, chosen: Sequence[SectorIndex], scene: Scene | None = None) -> PathTracer:
    """Over the scene, or over the dataset's triangles within reach of the chosen sectors."""
    if scene is not None:
        return PathTracer(scene.vertices, scene.triangles, scene.albedo, scene.emission)
    reach = int(np.ceil(GEOMETRY_REACH_M / SECTOR_SIZE_M))
    centre = np.array(chosen)
    near = [i for i in sorted(dataset.world.sectors) if (np.abs(centre - np.array(i)).max(axis=1) <= reach).any()]
    parts = [dataset.geometry(index) for index in near]
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    return PathTracer(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.triangles + start for part, start in zip(parts, starts, strict=False)]).astype(np.int32),
        np.concatenate([part.albedo for part in parts]),
        np.concatenate([part.emission for part in parts]),
    )


def points_of(tracer: PathTracer, dataset: Dataset, index: SectorIndex, count: int, seed: int) -> SectorPoints:
    """Where a sector is compared."""
    return choose_points(tracer.rays, dataset.geometry(index), dataset.sector(index), count, sector_rng(seed, index), dataset.world.rooms)


def room_points_of(dataset: Dataset, index: SectorIndex, count: int, seed: int) -> tuple[Float64, Float64]:
    """Points (n, 3) [m] on a sector's surfaces in rooms and normals (n, 3), where rooms are compared."""
    return points_in_rooms(dataset.geometry(index), dataset.world.rooms, count, sector_rng(seed, index, _IN_ROOMS))


def sector_rng(seed: int, index: SectorIndex, digest: str = "") -> np.random.Generator:
    """The same for a sector, and lighting, whatever else is compared."""
    key = (index.x & 0xFFFFFFFF, index.z & 0xFFFFFFFF, int(digest[:8] or "0", 16))
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))


def _compare_voxels(samples: StageSamples, volume: Volume, voxels: Int64, reference: Reference) -> None:
    y, z, x = voxels[volume.mask[tuple(voxels.T)] != VOXEL_NO_SECTOR].T
    centre = voxel_centre(np.stack([x, y, z], axis=1) + volume.first_voxel)
    samples.add(_six_faces(volume.values[:, y, z, x].transpose(1, 0, 2), reference.basis), reference.cubes(centre))


def _six_faces(light: Float32, basis: str) -> Float32:
    """What coefficients (n, B, 3) [lx] say of the six faces, as they are: (n, 6, 3)."""
    return light if basis == "cube" else np.asarray(np.einsum("fb,nbc->nfc", conversion(basis, "cube"), light))


def _compare_surfaces(
    stages: list[tuple[StageSamples, StageSamples]], served: list[Volume], points: SectorPoints, reference: Reference, truth: Estimate
) -> None:
    """Shaded and floor, of the volume in each basis that it is served in. All stages on surfaces share their reference, ``truth``."""
    normal = points.normal.astype(np.float32)
    volume = served[0]

    def as_client(values: Float32) -> Float32:
        return sample_volume(values, volume.origin, volume.voxel_size, points.surface, normal)

    for (shaded, _), found in zip(stages, served, strict=True):
        shaded.add(as_client(found.values), truth)
    if not points.open_voxel.any():
        return
    corner = corner_voxels(points.surface + CLIENT_OFFSET_M * points.normal, volume.origin).reshape(-1, 3)
    y, z, x = np.unique(corner, axis=0).T
    source = nearest_open_voxel(points.open_voxel)[:, y, z, x].T
    needed, which = np.unique(source, axis=0, return_inverse=True)
    of_corner = which.reshape(-1)
    bases = tuple(found.basis for found in served)
    for (_, floor), exact in zip(stages, reference.exact(voxel_centre(needed[:, [2, 0, 1]] + volume.first_voxel), bases), strict=True):
        values, noise = np.zeros((2, exact.mean.shape[1], *VOLUME_SHAPE, 3), np.float32)
        values[:, y, z, x] = exact.mean[of_corner].transpose(1, 0, 2)
        noise[:, y, z, x] = exact.standard_error[of_corner].transpose(1, 0, 2)
        # Corners' errors are independent, so their weighted sum overstates the noise: an upper bound. Harmonics' are not of one sign.
        floor.add(as_client(values), Estimate(truth.mean, np.hypot(truth.standard_error, np.abs(as_client(noise)))))


def _fine_light(engine: Engine, lighting: Lighting, points: SectorPoints) -> Float32:
    """What a client reads at surfaces (n, 3) from as many volumes of cascade -1 as it takes: (n, 3) [lx]."""
    tile, of_point = np.unique(np.floor(points.surface / FINE_TILE_M).astype(np.int64), axis=0, return_inverse=True)
    light = np.zeros((len(points.surface), 3), np.float32)
    for number, centre in enumerate((tile + 0.5) * FINE_TILE_M):
        some = of_point.reshape(-1) == number
        volume = engine.volume(centre, lighting, cascade=-1)
        normal = points.normal[some].astype(np.float32)
        light[some] = sample_volume(volume.values, volume.origin, volume.voxel_size, points.surface[some], normal)
    return light
