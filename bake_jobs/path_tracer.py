"""The judge: unbiased path-traced irradiance of a mesh under the lighting that the engine used.

What is estimated is what the engine serves: sky, emission and every bounce, those of sun, moon and lamps too, without the direct light
of sun, moon and lamps at the receiver itself (clients draw that). Surfaces are diffuse, two-sided and block light from both sides; where
snow lies (``Lighting.snow``) they are whiter. Lamps have no body: they shine through each other, and no path ends on one.

Paths run as a wavefront, one chunk at a time:

    primary direction -> closest hit -+-> sky texel, the path ends
                                      +-> emission + sun, moon and a lamp by shadow rays -> cosine direction -> closest hit -> ...

Each receiver's samples are split into replicates. A replicate's primary directions are a Fibonacci lattice under its own random
shift, so replicates are independent, identically distributed estimates and their spread is an honest standard error.

The sky is the nearest texel of ``Lighting.sky_radiance``: constant within a texel, and zero below the horizon, where geometry is
what light comes from. Results depend on the seed and the arguments, never on the number of threads.
"""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import numpy as np

from bake_jobs.lamp_sampling import LampSampler
from bake_jobs.rays import SURFACE_OFFSET_M, RayScene
from bake_jobs.snow import snow_attribute
from gi_core.arrays import AnyArray, Float32, Float64, Int32
from gi_core.basis import conversion, projection_weights
from gi_core.constants import SKY_SHAPE
from gi_core.errors import InputError
from gi_core.lighting import Lighting
from gi_core.snow import whitened
from gi_core.world import Lamp

# About 2.5 MB a float32 triple array: big enough that NumPy's call overhead vanishes, small enough for the cache of one core.
PATHS_PER_CHUNK = 1 << 16
# The first bounces carry most of the light; ending paths there by chance would cost more noise than it saves rays.
ROULETTE_FREE_BOUNCES = 3
# A path through white surfaces must end too.
ROULETTE_SURVIVAL_MAX = 0.95
# Lamps drawn at each point of a path. Time for a given noise among 96 street lamps: the same with 2 and 4, a little more with 1, nearly
# twice as much with 8.
LAMP_DRAWS = 4
GOLDEN_RATIO_FRACTION = (np.sqrt(5.0) - 1.0) / 2.0

Projector = Callable[[Float32], AnyArray]
Lamps = Sequence[Lamp]


@dataclass(frozen=True, eq=False)
class Estimate:
    """A Monte Carlo result: ``mean`` and ``standard_error`` of that mean, of equal shape, [lx]."""

    mean: Float64
    standard_error: Float64


