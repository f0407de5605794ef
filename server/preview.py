"""A picture of the lit city, drawn the way a client draws: direct light by shadow rays, indirect light from served volumes only.

    camera rays -> surface -> direct sun, moon and lamps (shadow rays)
                           -> indirect: the volume that covers the pixel, a quarter voxel off the surface; of its room, indoors
                           -> albedo, whitened where snow lies
                -> sky radiance, or a plain ground beyond the world's edge
                -> fog before both, then the lamps themselves

What a picture shows wrong is therefore wrong for clients as well.
"""

from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np

from gi_core.arrays import Float32, Float64, Int32, Int64
from gi_core.constants import VOLUME_SHAPE, VOXEL_SIZE_M
from gi_core.engine import Engine
from gi_core.errors import InputError
from gi_core.lighting import Lighting
from gi_core.lights import lamps_on
from gi_core.rooms import rooms_of
from gi_core.settings import NEUTRAL, Settings
from gi_core.snow import snow_attribute, whitened
from gi_core.volume import Volume, sample_volume
from gi_core.world import Lamp, Room
from server.camera import Camera
from server.preview_air import background, plain_distance, through_fog
from server.preview_lamps import draw_lamps, lamp_irradiance
from server.preview_scene import PreviewScene
from server.raycast import RayCaster

Indirect = Literal["on", "off", "split"]
# The served volume around a place, of the room that a number says; 0 is outdoors.
VolumeAt = Callable[[Float64, int], Volume]

STRAIGHT_UP = np.array([0.0, 1.0, 0.0])
SAMPLE_OFFSET_M = VOXEL_SIZE_M / 4
# Neighbouring volumes overlap by 4 voxels along each axis, so that every sample lies between voxel centres even after snapping.
TILE_M = (np.array([VOLUME_SHAPE[2], VOLUME_SHAPE[0], VOLUME_SHAPE[1]]) - 4) * VOXEL_SIZE_M
# The pixels that these do not cover are far away and share their nearest volume's edge.
MAX_VOLUMES = 128
# Sampling holds some 300 bytes a point: 20 MB.
SAMPLES_AT_ONCE = 1 << 16


def city_radiance(
    engine: Engine, scene: PreviewScene, camera: Camera, lighting: Lighting, indirect: Indirect = "on", settings: Settings = NEUTRAL
) -> Float32:
    """``render`` with an engine's lamps and volumes, under the artists' settings. Raises CorruptFileError."""
    lamps = settings.brightened(lamps_on(engine.lamps, lighting))
    source = volume_source(engine, lighting, settings)
    return render(camera, scene, settings.light(lighting), lamps, source, indirect, engine.dataset.world.rooms)


def volume_source(engine: Engine, lighting: Lighting, settings: Settings = NEUTRAL) -> VolumeAt:
    """An engine's volumes under one light. Calling it raises CorruptFileError."""
    low, high = engine.dataset.world.bounds

    def volume_at(position: Float64, room: int) -> Volume:
        # A tile's centre may lie beyond the world's edge though its pixels do not.
        inside = np.clip(position, low, high)
        try:
            return engine.interior(inside, lighting, settings, room=str(room)) if room else engine.volume(inside, lighting, settings)
        except InputError:  # a closet between voxels, of which no light is known
            return engine.volume(inside, lighting, settings)

    return volume_at


def render(
    camera: Camera,
    scene: PreviewScene,
    lighting: Lighting,
    lamps: Sequence[Lamp],
    volume_at: VolumeAt,
    indirect: Indirect,
    rooms: tuple[Room, ...] = (),
) -> Float32:
    """Radiance (height, width, 3) float32 [cd m^-2]. ``lamps`` are those that are on; ``volume_at`` gives the served volume around a
    world position (3,) [m]."""
    directions = camera.rays()
    shape = (camera.height, camera.width, 3)
    if scene.rays is None:
        return background(lighting, directions).reshape(shape)
    surface = scene.rays.first_surface(camera.eye, directions)
    hit, missed = np.flatnonzero(surface.hit), np.flatnonzero(~surface.hit)
    radiance = np.empty((len(directions), 3), np.float32)
    radiance[missed] = background(lighting, directions[missed])
    position, normal, triangle = surface.position[hit], surface.normal[hit], surface.triangle[hit]
    irradiance = direct_irradiance(scene.rays, lighting, lamps, position, normal)
    wanted = indirect_pixels(hit, camera.width, indirect)
    if len(wanted):
        irradiance[wanted] += indirect_irradiance(position[wanted], normal[wanted], volume_at, rooms)
    albedo = seen_albedo(scene, lighting, position, normal, triangle)
    radiance[hit] = albedo / np.pi * irradiance + scene.emission[triangle]
    radiance[hit] = through_fog(radiance[hit], surface.distance[hit], lighting)
    plain = plain_distance(camera.eye, directions[missed], float(scene.rays.low[1]))
    radiance[missed] = through_fog(radiance[missed], plain, lighting)
    picture = radiance.reshape(shape)
    draw_lamps(picture, camera, scene.rays, lamps, surface.distance, lighting.fog_density)
    return picture


