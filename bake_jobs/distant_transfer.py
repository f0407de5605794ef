"""What light sends to a sector's distant texel, over all bounces: worked out backwards from the texel, once for any light.

A texel is the mean of the sector's outdoor probes, whose light is linear in what bricks send out first. Instead of lighting the sector
once for each sky patch and each sun, the mean's weights are carried back through factors and bounces until nothing is left of them:

    C = F (e + B C) + S p,   texel = w C      ->      u = w + (u F) B,   texel = (u F) e + (u S) p

C probes' light, F and S factors of bricks and of the sky, e first exitance of bricks, p of patches, B bounces off probes' light. That is
six faces and three channels in all, whatever the number of lights, and a function of the sector's file, the sun table and the lamps.
"""

from collections import Counter
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from bake_jobs.rays import RayScene
from bake_jobs.scene import Scene
from gi_core.arrays import AnyArray, Bool, Float32, Float64, Int64
from gi_core.basis import FEEDBACK, basis_of_size, conversion, feedback_weights
from gi_core.constants import BASIS_SIZES, ROOM_OUTDOORS
from gi_core.distant_file import MAX_SCHEDULES
from gi_core.distant_transfer import CHANNELS, COVERS, SUN_PARTS, DistantTransfer
from gi_core.layout import SHADOW_END_M, SHADOW_START_M
from gi_core.lights import light_records
from gi_core.lights_twin import ray_targets, reaches, surfel_places, unshadowed, visible_share
from gi_core.relight_twin import brick_basis, snowed_albedo, sun_bits
from gi_core.sector import PROBE_IN_MARGIN, Sector, counts
from gi_core.world import Lamp

# What bounces that were left out could still add, as a share; half floats round by 5e-4.
RESIDUAL = 1e-4
MAX_PASSES = 512
FACES = 6


def of_texel(room: AnyArray, flags: AnyArray) -> Bool:
    """(P,): the probes whose mean is a sector's texel, from their rooms and flags: outdoors, and on the sector's own ground."""
    return np.asarray((room == ROOM_OUTDOORS) & (flags & PROBE_IN_MARGIN == 0))


class TransferBaker:
    """Finds transfers of one scene's sectors from their files' contents."""

    def __init__(self, scene: Scene, sun_directions: Float64, sky_patches: int, rays: RayScene | None = None) -> None:
        """sun_directions : (D, 3), unit, of the dataset's sun table; rays : of the scene, where there are any yet"""
        self._scene = scene
        self._sun_directions = sun_directions
        self._sky_patches = sky_patches
        self._given_rays = rays
        lamps = Counter(lamp.schedule for lamp in scene.lamps)
        # A world with more schedules than a file may hold goes without those of the fewest lamps.
        kept = [schedule for schedule, _ in lamps.most_common(MAX_SCHEDULES - 1)]
        self.schedules = tuple(sorted({*kept, *(["always"] if scene.emission.any() else [])}))

    @cached_property
    def _rays(self) -> RayScene:
        return self._given_rays or RayScene(self._scene.vertices, self._scene.triangles)

    def transfer(self, sector: Sector) -> DistantTransfer:
        """One texel's transfer, from a sector as its file has it."""
        sky = np.zeros((COVERS, self._sky_patches, FACES, CHANNELS), np.float32)
        sun = np.zeros((COVERS, len(self._sun_directions), SUN_PARTS, FACES, CHANNELS), np.float32)
        glow = np.zeros((COVERS, len(self.schedules), FACES, CHANNELS), np.float32)
        chosen = of_texel(sector.probe_room, sector.probe_flags)
        if chosen.any():
            factors, wanted = _factors(sector, self._sky_patches), _texel_weights(sector, chosen)
            sunlit = _sunlit(sector, self._sun_directions)
            shine = [self._lamplight(sector, schedule) for schedule in self.schedules]
            for cover in range(COVERS):
                albedo = snowed_albedo(sector, float(cover))
                of_bricks, sky[cover] = _carried_back(sector, factors, wanted, albedo)
                of_surfels = _of_surfels(sector, of_bricks)
                reflected = of_surfels * albedo[:, None, :]
                sun[cover] = _sun_transfer(sector, reflected, sunlit, self._sun_directions)
                for number, schedule in enumerate(self.schedules):
                    glow[cover, number] = np.einsum("sfc,sc->fc", reflected, shine[number])
                    if schedule == "always" and sector.surfel_emission is not None:
                        glow[cover, number] += np.einsum("sfc,sc->fc", of_surfels, np.float32(np.pi) * sector.surfel_emission)
        # Channels, then the one texel, then faces.
        sky, sun, glow = (np.moveaxis(found, -1, -2)[..., None, :] for found in (sky, sun, glow))
        return DistantTransfer(sky.astype(np.float16).astype(np.float32), sun.astype(np.float16), glow, self.schedules)

    def _lamplight(self, sector: Sector, schedule: str) -> Float32:
        """(S, 3) [lx] on surfels, of all lamps of a schedule."""
        lamps = [lamp for lamp in self._scene.lamps if lamp.schedule == schedule and lamp.lumens > 0 and any(lamp.color)]
        return lamplight(self._rays, sector, lamps) if lamps else np.zeros((sector.surfel_count, 3), np.float32)