class PathTracer:
    """Irradiance of one scene by path tracing. Read-only once built; safe to share between threads."""

    def __init__(
        self,
        vertices: Float64,
        triangles: Int32,
        albedo: Float32,
        emission: Float32,
        *,
        threads: int | None = None,
        rays: RayScene | None = None,
    ) -> None:
        """
        Parameters
        ----------
        vertices : (v, 3) float64 [m], world frame
        triangles : (m, 3) int32
        albedo : (m, 3) float32, linear sRGB, 0..1
        emission : (m, 3) float32 [cd m^-2], from both sides
        threads : how many chunks are traced at a time; all cores when None
        rays : of these vertices and triangles, where they are built already

        Raises
        ------
        InputError : albedo or emission do not fit the triangles, or are out of range
        """
        for name, values in (("albedo", albedo), ("emission", emission)):
            if values.shape != (len(triangles), 3):
                raise InputError(f"path tracer: expected {name} of shape {(len(triangles), 3)}, got {values.shape}")
            if not (np.isfinite(values).all() and (values >= 0).all()):
                raise InputError(f"path tracer: expected finite {name} >= 0")
        if (albedo > 1).any():
            raise InputError(f"path tracer: expected albedo <= 1, got {albedo.max()}")
        self.rays = rays or RayScene(vertices, triangles)
        self._albedo = np.ascontiguousarray(albedo, np.float32)
        self._emission = np.ascontiguousarray(emission, np.float32)
        self._emits = bool(emission.any())
        self._threads = threads or len(os.sched_getaffinity(0))

    def cube_irradiance(
        self, points: Float64, lighting: Lighting, lamps: Lamps = (), *, samples: int = 1024, replicates: int = 8, seed: int = 0
    ) -> Estimate:
        """Ambient cube at points in air: (n, 3) [m], world frame -> Estimate of (n, 6, 3) [lx], faces +X -X +Y -Y +Z -Z.

        Every path serves the three faces that look its way: directions are uniform over the sphere.
        """
        project = partial(projection_weights, "cube")
        return self.projected_irradiance(points, lighting, lamps, project, samples=samples, replicates=replicates, seed=seed)

    def surface_irradiance(
        self,
        points: Float64,
        normals: Float64,
        lighting: Lighting,
        lamps: Lamps = (),
        *,
        samples: int = 1024,
        replicates: int = 8,
        seed: int = 0,
    ) -> Estimate:
        """Irradiance on surfaces: points (n, 3) [m] and unit normals (n, 3) towards the lit side -> Estimate of (n, 3) [lx].

        Rays start ``SURFACE_OFFSET_M`` off the surface. Directions follow the cosine, so each path counts pi times its radiance.
        """
        normal = np.asarray(normals, np.float64)
        origin = np.asarray(points, np.float64) + normal * SURFACE_OFFSET_M
        estimate = self._estimate(origin, normal.astype(np.float32), lighting, lamps, None, samples, replicates, seed)
        return Estimate(estimate.mean[:, 0], estimate.standard_error[:, 0])

    def projected_irradiance(
        self,
        points: Float64,
        lighting: Lighting,
        lamps: Lamps,
        project: Projector,
        *,
        samples: int = 1024,
        replicates: int = 8,
        seed: int = 0,
    ) -> Estimate:
        """Whatever is linear in the light at points in air: (n, 3) [m] -> Estimate of (n, K, 3).

        project : unit directions (m, 3) -> (m, K), what radiance 1 [cd m^-2] from each adds, per solid angle [sr]
        """
        return self._estimate(np.asarray(points, np.float64), None, lighting, lamps, project, samples, replicates, seed)

    def _estimate(
        self,
        origins: Float64,
        normals: Float32 | None,
        lighting: Lighting,
        lamps: Lamps,
        project: Projector | None,
        samples: int,
        replicates: int,
        seed: int,
    ) -> Estimate:
        """Mean and standard error over replicates, (n, K, 3); K is what ``project`` gives, 1 for cosine directions about ``normals``."""
        if replicates < 2 or samples < replicates:
            raise InputError(f"path tracer: expected at least 2 replicates and as many samples, got {replicates} and {samples}")
        if origins.ndim != 2 or origins.shape[1] != 3 or not np.isfinite(origins).all():
            raise InputError(f"path tracer: expected finite points of shape (n, 3), got {origins.shape}")
        if lighting.sky_radiance.shape != (*SKY_SHAPE, 3):
            raise InputError(f"path tracer: expected a sky of shape {(*SKY_SHAPE, 3)}, got {lighting.sky_radiance.shape}")
        per_replicate = -(-samples // replicates)
        receivers_per_chunk = max(1, PATHS_PER_CHUNK // (per_replicate * replicates))
        starts = range(0, len(origins), receivers_per_chunk)
        sampler = LampSampler(lamps) if lamps else None

        def chunk(start: int) -> Float64:
            some = slice(start, start + receivers_per_chunk)
            rng = np.random.Generator(np.random.SFC64(np.random.SeedSequence(seed, spawn_key=(start,))))
            lattice = _shifted_lattices(len(origins[some]) * replicates, per_replicate, rng)
            paths_per_receiver = replicates * per_replicate
            if normals is None:
                direction = _sphere_direction(lattice)
            else:
                direction = _cosine_direction(np.repeat(normals[some], paths_per_receiver, axis=0), lattice)
            radiance = self._radiance(np.repeat(origins[some], paths_per_receiver, axis=0), direction, lighting, sampler, rng)
            shape = (len(origins[some]), replicates, per_replicate)
            if project is None:
                # Cosine-distributed: the density cos/pi cancels the cosine.
                return np.pi * radiance.reshape(*shape, 1, 3).mean(axis=2, dtype=np.float64)
            weight = project(direction).reshape(*shape, -1)
            # Uniform over the sphere: each path stands for 4 pi / per_replicate steradians.
            projected = np.swapaxes(weight, 2, 3) @ radiance.reshape(*shape, 3)
            return np.asarray(projected, np.float64) * (4.0 * np.pi / per_replicate)

        with ThreadPoolExecutor(self._threads) as pool:
            chunks = list(pool.map(chunk, starts))
        outputs = 1 if project is None else project(np.zeros((1, 3), np.float32)).shape[1]
        estimates = np.concatenate(chunks) if chunks else np.zeros((0, replicates, outputs, 3))
        return Estimate(estimates.mean(axis=1), estimates.std(axis=1, ddof=1) / np.sqrt(replicates))

    def _radiance(
        self, origin: Float64, direction: Float32, lighting: Lighting, lamps: LampSampler | None, rng: np.random.Generator
    ) -> Float32:
        """Radiance [cd m^-2] that arrives along each ray, one sample each: (n, 3) origins and directions -> (n, 3) float32."""
        radiance = np.zeros((len(origin), 3), np.float32)
        path = np.arange(len(origin))  # which ray a path that is still alive belongs to
        throughput = np.ones((len(origin), 3), np.float32)
        lights = lighting.directional_lights
        bounce = 0
        while len(path):
            hits = self.rays.closest(origin, direction)
            left = np.flatnonzero(~hits.hit)
            radiance[path[left]] += throughput[left] * sky_radiance(lighting.sky_radiance, direction[left])
            kept = np.flatnonzero(hits.hit)
            path, throughput, triangle, normal = path[kept], throughput[kept], hits.triangle[kept], hits.normal[kept]
            origin = origin[kept] + direction[kept] * hits.distance[kept, None] + normal * np.float32(SURFACE_OFFSET_M)
            if self._emits:
                radiance[path] += throughput * self._emission[triangle]
            throughput = throughput * self._reflectance(triangle, origin, normal, lighting.snow)
            for light in lights:
                cosine = normal @ light.direction.astype(np.float32)
                lit = np.flatnonzero(cosine > 0)
                lit = lit[~self.rays.occluded(origin[lit], np.broadcast_to(light.direction, (len(lit), 3)))]
                exitance = cosine[lit, None] * light.irradiance.astype(np.float32)
                radiance[path[lit]] += throughput[lit] * exitance * np.float32(1 / np.pi)
            if lamps is not None:
                radiance[path] += throughput * self._lamp_irradiance(lamps, origin, normal, rng) * np.float32(1 / np.pi)
            if bounce >= ROULETTE_FREE_BOUNCES:
                survival = np.minimum(throughput.max(axis=1), np.float32(ROULETTE_SURVIVAL_MAX))
                kept = np.flatnonzero(rng.random(len(path), np.float32) < survival)
                throughput = throughput[kept] / survival[kept, None]
            else:
                kept = np.flatnonzero(throughput.any(axis=1))
                throughput = throughput[kept]
            path, origin = path[kept], origin[kept]
            direction = _cosine_direction(normal[kept], rng.random((len(path), 2), np.float32))
            bounce += 1
        return radiance

    def _lamp_irradiance(self, lamps: LampSampler, start: Float64, normal: Float32, rng: np.random.Generator) -> Float32:
        """An unbiased estimate (n, 3) [lx] of all lamps' light on surfaces, from points (n, 3) just off them and normals (n, 3)."""
        irradiance = np.zeros((len(start), 3), np.float32)
        for _ in range(LAMP_DRAWS):
            drawn = lamps.draw(start, rng)
            cosine = np.einsum("ij,ij->i", normal[drawn.point], drawn.direction)
            lit = np.flatnonzero((cosine > 0) & drawn.irradiance.any(axis=1))
            # A lamp may lie in a surface, as one in a ceiling does, without being shadowed by it.
            reach = drawn.distance[lit] - np.float32(SURFACE_OFFSET_M)
            lit = lit[~self.rays.occluded(start[drawn.point[lit]], drawn.direction[lit], reach)]
            irradiance[drawn.point[lit]] += drawn.irradiance[lit] * cosine[lit, None]
        return irradiance / np.float32(LAMP_DRAWS)

    def _reflectance(self, triangle: Int32, start: Float64, normal: Float32, snow: float) -> Float32:
        """Albedo (n, 3) of what paths met, white where the snow that has fallen stays."""
        albedo = self._albedo[triangle]
        if snow == 0:
            return albedo
        return whitened(albedo, np.float32(snow) * snow_attribute(self.rays, start, normal))


def cube_projector(basis: str) -> Projector:
    """For ``PathTracer.projected_irradiance``: (n, 6, 3) [lx], the six faces as a basis has them."""
    return lambda directions: projection_weights(basis, directions) @ conversion(basis, "cube").T


def sky_radiance(sky: Float32, directions: AnyArray) -> Float32:
    """Radiance of the nearest texel of an equirectangular sky: (64, 128, 3) and unit directions (n, 3) -> (n, 3) float32."""
    rows, columns = sky.shape[:2]
    polar = np.arccos(np.clip(directions[:, 1], -1, 1))
    azimuth = np.arctan2(directions[:, 2], directions[:, 0])
    row = np.minimum((polar * (rows / np.pi)).astype(np.int32), rows - 1)
    column = np.floor(azimuth * (columns / (2 * np.pi))).astype(np.int32) % columns
    return np.asarray(sky[row, column], np.float32)


def _shifted_lattices(sets: int, points: int, rng: np.random.Generator) -> Float32:
    """``sets`` Fibonacci lattices of ``points`` points in the unit square, each under its own random shift: (sets * points, 2)."""
    index = np.arange(points)
    lattice = np.stack([(index + 0.5) / points, index * GOLDEN_RATIO_FRACTION], axis=1)
    shifted = (rng.random((sets, 1, 2)) + lattice) % 1.0
    # Rounding to float32 may give 1, which is no valid sample.
    return np.minimum(shifted.astype(np.float32), np.float32(1 - 2**-24)).reshape(-1, 2)


def _sphere_direction(sample: Float32) -> Float32:
    """Unit vectors, uniform over the sphere: (n, 2) in [0, 1) -> (n, 3) float32."""
    direction = np.empty((len(sample), 3), np.float32)
    direction[:, 1] = 1 - 2 * sample[:, 0]
    level = np.sqrt(np.maximum(1 - direction[:, 1] ** 2, 0))
    turn = sample[:, 1] * np.float32(2 * np.pi)
    direction[:, 0] = level * np.cos(turn)
    direction[:, 2] = level * np.sin(turn)
    return direction


def _cosine_direction(normal: Float32, sample: Float32) -> Float32:
    """Unit vectors with density cos/pi about unit normals (n, 3): a point of the unit sphere that touches the surface, normalised."""
    direction = _sphere_direction(sample) + normal
    length = np.sqrt(np.einsum("ij,ij->i", direction, direction))
    # The sphere touches the surface at one point, where the direction is undefined.
    touching = length < 1e-6
    direction[touching] = normal[touching]
    length[touching] = 1
    direction /= length[:, None]
    return direction
