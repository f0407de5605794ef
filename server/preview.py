"""A picture of the lit city, drawn the way a client draws: direct light by shadow rays, indirect light from served volumes only.

    camera rays -> surface -> direct sun, moon and lamps (shadow rays)
                           -> indirect: the volume that covers the pixel, of its room indoors, or the distant texture
                           -> albedo, whitened where snow lies
                -> sky radiance, or a plain ground beyond the world's edge
                -> fog before both, then the lamps themselves

What a picture shows wrong is therefore wrong for clients as well.
"""

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from gi_core.arrays import Float32, Float64, Int32, Int64
from gi_core.client_light import PLAIN_LOOK, Indirect, Look, ServedLight
from gi_core.engine import Engine
from gi_core.lighting import Lighting
from gi_core.lights import lamps_on
from gi_core.settings import NEUTRAL, Settings
from gi_core.snow import snow_attribute, whitened
from gi_core.world import Lamp
from server.camera import Camera
from server.preview_air import background, plain_distance, through_fog
from server.preview_fog import add_fog_light
from server.preview_lamps import draw_lamps, lamp_irradiance
from server.preview_occlusion import kept_by_decals, kept_in_picture, kept_share
from server.preview_scene import PreviewScene
from server.raycast import RayCaster

STRAIGHT_UP = np.array([0.0, 1.0, 0.0])


def city_radiance(
    engine: Engine, scene: PreviewScene, camera: Camera, lighting: Lighting, look: Look = PLAIN_LOOK, settings: Settings = NEUTRAL
) -> Float32:
    """``render`` with an engine's lamps and light, under the artists' settings. Raises as ``ServedLight.of``."""
    served = ServedLight.of(engine, lighting, look, camera.eye, settings)
    lamps = settings.brightened(lamps_on(engine.lamps, lighting))
    return render(camera, scene, settings.light(lighting), lamps, served, look)


def render(
    camera: Camera, scene: PreviewScene, lighting: Lighting, lamps: Sequence[Lamp], served: ServedLight, look: Look = PLAIN_LOOK
) -> Float32:
    """Radiance (height, width, 3) float32 [cd m^-2]. ``lamps`` are those that are on."""
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
    wanted = indirect_pixels(hit, camera.width, look.indirect)
    irradiance[wanted] += indirect_irradiance(
        scene.rays, served, look, position[wanted], normal[wanted], partial(kept_in_picture, pixel=hit[wanted], width=camera.width)
    )
    albedo = seen_albedo(scene, lighting, position, normal, triangle)
    radiance[hit] = albedo / np.pi * irradiance + scene.emission[triangle]
    radiance[hit] = through_fog(radiance[hit], surface.distance[hit], lighting)
    plain = plain_distance(camera.eye, directions[missed], float(scene.rays.low[1]))
    radiance[missed] = through_fog(radiance[missed], plain, lighting)
    add_fog_light(radiance, camera, scene.rays, served, lighting, surface.distance)
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


def indirect_irradiance(
    rays: RayCaster,
    served: ServedLight,
    look: Look,
    position: Float64,
    normal: Float32,
    kept: Callable[[RayCaster, Float64, Float32], Float32] = kept_share,
) -> Float64:
    """Indirect light (n, 3) [lx] on surface points (n, 3) [m] with normals (n, 3), as this look has it. ``kept``: what occlusion leaves."""
    light = served.irradiance(position, normal).astype(np.float64)
    if look.occlusion:
        light *= (kept(rays, position, normal) * kept_by_decals(served.decals, position, normal))[:, None]
    return light