def lamplight(rays: RayScene, sector: Sector, lamps: Sequence[Lamp]) -> Float32:
    """(S, 3) [lx]: what lamps give a sector's surfels past the scene: ``lights_twin.light_surfels`` with Embree's shadows."""
    total = np.zeros((sector.surfel_count, 3), np.float32)
    origin = sector.index.origin
    places, near = surfel_places(sector), cKDTree(sector.surfel_position)
    for light in light_records(lamps, origin):
        some = np.sort(np.asarray(near.query_ball_point(light["position"], light["range"]), np.int64))
        here = places[some]
        seen = np.stack([_sees(rays, light, here, target, origin) for target in ray_targets(light)])
        total[some] += (visible_share(light, here, seen) * unshadowed(light, here))[:, None] * light["intensity"]
    return total


def _sees(rays: RayScene, light: AnyArray, places: AnyArray, target: Float32, origin: Float64) -> Bool:
    open_ = reaches(light, places, target)
    lit = np.flatnonzero(open_)
    start = places["position"][lit] + places["normal"][lit] * np.float32(SHADOW_START_M)
    way = target - start
    distance = np.linalg.norm(way, axis=1)
    reach = np.maximum(distance - np.float32(SHADOW_END_M), 0)
    open_[lit] &= ~rays.occluded(start + origin, way / np.maximum(distance, np.float32(1e-6))[:, None], reach)
    return open_


def _texel_weights(sector: Sector, chosen: Bool) -> Float32:
    """(P B, 6): how the mean of the chosen probes, as a cube, weighs each coefficient of the sector's."""
    faces = conversion(basis_of_size(sector.basis_size), "cube")
    weights = chosen[:, None, None] / chosen.sum() * faces.T.astype(np.float64)
    return np.asarray(weights.reshape(-1, FACES), np.float32)


def _factors(sector: Sector, sky_patches: int) -> Any:
    """(N + T, P B) sparse: what probes' coefficients take of each source."""
    size = sector.basis_size
    probe = np.repeat(np.arange(sector.probe_count), counts(sector.factor_starts))
    column = probe[:, None] * size + np.arange(size)
    row = np.broadcast_to(sector.factor_source[:, None].astype(np.int64), column.shape)
    return _sparse(sector.factor_weight, row, column, (sector.brick_count + sky_patches, sector.probe_count * size))