def direct_irradiance(rays: RayCaster, lighting: Lighting, lamps: Sequence[Lamp], position: Float64, normal: Float32) -> Float64:
    """What sun, moon and lamps give surface points (n, 3) [m] with normals (n, 3), shadowed: (n, 3) [lx]."""
    irradiance = lamp_irradiance(rays, lamps, position, normal).astype(np.float64)
    for light in lighting.directional_lights:
        cosine = np.maximum(normal @ light.direction, 0) * rays.lit(position, normal, light.direction)
        irradiance += cosine[:, None] * light.irradiance
    return irradiance


def seen_albedo(scene: PreviewScene, lighting: Lighting, position: Float64, normal: Float32, triangle: Int32) -> Float32:
    """Albedo (n, 3) of surface points (n, 3) [m], white where snow lies."""
    albedo, rays = scene.albedo[triangle], scene.rays
    if lighting.snow == 0 or rays is None:
        return albedo
    stays = snow_attribute(normal, lambda flat: rays.lit(position[flat], normal[flat], STRAIGHT_UP))
    return whitened(albedo, np.float32(lighting.snow) * stays)


def indirect_pixels(pixel: Int64, width: int, indirect: Indirect) -> Int64:
    """Which of the hit pixels get indirect light: all, none, or those of the picture's right half."""
    if indirect == "split":
        return np.flatnonzero(pixel % width >= width // 2)
    return np.arange(len(pixel) if indirect == "on" else 0)


def indirect_irradiance(position: Float64, normal: Float32, volume_at: VolumeAt, rooms: tuple[Room, ...] = ()) -> Float64:
    """Irradiance (n, 3) [lx] at surface points (n, 3) [m] with normals (n, 3), read from as many volumes as they need."""
    result = np.zeros((len(position), 3))
    # sample_volume reads this far off the surface, which may be the next volume's, or a room's.
    at = position + SAMPLE_OFFSET_M * normal
    room = rooms_of(at, rooms)
    for number in np.unique(room):
        there = np.flatnonzero(room == number)
        centres, which = plan_volumes(at[there])
        for i, centre in enumerate(centres):
            volume = volume_at(centre, int(number))
            members = there[which == i]
            for start in range(0, len(members), SAMPLES_AT_ONCE):
                some = members[start : start + SAMPLES_AT_ONCE]
                result[some] = sample_volume(volume.values, volume.origin, volume.voxel_size, position[some], normal[some])
    return result


def plan_volumes(points: Float64) -> tuple[Float64, Int64]:
    """Centres (v, 3) [m] of the volumes that cover points (n, 3) [m], and which one each point reads (n,).

    A fixed lattice of overlapping volumes; when more than MAX_VOLUMES would be needed those with the fewest points are left out, and
    their points read the nearest of the others, at its edge.
    """
    tile = np.floor(points / TILE_M).astype(np.int64)
    first = tile.min(axis=0)
    shape = tuple(tile.max(axis=0) - first + 1)
    # One number per tile: sorting rows would take longer than everything else that a picture needs.
    keys, tile_of, counts = np.unique(np.ravel_multi_index(tuple((tile - first).T), shape), return_inverse=True, return_counts=True)
    centres = (np.stack(np.unravel_index(keys, shape), axis=1) + first + 0.5) * TILE_M
    kept = np.sort(np.argsort(-counts, kind="stable")[:MAX_VOLUMES])
    distance = np.linalg.norm(centres[:, None] - centres[None, kept], axis=2)
    return centres[kept], np.argmin(distance, axis=1)[tile_of]
