"""Where served light is wrong, in false colour: a picture of shaded points' error against the path tracer.

    camera rays, a grid of at most MAX_POINTS  ->  surface points  -+->  what a client reads from the served volumes
                                                                    +->  path-traced irradiance, without direct sun and lamps
    (served - traced) / max(traced, 2 % of the mean traced)   ->   blue: too dark; white: right; red: too bright

The measure is ``compare``'s stage "shaded", at the points that are seen. The judge belongs to the baker and is imported when the first
such picture is asked for.
"""

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from gi_core.arrays import Float32, Float64, UInt8
from gi_core.client_light import Look, ServedLight
from gi_core.error_report import DARKEST_SHARE_OF_MEAN
from gi_core.lighting import Lighting
from gi_core.lights import lamps_on
from gi_core.spectrum import LUMINANCE_FROM_RGB
from server.camera import Camera
from server.preview import indirect_irradiance
from server.preview_scene import PreviewScenes
from server.service import Service

# Each point takes SAMPLES paths: some two million in all, five to ten seconds of two cores.
MAX_POINTS = 8192
SAMPLES = 256
SEED = 0
FULL_SCALE = 0.5  # where colours end: errors of 50 % and more
TOO_DARK, RIGHT, TOO_BRIGHT, NO_SURFACE = (33, 82, 176), (245, 245, 245), (178, 34, 34), (70, 70, 70)
LEGEND_HEIGHT = 28


def error_picture(service: Service, camera: Camera, lighting: Lighting, look: Look) -> UInt8:
    """sRGB (height, width, 3) of a camera's view, a legend at its foot. Raises CorruptFileError."""
    coarse = _coarse(camera)
    scene = service.preview_scenes.around(camera.eye, camera.look)
    error = np.full(coarse.height * coarse.width, np.nan)
    if scene.rays is not None:
        surface = scene.rays.first_surface(camera.eye, coarse.rays())
        hit = np.flatnonzero(surface.hit)
        if len(hit):
            position, normal = surface.position[hit], surface.normal[hit]
            light = ServedLight.of(service.engine, lighting, look, camera.eye)
            served = indirect_irradiance(scene.rays, light, look, position, normal) @ LUMINANCE_FROM_RGB
            error[hit] = relative_error(served, _traced(service, camera, lighting, position, normal))
    picture = Image.fromarray(false_colour(error.reshape(coarse.height, coarse.width)))
    return _with_legend(picture.resize((camera.width, camera.height), Image.Resampling.NEAREST), error)


def relative_error(served: Float64, traced: Float64) -> Float64:
    """Signed error (n,) of luminances (n,)."""
    return np.asarray((served - traced) / np.maximum(traced, max(DARKEST_SHARE_OF_MEAN * float(traced.mean()), 1e-12)))


def false_colour(error: Float64) -> UInt8:
    """Colours (..., 3) of errors (...); NaN is no surface."""
    share = np.clip(np.nan_to_num(error) / FULL_SCALE, -1, 1)[..., None]
    end = np.where(share < 0, np.array(TOO_DARK), np.array(TOO_BRIGHT))
    colour = np.array(RIGHT) + (end - np.array(RIGHT)) * np.abs(share)
    return np.where(np.isnan(error)[..., None], np.array(NO_SURFACE), colour + 0.5).astype(np.uint8)


def _coarse(camera: Camera) -> Camera:
    """The camera with as many pixels as may be traced."""
    width = camera.width
    while width > 1 and width * Camera(camera.eye, camera.look, camera.fov_degrees, width).height > MAX_POINTS:
        width -= 1
    return Camera(camera.eye, camera.look, camera.fov_degrees, width)


def _traced(service: Service, camera: Camera, lighting: Lighting, position: Float64, normal: Float32) -> Float64:
    """Path-traced luminance (n,) [lx] on surfaces."""
    from bake_jobs.path_tracer import PathTracer

    tracer = PathTracer(*PreviewScenes.mesh_around(service.dataset, camera.eye, camera.look))
    lamps = lamps_on(service.engine.lamps, lighting)
    found = tracer.surface_irradiance(position, normal.astype(np.float64), lighting, lamps, samples=SAMPLES, seed=SEED)
    return np.asarray(found.mean @ LUMINANCE_FROM_RGB)


def _with_legend(picture: Image.Image, error: Float64) -> UInt8:
    """A scale of the colours, and what the picture comes to."""
    pen, (width, height) = ImageDraw.Draw(picture), picture.size
    top = height - LEGEND_HEIGHT
    pen.rectangle([0, top, width, height], fill=(0, 0, 0))
    bar = min(width // 3, 200)
    scale = false_colour(np.linspace(-FULL_SCALE, FULL_SCALE, bar))
    picture.paste(Image.fromarray(np.repeat(scale[None], 10, axis=0)), (6, top + 3))
    font = ImageFont.load_default()
    for share, text, anchor in ((0.0, f"-{FULL_SCALE:.0%}", "la"), (0.5, "0", "ma"), (1.0, f"+{FULL_SCALE:.0%}", "ra")):
        pen.text((6 + share * bar, top + 14), text, fill=(220, 220, 220), font=font, anchor=anchor)
    known = np.abs(error[~np.isnan(error)])
    if len(known):
        text = f"median {np.median(known):.1%}   p95 {np.quantile(known, 0.95):.0%}   of {len(known)} points"
        pen.text((bar + 18, top + 8), text, fill=(220, 220, 220), font=font)
    return np.asarray(picture)