def _bounces(sector: Sector, albedo: Float32) -> list[Any]:
    """For each channel (P B, N) sparse: what bricks send on of probes' coefficients."""
    size, basis = sector.basis_size, basis_of_size(sector.basis_size)
    brick = _brick_of_surfel(sector)
    is_cube = size == BASIS_SIZES["cube"]
    weight = feedback_weights(basis, sector.surfel_normal) if is_cube else brick_basis(sector)[brick]
    passed = np.minimum(albedo, np.float32(FEEDBACK[basis].albedo_max)) / counts(sector.brick_starts)[brick, None].astype(np.float32)
    row = sector.feedback_probe[:, :, None].astype(np.int64) * size + np.arange(size)
    column = np.broadcast_to(brick[:, None, None], row.shape)
    value = sector.feedback_weight[:, :, None] * weight[:, None, :]
    shape = (sector.probe_count * size, sector.brick_count)
    return [_sparse(value * passed[:, channel, None, None], row, column, shape) for channel in range(CHANNELS)]


def _sparse(value: AnyArray, row: Int64, column: Int64, shape: tuple[int, int]) -> Any:
    some = np.flatnonzero(value)
    return csr_array((value.reshape(-1)[some], (row.reshape(-1)[some], column.reshape(-1)[some])), shape=shape)


def _brick_of_surfel(sector: Sector) -> Int64:
    return np.repeat(np.arange(sector.brick_count), counts(sector.brick_starts))


def _of_surfels(sector: Sector, of_bricks: Float32) -> Float32:
    """(S, 6, 3): what the texel gets per exitance of each surfel, whose brick's is the mean of its surfels'."""
    brick = _brick_of_surfel(sector)
    return np.asarray(of_bricks[brick] / counts(sector.brick_starts)[brick, None, None].astype(np.float32), np.float32)


def _carried_back(sector: Sector, factors: Any, wanted: Float32, albedo: Float32) -> tuple[Float32, Float32]:
    """What the texel gets per first exitance of each brick (N, 6, 3), and of each sky patch (T, 6, 3)."""
    bounces, to_bricks = _bounces(sector, albedo), factors[: sector.brick_count]
    step = np.repeat(wanted[:, :, None], CHANNELS, axis=2)
    total, before = step.copy(), np.abs(step).sum(axis=0)
    for _ in range(MAX_PASSES):
        of_bricks = (to_bricks @ step.reshape(len(step), -1)).reshape(-1, FACES, CHANNELS)
        step = np.stack([bounce @ of_bricks[:, :, channel] for channel, bounce in enumerate(bounces)], axis=2)
        total += step
        change = np.abs(step).sum(axis=0)
        # As for any contraction: what is left is change * rate / (1 - rate).
        rate = np.minimum(change / np.maximum(before, np.finfo(np.float32).tiny), 0.999)
        if (change * rate <= RESIDUAL * (1 - rate) * np.abs(total).sum(axis=0)).all():
            break
        before = change
    found = (factors @ total.reshape(len(total), -1)).reshape(-1, FACES, CHANNELS)
    return found[: sector.brick_count], found[sector.brick_count :]


def _sunlit(sector: Sector, sun_directions: Float64) -> Any:
    """(D, S) sparse, 1 where a surfel sees a sun and faces it."""
    suns = sun_directions.astype(np.float32)
    lit = [np.flatnonzero((sun_bits(sector, d) > 0) & (sector.surfel_normal @ sun > 0)) for d, sun in enumerate(suns)]
    column = np.concatenate([np.zeros(0, np.int64), *lit])
    starts = np.cumsum([0, *map(len, lit)])
    return csr_array((np.ones(len(column), np.float32), column, starts), shape=(len(suns), sector.surfel_count))


def _sun_transfer(sector: Sector, reflected: Float32, sunlit: Any, sun_directions: Float64) -> Float32:
    """(D, 2, 6, 3): what the texel gets of each sun, from what it gets per irradiance of each surfel (S, 6, 3)."""
    # A surfel's cosine is linear in the sun's direction: along each axis by itself.
    by_axis = sector.surfel_normal[:, :, None] * reflected.reshape(-1, 1, FACES * CHANNELS)
    x, y, z = np.moveaxis((sunlit @ by_axis.reshape(-1, 3 * FACES * CHANNELS)).reshape(-1, 3, FACES, CHANNELS), 1, 0)
    east, south = (sun_directions[:, axis, None, None].astype(np.float32) for axis in (0, 2))
    return np.stack([y, east * x + south * z], axis=1)
